"""How wrong a pose is, and what share of the targets is right.

Errors: ADD (Hinterstoisser et al. 2012) for objects without symmetry; for objects with one ADD-S, their ADI,
named so by Xiang et al. (2018, PoseCNN); MSSD and MSPD of the BOP challenge (Hodan et al. 2020), which take
the symmetries one by one; rotation, translation and signed depth. Poses are T_cam_obj, batches of N;
distances in metres. A target without an estimate has an infinite error, so that it counts as failed.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.spatial import cKDTree

from dataset import SE3
from s2p3.objects import ObjectModel, Symmetry

Floats = NDArray[np.float64]

METRIC_POINTS = 1000
"""Points on the surface over which ADD and ADD-S are averaged."""

SURFACE_POINTS = 50_000
"""Points on the surface to which ADD-S looks for the nearest: so many that this costs 0.3 % of a diameter."""

SYMMETRY_STEPS = 315
"""Turns about a continuous axis that MSSD and MSPD try: as many as the BOP challenge, ceil(pi / 0.01)."""

MSSD_SHARES: Floats = np.arange(1, 11, dtype=np.float64) / 20
"""Of the diameter: the thresholds of the BOP challenge's recall by MSSD."""

MSPD_PIXELS: Floats = np.arange(5, 51, 5, dtype=np.float64)
"""Of an image 640 pixels wide: the thresholds of the BOP challenge's recall by MSPD."""

AUC_LIMIT_M = 0.1
"""Where the area under the recall curve ends, as with YCB-Video (Xiang et al. 2018)."""

_MSPD_WIDTH_PX = 640.0
_SKETCH = 48  # points that bound an error from below before all are looked at


def add(estimated: SE3, true: SE3, points: Floats) -> Floats:
    """(N,) mean distance between the object's points (P, 3) under the two poses, metres."""
    return np.linalg.norm(_placed(estimated, points) - _placed(true, points), axis=-1).mean(axis=-1)


def add_s(estimated: SE3, true: SE3, points: Floats, surface: cKDTree | None = None) -> Floats:
    """(N,) mean distance from each point under the true pose to the nearest one under the estimate, metres.

    Args:
        points: (P, 3) to average over.
        surface: of the points to find the nearest among; without it `points`, as the BOP challenge does with
            a mesh's vertices. Few points lie apart at a symmetric pose, too: a thousand by 2 % of a bottle's
            diameter.
    """
    tree = cKDTree(points) if surface is None else surface
    wanted = _placed(estimated.inverse() @ true, points)
    nearest: Floats = tree.query(wanted.reshape(-1, 3))[0]
    return nearest.reshape(wanted.shape[:2]).mean(axis=1)


def surface_errors(model: ObjectModel) -> dict[str, Callable[[SE3, SE3], Floats]]:
    """ADD and ADD-S of an object, each a function of estimated and true poses."""
    points = model.surface_points(METRIC_POINTS)
    surface = cKDTree(np.concatenate([points, model.surface_points(SURFACE_POINTS)]))
    return {"ADD": partial(add, points=points), "ADD-S": partial(add_s, points=points, surface=surface)}


def metric_name(model: ObjectModel) -> str:
    """Which of its `surface_errors` the object is judged by: ADD-S where it has a symmetry, else ADD."""
    return "ADD-S" if model.symmetry.any else "ADD"


def mssd(estimated: SE3, true: SE3, points: Floats, symmetries: Floats) -> Floats:
    """(N,) maximum symmetry-aware surface distance, metres.

    Args:
        points: (P, 3), in the BOP challenge the mesh's vertices; the largest distance is always at a corner
            of their convex hull.
        symmetries: (M, 4, 4) with the identity, see `Symmetry.sampled`.
    """
    return _smallest_largest(estimated, true, points, symmetries, lambda placed: placed)


def mspd(estimated: SE3, true: SE3, points: Floats, symmetries: Floats, K: Floats) -> Floats:
    """(N,) maximum symmetry-aware projection distance, pixels, of a pinhole with K (3, 3); as `mssd`."""

    def project(placed: Floats) -> Floats:
        seen = placed @ K.T
        projected: Floats = seen[..., :2] / seen[..., 2:]
        return projected

    return _smallest_largest(estimated, true, points, symmetries, project)


