"""Whether the arm, with the camera and the tool that it carries, keeps clear of the table and of itself, and
in its workspace.

The arm is a nominal UR5e on a table; it is clear when thick points along all of it are. The shapes are our
choice, on the cautious side. Anything else that stands in the room is not known here.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from acquisition.kinematics import link_transforms
from dataset.transforms import SE3

Floats = NDArray[np.float64]

_LINK_RADIUS = 0.06  # m
_TOOL_RADIUS = 0.015  # m, about the line from the flange to the tool centre point
_UPPER_ARM_OFFSET, _FOREARM_OFFSET = 0.138, 0.007  # m, of the tubes beside the Denavit-Hartenberg skeleton
_COLUMN_HEIGHT, _COLUMN_RADIUS = 0.24, 0.08  # m, of the base and shoulder
_SWEEP_STEP_RAD = 0.08


@dataclass(frozen=True)
class CarriedCamera:
    """The camera on the flange, and how much room it needs.

    Attributes:
        T_flange_tcp: the active tool.
        T_tcp_cam: rough hand-eye transform.
        radius: metres of room around the optical axis.
        length_behind, length_ahead: metres of housing behind, and of lens ahead of, the camera's centre.
        table_z: height of the table in the base frame, metres.
        table_gap: metres that everything stays above the table.
        workspace: lower and upper corner of the box in the base frame that the tool stays in, metres.
    """

    T_flange_tcp: SE3
    T_tcp_cam: SE3
    radius: float = 0.04
    length_behind: float = 0.05
    length_ahead: float = 0.02
    table_z: float = 0.0
    table_gap: float = 0.03
    workspace: tuple[tuple[float, float, float], tuple[float, float, float]] = (
        (-np.inf, -np.inf, -np.inf),
        (np.inf, np.inf, np.inf),
    )

    def T_base_flange(self, T_base_cam: SE3) -> SE3:
        """Where the flange is when the camera is there."""
        return T_base_cam @ (self.T_flange_tcp @ self.T_tcp_cam).inverse()

    def body(self) -> tuple[Floats, Floats]:
        """Points (5, 3) of what is carried, in the flange frame, and the room (5,) about each, metres: the
        housing's ends, the middle of its holder, the tool and its middle."""
        camera = self.T_flange_tcp @ self.T_tcp_cam
        along = np.array([-self.length_behind, self.length_ahead])
        housing = camera.translation + along[:, None] * camera.rotation[:, 2]
        tool = self.T_flange_tcp.translation
        points = np.vstack([housing, camera.translation / 2, tool / 2, tool])
        return points, np.array([self.radius, self.radius, self.radius, _TOOL_RADIUS, _TOOL_RADIUS])


def skeleton(q: ArrayLike) -> Floats:
    """(..., 9, 3) the arm's middle lines at joint angles (..., 6), base frame, metres, one point after the
    other: base, shoulder, both ends of the upper arm, both of the forearm, wrists 1 to 3 and the flange."""
    links = link_transforms(q)
    origins, axes = links[..., :3, 3], links[..., :3, 2]
    side = axes[..., 1, :]
    return np.stack(
        [
            origins[..., 0, :],
            origins[..., 1, :],
            origins[..., 1, :] + _UPPER_ARM_OFFSET * side,
            origins[..., 2, :] + _UPPER_ARM_OFFSET * side,
            origins[..., 2, :] + _FOREARM_OFFSET * side,
            origins[..., 3, :] + _FOREARM_OFFSET * side,
            origins[..., 4, :],
            origins[..., 5, :],
            origins[..., 6, :],
        ],
        axis=-2,
    )


def is_clear(q: ArrayLike, camera: CarriedCamera) -> NDArray[np.bool_]:
    """(...) bool: whether joint angles (..., 6) keep arm, camera and tool clear of the table and the arm, and
    the tool in its workspace."""
    flange = link_transforms(q)[..., 6, :, :]
    lines = skeleton(q)
    shoulder, elbow, elbow_inner, wrist = (lines[..., i, :] for i in (2, 3, 4, 5))
    points, room = camera.body()
    body = np.einsum("...ij,kj->...ki", flange[..., :3, :3], points) + flange[..., None, :3, 3]
    tool = body[..., -1, :]
    low, high = camera.workspace
    inside = ((tool >= low) & (tool <= high)).all(axis=-1)
    floor = camera.table_z + camera.table_gap
    clear = inside & (lines[..., 3:, 2].min(axis=-1) > floor + _LINK_RADIUS)
    clear &= (body[..., 2] > floor + room).all(axis=-1)
    hand = np.concatenate([lines[..., 7:, :], body], axis=-2)
    hand_room = np.concatenate([[_LINK_RADIUS, camera.radius], room])
    base, top = np.zeros(3), np.array([0.0, 0.0, _COLUMN_HEIGHT])
    clear &= (_distance(hand, base, top) > hand_room + _COLUMN_RADIUS).all(axis=-1)
    clear &= (_distance(hand, shoulder, elbow) > hand_room + _LINK_RADIUS).all(axis=-1)
    clear &= (_distance(body, elbow_inner, wrist) > room + _LINK_RADIUS).all(axis=-1)
    arm = np.stack([elbow, wrist], axis=-2)
    clear &= (_distance(arm, base, top) > _LINK_RADIUS + _COLUMN_RADIUS).all(axis=-1)
    return np.asarray(clear)


def sweep_clear(q_from: Floats, q_to: Floats, camera: CarriedCamera) -> bool:
    """Whether the straight joint motion from one configuration (6,) to another is clear; the first is not
    looked at."""
    count = 2 + int(np.abs(q_to - q_from).max() / _SWEEP_STEP_RAD)
    return bool(is_clear(q_from + np.linspace(0, 1, count)[1:, None] * (q_to - q_from), camera).all())


def _distance(points: Floats, start: Floats, end: Floats) -> Floats:
    """(..., K) distances from points (..., K, 3) to the segment between `start` and `end` (..., 3)."""
    along = (end - start)[..., None, :]
    offset = points - start[..., None, :]
    part = np.clip((offset * along).sum(axis=-1) / (along * along).sum(axis=-1), 0, 1)
    return np.asarray(np.linalg.norm(offset - part[..., None] * along, axis=-1))
