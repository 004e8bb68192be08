"""The simulated sensor: Stokes images in, a noisy quantized polarization mosaic out."""

from __future__ import annotations

from dataclasses import dataclass, field

import numba
import numpy as np
from numpy.typing import NDArray

Image = NDArray[np.float32]

_TABLE_BITS = 21
_COS_2A = np.array([[-1.0, 0.0], [0.0, 1.0]], np.float32)
_SIN_2A = np.array([[0.0, 1.0], [-1.0, 0.0]], np.float32)
"""cos 2a and sin 2a of the polarizer cell 90 45 / 135 0."""


@dataclass(frozen=True)
class Sensor:
    """A Polarsens sensor behind a colour filter array."""

    full_well: float
    """Electrons at the white level."""
    read_noise: float
    """Electrons, standard deviation."""
    polarization_efficiency: float
    """Factor on the degree of polarization: wire-grid polarizers leak."""
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
            stokes: (3, h, w) radiance; 1 is a white, well-lit surface.
            signal: fraction of the white level that radiance 1 reaches at this exposure and gain.
            bits: of the analogue-to-digital converter.
            colour: True for the 4x4 colour super-pixel, False for the 2x2 monochrome cell.
            rng: chooses where this frame starts in the table of normal deviates.

        Returns:
            (2 h, 2 w) uint16 mosaic in [0, 2**bits - 1].
        """
        height, width = stokes.shape[1:]
        out = np.empty((2 * height, 2 * width), np.uint16)
        gains = np.array(self.colour_gains if colour else (1.0, 1.0, 1.0), np.float32)
        _expose(
            stokes,
            np.float32(signal),
            np.float32(self.polarization_efficiency),
            gains,
            np.float32(self.full_well),
            np.float32(self.read_noise),
            np.float32((1 << bits) - 1),
            self.noise,
            int(rng.integers(1 << _TABLE_BITS)),
            int(rng.integers(1 << _TABLE_BITS)) | 1,
            out,
        )
        return out


@numba.njit(cache=True, fastmath=True, parallel=True)
def _expose(  # pragma: no cover - compiled
    stokes: Image,
    signal: float,
    efficiency: float,
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
            channel = (i & 1) + (j & 1)
            amplitude = 0.5 * signal * gains[channel]
            s0 = stokes[0, i, j] * amplitude
            s1 = stokes[1, i, j] * amplitude * efficiency
            s2 = stokes[2, i, j] * amplitude * efficiency
            for a in range(2):
                for b in range(2):
                    value = max(s0 + s1 * _COS_2A[a, b] + s2 * _SIN_2A[a, b], 0.0)
                    position = (position + 1) & mask
                    electrons = value * full_well
                    value += noise[position] * np.sqrt(electrons + read_noise * read_noise) * per_electron
                    out[2 * i + a, 2 * j + b] = np.uint16(min(max(value * white + 0.5, 0.0), white))
