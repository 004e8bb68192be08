"""Which GigE Vision cameras are in sight: for whoever does not know an address yet.

A driver opens a camera by the address alone. What is found here is shown, never opened: on a computer with
several networks a camera may be seen by way of a card through which its frames do not arrive.
"""

from __future__ import annotations

from dataclasses import dataclass

from acquisition.aravis_library import load_aravis


@dataclass(frozen=True)
class FoundCamera:
    """A camera that answered a call to all: where it is, and what it says it is."""

    address: str
    vendor: str
    model: str
    serial: str


def find_cameras() -> list[FoundCamera]:
    """Calls on every network of this computer, and waits a second for answers; sorted by address.

    Raises DeviceError naming the packages to install when Aravis is missing.
    """
    aravis = load_aravis().module
    aravis.update_device_list()
    found = [
        FoundCamera(
            address=aravis.get_device_address(index),
            vendor=aravis.get_device_vendor(index),
            model=aravis.get_device_model(index),
            serial=aravis.get_device_serial_nbr(index),
        )
        for index in range(aravis.get_n_devices())
        if aravis.get_device_protocol(index) == "GigEVision"
    ]
    return sorted(found, key=lambda camera: camera.address)
