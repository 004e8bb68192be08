"""The console: a page in the browser with the live camera, the arm, and a recorder. It moves nothing."""

from acquisition.console.page import serve_console
from acquisition.console.station import Station

__all__ = ["Station", "serve_console"]
