"""The differentiable renderer's fast path: one pass over the pixels forward, one backward, on the CPU.

Computes what `differentiable.render_reference` computes, with the derivatives written out by hand. With s d
the point seen along pixel ray d (z = 1), n_f the face's normal, v_0 its first corner, n_0 the normal there:

    s = (n_f . v_0 + (R n_f) . t) / ((R n_f) . d)
    x = R^T (s d - t)
    N = R normalize(n_0 + M (x - v_0))
"""

from __future__ import annotations

from typing import Any

import numba
import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from s2p3.rendering.rasterizer import draw_faces

Array = NDArray[Any]

RIM_PX = 1.5
"""A rim is taken as smooth where it is predicted within so many pixels of the last one seen (our choice)."""


class CpuRender(torch.autograd.Function):
    """(mask, normals, normals_interior, depth, nocs), each (B, C, H, W), from poses; see `RenderOutput`."""

    @staticmethod
    def forward(
        ctx: Any, R: Tensor, t: Tensor, K: Tensor, arrays: MeshArrays, size: tuple[int, int], step: float
    ) -> tuple[Tensor, ...]:
        """`step`: relative jump of depth that makes a silhouette; infinite for no silhouette gradients."""
        pose = (R.detach().contiguous().numpy(), t.detach().contiguous().numpy(), K.contiguous().numpy())
        batch, dtype = len(pose[0]), pose[0].dtype
        face = np.empty((batch, *size), np.int32)
        images = tuple(np.zeros((batch, channels, *size), dtype) for channels in (1, 3, 1, 3))
        draw_batch(*project(arrays[0], *pose), arrays[1], face)
        _forward(*pose, *arrays[2:], face, *images)
        ctx.kernel = (pose, arrays[2:], step, face, images)
        mask, normals, depth, nocs = (torch.from_numpy(image) for image in images)
        return mask, normals, normals.clone(), depth, nocs

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx: Any, *gradients: Tensor) -> tuple[Tensor | None, ...]:
        pose, (table, *box), step, face, images = ctx.kernel
        mask, normals, interior, depth, nocs = (gradient.contiguous().numpy() for gradient in gradients)
        out = (np.zeros_like(pose[0]), np.zeros_like(pose[1]))
        inner = (*pose, table, *box, face, images[2], normals + interior, depth, nocs, *out)
        _backward_interior(*inner)
        if step < np.inf:
            outer = (*pose, *box, step, face, *images, mask, normals, depth, nocs, *out)
            _backward_silhouette(*outer)
        grad_R, grad_t = out
        return torch.from_numpy(grad_R), torch.from_numpy(grad_t), None, None, None, None


MeshArrays = tuple[Array, Array, Array, Array, Array]
"""Vertices (V, 3), faces (F, 3), table (F, 18), lower (3,), extent (3,): `RenderMesh` as arrays."""


def project(vertices: Array, R: Array, t: Array, K: Array) -> tuple[Array, Array]:
    """Vertices (V, 3) under B poses -> float64 pixels (B, V, 2) and depths (B, V); pixels of depth <= 0 mean
    nothing."""
    points = vertices.astype(np.float64) @ R.transpose(0, 2, 1).astype(np.float64) + t[:, None]
    depths = np.ascontiguousarray(points[..., 2])
    plane = points[..., :2] / np.where(depths > 0, depths, 1.0)[..., None]
    return plane * K[:, None, [0, 1], [0, 1]] + K[:, None, :2, 2], depths


@numba.njit(cache=True)
def draw_batch(
    pixels: NDArray[np.float64],
    depths: NDArray[np.float64],
    faces: NDArray[np.int32],
    face_id: NDArray[np.int32],
) -> None:
    """The visible face (B, H, W), -1 where there is none, of one mesh at B poses."""
    inverse_depth = np.empty(face_id.shape[1:], np.float32)
    face_id[:] = -1
    for b in range(face_id.shape[0]):
        inverse_depth[:] = 0.0
        draw_faces(pixels[b], depths[b], faces, face_id[b], inverse_depth)


@numba.njit(cache=True, inline="always")
def _turn(R: Array, x: float, y: float, z: float) -> tuple[float, float, float]:
    return (
        R[0, 0] * x + R[0, 1] * y + R[0, 2] * z,
        R[1, 0] * x + R[1, 1] * y + R[1, 2] * z,
        R[2, 0] * x + R[2, 1] * y + R[2, 2] * z,
    )


