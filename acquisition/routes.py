"""The way of the arm in each capture, from a rig's guesses: planned here, drawn by a dry run, driven by a
capture."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import ArrayLike, NDArray

from acquisition.clearance import CarriedCamera
from acquisition.kinematics import forward
from acquisition.planning import JointPlan, plan_path, plan_stills
from acquisition.rig import Rig
from acquisition.robots.limits import MotionLimits
from acquisition.trajectories import board_visibility, hand_eye_views, hemisphere_path
from dataset.intrinsics import Intrinsics
from dataset.pictures import nominal_camera_matrix
from dataset.transforms import SE3

Floats = NDArray[np.float64]

_CANDIDATE_VIEWS = 80
_RADII_M = (0.38, 0.31, 0.45)
"""Distances from which the object is filmed, one sweep after the other (our choice)."""
_ELEVATIONS_DEG = (30.0, 80.0)
_ROLLS = tuple(np.deg2rad((-24.0, -12.0, 0.0, 12.0, 24.0)))
"""Turns of the camera about its axis that let the arm move smoothly; the horizon stays nearly level."""
_BOARD_SWEEP_VIEWS = 10
_STILL_S = 0.8
"""What a still takes beside the motion: settling, exposing, reading (our choice, for the estimate)."""
_FINE_STEP_RAD = 0.05


@dataclass(frozen=True, eq=False)
class Route:
    """What a capture has the arm do.

    Attributes:
        title: what it is for.
        stills: whether the arm comes to rest at each waypoint and one picture is taken, or it is filmed on.
        q_start: (6,) where the arm stood when it was planned, radians.
        plans: joint paths, one after the other; most routes have one.
        wished: how many views were asked for.
        carried: camera and tool.
        subject: (K, 3) outline of what is looked at, base frame, metres: a board's corners, or one point.
    """

    title: str
    stills: bool
    q_start: Floats
    plans: tuple[JointPlan, ...]
    wished: int
    carried: CarriedCamera
    subject: Floats

    @property
    def q(self) -> Floats:
        """(K, 6) all waypoints in their order."""
        return np.vstack([plan.q for plan in self.plans])

    @property
    def reached(self) -> int:
        """How many of the wished-for views the route passes."""
        return sum(int((plan.index >= 0).sum()) for plan in self.plans)

    def pictures_from(self) -> SE3:
        """T_base_cam, a batch: of every still, or of the camera all along the way while it films."""
        q = self.q
        if not self.stills:
            steps = [
                a
                + np.linspace(0, 1, 1 + int(np.abs(b - a).max() / _FINE_STEP_RAD), endpoint=False)[:, None]
                * (b - a)
                for a, b in pairwise(q)
            ]
            q = np.vstack([*steps, q[-1:]])
        return self.T_base_cam(q)

    def T_base_cam(self, q: ArrayLike) -> SE3:
        """Where the camera is at joint angles (..., 6)."""
        return forward(q) @ self.carried.T_flange_tcp @ self.carried.T_tcp_cam

    def duration_s(self, limits: MotionLimits, joint_acceleration: float) -> float:
        """Roughly how long it takes: trapezoids for stills, the limits' speeds along a filmed path."""
        q = self.q
        speeds = limits.joint_speeds(self.q_start, q)
        turns = np.abs(np.diff(np.vstack([self.q_start, q]), axis=0)).max(axis=1)
        if self.stills:
            return float(np.sum(turns / speeds + speeds / joint_acceleration) + _STILL_S * len(q))
        return float(np.sum(turns / speeds) + speeds.max() / joint_acceleration)


def board_stills(
    rig: Rig, carried: CarriedCamera, q_start: ArrayLike, size: tuple[int, int], views: int, seed: int = 0
) -> Route:
    """Diverse stills of the calibration board.

    Args:
        rig: where the board is.
        carried: the camera on the arm.
        q_start: (6,) where the arm is, radians.
        size: (width, height) of the mosaic.
        views: how many; fewer where the arm does not reach so many.
        seed: of the choice.

    Raises:
        ToolkitError: no view is reachable.
    """
    T_base_board, board_size = _board(rig)
    intrinsics = _rough_intrinsics(size)
    wished = hand_eye_views(T_base_board, board_size, intrinsics, max(_CANDIDATE_VIEWS, views), seed)
    shown = board_visibility(wished, T_base_board, board_size, intrinsics)
    plan = plan_stills(wished, carried, q_start, views, shown)
    return Route("stills of the board", True, _start(q_start), (plan,), views, carried, _outline(rig))


def board_sweep(
    rig: Rig, carried: CarriedCamera, q_start: ArrayLike, size: tuple[int, int], seed: int = 1
) -> Route:
    """A path about the calibration board, to be driven to and fro. Arguments and errors as `board_stills`."""
    stills = board_stills(rig, carried, q_start, size, _BOARD_SWEEP_VIEWS, seed)
    return Route(
        "the board in motion", False, stills.q_start, stills.plans, stills.wished, carried, stills.subject
    )


def object_sweeps(rig: Rig, carried: CarriedCamera, q_start: ArrayLike) -> Route:
    """Sweeps over the hemisphere about the object, each at another distance.

    Raises ToolkitError where no view is reachable.
    """
    centre = np.array(rig.frames.object_centre_guess)
    q = _start(q_start)
    plans: list[JointPlan] = []
    wished = 0
    for radius in _RADII_M:
        views = hemisphere_path(centre, (radius, radius), _ELEVATIONS_DEG, rows=6)
        plans.append(plan_path(views, carried, q, _ROLLS))
        wished += len(views)
        q = plans[-1].q[-1]
    return Route(
        "the object from all around", False, _start(q_start), tuple(plans), wished, carried, centre[None]
    )


def carried_camera(rig: Rig, tcp_offset: ArrayLike) -> CarriedCamera:
    """The rig's camera on an arm with a tool offset (6,)."""
    tool = SE3.from_pose6(np.asarray(tcp_offset, dtype=np.float64))
    T_tcp_cam = SE3.from_pose6(np.array(rig.frames.T_tcp_cam_guess))
    return CarriedCamera(tool, T_tcp_cam, workspace=rig.robot.workspace)


def _start(q_start: ArrayLike) -> Floats:
    return np.array(q_start, dtype=np.float64)


def _board(rig: Rig) -> tuple[SE3, tuple[float, float]]:
    size = (rig.board.squares_x * rig.board.square_m, rig.board.squares_y * rig.board.square_m)
    return SE3.from_pose6(np.array(rig.frames.T_base_board_guess)), size


def _outline(rig: Rig) -> Floats:
    pose, (width, height) = _board(rig)
    return pose.apply(np.array([[0, 0, 0], [width, 0, 0], [width, height, 0], [0, height, 0]]))


def _rough_intrinsics(size: tuple[int, int]) -> Intrinsics:
    width, height = size
    return Intrinsics(nominal_camera_matrix(height, width), np.zeros(0), height, width)
