"""How wrong a pose is: ADD, ADD-S, rotation, translation, signed depth; and what share of the targets is
right.

ADD (Hinterstoisser et al. 2012) for objects without symmetry, ADD-S (Hodan et al. 2016) for objects with one;
every summary names which. Poses are T_cam_obj, batches of N; distances in metres. A target without an
estimate has an infinite error, so that it counts as failed.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from dataset import SE3
from s2p3.objects import Symmetry

Floats = NDArray[np.float64]


def add(estimated: SE3, true: SE3, points: Floats) -> Floats:
    """(N,) mean distance between the object's points (P, 3) under the two poses, metres."""
    return np.linalg.norm(_placed(estimated, points) - _placed(true, points), axis=-1).mean(axis=-1)


def add_s(estimated: SE3, true: SE3, points: Floats) -> Floats:
    """(N,) mean distance from each point under the true pose to the nearest one under the estimate,
    metres."""
    pairs = zip(_placed(estimated, points), _placed(true, points), strict=True)
    return np.array([cKDTree(found).query(wanted)[0].mean() for found, wanted in pairs], dtype=np.float64)


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


def recall(errors: Floats, threshold: float) -> float:
    """Share of targets with an error below `threshold`, percent; NaN without targets."""
    return float(100 * np.mean(errors < threshold)) if len(errors) else float("nan")


@dataclass(frozen=True)
class Summary:
    """What a list of targets comes to.

    Attributes:
        metric: "ADD" or "ADD-S": what the recalls are of.
        targets, missed: how many there were, and without any estimate.
        recall_10, recall_5: percent of all targets within 10 % and 5 % of the diameter.
        rotation_deg, translation_mm: medians over the targets with an estimate.
        depth_mm: median signed error of z, positive where the estimate is too far.
    """

    metric: str
    targets: int
    missed: int
    recall_10: float
    recall_5: float
    rotation_deg: float
    translation_mm: float
    depth_mm: float

    def __str__(self) -> str:
        return (
            f"{self.metric} recall at 10 % {self.recall_10:.1f}, at 5 % {self.recall_5:.1f} "
            f"({self.targets} targets, {self.missed} missed); medians: rotation {self.rotation_deg:.1f} deg, "
            f"translation {self.translation_mm:.1f} mm, depth {self.depth_mm:+.1f} mm"
        )


def _placed(poses: SE3, points: Floats) -> Floats:
    """(N, P, 3)."""
    placed: Floats = points @ np.swapaxes(poses.rotation, -1, -2) + poses.translation[:, None]
    return placed
