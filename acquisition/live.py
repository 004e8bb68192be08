"""A recording in progress: the devices running, the file growing, and somebody watching over both."""

from __future__ import annotations

import contextlib
import threading
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from types import TracebackType
from typing import TYPE_CHECKING

from acquisition.camera import Camera, Trigger
from acquisition.clocks import clock_warnings
from acquisition.frame_stream import FrameLedger, FrameStream
from acquisition.robot import MotionStopped, PoseSource, Robot
from acquisition.trace_log import TraceLog
from dataset.errors import ToolkitError
from dataset.frames import RawFrame
from dataset.session import SessionWriter

if TYPE_CHECKING:
    from typing_extensions import Self

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
        warnings: at the end, what is doubtful about the recording, a line each.
    """

    frames: int
    dropped: int
    done: float | None
    warnings: tuple[str, ...] = ()


OnProgress = Callable[[Progress], object]


def ignore(progress: Progress) -> None:
    """For whoever needs no progress."""
    del progress


@dataclass(frozen=True)
class RecorderStatus:
    """What a recorder is doing at this moment.

    Attributes:
        offered: frames that came from the camera and were wanted: stored, in the ledger, or under way.
        stored, ledgered: in the file, and in its ledger of drops.
        queued: in memory, under way into the file.
        paused: frames that came during pauses.
        pausing: whether it is paused now.
        seconds: recorded so far, without pauses.
        latency_ms: of the newest stored frame, from its first packet to its being in the file.
    """

    offered: int
    stored: int
    ledgered: int
    queued: int
    paused: int
    pausing: bool
    seconds: float
    latency_ms: float


class Recorder:
    """A stream being recorded: whoever holds it can watch it, pause it, and end it, from any thread.

    It records from entering the `with` block to leaving it, which raises what went wrong meanwhile. A thread
    of its own moves the arm's trace into the file and stops the arm when the time is over or something
    failed; a motion runs in the caller's thread, so that Ctrl-C reaches it.

    Args:
        camera: opened, not started.
        robot: connected, without a running trace; None for a camera without an arm.
        writer: of the session, with `camera.info`.
        duration_s: the recording ends after this long, pauses not counted.
        on_progress: called ten times a second from another thread, and at the end.

    Attributes:
        over: set when the recording shall end, for whatever reason.
        progress: the newest; after the `with` block that of the whole, with its warnings.
    """

    def __init__(
        self,
        camera: Camera,
        robot: PoseSource | None,
        writer: SessionWriter,
        *,
        duration_s: float | None = None,
        on_progress: OnProgress = ignore,
    ) -> None:
        self.over = threading.Event()
        self.progress = Progress(0, 0, None if duration_s is None else 0.0)
        self._robot = robot
        self._writer = writer
        self._duration_s = duration_s
        self._on_progress = on_progress
        self._warnings: list[str] = []
        self._ledger = FrameLedger(writer)
        self._stream = FrameStream(camera, self._ledger)
        self._recording = recording(camera, robot, writer, "free", self._warnings)
        self._moving = threading.Event()
        self._ended = threading.Event()
        self._seconds = 0.0
        self._fit_clocks_after_s = 1.0
        self._error: Exception | None = None
        self._thread = threading.Thread(target=self._supervise, name="supervise")
        self._stack = contextlib.ExitStack()

    def __enter__(self) -> Self:
        with contextlib.ExitStack() as stack:
            self._log = stack.enter_context(self._recording)
            stack.enter_context(self._stream)
            self._stack = stack.pop_all()
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
        with self._stack:
            if self._error is not None and (error is None or isinstance(error, ToolkitError)):
                raise self._error from error
            if error is not None:
                raise error
        self.progress = Progress(self._ledger.stored, self._ledger.dropped, 1.0, tuple(self._warnings))
        self._on_progress(self.progress)

    @property
    def status(self) -> RecorderStatus:
        """What it is doing."""
        ledger, stream = self._ledger, self._stream
        stored, ledgered, queued = ledger.stored, ledger.dropped, stream.queued
        return RecorderStatus(
            offered=stored + ledgered + queued,
            stored=stored,
            ledgered=ledgered,
            queued=queued,
            paused=ledger.paused,
            pausing=stream.paused,
            seconds=self._seconds,
            latency_ms=stream.latencies_ms[-1] if stream.latencies_ms else 0.0,
        )

    @property
    def latest(self) -> RawFrame | None:
        """The newest frame, stored or not, for a preview; None before the first."""
        return self._stream.latest

    @property
    def latencies_ms(self) -> tuple[float, ...]:
        """Of the newest stored frames (some minutes of them), from first packet to file."""
        return tuple(self._stream.latencies_ms)

    def pause(self, reason: str = "paused") -> None:
        """Frames are read on and not stored; the session declares the gap. The arm's trace goes on."""
        self._stream.pause(reason)

    def resume(self) -> None:
        """Frames are stored again."""
        self._stream.resume()

    def stop(self) -> None:
        """Ends the recording: `wait` returns, and `run` as soon as the arm has been stopped."""
        self.over.set()

    def wait(self) -> None:
        """Returns when the recording is over: its time, `stop`, or a failure."""
        self.over.wait()

    def run(self, motion: Callable[[], object]) -> None:
        """Runs the motion; that it was stopped because the recording was over is no error."""
        self._moving.set()
        try:
            motion()
        except MotionStopped:
            if not self.over.is_set():
                raise
        finally:
            self._moving.clear()

    def _supervise(self) -> None:
        before_s = time.monotonic()
        while not self._ended.wait(_TICK_S):
            now_s = time.monotonic()
            if not self._stream.paused:
                self._seconds += now_s - before_s
            before_s = now_s
            try:
                if not self.over.is_set():
                    self._tick()
                # Again and again: a motion may just have been between two moves.
                if self.over.is_set() and self._moving.is_set() and isinstance(self._robot, Robot):
                    self._robot.stop()
            except Exception as error:  # raised by the thread that leaves the `with` block
                self._error = self._error or error
                self.over.set()

    def _tick(self) -> None:
        self._log.flush()
        if self._seconds > self._fit_clocks_after_s:
            # For a recording that will be killed; ever more rarely, since a fit costs more and gains less.
            self._fit_clocks_after_s = 1.5 * self._seconds
            self._writer.fit_clocks()
        done = None if self._duration_s is None else min(1.0, self._seconds / self._duration_s)
        self.progress = Progress(self._ledger.stored, self._ledger.dropped, done)
        self._on_progress(self.progress)
        if done == 1.0 or self._stream.failed.is_set():
            self.over.set()


@contextlib.contextmanager
def recording(
    camera: Camera, robot: PoseSource | None, writer: SessionWriter, trigger: Trigger, warnings: list[str]
) -> Iterator[TraceLog]:
    """Camera started and trace running; the clocks are stored at the end, however it comes."""
    margin_s = 0.0 if robot is None else _TRACE_MARGIN_S
    try:
        with TraceLog(robot, writer) as log:
            try:
                time.sleep(margin_s)
                camera.start(trigger)
                yield log
            except BaseException:
                # The error under way is the one the user must see.
                with contextlib.suppress(ToolkitError):
                    camera.stop()
                raise
            camera.stop()
            time.sleep(margin_s)
    except BaseException:
        with contextlib.suppress(ToolkitError):
            writer.fit_clocks()
        raise
    warnings += clock_warnings(writer.fit_clocks(), moving=trigger == "free")
