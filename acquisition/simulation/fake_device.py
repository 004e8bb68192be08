"""Aravis' fake GigE Vision device, serving our GenICam description and frames made by a callback.

Through introspection `set_fill_pattern` frees its closure on return, so ctypes installs the callback. The
device fills a buffer, then sends it: all of that, and the control protocol, happen in its one thread.
"""

from __future__ import annotations

import ctypes
import errno
import os
import socket
import sys
import time
import traceback
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from acquisition.aravis_library import load_aravis
from dataset.errors import DeviceError
from dataset.pixel_formats import PixelFormat, pixel_format

GENICAM_XML = Path(__file__).with_name("genicam.xml")
GVCP_PORT = 3956

# Fixed by the fake device.
_SENSOR_WIDTH, _SENSOR_HEIGHT, _WIDTH, _HEIGHT = 0x11C, 0x118, 0x100, 0x104
_PIXEL_FORMAT, _PERIOD_US, _TRIGGER_MODE, _PACKET_SIZE = 0x128, 0x138, 0x300, 0xD04
_STRINGS = {"vendor": (0x48, 32), "model": (0x68, 32), "version": (0x88, 32), "info": (0xA8, 48)}
# A client writes 1 to start and 0 to stop; to the device everything but 0 means on.
_ACQUISITION, _STARTED, _IN_STEP = 0x124, 1, 2
# Ours, as genicam.xml has them.
_EXPOSURE_AUTO, _BALANCE_WHITE_AUTO, _AUTO_CONTINUOUS = 0xA000, 0xA018, 2
_PTP_ENABLE, _PTP_MASTER, _GAMMA_ENABLE, _EXPOSURE_AUTO_STUCK = 0xA00C, 0xA020, 0xA014, 0xA01C
_PAYLOAD_PADDING = 0xA024

# The device answers nobody while it waits for its beat.
_LONGEST_WAIT_US = 250_000

_FILL = ctypes.CFUNCTYPE(
    None, ctypes.c_void_p, ctypes.c_void_p, ctypes.c_uint32, ctypes.c_uint32, ctypes.c_uint32
)


@dataclass(frozen=True)
class Exposure:
    """What the device asks of the callback: one frame, its region of interest and its settings.

    Attributes:
        format: to send.
        x, y, width, height: of the region, the sensor's pixels.
        exposure_us, gain_db: as a client set them.
        synchronized: whether the camera's clock follows an IEEE 1588 master.
    """

    format: PixelFormat
    x: int
    y: int
    width: int
    height: int
    exposure_us: float
    gain_db: float
    synchronized: bool = False


# Writes the packed frame into the array of its bytes, and returns the camera's timestamp in nanoseconds.
Fill = Callable[[Exposure, NDArray[np.uint8]], int]


