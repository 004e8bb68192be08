"""From a running camera into a session: one thread reads, several compress, one writes in order.

The queue between them is bounded. A frame that finds it full is dropped and entered into the ledger of the
session, as is every gap of the camera's counter: between the first and the last frame nothing is lost in
silence. A pause is declared as such: its frames are neither stored nor lost.
"""

from __future__ import annotations

import queue
import threading
import time
from collections import deque
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass, replace
from types import TracebackType
from typing import TYPE_CHECKING

from acquisition.camera import Camera, CameraLost
from dataset.errors import DeviceError, ToolkitError
from dataset.frames import CameraInfo, RawFrame
from dataset.session import Chunk, SessionWriter, compress

if TYPE_CHECKING:
    from typing_extensions import Self

QUEUE_FULL = "recorder busy: queue full"
NOT_RECEIVED = "lost on the way, or not read in time"

_MEMORY_BYTES = 400_000_000
_FEWEST_HELD, _MOST_HELD = 8, 256
"""Our choice. A disk that writes back what it has cached can stand still for seconds: what is held meanwhile
is stored afterwards, what is not held is lost for certain."""
_SECOND_LOOK_S = 0.5
_LATENCIES = 16384
_LARGEST_GAP = 100_000
"""More frames than a camera could lose in an hour: its counter is no counter (our choice)."""

UNKNOWN_FRAME_ID = -1
"""Stands in the ledger for a frame that was asked for and never came."""


class FrameLedger:
    """Stores frames, and enters those that are missing between them into the session's ledger.

    In a session that is appended to, ids go on from the last one that it knows.

    Attributes:
        stored, dropped, paused: frames so far.
    """

    def __init__(self, writer: SessionWriter) -> None:
        self.stored = 0
        self.dropped = 0
        self.paused = 0
        self._writer = writer
        self._last_id: int | None = None
        self._offset = 0
        self._pause: _Pause | None = None

    def store(self, frame: RawFrame, chunk: Chunk | None = None) -> None:
        """Stores the frame, and ledgers those between it and the one before.

        Raises DeviceError where more are missing than a camera loses, SessionError where the disk refuses.
        """
        frame_id = self._arrived(frame.frame_id, frame.host_time_ns)
        self._writer.add_frame(replace(frame, frame_id=frame_id), chunk)
        self.stored += 1

    def drop(self, frame_id: int, reason: str, host_time_ns: int) -> None:
        """Ledgers a frame that arrived and is not stored, and those between it and the one before."""
        self._enter(self._arrived(frame_id, host_time_ns), reason, host_time_ns)

    def skip(self, frame_id: int, reason: str, host_time_ns: int) -> None:
        """Counts a frame that came during a pause, with those between it and another such before it."""
        if self._pause is None or self._pause.reason != reason:
            known = self._arrived(frame_id, host_time_ns)
            self._pause = _Pause(known, known, reason, host_time_ns)
        else:
            known = frame_id + self._offset
            self._pause = replace(self._pause, last_id=known)
            self._last_id = known
        self.paused += 1

    def never_came(self, reason: str, host_time_ns: int) -> None:
        """Ledgers a frame that was asked for, whose number nobody knows."""
        self._enter(UNKNOWN_FRAME_ID, reason, host_time_ns)

    def end_pause(self, host_time_ns: int) -> None:
        """Declares the pause that is open in the session; harmless where there is none."""
        pause, self._pause = self._pause, None
        if pause is not None:
            self._writer.add_pause(pause.first_id, pause.last_id, pause.reason, pause.since_ns, host_time_ns)

    def _arrived(self, camera_id: int, host_time_ns: int) -> int:
        """The id of a frame in the session, whose predecessors are now accounted for."""
        self.end_pause(host_time_ns)
        if self._last_id is None:
            before = self._writer.last_known_id
            self._offset = 0 if before is None else before + 1 - camera_id
            self._last_id = camera_id + self._offset - 1
        frame_id = camera_id + self._offset
        if frame_id - self._last_id > _LARGEST_GAP:
            raise DeviceError(
                f"the camera's frame counter jumped from {self._last_id} to {frame_id}; restart the camera, "
                "and set how it numbers frames back to its default"
            )
        for missing in range(self._last_id + 1, frame_id):
            self._enter(missing, NOT_RECEIVED, host_time_ns)
        self._last_id = frame_id
        return frame_id

    def _enter(self, frame_id: int, reason: str, host_time_ns: int) -> None:
        self._writer.add_drop(frame_id, reason, host_time_ns)
        self.dropped += 1


@dataclass(frozen=True)
class _Pause:
    """Ids of the first and the last frame that came meanwhile, and when the first did."""

    first_id: int
    last_id: int
    reason: str
    since_ns: int


