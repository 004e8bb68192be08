"""Training sets: rendered polarization images with exact poses, masks and boxes."""
