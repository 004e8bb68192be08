"""Where the tip of a tool is, from poses of the arm in which the tip stays on one fixed point.

R_i t + p_i = c for every pose: linear in the tip t (tool frame) and the point c (base frame), solved for all
pairs at once; see Yaniv, "Which pivot calibration?", SPIE Medical Imaging 2015 ("algebraic one step").
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from calibration.words import axis_name
from dataset.errors import CalibrationError
from dataset.transforms import SE3

Floats = NDArray[np.float64]

MIN_POSES = 6
_MIN_CONE_RAD = np.radians(8.0)
"""Rms by which every direction of the tool must have swung (our choice): below, millimetres of the tip hide
behind tenths of the arm's."""
_SUBSETS = 300
_SUBSET = 4
_SLIPPED = 3.5
_SLIP_FLOOR_M = 3e-4
"""A tip that hops by less is taken for the arm's noise (our choice)."""
_MAX_RMS_M = 2e-3
_NOISE_FLOOR_M = 2e-5
_MOST_SLIPPED = 0.4
_SEED = 0  # of the draws: the same poses give the same tip again


@dataclass(frozen=True, eq=False)
class ToolTipResult:
    """What N poses about one point say.

    Attributes:
        tip_in_tcp: (3,) the tip in the tool's frame, metres.
        covariance: (3, 3).
        point_in_base: (3,) the fixed point.
        rms_m: root mean square distance of the tip from the point, over the poses used.
        distance_m: (N,) of every pose.
        used: (N,) False where the tip had slipped.
        swing_deg: (3,) rms by which the tool's directions swung, along its principal axes, smallest first:
            the smallest says how well the tip is determined along `weak_axis`.
        weak_axis: (3,) that direction in the tool's frame.
    """

    tip_in_tcp: Floats
    covariance: Floats
    point_in_base: Floats
    rms_m: float
    distance_m: Floats
    used: NDArray[np.bool_]
    swing_deg: Floats
    weak_axis: Floats

    @property
    def sigma_m(self) -> float:
        """Standard deviation of the tip (root sum of squares of the axes), metres."""
        return float(np.sqrt(np.trace(self.covariance)))


def calibrate_tool_tip(T_base_tcp: SE3) -> ToolTipResult:
    """The tip from N poses of the arm about one fixed point.

    The poses in which the tip slipped are found by consensus and left out, named by `used`.

    Args:
        T_base_tcp: N poses.

    Raises:
        CalibrationError: fewer than 6 poses, NaN, a tool that was not tilted enough (the message says about
            which axis), or poses that share no fixed point.
    """
    _check(T_base_tcp)
    rotation, translation = T_base_tcp.rotation, T_base_tcp.translation
    require_swing(rotation)
    used = _consensus(rotation, translation)
    swing, axes = require_swing(rotation[used])
    tip, point, normal = _solve(rotation[used], translation[used])
    distance = np.linalg.norm(rotation @ tip + translation - point, axis=1)
    rms = float(np.sqrt(np.mean(distance[used] ** 2)))
    # Three equations a pose, six unknowns; the noise of one coordinate.
    freedom = 3 * int(used.sum()) - 6
    noise = max(float(np.sqrt(np.sum(distance[used] ** 2) / freedom)), _NOISE_FLOOR_M)
    return ToolTipResult(
        tip_in_tcp=tip,
        covariance=np.asarray(noise**2 * np.linalg.inv(normal)[:3, :3], np.float64),
        point_in_base=point,
        rms_m=rms,
        distance_m=distance,
        used=used,
        swing_deg=np.degrees(swing),
        weak_axis=axes[:, 0],
    )


def require_swing(rotation: Floats) -> tuple[Floats, Floats]:
    """How far each direction of the tool swung, rms radians (3,), smallest first, and those directions as
    columns (3, 3) of the tool's frame.

    Raises:
        CalibrationError: one direction hardly swung; where the tip is along it cannot be told.
    """
    apart = rotation - rotation.mean(axis=0)
    values, axes = np.linalg.eigh(np.mean(np.swapaxes(apart, 1, 2) @ apart, axis=0))
    swing = np.arcsin(np.sqrt(np.clip(values, 0, 1)))
    if swing[1] < _MIN_CONE_RAD:
        raise CalibrationError(
            f"tool tip: the tool hardly turned ({np.degrees(swing[2]):.1f} degrees rms); keep the tip on its"
            " point and tilt the tool by 20-30 degrees to all sides"
        )
    if swing[0] < _MIN_CONE_RAD:
        raise CalibrationError(
            f"tool tip: the tool's {axis_name(axes[:, 0])} axis swung by {np.degrees(swing[0]):.1f} degrees"
            f" only, so the tip along it stays unknown; tilt that axis by 20-30 degrees, to all sides"
        )
    return swing, axes


def _check(poses: SE3) -> None:
    if poses.batch == () or len(poses) < MIN_POSES:
        count = 1 if poses.batch == () else len(poses)
        raise CalibrationError(
            f"tool tip: {count} poses; at least {MIN_POSES} are needed, 12-20 tilted to all sides are good"
        )
    if not poses.finite.all():
        bad = int(np.flatnonzero(~poses.finite)[0])
        raise CalibrationError(f"tool tip: pose {bad} is NaN or infinite; drop it or record again")


def _solve(rotation: Floats, translation: Floats) -> tuple[Floats, Floats, Floats]:
    """Tip, point, and the normal matrix (6, 6)."""
    A = np.concatenate([rotation, -np.broadcast_to(np.eye(3), rotation.shape)], axis=2).reshape(-1, 6)
    normal = A.T @ A
    solution = np.linalg.solve(normal, A.T @ -translation.ravel())
    return solution[:3], solution[3:], normal


def _consensus(rotation: Floats, translation: Floats) -> NDArray[np.bool_]:
    """The poses that share a point: least median of squares over drawn subsets (Rousseeuw 1984), then all
    within reach of it, twice."""
    rng = np.random.default_rng(_SEED)
    count = len(rotation)
    best, distance = np.inf, np.zeros(count)
    for _ in range(_SUBSETS):
        chosen = rng.choice(count, _SUBSET, replace=False)
        try:
            tip, point, _ = _solve(rotation[chosen], translation[chosen])
        except np.linalg.LinAlgError:
            continue
        apart = np.linalg.norm(rotation @ tip + translation - point, axis=1)
        if np.median(apart) < best:
            best, distance = float(np.median(apart)), apart
    used = np.ones(count, bool)
    for _ in range(2):
        # 1.54 sigma is the median length of a 3-D normal deviate.
        used = distance < max(_SLIPPED * float(np.median(distance)) / 1.54 * np.sqrt(3), _SLIP_FLOOR_M)
        if used.sum() < MIN_POSES:
            break
        tip, point, _ = _solve(rotation[used], translation[used])
        distance = np.linalg.norm(rotation @ tip + translation - point, axis=1)
    rms = float(np.sqrt(np.mean(distance[used] ** 2))) if used.any() else np.inf
    if used.sum() < max(MIN_POSES, (1 - _MOST_SLIPPED) * count) or rms > _MAX_RMS_M:
        raise CalibrationError(
            f"tool tip: the poses share no point (half of them are farther than {1e3 * best:.1f} mm from the"
            " best one); keep the tip in a punched hole while tilting: `s2p3 capture tool-tip` records that"
        )
    return used
