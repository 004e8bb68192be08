"""Frames on their way from a driver's grab thread to whoever reads them."""

from __future__ import annotations

import threading
from collections import deque

from acquisition.camera import CameraStatistics
from dataset.errors import ToolkitError
from dataset.frames import RawFrame

_CAPACITY = 16


class FrameQueue:
    """Bounded: when `_CAPACITY` newer frames wait, the oldest is dropped, and its id is missing in what is
    read. Counts what became of every frame."""

    def __init__(self) -> None:
        self._frames: deque[RawFrame] = deque()
        self._arrived = threading.Condition()
        self._not_before_ns = 0
        self._whole = self._incomplete = self._discarded = 0
        self._failure: ToolkitError | None = None

    def statistics(self, underruns: int) -> CameraStatistics:
        """Counts since the queue was made."""
        with self._arrived:
            return CameraStatistics(self._whole, self._incomplete, self._discarded, underruns)

    def put(self, frame: RawFrame) -> None:
        """Hands a whole frame over; one from before `discard_until` is dropped."""
        with self._arrived:
            self._whole += 1
            if frame.host_time_ns < self._not_before_ns:
                self._discarded += 1
                return
            if len(self._frames) == _CAPACITY:
                self._frames.popleft()
                self._discarded += 1
            self._frames.append(frame)
            self._arrived.notify_all()

    def count_incomplete(self) -> None:
        """One more frame arrived with packets missing."""
        with self._arrived:
            self._incomplete += 1

    def fail(self, error: ToolkitError) -> None:
        """Makes `take` raise the error when the frames before it are used up."""
        with self._arrived:
            self._failure = error
            self._arrived.notify_all()

    def recover(self) -> None:
        """Forgets a failure: frames come again."""
        with self._arrived:
            self._failure = None

    def discard_until(self, host_time_ns: int) -> None:
        """Drops every frame, waiting or on its way, whose first packet came before a host time."""
        with self._arrived:
            self._discarded += len(self._frames)
            self._frames.clear()
            self._not_before_ns = host_time_ns

    def take(self, timeout_s: float) -> RawFrame | None:
        """The oldest frame; None when there is none in time. Raises what `fail` was given."""
        with self._arrived:
            self._arrived.wait_for(lambda: self._frames or self._failure, timeout_s)
            if self._frames:
                return self._frames.popleft()
            if self._failure is not None:
                raise self._failure
            return None