@numba.njit(cache=True, inline="always")
def _turn_back(R: Array, x: float, y: float, z: float) -> tuple[float, float, float]:
    return (
        R[0, 0] * x + R[1, 0] * y + R[2, 0] * z,
        R[0, 1] * x + R[1, 1] * y + R[2, 1] * z,
        R[0, 2] * x + R[1, 2] * y + R[2, 2] * z,
    )


@numba.njit(cache=True, inline="always")
def _add_outer(out: Array, ax: float, ay: float, az: float, bx: float, by: float, bz: float) -> None:
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
def _plane(R: Array, t: Array, row: Array, dx: float, dy: float) -> tuple[float, float, float, float, float]:
    """Numerator and denominator of s, and the face's normal in the camera frame."""
    nx, ny, nz = _turn(R, row[3], row[4], row[5])
    numerator = row[3] * row[0] + row[4] * row[1] + row[5] * row[2] + nx * t[0] + ny * t[1] + nz * t[2]
    denominator = nx * dx + ny * dy + nz
    if abs(denominator) < 1e-5:
        denominator = -1e-5
    return numerator, denominator, nx, ny, nz


@numba.njit(cache=True, inline="always")
def _smooth_normal(row: Array, x: float, y: float, z: float) -> tuple[float, float, float, float]:
    """The interpolated normal at an object point, unit, and the length it had."""
    ox, oy, oz = x - row[0], y - row[1], z - row[2]
    nx = row[6] + row[9] * ox + row[10] * oy + row[11] * oz
    ny = row[7] + row[12] * ox + row[13] * oy + row[14] * oz
    nz = row[8] + row[15] * ox + row[16] * oy + row[17] * oz
    length = max(np.sqrt(nx * nx + ny * ny + nz * nz), 1e-12)
    return nx / length, ny / length, nz / length, length


@numba.njit(cache=True, error_model="numpy")
def _forward(
    R: Array,
    t: Array,
    K: Array,
    table: Array,
    lower: Array,
    extent: Array,
    face: NDArray[np.int32],
    mask: Array,
    normals: Array,
    depth: Array,
    nocs: Array,
) -> None:
    batch, height, width = face.shape
    for b in range(batch):
        for i in range(height):
            dy = (i - K[b, 1, 2]) / K[b, 1, 1]
            for j in range(width):
                if face[b, i, j] < 0:
                    continue
                row = table[face[b, i, j]]
                dx = (j - K[b, 0, 2]) / K[b, 0, 0]
                numerator, denominator, _, _, _ = _plane(R[b], t[b], row, dx, dy)
                s = numerator / denominator
                x, y, z = _turn_back(R[b], s * dx - t[b, 0], s * dy - t[b, 1], s - t[b, 2])
                nx, ny, nz, _ = _smooth_normal(row, x, y, z)
                mask[b, 0, i, j] = 1.0
                normals[b, 0, i, j], normals[b, 1, i, j], normals[b, 2, i, j] = _turn(R[b], nx, ny, nz)
                depth[b, 0, i, j] = s
                nocs[b, 0, i, j] = (x - lower[0]) / extent[0]
                nocs[b, 1, i, j] = (y - lower[1]) / extent[1]
                nocs[b, 2, i, j] = (z - lower[2]) / extent[2]


