"""The simulated sensor: Stokes images in, a noisy quantized polarization mosaic out."""

from __future__ import annotations

from dataclasses import dataclass, field

import numba
import numpy as np
from numpy.typing import NDArray

from dataset.polarizer_response import PolarizerResponse, nominal_orientation

Image = NDArray[np.float32]

_TABLE_BITS = 21


@dataclass(frozen=True, eq=False)
class Sensor:
    """A Polarsens sensor behind a colour filter array."""

    full_well: float
    """Electrons at the white level."""
    read_noise: float
    """Electrons, standard deviation."""
    response: PolarizerResponse
    """Gain, extinction and orientation of every pixel's polarizer."""
    colour_gains: tuple[float, float, float] = (0.92, 1.0, 0.84)
    noise: Image = field(
        default_factory=lambda: np.random.default_rng(0).standard_normal(1 << _TABLE_BITS, dtype=np.float32),
        repr=False,
    )

    def expose(
        self, stokes: Image, signal: float, bits: int, colour: bool, rng: np.random.Generator
    ) -> NDArray[np.uint16]:
        """Expose one frame.

        Args:
            stokes: (3, h, w) radiance, a vector for each 2x2 cell of the sensor; 1 is a white, well-lit
                surface.
            signal: fraction of the white level that radiance 1 reaches at this exposure and gain.
            bits: of the analogue-to-digital converter.
            colour: True for the 4x4 colour super-pixel, False for the 2x2 monochrome cell.
            rng: chooses where this frame starts in the table of normal deviates.

        Returns:
            (2 h, 2 w) uint16 mosaic in [0, 2**bits - 1].
        """
        out = np.empty(self.response.shape, np.uint16)
        gains = np.array(self.colour_gains if colour else (1.0, 1.0, 1.0), np.float32)
        _expose(
            stokes,
            self.response.analysis,
            np.float32(signal) * gains,
            np.float32(self.full_well),
            np.float32(self.read_noise),
            np.float32((1 << bits) - 1),
            self.noise,
            int(rng.integers(1 << _TABLE_BITS)),
            int(rng.integers(1 << _TABLE_BITS)) | 1,
            out,
        )
        return out


def made_sensor(
    height: int,
    width: int,
    extinction_ratio: tuple[float, float],
    orientation_sigma_rad: float,
    gain_sigma: float,
    rng: np.random.Generator,
) -> PolarizerResponse:
    """What comes out of a fab: extinction ratios spread evenly over a range, orientations and gains normally
    about the nominal ones, pixel by pixel."""
    shape = (height, width)
    low, high = extinction_ratio
    return PolarizerResponse.of(
        1 + gain_sigma * rng.standard_normal(shape, dtype=np.float32),
        low + (high - low) * rng.random(shape, dtype=np.float32),
        nominal_orientation(height, width)
        + orientation_sigma_rad * rng.standard_normal(shape, dtype=np.float32),
    )


@numba.njit(cache=True, fastmath=True, parallel=True)
def _expose(  # pragma: no cover - compiled
    stokes: Image,
    analysis: Image,
    gains: Image,
    full_well: float,
    read_noise: float,
    white: float,
    noise: Image,
    start: int,
    stride: int,
    out: NDArray[np.uint16],
) -> None:
    _, height, width = stokes.shape
    mask = noise.size - 1
    per_electron = 1.0 / full_well
    for i in numba.prange(height):
        # A new start on each row: consecutive frames and rows share no pattern.
        position = (start + i * stride) & mask
        for j in range(width):
            gain = gains[(i & 1) + (j & 1)]
            s0, s1, s2 = gain * stokes[0, i, j], gain * stokes[1, i, j], gain * stokes[2, i, j]
            for a in range(2):
                for b in range(2):
                    vector = analysis[2 * i + a, 2 * j + b]
                    value = max(vector[0] * s0 + vector[1] * s1 + vector[2] * s2, 0.0)
                    position = (position + 1) & mask
                    electrons = value * full_well
                    value += noise[position] * np.sqrt(electrons + read_noise * read_noise) * per_electron
                    out[2 * i + a, 2 * j + b] = np.uint16(min(max(value * white + 0.5, 0.0), white))
