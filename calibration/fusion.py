"""One pose from several estimates of it, each with its covariance."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.stats import chi2

from dataset.errors import CalibrationError
from dataset.transforms import SE3

Floats = NDArray[np.float64]

_STEPS = 10
_IMPLAUSIBLE = 1e-4
"""Probability under which estimates are not of one pose (our choice)."""


@dataclass(frozen=True, eq=False)
class FusedPose:
    """The mean of N poses, weighted by their information.

    Attributes:
        pose: T_base_obj.
        covariance: (6, 6) of the twist in pose @ exp(twist).
        apart_m, apart_rad: (N,) how far the estimates lie from it.
    """

    pose: SE3
    covariance: Floats
    apart_m: Floats
    apart_rad: Floats


def fuse_poses(poses: SE3, covariances: ArrayLike, symmetry_axis: ArrayLike | None = None) -> FusedPose:
    """The pose that N independent estimates agree on best.

    Args:
        poses: N estimates of T_base_obj.
        covariances: (N, 6, 6) of the twists in T_base_obj @ exp(twist).
        symmetry_axis: (3,) of a body of revolution: turns about it carry no information, so the estimates are
            first turned towards the first one.

    Raises:
        CalibrationError: estimates that contradict each other: the object was moved in between.
    """
    variances = np.asarray(covariances, np.float64)
    if symmetry_axis is not None:
        poses = turned_alike(poses, poses[0], symmetry_axis)
    information = np.linalg.inv(variances)
    total = information.sum(axis=0)
    mean = poses[0]
    for _ in range(_STEPS):
        apart = (mean.inverse() @ poses).log()
        mean = mean @ SE3.exp(np.linalg.solve(total, np.einsum("nij,nj->i", information, apart)))
    apart = (mean.inverse() @ poses).log()
    apart_m, apart_rad = np.linalg.norm(apart[:, :3], axis=1), np.linalg.norm(apart[:, 3:], axis=1)
    square = float(np.einsum("ni,nij,nj->", apart, information, apart))
    freedom = 6 * (len(poses) - 1)
    if freedom and chi2.sf(square, freedom) < _IMPLAUSIBLE:
        raise CalibrationError(
            f"object pose: the sessions contradict each other (up to {1e3 * apart_m.max():.1f} mm and"
            f" {np.degrees(apart_rad.max()):.2f} degrees from their mean, far beyond their error bars); the"
            " object was moved in between: touch it again"
        )
    return FusedPose(mean, np.linalg.inv(total), apart_m, apart_rad)


def turned_alike(poses: SE3, reference: SE3, symmetry_axis: ArrayLike) -> SE3:
    """N poses turned about the object's axis so that each is as close to a reference as can be."""
    axis = np.asarray(symmetry_axis, np.float64)
    axis = axis / np.linalg.norm(axis)
    # The twist about the axis of a rotation (swing-twist decomposition of its quaternion).
    quaternion = (poses.inverse() @ reference).as_quaternion()
    angle = 2 * np.arctan2(quaternion[:, :3] @ axis, quaternion[:, 3])
    return poses @ SE3.from_rotvec(angle[:, None] * axis, np.zeros(3))
