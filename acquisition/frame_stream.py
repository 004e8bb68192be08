"""From a running camera into a session: one thread reads, several compress, one writes in order.

The queue between them is bounded. A frame that finds it full is dropped and entered into the ledger of the
session, as is every gap of the camera's counter: between the first and the last frame nothing is lost in
silence.
"""

from __future__ import annotations

import queue
import threading
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass
from types import TracebackType
from typing import TYPE_CHECKING

from acquisition.camera import Camera
from acquisition.clocks import FEWEST_SAMPLES, fit_clock
from dataset.errors import DeviceError, ToolkitError
from dataset.frames import RawFrame
from dataset.session import Chunk, SessionWriter, compress

if TYPE_CHECKING:
    from typing_extensions import Self

QUEUE_FULL = "recorder busy: queue full"
NOT_RECEIVED = "lost on the way, or not read in time"

_SECOND_LOOK_S = 0.5

UNKNOWN_FRAME_ID = -1
"""Stands in the ledger for a frame that was asked for and never came."""


class FrameLedger:
    """Stores frames, and enters those that are missing between them into the session's ledger."""

    def __init__(self, writer: SessionWriter) -> None:
        self.stored = 0
        self.dropped = 0
        self._camera_time_ns: list[int] = []
        self._host_time_ns: list[int] = []
        self._writer = writer
        self._last_id: int | None = None

    def store(self, frame: RawFrame, chunk: Chunk | None = None) -> None:
        """Stores the frame, and ledgers those between it and the one before."""
        self._arrived(frame.frame_id, frame.host_time_ns)
        self._writer.add_frame(frame, chunk)
        self._camera_time_ns.append(frame.camera_time_ns)
        self._host_time_ns.append(frame.host_time_ns)
        self.stored += 1

    def drop(self, frame_id: int, reason: str, host_time_ns: int) -> None:
        """Ledgers a frame that arrived and is not stored, and those between it and the one before."""
        self._arrived(frame_id, host_time_ns)
        self._enter(frame_id, reason, host_time_ns)

    def never_came(self, reason: str, host_time_ns: int) -> None:
        """Ledgers a frame that was asked for, whose number nobody knows."""
        self._enter(UNKNOWN_FRAME_ID, reason, host_time_ns)

    def store_clock(self) -> None:
        """Stores the camera's clock as the frames so far show it; a handful of stills cannot, and needs none.

        Raises ToolkitError where the camera's clock jumped.
        """
        count = self.stored  # another thread may be storing
        if count >= FEWEST_SAMPLES:
            fit = fit_clock(self._camera_time_ns[:count], self._host_time_ns[:count])
            self._writer.set_clocks(camera=fit)

    def _arrived(self, frame_id: int, host_time_ns: int) -> None:
        first_missing = frame_id if self._last_id is None else self._last_id + 1
        for missing in range(first_missing, frame_id):
            self._enter(missing, NOT_RECEIVED, host_time_ns)
        self._last_id = frame_id

    def _enter(self, frame_id: int, reason: str, host_time_ns: int) -> None:
        self._writer.add_drop(frame_id, reason, host_time_ns)
        self.dropped += 1


@dataclass(frozen=True)
class _Item:
    """A frame on its way to the file; without pixels where the queue was full."""

    frame_id: int
    host_time_ns: int
    frame: RawFrame | None = None
    chunk: Future[Chunk] | None = None


class FrameStream:
    """Stores the frames of a started camera from entering the `with` block to leaving it.

    Leaving waits until all that was read is written, and raises what went wrong in the threads. `failed` is
    set as soon as something does.

    Args:
        camera: started.
        ledger: of the session.
        depth: frames held in memory at most, beside the camera's own buffers.
        threads: that compress.
    """

    def __init__(self, camera: Camera, ledger: FrameLedger, *, depth: int = 24, threads: int = 2) -> None:
        self.failed = threading.Event()
        self._camera = camera
        self._ledger = ledger
        self._error: Exception | None = None
        self._stopping = threading.Event()
        self._slots = threading.Semaphore(depth)
        self._items: queue.SimpleQueue[_Item | None] = queue.SimpleQueue()
        self._pool = ThreadPoolExecutor(threads, thread_name_prefix="compress")
        self._reader = threading.Thread(target=self._read, name="read-frames")
        self._writer = threading.Thread(target=self._write, name="write-frames")

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
                if self._slots.acquire(blocking=False):
                    chunk = self._pool.submit(compress, frame.pixels)
                    self._items.put(_Item(frame.frame_id, frame.host_time_ns, frame, chunk))
                else:
                    self._items.put(_Item(frame.frame_id, frame.host_time_ns))
        except Exception as error:  # handed to the thread that leaves the `with` block
            # When all is over, a frame that does not come is nobody's loss.
            if not self._stopping.is_set():
                self._fail(error)
        finally:
            self._items.put(None)

    def _next_frame(self) -> RawFrame:
        try:
            return self._camera.read()
        except DeviceError:
            # A host that stood still for longer than the time-out finds the frames waiting in the driver.
            return self._camera.read(_SECOND_LOOK_S)

    def _write(self) -> None:
        while (item := self._items.get()) is not None:
            try:
                if item.frame is None or item.chunk is None:
                    self._ledger.drop(item.frame_id, QUEUE_FULL, item.host_time_ns)
                    continue
                chunk = item.chunk.result()
                self._slots.release()
                self._ledger.store(item.frame, chunk)
            except Exception as error:  # as above
                self._fail(error)
                return

    def _fail(self, error: Exception) -> None:
        self._error = self._error or error
        self._stopping.set()
        self.failed.set()
