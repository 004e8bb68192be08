"""Gradients of the boundaries between what neighbouring pixels see: silhouettes and creases.

A boundary that moves by s along an image axis, from one pixel towards the next, changes the image by
s * (first - second), shared by the two. How it moves with the pose follows from a point X of the object on
it, with g = dL/ds, along the rows:

    dL/dX_cam = g f / z (1, 0, -x / z)
    dL/dR += dL/dX_cam X^T,   dL/dt += dL/dX_cam
"""

from __future__ import annotations

import numba
import numpy as np
from numpy.typing import NDArray

from s2p3.rendering.kernel_algebra import Array, add_outer, plane, smooth_normal, turn, turn_back

RIM_PX = 1.5
"""A rim is taken as smooth where it is predicted within so many pixels of the last one seen (our choice)."""

CREASE_COSINE = 0.94
"""Neighbouring pixels whose normals differ by more (20 deg) are looked at for a crease (our choice)."""


@numba.njit(cache=True, error_model="numpy")
def backward_boundaries(
    R: Array,
    t: Array,
    K: Array,
    table: Array,
    step: float,
    face: NDArray[np.int32],
    mask: Array,
    normals: Array,
    depth: Array,
    nocs: Array,
    g_mask: Array,
    g_normals: Array,
    g_depth: Array,
    g_nocs: Array,
    grad_R: Array,
    grad_t: Array,
) -> None:
    """Add to the gradients of the pose, (B, 3, 3) and (B, 3), what the boundaries contribute.

    Images are (B, C, H, W); `step` is the relative jump of depth that makes a silhouette.
    """
    batch, height, width = face.shape
    for b in range(batch):
        for i in range(height):
            for j in range(width):
                for axis in range(2):
                    i1, j1 = i + axis, j + 1 - axis
                    if i1 >= height or j1 >= width or (face[b, i, j] < 0 and face[b, i1, j1] < 0):
                        continue
                    here = depth[b, 0, i, j] if face[b, i, j] >= 0 else np.inf
                    there = depth[b, 0, i1, j1] if face[b, i1, j1] >= 0 else np.inf
                    if max(here, there) <= min(here, there) * (1 + step):
                        cosine = normals[b, 0, i, j] * normals[b, 0, i1, j1]
                        cosine += normals[b, 1, i, j] * normals[b, 1, i1, j1]
                        cosine += normals[b, 2, i, j] * normals[b, 2, i1, j1]
                        if cosine > CREASE_COSINE:
                            continue
                        first, second = table[face[b, i, j]], table[face[b, i1, j1]]
                        at, z, nx, ny, nz = _crease(R[b], t[b], K[b], first, second, i, j, axis)
                        if not min(here, there) <= z * (1 + step) or not z <= max(here, there) * (1 + step):
                            continue
                        gain = nx * (g_normals[b, 0, i, j] + g_normals[b, 0, i1, j1])
                        gain += ny * (g_normals[b, 1, i, j] + g_normals[b, 1, i1, j1])
                        gain += nz * (g_normals[b, 2, i, j] + g_normals[b, 2, i1, j1])
                    else:
                        first_is_front = here < there
                        fi, fj, bi, bj = (i, j, i1, j1) if first_is_front else (i1, j1, i, j)
                        # the outline lies, on average, half way to the pixel behind
                        at, z = 0.5, depth[b, 0, fi, fj]
                        z *= 1.0 + _depth_of_rim(normals[b], depth[b, 0], K[b], fi, fj, bi, bj, axis, step)
                        gain = (mask[b, 0, i, j] - mask[b, 0, i1, j1]) * (
                            g_mask[b, 0, i, j] + g_mask[b, 0, i1, j1]
                        )
                        gain += (depth[b, 0, i, j] - depth[b, 0, i1, j1]) * (
                            g_depth[b, 0, i, j] + g_depth[b, 0, i1, j1]
                        )
                        for c in range(3):
                            gain += (normals[b, c, i, j] - normals[b, c, i1, j1]) * (
                                g_normals[b, c, i, j] + g_normals[b, c, i1, j1]
                            )
                            gain += (nocs[b, c, i, j] - nocs[b, c, i1, j1]) * (
                                g_nocs[b, c, i, j] + g_nocs[b, c, i1, j1]
                            )
                    if gain == 0.0:
                        continue
                    px = z * (j + at * (j1 - j) - K[b, 0, 2]) / K[b, 0, 0]
                    py = z * (i + at * (i1 - i) - K[b, 1, 2]) / K[b, 1, 1]
                    x, y, w = turn_back(R[b], px - t[b, 0], py - t[b, 1], z - t[b, 2])
                    gain *= 0.5 * K[b, axis, axis] / z
                    gx = gain if axis == 0 else 0.0
                    gy = gain if axis == 1 else 0.0
                    gz = -gain * (py if axis else px) / z
                    add_outer(grad_R[b], gx, gy, gz, x, y, w)
                    grad_t[b, 0] += gx
                    grad_t[b, 1] += gy
                    grad_t[b, 2] += gz


