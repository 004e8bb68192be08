"""What a lab records, from a rig file: the board, the object, touched points.

Each capture opens the rig's devices, plans the motion from the rig's guesses, records one session, and closes
the devices.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from itertools import cycle
from pathlib import Path
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from acquisition.camera import Camera
from acquisition.clearance import CarriedCamera
from acquisition.live import ignore
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
from acquisition.routes import Route, board_stills, board_sweep, carried_camera, object_sweeps
from dataset.errors import SessionError
from dataset.frames import CameraInfo
from dataset.schema import Kind
from dataset.session import SessionWriter

Floats = NDArray[np.float64]


def capture_board(
    rig: Rig,
    out: Path,
    *,
    kind: Literal["intrinsics", "hand_eye"] = "hand_eye",
    views: int = 24,
    seed: int = 0,
    on_progress: OnProgress = ignore,
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
    _refuse_to_overwrite(out)
    with _devices(rig) as (camera, robot):
        route = board_stills(rig, *_standing(rig, robot), _size(camera), views, seed)
        with _writer(out, kind, camera.info, rig) as writer:
            return record_stills(camera, robot, route.q, writer, on_progress=on_progress)


def capture_board_motion(
    rig: Rig, out: Path, *, seconds: float, seed: int = 1, on_progress: OnProgress = ignore
) -> Progress:
    """The board filmed while the arm moves, from which the clock offset of camera and arm is estimated."""
    _refuse_to_overwrite(out)
    with _devices(rig) as (camera, robot):
        route = board_sweep(rig, *_standing(rig, robot), _size(camera), seed)

        def begin() -> SessionWriter:
            return _writer(out, "hand_eye", camera.info, rig)

        return _film(camera, robot, route, begin, seconds, on_progress)


def capture_sequence(
    rig: Rig,
    out: Path,
    *,
    seconds: float,
    append: bool = False,
    on_progress: OnProgress = ignore,
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
    if not append:
        _refuse_to_overwrite(out)
    with _devices(rig) as (camera, robot):
        route = object_sweeps(rig, *_standing(rig, robot))

        def begin() -> SessionWriter:
            if append:
                return SessionWriter.append(out, "sequence", camera.info)
            return _writer(out, "sequence", camera.info, rig)

        return _film(camera, robot, route, begin, seconds, on_progress)


def capture_touches(rig: Rig, out: Path, *, count: int, on_progress: OnProgress = ignore) -> Progress:
    """Points touched on the object with the measuring tip while a hand guides the arm; the toolkit only reads
    it."""
    return _guided(rig, out, "touches", count, on_progress)


def capture_tool_tip(rig: Rig, out: Path, *, count: int, on_progress: OnProgress = ignore) -> Progress:
    """The tip kept in one point while a hand tilts the tool, `count` times held still."""
    return _guided(rig, out, "tool_tip", count, on_progress)


def capture_polarizer(
    rig: Rig,
    out: Path,
    turns: Iterable[float],
    *,
    frames: int = 1,
    on_progress: OnProgress = ignore,
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


def _film(
    camera: Camera,
    robot: Robot,
    route: Route,
    begin: Callable[[], SessionWriter],
    seconds: float,
    on_progress: OnProgress,
) -> Progress:
    """To the beginning of the route; then along it and back until the time is over, filming into the session
    that `begin` opens."""
    robot.move_joints(route.q[0])
    sweep = _to_and_fro(robot, route)
    with begin() as writer:
        return record_stream(camera, robot, writer, motion=sweep, duration_s=seconds, on_progress=on_progress)


def _refuse_to_overwrite(out: Path) -> None:
    """Before devices are opened and a route is planned; the file itself is made when both have succeeded."""
    if out.exists():
        raise SessionError(f"{out} already exists; choose another name or remove it first")


@contextmanager
def _devices(rig: Rig) -> Iterator[tuple[Camera, Robot]]:
    with open_camera(rig) as camera, open_robot(rig) as robot:
        yield camera, robot


def _writer(out: Path, kind: Kind, camera: CameraInfo, rig: Rig) -> SessionWriter:
    return SessionWriter(out, kind, camera, rig_toml=rig.to_toml())


def _standing(rig: Rig, robot: Robot) -> tuple[CarriedCamera, Floats]:
    """What the arm carries, and where it stands."""
    return carried_camera(rig, robot.tcp_offset), robot.sample().q


def _size(camera: Camera) -> tuple[int, int]:
    return camera.info.width, camera.info.height


def _to_and_fro(robot: Robot, route: Route) -> Callable[[], None]:
    """A motion without an end: along each of the route's paths, from wherever the one before it ended."""
    paths = [plan.q for plan in route.plans]

    def move() -> None:
        for path in cycle([*paths, *[p[::-1] for p in reversed(paths)]]):
            robot.follow(path)

    return move
