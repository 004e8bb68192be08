"""Mesh files, and how large a mesh is."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike, NDArray

from dataset.errors import ToolkitError

if TYPE_CHECKING:
    import trimesh


def read_mesh(path: Path, scale: float) -> tuple[NDArray[np.float64], NDArray[np.int32]]:
    """Vertices (V, 3), multiplied by `scale`, and triangles (F, 3) of a file.

    Raises:
        ToolkitError: as `load_mesh`.
    """
    mesh = load_mesh(path)
    return np.asarray(mesh.vertices, np.float64) * scale, np.asarray(mesh.faces, np.int32)


def load_mesh(path: Path, hint: str = "check that the folder is complete") -> trimesh.Trimesh:
    """A PLY, OBJ or STL file, its vertices as they are.

    Args:
        hint: what to do where the file is missing.

    Raises:
        ToolkitError: missing, unreadable or without faces.
    """
    import trimesh

    if not path.is_file():
        raise ToolkitError(f"{path}: no such mesh file; {hint}")
    try:
        mesh = trimesh.load_mesh(path, process=False)
    except Exception as error:  # trimesh's readers raise whatever a malformed file provokes
        raise ToolkitError(f"{path}: cannot be read as a mesh ({error}); give a PLY, OBJ or STL") from error
    if not isinstance(mesh, trimesh.Trimesh) or len(mesh.faces) == 0:
        raise ToolkitError(f"{path}: holds no faces; export a triangle mesh")
    return mesh


def diameter(vertices: ArrayLike) -> float:
    """The largest distance between two of the points (V, 3), in their unit."""
    from scipy.spatial import ConvexHull
    from scipy.spatial.distance import pdist

    points = np.asarray(vertices, dtype=np.float64)
    if np.ptp(points, axis=0).min() > 0 and len(points) > 4:
        points = points[ConvexHull(points).vertices]
    return float(pdist(points).max())
