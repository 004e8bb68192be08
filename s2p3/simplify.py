"""Fewer faces for rendering, with a bound on how far the surface moved."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dataset import ToolkitError
from s2p3.objects import ObjectModel

_FEWEST_FACES = 200
_STEPS = 12  # of the bisection between the fewest faces and all of them
_SAMPLES = 50_000


@dataclass(frozen=True, eq=False)
class Simplified:
    """An object with fewer faces.

    Attributes:
        model: still watertight; diameter and everything else are the original's.
        error_m: largest distance found between the two surfaces, either way: from every vertex and from
            points spread over the faces.
    """

    model: ObjectModel
    error_m: float


def simplify(model: ObjectModel, largest_error_m: float) -> Simplified:
    """As few faces as keep both surfaces within a distance of each other.

    Quadric edge collapse (Garland and Heckbert, SIGGRAPH 1997) in Open3D; the number of faces is bisected and
    the distance measured each time.

    Args:
        largest_error_m: metres; half a pixel at the nearest view is a good measure.

    Raises:
        ToolkitError: Open3D is missing, or the bound is not positive.
    """
    if not largest_error_m > 0:
        raise ToolkitError(
            f"{model.name}: an error of {largest_error_m:g} m allows nothing; give a positive one"
        )
    open3d = _open3d()
    original = open3d.geometry.TriangleMesh(
        open3d.utility.Vector3dVector(model.vertices), open3d.utility.Vector3iVector(model.faces)
    )
    best = Simplified(model, 0.0)
    low, high = _FEWEST_FACES, len(model.faces)
    for _ in range(_STEPS):
        if high - low <= max(10, high // 50):
            break
        count = int(np.sqrt(low * high))
        candidate = original.simplify_quadric_decimation(count)
        fewer = replace(
            model,
            vertices=np.asarray(candidate.vertices, np.float64),
            faces=np.asarray(candidate.triangles, np.int32),
        )
        error = distance_between(model, fewer)
        if error <= largest_error_m and candidate.is_edge_manifold(allow_boundary_edges=False):
            best, high = Simplified(fewer, error), count
        else:
            low = count
    return best


def distance_between(one: ObjectModel, other: ObjectModel) -> float:
    """The largest distance from the vertices and sampled points of either surface to the other, metres.

    Raises:
        ToolkitError: Open3D is missing.
    """
    return max(_farthest(one, other), _farthest(other, one))


def _farthest(source: ObjectModel, target: ObjectModel) -> float:
    open3d = _open3d()
    scene = open3d.t.geometry.RaycastingScene(nthreads=1)
    scene.add_triangles(
        open3d.core.Tensor(target.vertices.astype(np.float32)),
        open3d.core.Tensor(target.faces.astype(np.uint32)),
    )
    corners = source.vertices[np.unique(source.faces)]
    points = np.concatenate([corners, source.surface_points(_SAMPLES)]).astype(np.float32)
    distances: NDArray[np.float32] = scene.compute_distance(open3d.core.Tensor(points)).numpy()
    return float(distances.max())


def _open3d() -> Any:
    try:
        import open3d
    except ImportError as error:
        raise ToolkitError(
            f"simplifying a mesh needs Open3D ({error}); pip install 's2p3[objects]'"
        ) from error
    return open3d