class FakeDevice:
    """A GigE Vision device on `address`, UDP port 3956, until `close`."""

    def __init__(
        self,
        address: str,
        fill: Fill,
        *,
        serial: str,
        model: str,
        width: int,
        height: int,
        format_: PixelFormat,
        frame_rate: float,
        packet_size: int,
        trigger_poll_hz: float,
        lost_ratio: float,
    ) -> None:
        """Serves at once.

        Raises DeviceError when the address is not this machine's or its port is taken.
        """
        _check_port(address)
        aravis = load_aravis().module
        self._library = _load_library()
        self._gv = aravis.GvFakeCamera.new_full(address, serial, str(GENICAM_XML))
        if not self._gv.is_running():
            # Aravis wants an address that a card bears; 127.0.0.2 can be bound to without one that does.
            raise DeviceError(
                f"the simulated camera cannot listen on {address}, which no network card has; add it with: "
                f"ip addr add {address}/8 dev lo"
            )
        self._camera = self._gv.get_fake_camera()
        self._pointer = _pointer_of(self._camera)
        self.set_lost_ratio(lost_ratio)
        for register, value in (
            (_SENSOR_WIDTH, width),
            (_SENSOR_HEIGHT, height),
            (_WIDTH, width),
            (_HEIGHT, height),
            (_PIXEL_FORMAT, format_.code),
            (_PERIOD_US, round(1e6 / frame_rate)),
            (_PACKET_SIZE, packet_size),
            # As cameras come out of the box: a client has to lock them.
            (_EXPOSURE_AUTO, _AUTO_CONTINUOUS),
            (_BALANCE_WHITE_AUTO, _AUTO_CONTINUOUS),
            (_GAMMA_ENABLE, 1),
        ):
            self._camera.write_register(register, value)
        texts = {"vendor": "Lucid Vision Labs", "model": model, "version": "1.0", "info": "S2P3 simulation"}
        for name, text in texts.items():
            offset, length = _STRINGS[name]
            self._library.arv_fake_camera_write_memory(
                self._pointer, offset, length, text.encode().ljust(length, b"\0")
            )
        self._library.arv_fake_camera_set_trigger_frequency(self._pointer, trigger_poll_hz)
        self._fill = fill
        # Kept: the device calls it as long as it lives.
        self._callback = _FILL(self._on_fill)
        self._library.arv_fake_camera_set_fill_pattern(self._pointer, self._callback, None)

    def set_lost_ratio(self, ratio: float) -> None:
        """Loses this fraction (0 to 1) of the stream's packets."""
        if not 0.0 <= ratio <= 1.0:
            raise ValueError(f"the ratio of lost packets is {ratio}; it must be between 0 and 1")
        self._gv.set_property("gvsp-lost-ratio", ratio)

    def set_ptp_master(self, present: bool) -> None:
        """Whether the network has a master clock that the camera can follow."""
        self._camera.write_register(_PTP_MASTER, int(present))

    def stick_exposure_auto(self, stuck: bool) -> None:
        """Whether automatic exposure stays on, whatever a client writes."""
        self._camera.write_register(_EXPOSURE_AUTO_STUCK, int(stuck))

    def pad_payload(self, size: int) -> None:
        """Announces frames larger than they are by so many bytes."""
        self._camera.write_register(_PAYLOAD_PADDING, size)

    def close(self) -> None:
        """Ends the device's thread and frees its port."""
        self._camera = None
        self._gv = None

    def _synchronized(self) -> bool:
        return all(self._camera.read_register(register)[1] for register in (_PTP_ENABLE, _PTP_MASTER))

    def _fall_into_step(self) -> None:
        """Delays the first frame of an acquisition to the device's beat.

        Running free, the device sends at whole multiples of the period on the wall clock, but the first frame
        at once; a camera's frames are equally spaced from the first on.
        """
        _, acquisition = self._camera.read_register(_ACQUISITION)
        if acquisition != _STARTED:
            return
        self._camera.write_register(_ACQUISITION, _IN_STEP)
        _, period_us = self._camera.read_register(_PERIOD_US)
        _, triggered = self._camera.read_register(_TRIGGER_MODE)
        if not triggered and period_us <= _LONGEST_WAIT_US:
            time.sleep((period_us - time.time_ns() // 1000 % period_us) * 1e-6)

    def _on_fill(self, buffer: int, user: int | None, exposure_us: int, gain: int, code: int) -> None:
        try:
            library = self._library
            format_ = pixel_format(code)
            exposure = Exposure(
                format=format_,
                x=format_.cell * library.arv_buffer_get_image_x(buffer),
                y=format_.cell * library.arv_buffer_get_image_y(buffer),
                width=format_.cell * library.arv_buffer_get_image_width(buffer),
                height=format_.cell * library.arv_buffer_get_image_height(buffer),
                exposure_us=float(exposure_us),
                gain_db=gain / 10.0,
                synchronized=self._synchronized(),
            )
            self._fall_into_step()
            # The size that Aravis could report is that of received data, none here.
            size = exposure.format.size(exposure.height, exposure.width)
            memory = (ctypes.c_uint8 * size).from_address(library.arv_buffer_get_data(buffer, None))
            timestamp_ns = self._fill(exposure, np.ctypeslib.as_array(memory))
            # The device stamped the buffer before it asked for the filling, with the host's clock.
            library.arv_buffer_set_timestamp(buffer, timestamp_ns)
        except BaseException:
            # No exception can pass through C, and a camera must not go on sending what it did not see.
            traceback.print_exc()
            sys.stderr.flush()
            os._exit(1)


def _check_port(address: str) -> None:
    """The fake device claims to run even when it could not bind its port."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        try:
            probe.bind((address, GVCP_PORT))
        except OSError as error:
            if error.errno == errno.EADDRINUSE:
                reason = "another camera is simulated there: stop it, or use another address"
            else:
                reason = f"add it with: ip addr add {address}/8 dev lo"
            raise DeviceError(
                f"the simulated camera cannot bind UDP {address}:{GVCP_PORT} ({error.strerror}); {reason}"
            ) from error


def _load_library() -> Any:
    library = ctypes.CDLL("libaravis-0.8.so.0")
    pointer, uint = ctypes.c_void_p, ctypes.c_uint32
    for name, result, arguments in (
        ("arv_fake_camera_set_fill_pattern", None, [pointer, _FILL, pointer]),
        ("arv_fake_camera_set_trigger_frequency", None, [pointer, ctypes.c_double]),
        ("arv_fake_camera_write_memory", ctypes.c_int, [pointer, uint, uint, ctypes.c_char_p]),
        ("arv_buffer_get_data", pointer, [pointer, ctypes.POINTER(ctypes.c_size_t)]),
        ("arv_buffer_set_timestamp", None, [pointer, ctypes.c_uint64]),
        ("arv_buffer_get_image_width", ctypes.c_int, [pointer]),
        ("arv_buffer_get_image_height", ctypes.c_int, [pointer]),
        ("arv_buffer_get_image_x", ctypes.c_int, [pointer]),
        ("arv_buffer_get_image_y", ctypes.c_int, [pointer]),
    ):
        function = getattr(library, name)
        function.restype, function.argtypes = result, arguments
    return library


def _pointer_of(object_: Any) -> int:
    """Address of the C object behind an introspected one."""
    get_pointer = ctypes.pythonapi.PyCapsule_GetPointer
    get_pointer.restype, get_pointer.argtypes = ctypes.c_void_p, [ctypes.py_object, ctypes.c_char_p]
    return int(get_pointer(object_.__gpointer__, None))
