"""Looking into a session: frame by frame in the browser, or as pictures and a film in a folder."""

from s2p3.viewer.page import serve_viewer
from s2p3.viewer.save import save_pictures

__all__ = ["save_pictures", "serve_viewer"]
