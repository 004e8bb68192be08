"""The one place that loads Aravis, the GigE Vision library, through GObject introspection."""

from __future__ import annotations

from typing import Any, NamedTuple

from dataset.errors import DeviceError

_INSTALL = (
    "install it with: apt-get install gir1.2-aravis-0.8 libgirepository1.0-dev libcairo2-dev pkg-config gcc "
    "&& pip install 's2p3[aravis]'"
)


class AravisLibrary(NamedTuple):
    """The introspected module, and what its calls raise."""

    module: Any
    error: type[Exception]


def load_aravis() -> AravisLibrary:
    """Loads Aravis 0.8.

    Raises DeviceError naming the packages to install when PyGObject or the typelib is missing.
    """
    try:
        import gi
    except ImportError as error:
        raise DeviceError(f"PyGObject, which GigE Vision cameras need, is missing; {_INSTALL}") from error
    try:
        gi.require_version("Aravis", "0.8")
        from gi.repository import Aravis, GLib
    except (ImportError, ValueError) as error:
        raise DeviceError(f"the Aravis 0.8 typelib is missing ({error}); {_INSTALL}") from error
    return AravisLibrary(Aravis, GLib.Error)
