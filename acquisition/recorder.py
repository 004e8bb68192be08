"""Recording sessions: stills at rest, a stream while the arm moves, points touched by hand.

Every recording holds the arm's whole trace and the devices' clocks, and accounts for every frame between its
first and its last: stored, in the ledger of drops, or in a declared pause. Open the session's writer around
the call::

    with SessionWriter(path, "hand_eye", camera.info, rig_toml=rig.to_toml()) as writer:
        record_stills(camera, robot, joint_path, writer)

An exception or Ctrl-C stops the arm, keeps what was recorded until then, and leaves the file marked
incomplete. Who wants to watch and steer a stream while it is recorded uses `Recorder`.
"""

from __future__ import annotations

import contextlib
import time
from collections.abc import Callable, Iterable

import numpy as np
from numpy.typing import ArrayLike

from acquisition.camera import Camera, CameraLost
from acquisition.frame_stream import FrameLedger
from acquisition.live import OnProgress, Progress, Recorder, RecorderStatus, ignore, recording
from acquisition.robot import PoseSource, Robot
from acquisition.trace_log import TraceLog
from dataset.errors import DeviceError, SessionError, ToolkitError
from dataset.frames import CameraInfo, RawFrame
from dataset.rests import Rest, RestFinder
from dataset.session import SessionWriter

__all__ = [
    "NO_CAMERA",
    "OnProgress",
    "Progress",
    "Recorder",
    "RecorderStatus",
    "record_stills",
    "record_stream",
    "record_touches",
    "record_turns",
]

NO_CAMERA = CameraInfo("none", "none", "", "", "Mono8", "mono", width=2, height=2, bits=8, packet_size=0)
"""What a session without frames, such as one of touched points, says about its camera."""

_TOUCH_TICK_S = 0.1


def record_stills(
    camera: Camera,
    robot: Robot,
    joint_path: ArrayLike,
    writer: SessionWriter,
    *,
    settle_s: float = 0.3,
    on_progress: OnProgress = ignore,
) -> Progress:
    """One frame at each stop of a path: move, come to rest, wait, trigger, read.

    Args:
        camera: opened, not started.
        robot: connected, without a running trace.
        joint_path: (M, 6) joint angles, radians.
        writer: of the session, with `camera.info`.
        settle_s: wait between the arm's rest and the trigger, in which it stops to vibrate.
        on_progress: called after every stop.

    Raises:
        DeviceError: a device stopped, or a triggered frame did not arrive twice in a row.
        SessionError: the disk refuses a frame.
    """
    path = np.asarray(joint_path, dtype=np.float64)
    ledger = FrameLedger(writer)
    warnings: list[str] = []
    with recording(camera, robot, writer, "software", warnings) as log:
        for stop, q in enumerate(path, start=1):
            robot.move_joints(q)
            robot.wait_until_still()
            time.sleep(settle_s)
            ledger.store(_triggered_frame(camera, ledger))
            log.flush()
            on_progress(Progress(ledger.stored, ledger.dropped, stop / len(path)))
    return Progress(ledger.stored, ledger.dropped, 1.0, tuple(warnings))


def record_stream(
    camera: Camera,
    robot: PoseSource | None,
    writer: SessionWriter,
    *,
    motion: Callable[[], object] | None = None,
    duration_s: float | None = None,
    on_progress: OnProgress = ignore,
) -> Progress:
    """Frames at the camera's own rate while the arm moves.

    Args:
        camera: opened, not started.
        robot: connected, without a running trace; None for a camera without an arm.
        writer: of the session, with `camera.info`.
        motion: moves the arm, such as `lambda: robot.follow(path)`; the recording ends when it returns.
        duration_s: the recording ends after this long, and stops a motion that is still under way.
        on_progress: called ten times a second from another thread, and at the end.

    Raises:
        ToolkitError: neither motion nor duration is given.
        DeviceError: a device stopped.
        SessionError: the disk refuses a frame.
    """
    if motion is None and duration_s is None:
        raise ToolkitError("a stream needs a motion or a duration, else it would never end; give one of them")
    with Recorder(camera, robot, writer, duration_s=duration_s, on_progress=on_progress) as recorder:
        if motion is None:
            recorder.wait()
        else:
            recorder.run(motion)
    return recorder.progress


def record_turns(
    camera: Camera,
    writer: SessionWriter,
    turns: Iterable[float],
    *,
    frames: int = 1,
    on_progress: OnProgress = ignore,
) -> Progress:
    """Frames of a lamp behind a polarizer that is turned in between, for the calibration of the polarizers.

    Args:
        camera: opened, not started.
        writer: of a session of kind "polarizer", with `camera.info`.
        turns: yields the polarizer's angle (radians, NaN where nobody reads it) as soon as it stands there.
        frames: to take at each.
        on_progress: called after every angle.

    Raises:
        DeviceError: the camera stopped, or a triggered frame did not arrive twice in a row.
        SessionError: the disk refuses a frame.
    """
    ledger = FrameLedger(writer)
    warnings: list[str] = []
    with recording(camera, None, writer, "software", warnings):
        for angle in turns:
            for _again in range(frames):
                ledger.store(_triggered_frame(camera, ledger))
                writer.add_polarizer_angle(angle)
            on_progress(Progress(ledger.stored, ledger.dropped, None))
    return Progress(ledger.stored, ledger.dropped, None, tuple(warnings))


def record_touches(
    source: PoseSource,
    writer: SessionWriter,
    count: int,
    *,
    finder: RestFinder | None = None,
    on_progress: OnProgress = ignore,
) -> list[Rest]:
    """Points touched with the measuring tip, or tilts about one point, the arm being guided by hand: only
    reads the arm.

    A point is taken whenever the arm is held still for a moment, elsewhere than before. The session holds the
    trace, in which `dataset.rests.find_rests` finds the same points again.

    Args:
        source: connected, without a running trace.
        writer: of a session of kind "touches" or "tool_tip", with `NO_CAMERA`.
        count: points to take.
        finder: when the arm counts as still.
        on_progress: called at every point.

    Raises:
        DeviceError: the arm was lost.
    """
    finder = finder or RestFinder()
    touches: list[Rest] = []
    try:
        with TraceLog(source, writer) as log:
            while len(touches) < count:
                time.sleep(_TOUCH_TICK_S)
                for rest in finder.feed(log.flush()):
                    touches.append(rest)
                    on_progress(Progress(len(touches), 0, min(1.0, len(touches) / count)))
    finally:
        with contextlib.suppress(SessionError):  # an error under way is the one the user must see
            writer.fit_clocks()
    return touches


def _triggered_frame(camera: Camera, ledger: FrameLedger) -> RawFrame:
    """A frame whose exposure begins now. At most one trigger is outstanding; the second must succeed."""
    camera.trigger()
    try:
        return camera.read()
    except CameraLost:
        raise
    except DeviceError:
        camera.trigger()
    try:
        return camera.read()
    except DeviceError as error:
        ledger.never_came("triggered twice, never came", time.monotonic_ns())
        raise DeviceError(f"a triggered frame did not arrive, nor did a second one: {error}") from error
