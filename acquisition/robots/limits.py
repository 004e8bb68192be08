"""What a motion may do: where the tool may go and how fast, checked before anything moves.

The tool's way is that of the nominal arm, which is good to millimetres and decides nothing but whether to
refuse.
"""

from __future__ import annotations

from itertools import pairwise

import numpy as np
from numpy.typing import ArrayLike, NDArray

from acquisition.kinematics import JOINT_LIMIT, forward
from acquisition.robot import RobotConfig
from dataset.errors import ToolkitError
from dataset.transforms import SE3

Floats = NDArray[np.float64]

_STEP_RAD = 0.05  # between the points of a joint motion at which the tool is looked at
_NEARER_BY_M = 1e-4  # from one point to the next, an arm on its way into the workspace may lead away from it
_SLOWEST = 1e-3  # rad/s; the controller refuses a speed of zero


def joint_angles(q: ArrayLike, shape: tuple[int, ...]) -> Floats:
    """`q` as an array of a shape, (6,) or (-1, 6).

    Raises ToolkitError for another shape, no row at all, or angles that are no joint's.
    """
    joints = np.asarray(q, dtype=np.float64)
    if joints.ndim != len(shape) or joints.shape[-1] != 6 or not len(joints):
        raise ToolkitError(
            f"joint angles of shape {joints.shape}; give {'(6,)' if shape == (6,) else '(M, 6)'}"
        )
    if not (np.abs(joints) <= JOINT_LIMIT).all():
        raise ToolkitError("joint angles must be finite and within one turn either way; are they in degrees?")
    return joints


class MotionLimits:
    """The limits of a rig's arm with a tool.

    Args:
        config: workspace and speeds.
        tcp_offset: (6,) of the tool.
    """

    def __init__(self, config: RobotConfig, tcp_offset: ArrayLike) -> None:
        self._config = config
        self._T_flange_tcp = SE3.from_pose6(np.asarray(tcp_offset, dtype=np.float64))

    def check_joint_path(self, q_start: Floats, waypoints: Floats) -> None:
        """Checks the tool along straight lines in joint space, from `q_start` (6,) through (M, 6).

        An arm that stands outside the workspace may move into it, on a way that never leads away from it.
        Raises ToolkitError.
        """
        positions = np.vstack(self._ways(q_start, waypoints))
        beyond = self._beyond(positions)
        entered = int(np.argmax(beyond <= 0)) if (beyond <= 0).any() else len(beyond)
        away = np.flatnonzero(np.diff(beyond[:entered]) > _NEARER_BY_M)
        if len(away):
            entered = int(away[0]) + 1
        self.check_positions(positions[entered:] if entered < len(positions) else positions[-1:])

    def check_positions(self, positions: Floats) -> None:
        """Raises ToolkitError where the tool's positions (N, 3) leave the workspace."""
        outside = self._beyond(positions) > 0
        if outside.any():
            x, y, z = positions[np.argmax(outside)]
            low, high = self._config.workspace
            raise ToolkitError(
                f"the motion would take the tool to ({x:.3f}, {y:.3f}, {z:.3f}) m, outside the workspace "
                f"{low} to {high}; change the target, or workspace under [robot] in the rig file"
            )

    def joint_speeds(self, q_start: Floats, waypoints: Floats) -> Floats:
        """(M,) speed of the fastest joint, rad/s, on the way to each waypoint, that keeps both the joints and
        the tool within their limits."""
        turning = np.abs(np.diff(np.vstack([q_start, waypoints]), axis=0)).max(axis=1)
        fastest = np.array(
            [
                np.linalg.norm(np.diff(way, axis=0), axis=1).max() * (len(way) - 1) / max(turn, 1e-9)
                for way, turn in zip(self._ways(q_start, waypoints), turning, strict=True)
            ]
        )  # metres of tool travel per radian, at the worst place of each way
        speeds = np.minimum(self._config.joint_speed, self._config.speed / np.maximum(fastest, 1e-9))
        return np.asarray(np.maximum(speeds, _SLOWEST))

    def tool_travel(self, q_start: Floats, waypoints: Floats) -> Floats:
        """(M,) metres between the tool's positions at successive waypoints."""
        corners = forward(np.vstack([q_start, waypoints])) @ self._T_flange_tcp
        return np.asarray(np.linalg.norm(np.diff(corners.translation, axis=0), axis=1))

    def _ways(self, q_start: Floats, waypoints: Floats) -> list[Floats]:
        """The tool's positions (n, 3) on the way to each waypoint, both ends included."""
        ways = []
        for begin, end in pairwise([q_start, *waypoints]):
            count = 2 + int(np.abs(end - begin).max() / _STEP_RAD)
            q = begin + np.linspace(0, 1, count)[:, None] * (end - begin)
            ways.append((forward(q) @ self._T_flange_tcp).translation)
        return ways

    def _beyond(self, positions: Floats) -> Floats:
        """(N,) metres from positions (N, 3) to the workspace; 0 inside."""
        low, high = (np.array(corner) for corner in self._config.workspace)
        return np.asarray(np.linalg.norm(np.clip(positions, low, high) - positions, axis=1))
