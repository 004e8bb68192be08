"""A frame source for the console's tests: a bright square that stands where the arm's base joint points."""

from __future__ import annotations

import threading

import numpy as np

from acquisition.robots.rtde import RtdeReader
from acquisition.simulation.patterns import Pixels
from dataset.errors import DeviceError
from dataset.pixel_formats import pixel_format
from dataset.polarimetry import Stokes, encode


class ArmPattern:
    """Follows the arm at `host`; a radian of its base joint moves the square by half the image's width."""

    def __init__(self, host: str) -> None:
        self._host = host
        self._angle = 0.0
        threading.Thread(target=self._follow, daemon=True).start()

    def frame(
        self, pixel_format_: str, height: int, width: int, exposure_us: float, gain_db: float, time_ns: int
    ) -> Pixels:
        """See `FrameSource`: noiseless, and the same as long as the arm stands still."""
        brightness = exposure_us / 10_000.0 * 10 ** (gain_db / 20)
        s0 = np.full((height // 4, width // 4), 0.3 * brightness, np.float32)
        centre = round(width // 8 + width / 8 * np.sin(self._angle))
        s0[height // 10 : height // 5, max(0, centre - 8) : centre + 8] = 1.2 * brightness
        stokes = Stokes(s0, 0.5 * s0, np.zeros_like(s0), np.ones(s0.shape, bool))
        layout = pixel_format(pixel_format_)
        return encode(stokes, "colour", layout.bits, shape=(height, width))

    def _follow(self) -> None:
        while True:
            try:
                with RtdeReader(self._host, ("actual_q",), 25) as reader:
                    while True:
                        for package in reader.packages():
                            self._angle = float(np.frombuffer(package, reader.dtype)[0]["actual_q"][0])
            except DeviceError:
                pass  # the arm is not there yet, or no more