@numba.njit(cache=True, error_model="numpy")
def _backward_interior(
    R: Array,
    t: Array,
    K: Array,
    table: Array,
    lower: Array,
    extent: Array,
    face: NDArray[np.int32],
    depth: Array,
    g_normals: Array,
    g_depth: Array,
    g_nocs: Array,
    grad_R: Array,
    grad_t: Array,
) -> None:
    batch, height, width = face.shape
    for b in range(batch):
        turn, shift = np.zeros((3, 3)), np.zeros(3)
        for i in range(height):
            dy = (i - K[b, 1, 2]) / K[b, 1, 1]
            for j in range(width):
                if face[b, i, j] < 0:
                    continue
                row = table[face[b, i, j]]
                dx = (j - K[b, 0, 2]) / K[b, 0, 0]
                s = depth[b, 0, i, j]
                qx, qy, qz = s * dx - t[b, 0], s * dy - t[b, 1], s - t[b, 2]
                x, y, z = _turn_back(R[b], qx, qy, qz)
                nx, ny, nz, length = _smooth_normal(row, x, y, z)
                # N = R n
                gx, gy, gz = g_normals[b, 0, i, j], g_normals[b, 1, i, j], g_normals[b, 2, i, j]
                _add_outer(turn, gx, gy, gz, nx, ny, nz)
                gx, gy, gz = _turn_back(R[b], gx, gy, gz)
                along = gx * nx + gy * ny + gz * nz
                gx, gy, gz = (
                    (gx - along * nx) / length,
                    (gy - along * ny) / length,
                    (gz - along * nz) / length,
                )
                # n = normalize(n_0 + M (x - v_0)), and NOCS
                px = row[9] * gx + row[12] * gy + row[15] * gz + g_nocs[b, 0, i, j] / extent[0]
                py = row[10] * gx + row[13] * gy + row[16] * gz + g_nocs[b, 1, i, j] / extent[1]
                pz = row[11] * gx + row[14] * gy + row[17] * gz + g_nocs[b, 2, i, j] / extent[2]
                # x = R^T q with q = s d - t
                _add_outer(turn, qx, qy, qz, px, py, pz)
                px, py, pz = _turn(R[b], px, py, pz)
                g_s = g_depth[b, 0, i, j] + px * dx + py * dy + pz
                # s = numerator / denominator
                _, denominator, fx, fy, fz = _plane(R[b], t[b], row, dx, dy)
                g_up, g_down = g_s / denominator, -g_s * s / denominator
                shift[0] += g_up * fx - px
                shift[1] += g_up * fy - py
                shift[2] += g_up * fz - pz
                gx, gy, gz = (
                    g_up * t[b, 0] + g_down * dx,
                    g_up * t[b, 1] + g_down * dy,
                    g_up * t[b, 2] + g_down,
                )
                _add_outer(turn, gx, gy, gz, row[3], row[4], row[5])
        for row_ in range(3):
            grad_t[b, row_] += shift[row_]
            for column in range(3):
                grad_R[b, row_, column] += turn[row_, column]


@numba.njit(cache=True, error_model="numpy")
def _backward_silhouette(
    R: Array,
    t: Array,
    K: Array,
    lower: Array,
    extent: Array,
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
                        continue
                    first_is_front = here < there
                    fi, fj, bi, bj = (i, j, i1, j1) if first_is_front else (i1, j1, i, j)
                    gain = (mask[b, 0, fi, fj] - mask[b, 0, bi, bj]) * (
                        g_mask[b, 0, i, j] + g_mask[b, 0, i1, j1]
                    )
                    gain += (depth[b, 0, fi, fj] - depth[b, 0, bi, bj]) * (
                        g_depth[b, 0, i, j] + g_depth[b, 0, i1, j1]
                    )
                    for c in range(3):
                        gain += (normals[b, c, fi, fj] - normals[b, c, bi, bj]) * (
                            g_normals[b, c, i, j] + g_normals[b, c, i1, j1]
                        )
                        gain += (nocs[b, c, fi, fj] - nocs[b, c, bi, bj]) * (
                            g_nocs[b, c, i, j] + g_nocs[b, c, i1, j1]
                        )
                    gain *= 0.5 if first_is_front else -0.5
                    x = nocs[b, 0, fi, fj] * extent[0] + lower[0]
                    y = nocs[b, 1, fi, fj] * extent[1] + lower[1]
                    z = nocs[b, 2, fi, fj] * extent[2] + lower[2]
                    px, py, pz = _turn(R[b], x, y, z)
                    px, py, pz = px + t[b, 0], py + t[b, 1], pz + t[b, 2]
                    deeper = 1.0 + _depth_of_rim(normals[b], depth[b, 0], K[b], fi, fj, bi, bj, axis, step)
                    px, py, pz = px * deeper, py * deeper, pz * deeper
                    x, y, z = _turn_back(R[b], px - t[b, 0], py - t[b, 1], pz - t[b, 2])
                    inward = gain * K[b, axis, axis] / pz
                    gx = inward if axis == 0 else 0.0
                    gy = inward if axis == 1 else 0.0
                    gz = -inward * (py if axis else px) / pz
                    _add_outer(grad_R[b], gx, gy, gz, x, y, z)
                    grad_t[b, 0] += gx
                    grad_t[b, 1] += gy
                    grad_t[b, 2] += gz


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
