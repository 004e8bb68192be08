"""The sensor that synthetic frames are read from: mosaic, shot noise, read noise, quantization."""

from __future__ import annotations

from functools import lru_cache

import numba
import numpy as np
from numpy.typing import NDArray

from dataset.polarimetry import Stokes, sample_mosaic, white_level
from s2p3.synthesis.scene import SceneParameters

Image = NDArray[np.float32]

_NOISE_COUNT = 1 << 22
"""Of deviates at least; twice as many as an image has pixels, where that is more."""


def expose(
    stokes: Stokes, parameters: SceneParameters, bits: int, rng: np.random.Generator
) -> NDArray[np.uint16]:
    """A raw mosaic (2h, 2w) uint16 of a monochrome polarization sensor: shot and read noise, quantization."""
    intensity = sample_mosaic(stokes, "mono")
    noise = _noise(max(_NOISE_COUNT, 1 << (2 * intensity.size - 1).bit_length()))
    start = int(rng.integers(len(noise) - intensity.size))
    out = np.empty(intensity.shape, np.uint16)
    _read_out(
        intensity.ravel(),
        noise[start : start + intensity.size],
        np.float32(parameters.full_well),
        np.float32(parameters.read_noise**2),
        np.float32(white_level(bits)),
        out.ravel(),
    )
    return out


@lru_cache(maxsize=1)
def _noise(count: int) -> Image:
    """A long row of normal deviates; each frame reads it from another place: cheaper than drawing."""
    return np.random.default_rng(0).standard_normal(count, dtype=np.float32)


@numba.njit(cache=True)
def _read_out(
    intensity: Image,
    noise: Image,
    full_well: float,
    read_variance: float,
    white: float,
    out: NDArray[np.uint16],
) -> None:
    for i in range(intensity.size):
        electrons = max(intensity[i], np.float32(0)) * full_well
        electrons += noise[i] * np.sqrt(electrons + read_variance)
        out[i] = np.uint16(min(max(electrons / full_well * white + np.float32(0.5), np.float32(0)), white))
