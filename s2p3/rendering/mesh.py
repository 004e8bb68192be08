"""A triangle mesh prepared for rendering: smooth normals that stop at creases, and its NOCS box."""

from __future__ import annotations

from dataclasses import dataclass

import numba
import numpy as np
from numpy.typing import ArrayLike, NDArray

CREASE_DEG = 40.0
"""Faces that meet at a larger angle keep a visible edge between them (our choice)."""


@dataclass(frozen=True, eq=False)
class Mesh:
    """Immutable render mesh.

    Attributes:
        vertices: (V, 3) float32, metres, object frame.
        faces: (F, 3) int32, counter-clockwise seen from outside.
        corner_normals: (F, 3, 3) float32, unit, one per corner of each face.
        lower, extent: (3,) float32, corner and edge lengths of the axis-aligned box that NOCS spans.
    """

    vertices: NDArray[np.float32]
    faces: NDArray[np.int32]
    corner_normals: NDArray[np.float32]
    lower: NDArray[np.float32]
    extent: NDArray[np.float32]

    @staticmethod
    def from_arrays(vertices: ArrayLike, faces: ArrayLike, crease_deg: float = CREASE_DEG) -> Mesh:
        """Prepare vertices (V, 3) and faces (F, 3); faces within `crease_deg` of each other blend."""
        points = np.ascontiguousarray(vertices, dtype=np.float64)
        triangles = np.ascontiguousarray(faces, dtype=np.int32)
        lower, upper = points.min(axis=0), points.max(axis=0)
        return Mesh(
            points.astype(np.float32),
            triangles,
            _corner_normals(points, triangles, float(np.cos(np.radians(crease_deg)))),
            lower.astype(np.float32),
            np.maximum(upper - lower, 1e-9).astype(np.float32),
        )


def _corner_normals(
    vertices: NDArray[np.float64], faces: NDArray[np.int32], min_cosine: float
) -> NDArray[np.float32]:
    corners = vertices[faces]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-30)
    edges = np.roll(corners, -1, axis=1) - corners
    edges /= np.maximum(np.linalg.norm(edges, axis=2, keepdims=True), 1e-30)
    angles = np.arccos(np.clip(-(edges * np.roll(edges, 1, axis=1)).sum(axis=2), -1.0, 1.0))
    order = np.argsort(faces.ravel(), kind="stable")
    starts = np.searchsorted(faces.ravel()[order], np.arange(len(vertices) + 1))
    return _gather_smooth(faces, normals, angles, order, starts, min_cosine)


@numba.njit(cache=True)
def _gather_smooth(
    faces: NDArray[np.int32],
    normals: NDArray[np.float64],
    angles: NDArray[np.float64],
    order: NDArray[np.int64],
    starts: NDArray[np.int64],
    min_cosine: float,
) -> NDArray[np.float32]:
    """Per corner: the angle-weighted mean of the vertex's face normals on this side of a crease."""
    out = np.empty((faces.shape[0], 3, 3), np.float32)
    for face in range(faces.shape[0]):
        nx, ny, nz = normals[face]
        for corner in range(3):
            vertex = faces[face, corner]
            sx = sy = sz = 0.0
            for k in range(starts[vertex], starts[vertex + 1]):
                other, at = order[k] // 3, order[k] % 3
                ox, oy, oz = normals[other]
                if nx * ox + ny * oy + nz * oz >= min_cosine:
                    weight = angles[other, at]
                    sx += weight * ox
                    sy += weight * oy
                    sz += weight * oz
            length = np.sqrt(sx * sx + sy * sy + sz * sz)
            if length < 1e-12:
                sx, sy, sz, length = nx, ny, nz, 1.0
            out[face, corner, 0] = sx / length
            out[face, corner, 1] = sy / length
            out[face, corner, 2] = sz / length
    return out
