"""Camera drivers; import the one that is needed."""
