"""How a device's clock runs against the host's, while one looks."""

from __future__ import annotations

import threading
from collections import deque

from dataset.clocks import DeviceClock, fit_clock

_SPAN_NS = 60_000_000_000
_APART_NS = 20_000_000  # nearer samples would only make the fit slower
_FEWEST_S = 5.0  # before, a rate says more about the host than about the device


class ClockWatch:
    """Keeps the arrivals of the last minute. Its methods may be called from several threads."""

    def __init__(self) -> None:
        self._arrivals: deque[tuple[int, int]] = deque()
        self._lock = threading.Lock()

    def clear(self) -> None:
        """Forgets everything: the device was opened anew, and its clock may have been."""
        with self._lock:
            self._arrivals.clear()

    def add(self, device_ns: int, host_ns: int) -> None:
        """One arrival: when it happened on the device's clock, and when it was first seen on the host's."""
        with self._lock:
            if self._arrivals and host_ns < self._arrivals[-1][1] + _APART_NS:
                return
            self._arrivals.append((device_ns, host_ns))
            while self._arrivals[0][1] < host_ns - _SPAN_NS:
                self._arrivals.popleft()

    def fit(self) -> DeviceClock | None:
        """The clock on the host's by the arrivals so far; None while they span less than five seconds.

        Raises ToolkitError where the times make no clock.
        """
        with self._lock:
            arrivals = list(self._arrivals)
        if len(arrivals) < 2 or (arrivals[-1][1] - arrivals[0][1]) * 1e-9 < _FEWEST_S:
            return None
        device_ns, host_ns = zip(*arrivals, strict=True)
        return fit_clock(device_ns, host_ns)
