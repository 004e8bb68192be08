"""The arm's trace, moved into the session while it grows, so that a killed recording keeps its poses too."""

from __future__ import annotations

import contextlib
import threading
from collections.abc import Callable
from types import TracebackType
from typing import TYPE_CHECKING

import numpy as np

from acquisition.robot import PoseSource
from dataset.errors import ToolkitError
from dataset.frames import RobotTrace
from dataset.session import SessionWriter

if TYPE_CHECKING:
    from typing_extensions import Self


class TraceLog:
    """Records an arm's trace from entering the `with` block to leaving it.

    Args:
        source: connected, without a running trace; None for a recording without an arm.
        writer: of the session.
    """

    def __init__(self, source: PoseSource | None, writer: SessionWriter) -> None:
        self._source = source
        self._writer = writer
        self._lock = threading.Lock()

    def __enter__(self) -> Self:
        if self._source is not None:
            self._source.start_trace()
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        if self._source is None:
            return
        if error is None:
            self._store(self._source, self._source.take_trace)  # kept even where the arm was lost at the end
            self._store(self._source, self._source.stop_trace)
            return
        # The error under way is the one the user must see.
        with contextlib.suppress(ToolkitError):
            self.flush()
        with contextlib.suppress(ToolkitError):
            self._store(self._source, self._source.stop_trace)

    def flush(self) -> RobotTrace:
        """Stores the samples that are new and returns them. Raises DeviceError where the arm was lost."""
        if self._source is None:
            return _NO_SAMPLES
        trace = self._store(self._source, self._source.take_trace)
        self._source.sample()  # raises where no more will come
        return trace

    def _store(self, source: PoseSource, take: Callable[[], RobotTrace]) -> RobotTrace:
        with self._lock:  # two threads that take and store in turns would mix the order
            trace = take()
            self._writer.add_robot_trace(trace, source.tcp_offset, source.payload)
        return trace


_NO_SAMPLES = RobotTrace(
    host_time_ns=np.empty(0, np.int64),
    robot_time_s=np.empty(0),
    q=np.empty((0, 6)),
    pose=np.empty((0, 6)),
    safety_bits=np.empty(0, np.uint32),
)
