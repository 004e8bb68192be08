"""The compiled inner loops of `dataset.polarimetry`: one pass over the mosaic, no intermediate image.

Compiled when first called and cached on disk; they release the GIL. The 2x2 polarizer cell `90 45 / 135 0`
is written out; tests hold the loops against the plain `split_angles` and `Stokes.from_angles`.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import TypeVar, cast

import numba
import numpy as np
from numpy.typing import NDArray

Function = TypeVar("Function", bound=Callable[..., None])


def _compiled(function: Function) -> Function:
    compiled = numba.njit(cache=True, nogil=True, fastmath=False)(function)
    return cast(Function, compiled)


@_compiled
def mono_stokes(
    raw: NDArray[np.uint16],
    scale: np.float32,
    saturated: float,
    dark: np.float32,
    out: NDArray[np.float32],
    valid: NDArray[np.bool_],
) -> None:
    """(2h, 2w) mosaic to (3, h, w) Stokes and (h, w) validity."""
    height, width = valid.shape
    half = np.float32(0.5) * scale
    for y in range(height):
        top, bottom = raw[2 * y], raw[2 * y + 1]
        for x in range(width):
            i90, i45 = np.int32(top[2 * x]), np.int32(top[2 * x + 1])
            i135, i0 = np.int32(bottom[2 * x]), np.int32(bottom[2 * x + 1])
            s0 = half * np.float32(i0 + i45 + i90 + i135)
            out[0, y, x] = s0
            out[1, y, x] = scale * np.float32(i0 - i90)
            out[2, y, x] = scale * np.float32(i45 - i135)
            valid[y, x] = max(max(i0, i45), max(i90, i135)) < saturated and s0 >= dark


@_compiled
def colour_stokes(
    raw: NDArray[np.uint16],
    scale: np.float32,
    saturated: float,
    dark: np.float32,
    out: NDArray[np.float32],
    valid: NDArray[np.bool_],
) -> None:
    """(4h, 4w) mosaic to (3, h, w) Stokes and (h, w) validity; each angle the mean of its Bayer pixels."""
    height, width = valid.shape
    quarter = np.float32(0.25) * scale
    half = np.float32(0.5) * quarter
    for y in range(height):
        for x in range(width):
            i0 = i45 = i90 = i135 = np.int32(0)
            peak = np.int32(0)
            for row in range(4 * y, 4 * y + 4, 2):
                for column in range(4 * x, 4 * x + 4, 2):
                    a, b = np.int32(raw[row, column]), np.int32(raw[row, column + 1])
                    c, d = np.int32(raw[row + 1, column]), np.int32(raw[row + 1, column + 1])
                    i90 += a
                    i45 += b
                    i135 += c
                    i0 += d
                    peak = max(peak, max(max(a, b), max(c, d)))
            s0 = half * np.float32(i0 + i45 + i90 + i135)
            out[0, y, x] = s0
            out[1, y, x] = quarter * np.float32(i0 - i90)
            out[2, y, x] = quarter * np.float32(i45 - i135)
            valid[y, x] = peak < saturated and s0 >= dark


@_compiled
def sample_stokes(
    s0: NDArray[np.float32],
    s1: NDArray[np.float32],
    s2: NDArray[np.float32],
    block: int,
    gains: NDArray[np.float32],
    out: NDArray[np.float32],
) -> None:
    """Stokes images to the intensities (H, W) of a mosaic whose pixels are `block` times finer."""
    height, width = out.shape
    half = np.float32(0.5)
    for y in range(0, height, 2):
        upper, lower = y // block, (y + 1) // block
        for x in range(0, width, 2):
            left, right = x // block, (x + 1) // block
            gain = half * gains[(y // 2) % 2, (x // 2) % 2]
            out[y, x] = gain * (s0[upper, left] - s1[upper, left])
            out[y, x + 1] = gain * (s0[upper, right] + s2[upper, right])
            out[y + 1, x] = gain * (s0[lower, left] - s2[lower, left])
            out[y + 1, x + 1] = gain * (s0[lower, right] + s1[lower, right])
