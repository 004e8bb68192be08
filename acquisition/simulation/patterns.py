"""Where the simulated camera's frames come from: the protocol of a source, and a test pattern that moves."""

from __future__ import annotations

from functools import lru_cache
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from dataset.frames import Mosaic
from dataset.pixel_formats import pixel_format
from dataset.polarimetry import Stokes, encode

Pixels = NDArray[np.uint8] | NDArray[np.uint16]


class FrameSource(Protocol):
    """Makes what the sensor sees.

    A source may also have `command(line: str) -> str`: it is given the command lines that the simulator does
    not know itself, from another thread than the one that asks for frames.
    """

    def frame(
        self,
        pixel_format: str,
        height: int,
        width: int,
        exposure_us: float,
        gain_db: float,
        time_ns: int,
    ) -> Pixels:
        """The whole sensor's raw mosaic, (H, W) uint8 or uint16, unpacked.

        `time_ns` is the host's monotonic clock at the start of the exposure.
        """


class MovingPattern:
    """Rings of polarization at all angles under a brightness ramp, gliding to the left.

    A pure function of its arguments, so that whoever knows an exposure's time knows its frame bit for bit.
    """

    def __init__(self, speed_px_s: float = 200.0, exposure_us: float = 10_000.0) -> None:
        """`speed_px_s` in mosaic pixels; at `exposure_us` and 0 dB the brightest spot nearly saturates."""
        self.speed_px_s = speed_px_s
        self.exposure_us = exposure_us

    def frame(
        self,
        pixel_format: str,
        height: int,
        width: int,
        exposure_us: float,
        gain_db: float,
        time_ns: int,
    ) -> Pixels:
        """See `FrameSource`."""
        brightness = exposure_us / self.exposure_us * 10.0 ** (gain_db / 20.0)
        plate = _plate(pixel_format, height, width, brightness)
        travelled = (
            int(time_ns * self.speed_px_s / 1e9) // 4 * 4
        )  # whole super-pixels keep the mosaic in step
        start = travelled % width // 4 * 4
        return plate[:, start : start + width]


@lru_cache(maxsize=2)
def _plate(format_name: str, height: int, width: int, brightness: float) -> Pixels:
    """The pattern twice side by side, so that every window of `width` is one slice."""
    format_ = pixel_format(format_name)
    y, x = np.mgrid[0 : height // 2, 0 : width // 2].astype(np.float32)
    centre_y, centre_x = height / 4, width / 4
    dy, dx = centre_y - y, x - centre_x
    radius = np.hypot(dx, dy)
    aolp = np.arctan2(dy, dx) / 2
    dolp = 0.4 * (1 + np.cos(radius / (height + width) * 60)) / 2
    s0 = brightness * (0.45 + 0.9 * np.cos((x / (width // 2) - 0.5) * np.pi) ** 2)
    stokes = Stokes(
        s0.astype(np.float32),
        (s0 * dolp * np.cos(2 * aolp)).astype(np.float32),
        (s0 * dolp * np.sin(2 * aolp)).astype(np.float32),
        np.ones(s0.shape, bool),
    )
    layout: Mosaic = "colour" if format_.colour else "mono"
    mosaic = encode(stokes, layout, format_.bits, shape=(height, width))
    return np.concatenate([mosaic, mosaic], axis=1)