def rotation_error_deg(estimated: SE3, true: SE3, symmetry: Symmetry) -> Floats:
    """(N,) angle between the rotations, degrees: the smallest over the object's symmetries.

    The best turn about a continuous axis is taken exactly: it cancels the quaternion's part along that axis.
    """
    discrete = np.concatenate([np.eye(3)[None], symmetry.transforms[:, :3, :3]])
    between = np.einsum("nji,njk,mlk->nmil", true.rotation, estimated.rotation, discrete)
    quaternion = SE3(between, np.zeros((*between.shape[:2], 3))).as_quaternion()
    vector, scalar = quaternion[..., :3], quaternion[..., 3]
    if symmetry.axis is not None:
        along = vector @ symmetry.axis
        vector, scalar = vector - along[..., None] * symmetry.axis, np.hypot(scalar, along)
    angle = 2 * np.arctan2(np.linalg.norm(vector, axis=-1), np.abs(scalar))
    return np.degrees(angle.min(axis=1))


def viewing_direction(T_cam_obj: SE3) -> Floats:
    """(N, 3) unit vectors of the object frame, from the object's origin to the camera."""
    to_camera = T_cam_obj.inverse().translation
    return to_camera / np.linalg.norm(to_camera, axis=-1, keepdims=True)


def view_distance_deg(directions: Floats, known: Floats, symmetry: Symmetry) -> Floats:
    """(N,) angle on the sphere of views from each of `directions` (N, 3) to the nearest of `known` (M, 3),
    degrees; views that a symmetry makes alike count as the same."""
    turned = np.concatenate([known, *(known @ turn[:3, :3].T for turn in symmetry.transforms)])
    if symmetry.axis is None:
        return np.degrees(np.arccos(np.clip(directions @ turned.T, -1, 1).max(axis=1)))
    from_axis, known_from_axis = (np.arccos(np.clip(d @ symmetry.axis, -1, 1)) for d in (directions, turned))
    nearest: Floats = np.abs(from_axis[:, None] - known_from_axis).min(axis=1)
    return np.degrees(nearest)


def recall(errors: ArrayLike, threshold: float) -> float:
    """Share of targets with an error below `threshold`, percent; NaN without targets."""
    return float(recall_curve(errors, [threshold])[0])


def recall_curve(errors: ArrayLike, thresholds: ArrayLike) -> Floats:
    """(T,) `recall` at each of the thresholds (T,)."""
    errors = np.asarray(errors, dtype=np.float64)
    if not len(errors):
        return np.full(len(np.atleast_1d(thresholds)), np.nan)
    percent: Floats = 100 * (errors[None] < np.asarray(thresholds)[:, None]).mean(axis=1)
    return percent


def area_shares(errors: ArrayLike, limit: float = AUC_LIMIT_M) -> Floats:
    """(N,) what each target adds to the area under the recall curve up to `limit`, percent: the area is their
    mean, and exact (no curve is sampled)."""
    shares: Floats = 100 * np.clip(1 - np.asarray(errors, dtype=np.float64) / limit, 0, 1)
    return shares


def average_recalls(errors: ArrayLike, thresholds: ArrayLike) -> Floats:
    """(N,) percent of the thresholds that each error stays below; their mean is the BOP challenge's AR."""
    percent: Floats = 100 * (np.asarray(errors)[:, None] < np.asarray(thresholds)[None]).mean(axis=1)
    return percent


def mspd_thresholds_px(width: int) -> Floats:
    """(10,) the BOP challenge's thresholds of MSPD in an image `width` pixels wide."""
    thresholds: Floats = MSPD_PIXELS * np.float64(width / _MSPD_WIDTH_PX)
    return thresholds


def _placed(poses: SE3, points: Floats) -> Floats:
    """(N, P, 3)."""
    placed: Floats = points @ np.swapaxes(poses.rotation, -1, -2) + poses.translation[:, None]
    return placed


def _smallest_largest(
    estimated: SE3, true: SE3, points: Floats, symmetries: Floats, seen: Callable[[Floats], Floats]
) -> Floats:
    """(N,) the smallest over the symmetries of the largest distance over the points.

    The distance of some points bounds that of all from below, which spares most symmetries the rest.
    """
    sketch = points[:: -(-len(points) // _SKETCH)]
    turns = SE3.from_matrix(symmetries)
    found = np.empty(len(estimated.translation))
    for index in range(len(found)):
        alike = true[index] @ turns
        pose = SE3.stack([estimated[index]])
        bounds = np.linalg.norm(seen(_placed(alike, sketch)) - seen(_placed(pose, sketch)), axis=-1).max(
            axis=1
        )
        whole, best = seen(_placed(pose, points))[0], np.inf
        for turn in np.argsort(bounds):
            if bounds[turn] >= best:
                break
            placed = seen(_placed(SE3.stack([alike[int(turn)]]), points))[0]
            best = min(best, float(np.linalg.norm(placed - whole, axis=-1).max()))
        found[index] = best
    return found
