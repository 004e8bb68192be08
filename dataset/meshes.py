"""Reading a mesh file into arrays."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from dataset.errors import ToolkitError


def read_mesh(path: Path, scale: float) -> tuple[NDArray[np.float64], NDArray[np.int32]]:
    """Vertices (V, 3), multiplied by `scale`, and triangles (F, 3) of a PLY, OBJ or STL file.

    Raises:
        ToolkitError: missing, unreadable or without faces.
    """
    import trimesh

    if not path.is_file():
        raise ToolkitError(f"{path} is missing; check that the folder is complete")
    try:
        mesh = trimesh.load_mesh(path, process=False)
    except Exception as error:  # trimesh's readers raise whatever a malformed file provokes
        raise ToolkitError(f"{path}: cannot be read as a mesh ({error}); give a PLY, OBJ or STL") from error
    if not isinstance(mesh, trimesh.Trimesh) or len(mesh.faces) == 0:
        raise ToolkitError(f"{path}: holds no faces; export a triangle mesh")
    return np.asarray(mesh.vertices, np.float64) * scale, np.asarray(mesh.faces, np.int32)


def widest(vertices: NDArray[np.float64]) -> float:
    """The largest distance between two of the points (V, 3): the diameter."""
    from scipy.spatial import ConvexHull
    from scipy.spatial.distance import pdist

    points = vertices
    if np.ptp(points, axis=0).min() > 0 and len(points) > 4:
        points = points[ConvexHull(points).vertices]
    return float(pdist(points).max())
