"""What a lab records, from a rig file: the board, the object, touched points.

Each capture opens the rig's devices, plans the motion from the rig's guesses, records one session, and closes
the devices.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from contextlib import ExitStack, contextmanager
from itertools import cycle
from pathlib import Path
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from acquisition.camera import Camera
from acquisition.clearance import CarriedCamera
from acquisition.planning import plan_path, plan_stills
from acquisition.recorder import (
    NO_CAMERA,
    OnProgress,
    Progress,
    record_stills,
    record_stream,
    record_touches,
    record_turns,
)
from acquisition.rig import Rig, open_camera, open_pose_source, open_robot
from acquisition.robot import Robot
from acquisition.trajectories import hand_eye_views, hemisphere_path
from dataset.frames import CameraInfo
from dataset.intrinsics import Intrinsics
from dataset.schema import Kind
from dataset.session import SessionWriter
from dataset.transforms import SE3

Floats = NDArray[np.float64]

_CANDIDATE_VIEWS = 80
_NOMINAL_FOCAL = 0.71
"""Focal length in image widths, for planning only (our choice: the paper's 6 mm lens)."""
_RADII_M = (0.38, 0.31, 0.45)
"""Distances from which the object is filmed, one sweep after the other (our choice)."""
_ELEVATIONS_DEG = (30.0, 80.0)
_ROLLS = tuple(np.deg2rad((-24.0, -12.0, 0.0, 12.0, 24.0)))
"""Turns of the camera about its axis that let the arm move smoothly; the horizon stays nearly level."""
_BOARD_SWEEP_VIEWS = 10


def capture_board(
    rig: Rig,
    out: Path,
    *,
    kind: Literal["intrinsics", "hand_eye"] = "hand_eye",
    views: int = 24,
    seed: int = 0,
    on_progress: OnProgress = lambda progress: None,
) -> Progress:
    """Stills of the calibration board from diverse directions; serves intrinsics and hand-eye calibration.

    Args:
        out: session file to write.
        views: how many; fewer where the arm does not reach so many.
        seed: of the choice of views.

    Raises:
        ToolkitError: no view is reachable.
        DeviceError: a device does not answer or stopped.
    """
    with _devices(rig) as (camera, robot), _writer(out, kind, camera.info, rig) as writer:
        plan = plan_stills(
            _board_views(rig, camera.info, seed), _carried(rig, robot), robot.sample().q, views
        )
        return record_stills(camera, robot, plan.q, writer, on_progress=on_progress)


def capture_board_motion(
    rig: Rig, out: Path, *, seconds: float, seed: int = 1, on_progress: OnProgress = lambda progress: None
) -> Progress:
    """The board filmed while the arm moves, from which the clock offset of camera and arm is estimated."""
    with _devices(rig) as (camera, robot), _writer(out, "hand_eye", camera.info, rig) as writer:
        views = _board_views(rig, camera.info, seed)
        plan = plan_stills(views, _carried(rig, robot), robot.sample().q, _BOARD_SWEEP_VIEWS)
        robot.move_joints(plan.q[0])
        sweep = _to_and_fro(robot, [plan.q])
        return record_stream(camera, robot, writer, motion=sweep, duration_s=seconds, on_progress=on_progress)


def capture_sequence(
    rig: Rig,
    out: Path,
    *,
    seconds: float,
    append: bool = False,
    on_progress: OnProgress = lambda progress: None,
) -> Progress:
    """The object filmed from the hemisphere above it, sweep after sweep at changing distance.

    Args:
        out: session file to write.
        seconds: how long to film.
        append: whether `out` is a sequence that was interrupted and repaired, and shall go on.

    Raises:
        SessionError: `out` exists, or with `append` cannot go on; says why.
        ToolkitError: no view is reachable.
        DeviceError: a device does not answer or stopped.
    """
    with ExitStack() as stack:
        camera, robot = stack.enter_context(_devices(rig))
        if append:
            writer = stack.enter_context(SessionWriter.append(out, "sequence", camera.info))
        else:
            writer = stack.enter_context(_writer(out, "sequence", camera.info, rig))
        centre = np.array(rig.frames.object_centre_guess)
        carried = _carried(rig, robot)
        q = robot.sample().q
        sweeps = []
        for radius in _RADII_M:
            views = hemisphere_path(centre, (radius, radius), _ELEVATIONS_DEG, rows=6)
            path = plan_path(views, carried, q, _ROLLS)
            sweeps.append(path.q)
            q = path.q[-1]
        robot.move_joints(sweeps[0][0])
        motion = _to_and_fro(robot, sweeps)
        return record_stream(
            camera, robot, writer, motion=motion, duration_s=seconds, on_progress=on_progress
        )


def capture_touches(
    rig: Rig, out: Path, *, count: int, on_progress: OnProgress = lambda progress: None
) -> Progress:
    """Points touched on the object with the measuring tip while a hand guides the arm; the toolkit only reads
    it."""
    return _guided(rig, out, "touches", count, on_progress)


def capture_tool_tip(
    rig: Rig, out: Path, *, count: int, on_progress: OnProgress = lambda progress: None
) -> Progress:
    """The tip kept in one point while a hand tilts the tool, `count` times held still."""
    return _guided(rig, out, "tool_tip", count, on_progress)


def capture_polarizer(
    rig: Rig,
    out: Path,
    turns: Iterable[float],
    *,
    frames: int = 1,
    on_progress: OnProgress = lambda progress: None,
) -> Progress:
    """An even lamp behind a linear polarizer that somebody turns; `turns` as in `record_turns`."""
    with open_camera(rig) as camera, _writer(out, "polarizer", camera.info, rig) as writer:
        return record_turns(camera, writer, turns, frames=frames, on_progress=on_progress)


def _guided(
    rig: Rig, out: Path, kind: Literal["touches", "tool_tip"], count: int, on_progress: OnProgress
) -> Progress:
    with open_pose_source(rig) as source, _writer(out, kind, NO_CAMERA, rig) as writer:
        touches = record_touches(source, writer, count, on_progress=on_progress)
    return Progress(len(touches), 0, 1.0)


@contextmanager
def _devices(rig: Rig) -> Iterator[tuple[Camera, Robot]]:
    with open_camera(rig) as camera, open_robot(rig) as robot:
        yield camera, robot


def _writer(out: Path, kind: Kind, camera: CameraInfo, rig: Rig) -> SessionWriter:
    return SessionWriter(out, kind, camera, rig_toml=rig.to_toml())


def _carried(rig: Rig, robot: Robot) -> CarriedCamera:
    return CarriedCamera(
        SE3.from_pose6(robot.tcp_offset), SE3.from_pose6(np.array(rig.frames.T_tcp_cam_guess))
    )


def _board_views(rig: Rig, camera: CameraInfo, seed: int) -> SE3:
    focal = _NOMINAL_FOCAL * camera.width
    matrix = np.array([[focal, 0, (camera.width - 1) / 2], [0, focal, (camera.height - 1) / 2], [0, 0, 1]])
    rough = Intrinsics(matrix, np.zeros(0), camera.height, camera.width)
    board = rig.board
    size = (board.squares_x * board.square_m, board.squares_y * board.square_m)
    pose = SE3.from_pose6(np.array(rig.frames.T_base_board_guess))
    return hand_eye_views(pose, size, rough, _CANDIDATE_VIEWS, seed)


def _to_and_fro(robot: Robot, paths: list[Floats]) -> Callable[[], None]:
    """A motion without an end: along each path, from wherever the one before it ended."""

    def move() -> None:
        for path in cycle([*paths, *[p[::-1] for p in reversed(paths)]]):
            robot.follow(path)

    return move
