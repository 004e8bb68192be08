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

from s2p3.rendering.boundary_kernels import backward_boundaries
from s2p3.rendering.kernel_algebra import Array, add_outer, plane, smooth_normal, turn, turn_back
from s2p3.rendering.rasterizer import draw_faces


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
        draw_batch(arrays[0], *pose, arrays[1], face)
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
            outer = (*pose, table, step, face, *images, mask, normals, depth, nocs, *out)
            backward_boundaries(*outer)
        grad_R, grad_t = out
        return torch.from_numpy(grad_R), torch.from_numpy(grad_t), None, None, None, None


MeshArrays = tuple[Array, Array, Array, Array, Array]
"""Vertices (V, 3), faces (F, 3), table (F, 18), lower (3,), extent (3,): `RenderMesh` as arrays."""


@numba.njit(cache=True, error_model="numpy")
def draw_batch(
    vertices: Array, R: Array, t: Array, K: Array, faces: NDArray[np.int32], face_id: NDArray[np.int32]
) -> None:
    """The visible face (B, H, W), -1 where there is none, of one mesh (V, 3), (F, 3) at B poses."""
    pixels, depths = np.empty((len(vertices), 2)), np.empty(len(vertices))
    inverse_depth = np.empty(face_id.shape[1:], np.float32)
    face_id[:] = -1
    for b in range(face_id.shape[0]):
        rotation, shift, camera = R[b].astype(np.float64), t[b].astype(np.float64), K[b].astype(np.float64)
        for v in range(len(vertices)):
            x, y, z = turn(rotation, vertices[v, 0], vertices[v, 1], vertices[v, 2])
            z += shift[2]
            depths[v] = z
            scale = 1.0 / z if z > 0 else 1.0  # behind the camera, the pixel means nothing
            pixels[v, 0] = camera[0, 0] * (x + shift[0]) * scale + camera[0, 2]
            pixels[v, 1] = camera[1, 1] * (y + shift[1]) * scale + camera[1, 2]
        inverse_depth[:] = 0.0
        draw_faces(pixels, depths, faces, face_id[b], inverse_depth)


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
                numerator, denominator, _, _, _ = plane(R[b], t[b], row, dx, dy)
                s = numerator / denominator
                x, y, z = turn_back(R[b], s * dx - t[b, 0], s * dy - t[b, 1], s - t[b, 2])
                nx, ny, nz, _ = smooth_normal(row, x, y, z)
                mask[b, 0, i, j] = 1.0
                normals[b, 0, i, j], normals[b, 1, i, j], normals[b, 2, i, j] = turn(R[b], nx, ny, nz)
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
        g_R, g_t = np.zeros((3, 3)), np.zeros(3)
        for i in range(height):
            dy = (i - K[b, 1, 2]) / K[b, 1, 1]
            for j in range(width):
                if face[b, i, j] < 0:
                    continue
                row = table[face[b, i, j]]
                dx = (j - K[b, 0, 2]) / K[b, 0, 0]
                s = depth[b, 0, i, j]
                qx, qy, qz = s * dx - t[b, 0], s * dy - t[b, 1], s - t[b, 2]
                x, y, z = turn_back(R[b], qx, qy, qz)
                nx, ny, nz, length = smooth_normal(row, x, y, z)
                # N = R n
                gx, gy, gz = g_normals[b, 0, i, j], g_normals[b, 1, i, j], g_normals[b, 2, i, j]
                add_outer(g_R, gx, gy, gz, nx, ny, nz)
                gx, gy, gz = turn_back(R[b], gx, gy, gz)
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
                add_outer(g_R, qx, qy, qz, px, py, pz)
                px, py, pz = turn(R[b], px, py, pz)
                g_s = g_depth[b, 0, i, j] + px * dx + py * dy + pz
                # s = numerator / denominator
                _, denominator, fx, fy, fz = plane(R[b], t[b], row, dx, dy)
                g_up, g_down = g_s / denominator, -g_s * s / denominator
                g_t[0] += g_up * fx - px
                g_t[1] += g_up * fy - py
                g_t[2] += g_up * fz - pz
                gx, gy, gz = (
                    g_up * t[b, 0] + g_down * dx,
                    g_up * t[b, 1] + g_down * dy,
                    g_up * t[b, 2] + g_down,
                )
                add_outer(g_R, gx, gy, gz, row[3], row[4], row[5])
        for row_ in range(3):
            grad_t[b, row_] += g_t[row_]
            for column in range(3):
                grad_R[b, row_, column] += g_R[row_, column]
