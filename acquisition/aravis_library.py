"""The one place that loads Aravis, the GigE Vision library, through GObject introspection."""

from __future__ import annotations

from typing import Any

from dataset.errors import DeviceError

_INSTALL = (
    "install it with: apt-get install gir1.2-aravis-0.8 libgirepository1.0-dev libcairo2-dev pkg-config gcc "
    "&& pip install 's2p3[aravis]'"
)


def load_aravis() -> Any:
    """The `Aravis` introspection module.

    Raises DeviceError naming the packages to install when PyGObject or the typelib is missing.
    """
    try:
        import gi
    except ImportError as error:
        raise DeviceError(
            f"PyGObject is not installed, so no GigE Vision camera can be used; {_INSTALL}"
        ) from error
    try:
        gi.require_version("Aravis", "0.8")
        from gi.repository import Aravis
    except (ImportError, ValueError) as error:
        raise DeviceError(f"the Aravis 0.8 typelib is not installed ({error}); {_INSTALL}") from error
    return Aravis
