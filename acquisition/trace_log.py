"""The arm's trace, moved into the session while it grows, so that a killed recording keeps its poses too."""

from __future__ import annotations

import contextlib
import threading
from collections.abc import Callable
from types import TracebackType
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from acquisition.clocks import FEWEST_SAMPLES, fit_clock
from acquisition.robot import PoseSource
from dataset.errors import ToolkitError
from dataset.frames import RobotTrace
from dataset.session import SessionWriter

if TYPE_CHECKING:
    from typing_extensions import Self


class TraceLog:
    """Records an arm's trace from entering the `with` block to leaving it, and then the arm's clock.

    Args:
        source: connected, without a running trace; None for a recording without an arm.
        writer: of the session.
    """

    def __init__(self, source: PoseSource | None, writer: SessionWriter) -> None:
        self._source = source
        self._writer = writer
        self._lock = threading.Lock()
        self._robot_time_s: list[NDArray[np.float64]] = []
        self._host_time_ns: list[NDArray[np.int64]] = []

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
            self._finish(self._source)
            return
        # The error under way is the one the user must see.
        with contextlib.suppress(ToolkitError):
            self.flush()
        with contextlib.suppress(ToolkitError):
            self._finish(self._source)

    def flush(self) -> RobotTrace:
        """Stores the samples that are new and returns them. Raises DeviceError where the arm was lost."""
        if self._source is None:
            return _NO_SAMPLES
        trace = self._store(self._source, self._source.take_trace)
        self._source.sample()  # raises where no more will come
        return trace

    def store_clock(self) -> None:
        """Stores the arm's clock as the samples so far show it. Raises ToolkitError where it jumped."""
        with self._lock:
            robot_s, host_ns = self._robot_time_s.copy(), self._host_time_ns.copy()
        if sum(map(len, robot_s)) >= FEWEST_SAMPLES:
            robot_ns = np.rint(1e9 * np.concatenate(robot_s)).astype(np.int64)
            self._writer.set_clocks(robot=fit_clock(robot_ns, np.concatenate(host_ns)))

    def _finish(self, source: PoseSource) -> None:
        self._store(source, source.stop_trace)
        self.store_clock()

    def _store(self, source: PoseSource, take: Callable[[], RobotTrace]) -> RobotTrace:
        with self._lock:  # two threads that take and store in turns would mix the order
            trace = take()
            self._writer.add_robot_trace(trace, source.tcp_offset)
            self._robot_time_s.append(trace.robot_time_s)
            self._host_time_ns.append(trace.host_time_ns)
        return trace


_NO_SAMPLES = RobotTrace(
    host_time_ns=np.empty(0, np.int64),
    robot_time_s=np.empty(0),
    q=np.empty((0, 6)),
    pose=np.empty((0, 6)),
    safety_bits=np.empty(0, np.uint32),
)