@dataclass(frozen=True)
class _Item:
    """A frame on its way to the file; without pixels where it is not to be stored, for a reason."""

    frame_id: int
    host_time_ns: int
    frame: RawFrame | None = None
    chunk: Future[Chunk] | None = None
    pause: str | None = None


class FrameStream:
    """Stores the frames of a started camera from entering the `with` block to leaving it.

    Leaving waits until all that was read is written, and raises what went wrong in the threads.

    Args:
        camera: started.
        ledger: of the session.
        depth: frames held in memory at most, beside the camera's own buffers; None for what fits 400 MB.
        threads: that compress.

    Attributes:
        failed: set as soon as something goes wrong.
        latest: the newest frame that was read, stored or not; None before the first.
        latencies_ms: of the newest stored frames, from their first packet to their being in the file.
    """

    def __init__(
        self, camera: Camera, ledger: FrameLedger, *, depth: int | None = None, threads: int = 2
    ) -> None:
        self.failed = threading.Event()
        self.latest: RawFrame | None = None
        self.latencies_ms: deque[float] = deque(maxlen=_LATENCIES)
        self._camera = camera
        self._ledger = ledger
        self._accepted = self._written = 0
        self._pause: str | None = None
        self._error: Exception | None = None
        self._stopping = threading.Event()
        self._slots = threading.Semaphore(_depth(camera.info) if depth is None else depth)
        self._items: queue.SimpleQueue[_Item | None] = queue.SimpleQueue()
        self._pool = ThreadPoolExecutor(threads, thread_name_prefix="compress")
        self._reader = threading.Thread(target=self._read, name="read-frames")
        self._writer = threading.Thread(target=self._write, name="write-frames")

    @property
    def queued(self) -> int:
        """Frames in memory that are not in the file yet."""
        return self._accepted - self._written

    @property
    def paused(self) -> bool:
        """Whether frames are read and not stored."""
        return self._pause is not None

    def pause(self, reason: str) -> None:
        """From the next frame on, frames are read for whoever looks at `latest`, and not stored."""
        self._pause = reason

    def resume(self) -> None:
        """Frames are stored again."""
        self._pause = None

    def __enter__(self) -> Self:
        self._reader.start()
        self._writer.start()
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        self._stopping.set()
        self._reader.join()
        self._writer.join()
        self._pool.shutdown()
        if self._error is not None and (error is None or isinstance(error, ToolkitError)):
            # What failed here first is why the rest was given up.
            raise self._error from error

    def _read(self) -> None:
        try:
            while not self._stopping.is_set():
                frame = self._next_frame()
                self.latest = frame
                self._items.put(self._item(frame))
        except Exception as error:  # handed to the thread that leaves the `with` block
            # When all is over, a frame that does not come is nobody's loss.
            if not self._stopping.is_set():
                self._fail(error)
        finally:
            self._items.put(None)

    def _item(self, frame: RawFrame) -> _Item:
        pause = self._pause
        if pause is not None:
            return _Item(frame.frame_id, frame.host_time_ns, pause=pause)
        if not self._slots.acquire(blocking=False):
            return _Item(frame.frame_id, frame.host_time_ns)
        self._accepted += 1
        return _Item(frame.frame_id, frame.host_time_ns, frame, self._pool.submit(compress, frame.pixels))

    def _next_frame(self) -> RawFrame:
        try:
            return self._camera.read()
        except DeviceError as error:
            # A host that stood still for longer than the time-out finds the frames waiting in the driver.
            try:
                return self._camera.read(_SECOND_LOOK_S)
            except CameraLost:
                raise
            except DeviceError:
                raise error from None

    def _write(self) -> None:
        try:
            while (item := self._items.get()) is not None:
                self._write_item(item)
            self._ledger.end_pause(time.monotonic_ns())
        except Exception as error:  # as above
            self._fail(error)

    def _write_item(self, item: _Item) -> None:
        if item.pause is not None:
            self._ledger.skip(item.frame_id, item.pause, item.host_time_ns)
        elif item.frame is None or item.chunk is None:
            self._ledger.drop(item.frame_id, QUEUE_FULL, item.host_time_ns)
        else:
            self._ledger.store(item.frame, item.chunk.result())
            self._written += 1
            self._slots.release()
            self.latencies_ms.append(1e-6 * (time.monotonic_ns() - item.host_time_ns))

    def _fail(self, error: Exception) -> None:
        self._error = self._error or error
        self._stopping.set()
        self.failed.set()


def _depth(info: CameraInfo) -> int:
    """How many frames of a camera to hold in memory."""
    frame_bytes = info.width * info.height * (1 if info.bits <= 8 else 2)
    return min(max(_MEMORY_BYTES // frame_bytes, _FEWEST_HELD), _MOST_HELD)
