"""What the compiled kernels share: rotations, the plane of a face, the normal inside it."""

from __future__ import annotations

from typing import Any

import numba
import numpy as np
from numpy.typing import NDArray

Array = NDArray[Any]


@numba.njit(cache=True, inline="always")
def turn(R: Array, x: float, y: float, z: float) -> tuple[float, float, float]:
    return (
        R[0, 0] * x + R[0, 1] * y + R[0, 2] * z,
        R[1, 0] * x + R[1, 1] * y + R[1, 2] * z,
        R[2, 0] * x + R[2, 1] * y + R[2, 2] * z,
    )


@numba.njit(cache=True, inline="always")
def turn_back(R: Array, x: float, y: float, z: float) -> tuple[float, float, float]:
    return (
        R[0, 0] * x + R[1, 0] * y + R[2, 0] * z,
        R[0, 1] * x + R[1, 1] * y + R[2, 1] * z,
        R[0, 2] * x + R[1, 2] * y + R[2, 2] * z,
    )


@numba.njit(cache=True, inline="always")
def add_outer(out: Array, ax: float, ay: float, az: float, bx: float, by: float, bz: float) -> None:
    out[0, 0] += ax * bx
    out[0, 1] += ax * by
    out[0, 2] += ax * bz
    out[1, 0] += ay * bx
    out[1, 1] += ay * by
    out[1, 2] += ay * bz
    out[2, 0] += az * bx
    out[2, 1] += az * by
    out[2, 2] += az * bz


@numba.njit(cache=True, inline="always")
def plane(R: Array, t: Array, row: Array, dx: float, dy: float) -> tuple[float, float, float, float, float]:
    """Numerator and denominator of s, and the face's normal in the camera frame."""
    nx, ny, nz = turn(R, row[3], row[4], row[5])
    numerator = 1.0 * row[3] * row[0] + 1.0 * row[4] * row[1] + 1.0 * row[5] * row[2]
    numerator += nx * t[0] + ny * t[1] + nz * t[2]
    denominator = nx * dx + ny * dy + nz
    if abs(denominator) < 1e-5:
        denominator = -1e-5
    return numerator, denominator, nx, ny, nz


@numba.njit(cache=True, inline="always")
def smooth_normal(row: Array, x: float, y: float, z: float) -> tuple[float, float, float, float]:
    """The interpolated normal at an object point, unit, and the length it had."""
    ox, oy, oz = x - row[0], y - row[1], z - row[2]
    nx = row[6] + row[9] * ox + row[10] * oy + row[11] * oz
    ny = row[7] + row[12] * ox + row[13] * oy + row[14] * oz
    nz = row[8] + row[15] * ox + row[16] * oy + row[17] * oz
    length = max(np.sqrt(nx * nx + ny * ny + nz * nz), 1e-12)
    return nx / length, ny / length, nz / length, length
