"""Recording sessions: stills at rest, a stream while the arm moves, points touched by hand.

Every recording holds the arm's whole trace and the devices' clocks, and accounts for every frame between its
first and its last: stored, or in the ledger of drops. Open the session's writer around the call::

    with SessionWriter(path, "hand_eye", camera.info, rig_toml=rig.to_toml()) as writer:
        record_stills(camera, robot, joint_path, writer)

An exception or Ctrl-C stops the arm, keeps what was recorded until then, and leaves the file marked
incomplete.
"""

from __future__ import annotations

import contextlib
import threading
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from types import TracebackType
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike

from acquisition.camera import Camera, Trigger
from acquisition.frame_stream import FrameLedger, FrameStream
from acquisition.robot import MotionStopped, PoseSource, Robot
from acquisition.trace_log import TraceLog
from dataset.errors import DeviceError, ToolkitError
from dataset.frames import CameraInfo, RawFrame
from dataset.rests import Rest, RestFinder
from dataset.session import SessionWriter

if TYPE_CHECKING:
    from typing_extensions import Self

NO_CAMERA = CameraInfo("none", "none", "", "", "Mono8", "mono", width=2, height=2, bits=8, packet_size=0)
"""What a session without frames, such as one of touched points, says about its camera."""

_TICK_S = 0.1

_TRACE_MARGIN_S = 0.2
"""How much longer than the frames the arm's trace is at either end: a delay between the two clocks, not yet
known, must not leave a frame without its pose (our choice)."""


@dataclass(frozen=True)
class Progress:
    """How far a recording has come.

    Attributes:
        frames: stored so far; for touches, points taken.
        dropped: in the ledger so far.
        done: share of the whole in [0, 1]; None where the end is not known.
    """

    frames: int
    dropped: int
    done: float | None


OnProgress = Callable[[Progress], object]


def _ignore(progress: Progress) -> None:
    del progress


