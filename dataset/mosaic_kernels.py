"""The compiled inner loops of `dataset.polarimetry`: one pass over the mosaic, no intermediate image.

Compiled when first called and cached on disk; they release the GIL. The 2x2 polarizer cell `90 45 / 135 0`
is written out; tests hold the loops against the plain `split_angles` and a matrix of least squares.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, TypeVar, cast

import numba
import numpy as np
from numpy.typing import NDArray

Function = TypeVar("Function", bound=Callable[..., None])


def _compiled(function: Function) -> Function:
    compiled = numba.njit(cache=True, nogil=True, fastmath=False)(function)
    return cast(Function, compiled)


@_compiled
def mono_stokes(
    raw: NDArray[Any],
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
    words: NDArray[Any],
    scale: np.float32,
    saturated: float,
    dark: np.float32,
    out: NDArray[np.float32],
    valid: NDArray[np.bool_],
) -> None:
    """(4h, w) words to (3, h, w) Stokes and (h, w) validity; each angle the mean of its Bayer pixels.

    A word is the four pixels of a super-pixel's row, the first in the lowest bits. Pixels of one polarizer
    lie in every other quarter of it: two are added, or held against the limit, in one step.
    """
    word = words.dtype.type
    bits, twice = word(2 * words.itemsize), word(4 * words.itemsize)  # of one pixel, of two
    carry = word(word(1) << bits)
    quarters = word(word(carry - word(1)) * word(word(1) | word(word(1) << twice)))
    low = word(word(word(1) << twice) - word(1))
    limit = min(np.int64(np.ceil(saturated)), np.int64(carry))
    to_carry = word(word(carry - word(limit)) * word(word(1) | word(word(1) << twice)))
    carry = word(carry | word(carry << twice))
    height, width = valid.shape
    quarter = np.float32(0.25) * scale
    half = np.float32(0.5) * quarter
    for y in range(height):
        top, upper, lower, bottom = words[4 * y], words[4 * y + 1], words[4 * y + 2], words[4 * y + 3]
        for x in range(width):
            a90, a45 = word(top[x] & quarters), word(word(top[x] >> bits) & quarters)
            b90, b45 = word(lower[x] & quarters), word(word(lower[x] >> bits) & quarters)
            a135, a0 = word(upper[x] & quarters), word(word(upper[x] >> bits) & quarters)
            b135, b0 = word(bottom[x] & quarters), word(word(bottom[x] >> bits) & quarters)
            full = word(a90 + to_carry) | word(a45 + to_carry) | word(b90 + to_carry) | word(b45 + to_carry)
            full |= word(a135 + to_carry) | word(a0 + to_carry) | word(b135 + to_carry) | word(b0 + to_carry)
            i90, i45, i135, i0 = word(a90 + b90), word(a45 + b45), word(a135 + b135), word(a0 + b0)
            i90 = np.int32(word(word(i90 & low) + word(i90 >> twice)))
            i45 = np.int32(word(word(i45 & low) + word(i45 >> twice)))
            i135 = np.int32(word(word(i135 & low) + word(i135 >> twice)))
            i0 = np.int32(word(word(i0 & low) + word(i0 >> twice)))
            s0 = half * np.float32(i0 + i45 + i90 + i135)
            out[0, y, x] = s0
            out[1, y, x] = quarter * np.float32(i0 - i90)
            out[2, y, x] = quarter * np.float32(i45 - i135)
            valid[y, x] = (word(full & carry) == 0) & (s0 >= dark)


@_compiled
def angle_stokes(intensities: NDArray[np.float32], top: int, out: NDArray[np.float32]) -> None:
    """Rows `top` to `top + h` of (4, H, w) angle images to (3, h, w) Stokes."""
    half = np.float32(0.5)
    for y in range(out.shape[1]):
        i0, i45 = intensities[0, top + y], intensities[1, top + y]
        i90, i135 = intensities[2, top + y], intensities[3, top + y]
        for x in range(out.shape[2]):
            out[0, y, x] = half * (i0[x] + i45[x] + i90[x] + i135[x])
            out[1, y, x] = i0[x] - i90[x]
            out[2, y, x] = i45[x] - i135[x]


@_compiled
def calibrated_stokes(
    raw: NDArray[Any],
    demodulation: NDArray[np.float32],
    cells: int,
    scale: np.float32,
    saturated: float,
    dark: np.float32,
    out: NDArray[np.float32],
    valid: NDArray[np.bool_],
) -> None:
    """Mosaic to (3, h, w) Stokes and (h, w) validity, each pixel the mean of cells x cells demodulated 2x2
    cells."""
    height, width = valid.shape
    mean = scale / np.float32(cells * cells)
    for y in range(height):
        for x in range(width):
            s0 = s1 = s2 = np.float32(0)
            usable = True
            for row in range(cells * y, cells * y + cells):
                top, bottom = raw[2 * row], raw[2 * row + 1]
                for column in range(cells * x, cells * x + cells):
                    a, b = np.float32(top[2 * column]), np.float32(top[2 * column + 1])
                    c, d = np.float32(bottom[2 * column]), np.float32(bottom[2 * column + 1])
                    m = demodulation[row, column]
                    s0 += m[0, 0] * a + m[0, 1] * b + m[0, 2] * c + m[0, 3] * d
                    s1 += m[1, 0] * a + m[1, 1] * b + m[1, 2] * c + m[1, 3] * d
                    s2 += m[2, 0] * a + m[2, 1] * b + m[2, 2] * c + m[2, 3] * d
                    determined = m[0, 0] + m[0, 1] + m[0, 2] + m[0, 3] > 0
                    usable = usable and determined and max(max(a, b), max(c, d)) < saturated
            out[0, y, x], out[1, y, x], out[2, y, x] = mean * s0, mean * s1, mean * s2
            valid[y, x] = usable and mean * s0 >= dark


@_compiled
def demodulation_of(analysis: NDArray[np.float32], out: NDArray[np.float32]) -> None:
    """(2h, 2w, 3) analysis vectors to the pseudo-inverse (h, w, 3, 4) of each 2x2 cell's; zero where that is
    ill-conditioned."""
    height, width = out.shape[:2]
    vectors = np.empty((4, 3), np.float64)
    adjoint = np.empty((3, 3), np.float64)
    n = np.empty((3, 3), np.float64)
    for y in range(height):
        for x in range(width):
            for k in range(4):
                for i in range(3):
                    vectors[k, i] = analysis[2 * y + k // 2, 2 * x + k % 2, i]
            for i in range(3):
                for j in range(3):
                    n[i, j] = 0.0
                    for k in range(4):
                        n[i, j] += vectors[k, i] * vectors[k, j]
            for i in range(3):
                for j in range(3):
                    p, q, r, s = (i + 1) % 3, (i + 2) % 3, (j + 1) % 3, (j + 2) % 3
                    adjoint[i, j] = n[p, r] * n[q, s] - n[p, s] * n[q, r]
            determinant = n[0, 0] * adjoint[0, 0] + n[0, 1] * adjoint[0, 1] + n[0, 2] * adjoint[0, 2]
            # The ideal cell has determinant 1/4 for a trace of 2; a hundredth of that no longer carries.
            carries = determinant > 3e-4 * (n[0, 0] + n[1, 1] + n[2, 2]) ** 3
            for i in range(3):
                for k in range(4):
                    value = 0.0
                    if carries:
                        for j in range(3):
                            value += adjoint[i, j] * vectors[k, j]
                        value /= determinant
                    out[y, x, i, k] = np.float32(value)


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
