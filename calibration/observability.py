"""Does a set of arm poses determine the hand-eye transform? Asked before anything is solved."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from calibration.closed_forms import Mount, mean_rotation
from calibration.words import axis_name
from dataset.errors import CalibrationError
from dataset.transforms import SE3

MIN_POSES = 5
MIN_SPREAD_DEG = 3.0
"""Least rms rotation about the second principal axis (our choice): below it, an arm's noise passes for
motion."""

_SAME_M = 1e-3
_SAME_RAD = np.radians(0.3)


@dataclass(frozen=True, eq=False)
class RotationSpread:
    """How the tool's orientation varied.

    Attributes:
        axes: (3, 3) rows are principal axes of rotation in the tool's frame, largest spread first.
        rms_deg: (3,) root mean square rotation about each, degrees.
        smallest_singular: of the stacked R_i - R_mean over sqrt(N), the matrix that the unknown position is
            solved with: one unit of noise in the arm's position becomes 1 / (this sqrt(N)) in the unknown.
    """

    axes: NDArray[np.float64]
    rms_deg: NDArray[np.float64]
    smallest_singular: float


def rotation_spread(T_base_tcp: SE3) -> RotationSpread:
    """Principal axes of the rotations of N poses about their mean orientation, in the tool's frame."""
    mean = mean_rotation(T_base_tcp.rotation)
    about_mean = SE3(mean.T @ T_base_tcp.rotation, np.zeros_like(T_base_tcp.translation)).as_rotvec()
    about_mean = about_mean - about_mean.mean(axis=0)
    _, singular, axes = np.linalg.svd(about_mean, full_matrices=True)
    rms = np.zeros(3)
    rms[: len(singular)] = np.degrees(singular / np.sqrt(len(about_mean)))
    apart = (T_base_tcp.rotation - T_base_tcp.rotation.mean(axis=0)).reshape(-1, 3)
    smallest = np.linalg.svd(apart, compute_uv=False)[-1] / np.sqrt(len(T_base_tcp))
    return RotationSpread(axes, rms, float(smallest))


def require_observable(T_base_tcp: SE3, mount: Mount = "eye_in_hand") -> RotationSpread:
    """The spread of N tool poses, if it determines a hand-eye transform (two rotation axes that are not
    parallel; Tsai & Lenz 1989).

    Args:
        T_base_tcp: N poses.
        mount: names what stays unknown: the camera on the tool, or the board on it.

    Raises:
        CalibrationError: NaN poses, too few, the same pose repeated, no rotation, or rotation about one axis
            only (the message names the axis along which the camera's position stays unknown).
    """
    carried = "camera" if mount == "eye_in_hand" else "board"
    bad = np.flatnonzero(~T_base_tcp.finite)
    if len(bad):
        raise CalibrationError(
            f"hand-eye: the arm's pose is NaN or infinite in view {', '.join(map(str, bad[:8]))};"
            " drop these views or check the recorded trace"
        )
    if len(T_base_tcp) < MIN_POSES:
        raise CalibrationError(
            f"hand-eye: {len(T_base_tcp)} views show the board; at least {MIN_POSES} are needed, 20-25 are"
            " good"
        )
    distinct = _distinct_poses(T_base_tcp)
    if distinct < MIN_POSES:
        raise CalibrationError(
            f"hand-eye: only {distinct} of {len(T_base_tcp)} arm poses differ by more than 1 mm or 0.3"
            " degrees; the same pose repeated adds nothing: record different poses"
        )
    spread = rotation_spread(T_base_tcp)
    if spread.rms_deg[0] < MIN_SPREAD_DEG:
        raise CalibrationError(
            f"hand-eye: the tool hardly rotated ({spread.rms_deg[0]:.2f} degrees rms), so the {carried}'s"
            " position on it is not observable; rotate the tool by 15-30 degrees about"
            " at least two axes between views"
        )
    if spread.rms_deg[1] < MIN_SPREAD_DEG:
        first, second = spread.axes[0], spread.axes[1]
        raise CalibrationError(
            f"hand-eye: the tool rotated about one axis only ({axis_name(first)}, {spread.rms_deg[0]:.1f}"
            f" degrees rms; {spread.rms_deg[1]:.2f} about {axis_name(second)}), so the {carried}'s position"
            f" along that axis is not observable; add views tilted by 15-30 degrees about {axis_name(second)}"
            " of the tool"
        )
    return spread


def _distinct_poses(poses: SE3) -> int:
    kept: list[int] = []
    for index in range(len(poses)):
        moved = poses[kept].inverse() @ poses[index]
        near = np.linalg.norm(moved.translation, axis=1) < _SAME_M
        if not (near & (np.linalg.norm(moved.as_rotvec(), axis=1) < _SAME_RAD)).any():
            kept.append(index)
    return len(kept)