@numba.njit(cache=True, error_model="numpy")
def _crease(
    R: Array,
    t: Array,
    K: Array,
    first: Array,
    second: Array,
    i: int,
    j: int,
    axis: int,
) -> tuple[float, float, float, float, float]:
    """Where between a pixel and the next along an axis the surface folds: how far along (0 to 1), its depth,
    and the jump of the normal there.

    `first` and `second` are the table's rows of the two faces. The fold is where their planes meet, if that
    is between the pixels, else half way, on the nearer plane: a small step of depth. The jump is that of the
    normals interpolated on either side, which on a smooth surface agree.
    """
    dx, dy = (j - K[0, 2]) / K[0, 0], (i - K[1, 2]) / K[1, 1]
    ex, ey = (j + 1 - axis - K[0, 2]) / K[0, 0], (i + axis - K[1, 2]) / K[1, 1]
    up, down0, _, _, _ = plane(R, t, first, dx, dy)
    _, down1, _, _, _ = plane(R, t, first, ex, ey)
    other_up, other_down0, _, _, _ = plane(R, t, second, dx, dy)
    _, other_down1, _, _, _ = plane(R, t, second, ex, ey)
    before = down0 / up - other_down0 / other_up  # difference of 1 / z at either pixel
    after = down1 / up - other_down1 / other_up
    at = 0.5
    if before * after < 0.0:
        at = before / (before - after)
    elif before + after < 0.0:
        up, down0, down1 = other_up, other_down0, other_down1
    z = up / (down0 + at * (down1 - down0))
    dx, dy = dx + at * (ex - dx), dy + at * (ey - dy)
    x, y, w = turn_back(R, z * dx - t[0], z * dy - t[1], z - t[2])
    ax, ay, az, _ = smooth_normal(first, x, y, w)
    bx, by, bz, _ = smooth_normal(second, x, y, w)
    nx, ny, nz = turn(R, ax - bx, ay - by, az - bz)
    return at, z, nx, ny, nz


@numba.njit(cache=True, error_model="numpy")
def _depth_of_rim(
    normals: Array, depth: Array, K: Array, fi: int, fj: int, bi: int, bj: int, axis: int, step: float
) -> float:
    """How much deeper than the front pixel, as a fraction, a smooth rim lies; 0 at a sharp edge.

    A rounded outline lies a little behind the last pixel that shows it, and turns with the object
    differently. Across a smooth rim cos^2 of the incidence falls linearly to zero: extrapolated from the next
    pixel inside, it tells how far away the rim is, and with cos itself how deep.
    """
    ii, jj = 2 * fi - bi, 2 * fj - bj
    if ii < 0 or jj < 0 or ii >= depth.shape[0] or jj >= depth.shape[1] or depth[ii, jj] <= 0.0:
        return 0.0
    z = depth[fi, fj]
    if abs(depth[ii, jj] - z) > step * z:
        return 0.0
    cosine, across, scale = _inclination(normals, K, fi, fj, axis)
    inner, _, _ = _inclination(normals, K, ii, jj, axis)
    if cosine <= 0.02 or cosine > 0.7 or inner <= cosine:
        return 0.0
    pixels = cosine * cosine / (inner * inner - cosine * cosine)
    if pixels > RIM_PX:
        return 0.0
    share = abs(across) / np.sqrt(1.0 - cosine * cosine)  # of the rim's direction along this axis
    return 2.0 * min(pixels, 1.0) * share / (K[axis, axis] * cosine * scale)


@numba.njit(cache=True, inline="always")
def _inclination(normals: Array, K: Array, i: int, j: int, axis: int) -> tuple[float, float, float]:
    """Of a pixel's normal: the cosine with the viewer, the part across the ray along an image axis; |ray|."""
    dx, dy = (j - K[0, 2]) / K[0, 0], (i - K[1, 2]) / K[1, 1]
    scale = np.sqrt(dx * dx + dy * dy + 1.0)
    cosine = -(normals[0, i, j] * dx + normals[1, i, j] * dy + normals[2, i, j]) / scale
    return cosine, normals[axis, i, j] + cosine * (dy if axis else dx) / scale, scale