def record_stills(
    camera: Camera,
    robot: Robot,
    joint_path: ArrayLike,
    writer: SessionWriter,
    *,
    settle_s: float = 0.3,
    on_progress: OnProgress = _ignore,
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
    progress = Progress(0, 0, 0.0)
    with _recording(camera, robot, writer, "software") as (ledger, log):
        for stop, q in enumerate(path, start=1):
            robot.move_joints(q)
            robot.wait_until_still()
            time.sleep(settle_s)
            ledger.store(_triggered_frame(camera, ledger))
            log.flush()
            progress = Progress(ledger.stored, ledger.dropped, stop / len(path))
            on_progress(progress)
    return progress


def record_stream(
    camera: Camera,
    robot: PoseSource | None,
    writer: SessionWriter,
    *,
    motion: Callable[[], object] | None = None,
    duration_s: float | None = None,
    on_progress: OnProgress = _ignore,
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
    with (
        _recording(camera, robot, writer, "free") as (ledger, log),
        FrameStream(camera, ledger) as stream,
        _Supervisor(robot, ledger, log, stream, duration_s, on_progress) as supervisor,
    ):
        if motion is None:
            supervisor.over.wait()
        else:
            supervisor.run(motion)
    progress = Progress(ledger.stored, ledger.dropped, 1.0)
    on_progress(progress)
    return progress


def record_touches(
    source: PoseSource,
    writer: SessionWriter,
    count: int,
    *,
    finder: RestFinder | None = None,
    on_progress: OnProgress = _ignore,
) -> list[Rest]:
    """Points touched with the measuring tip, the arm being guided by hand: only reads the arm.

    A point is taken whenever the arm is held still for a moment, elsewhere than before. The session holds the
    trace, in which `dataset.rests.find_rests` finds the same points again.

    Args:
        source: connected, without a running trace.
        writer: of a session of kind "tool_tip", with `NO_CAMERA`.
        count: points to take.
        finder: when the arm counts as still.
        on_progress: called at every point.

    Raises:
        DeviceError: the arm was lost.
    """
    finder = finder or RestFinder()
    touches: list[Rest] = []
    with TraceLog(source, writer) as log:
        while len(touches) < count:
            time.sleep(_TICK_S)
            for rest in finder.feed(log.flush()):
                touches.append(rest)
                on_progress(Progress(len(touches), 0, min(1.0, len(touches) / count)))
    return touches


@contextlib.contextmanager
def _recording(
    camera: Camera, robot: PoseSource | None, writer: SessionWriter, trigger: Trigger
) -> Iterator[tuple[FrameLedger, TraceLog]]:
    """Camera started and trace running; the clocks are stored at the end, however it comes."""
    ledger = FrameLedger(writer)
    margin_s = 0.0 if robot is None else _TRACE_MARGIN_S
    with TraceLog(robot, writer) as log:
        try:
            time.sleep(margin_s)
            camera.start(trigger)
            yield ledger, log
        except BaseException:
            # The error under way is the one the user must see.
            with contextlib.suppress(ToolkitError):
                camera.stop()
            with contextlib.suppress(ToolkitError):
                ledger.store_clock()
            raise
        camera.stop()
        ledger.store_clock()
        time.sleep(margin_s)


def _triggered_frame(camera: Camera, ledger: FrameLedger) -> RawFrame:
    """A frame whose exposure begins now. At most one trigger is outstanding; the second must succeed."""
    camera.trigger()
    with contextlib.suppress(DeviceError):
        return camera.read()
    camera.trigger()
    try:
        return camera.read()
    except DeviceError as error:
        ledger.never_came("triggered twice, never came", time.monotonic_ns())
        raise DeviceError(f"a triggered frame did not arrive, nor did a second one: {error}") from error


class _Supervisor:
    """Watches over a stream from a thread of its own: moves the trace into the file, tells the progress, and
    stops the arm when the time is over or something failed. Leaving the `with` block raises what failed here.

    The motion runs in the caller's thread, so that Ctrl-C reaches it.
    """

    def __init__(
        self,
        robot: PoseSource | None,
        ledger: FrameLedger,
        log: TraceLog,
        stream: FrameStream,
        duration_s: float | None,
        on_progress: OnProgress,
    ) -> None:
        self.over = threading.Event()
        self._robot = robot
        self._ledger = ledger
        self._log = log
        self._stream = stream
        self._duration_s = duration_s
        self._on_progress = on_progress
        self._moving = threading.Event()
        self._ended = threading.Event()
        self._fit_clocks_after_s = 1.0
        self._error: Exception | None = None
        self._thread = threading.Thread(target=self._run, name="supervise")

    def __enter__(self) -> Self:
        self._thread.start()
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        self._ended.set()
        self._thread.join()
        if self._error is not None and (error is None or isinstance(error, ToolkitError)):
            raise self._error from error

    def run(self, motion: Callable[[], object]) -> None:
        """Runs the motion; that it was stopped when the time was over is no error."""
        self._moving.set()
        try:
            motion()
        except MotionStopped:
            if not self.over.is_set():
                raise
        finally:
            self._moving.clear()

    def _run(self) -> None:
        started = time.monotonic()
        while not self._ended.wait(_TICK_S):
            try:
                if not self.over.is_set():
                    self._tick(time.monotonic() - started)
                # Again and again: a motion may just have been between two moves.
                if self.over.is_set() and self._moving.is_set() and isinstance(self._robot, Robot):
                    self._robot.stop()
            except Exception as error:  # raised by the thread that leaves the `with` block
                self._error = self._error or error
                self.over.set()

    def _tick(self, elapsed_s: float) -> None:
        self._log.flush()
        if elapsed_s > self._fit_clocks_after_s:
            # For a recording that will be killed; ever more rarely, since a fit costs more and gains less.
            self._fit_clocks_after_s = 1.5 * elapsed_s
            with contextlib.suppress(ToolkitError):  # what is wrong with a clock is said at the end
                self._ledger.store_clock()
                self._log.store_clock()
        done = None if self._duration_s is None else min(1.0, elapsed_s / self._duration_s)
        self._on_progress(Progress(self._ledger.stored, self._ledger.dropped, done))
        if done == 1.0 or self._stream.failed.is_set():
            self.over.set()
