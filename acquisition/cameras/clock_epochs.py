"""When the camera's clock was set or restarted, as the frames' two times show it."""

from __future__ import annotations

_EARLY_NS = 50_000_000
_LATE_NS = 5_000_000_000
_LARGEST_RATE_ERROR = 0.01
_CREEP = 0.001
"""Our choices: how much too early a frame must come to prove that the clock was set forward, how much too
late to make a clock set back the likelier cause than a busy host; the worst clock, and the worst crystal."""


class ClockEpochs:
    """Counts the epochs of one camera's clock.

    A frame can arrive late, never early. So the clock was set when time went back, when a frame came earlier
    than the earliest before it allow, or later than any host is busy. Jumps that hide among the latencies
    (back by less than a frame's period, forward by less than 50 ms) are left to the fit of the clocks.
    """

    def __init__(self) -> None:
        self._epoch = 0
        self._previous_ns: int | None = None
        self._floor_ns = 0.0

    def restart(self) -> None:
        """The camera was opened anew: its clock may have begun anew."""
        self._epoch += 1
        self._previous_ns = None

    def of(self, camera_time_ns: int, host_time_ns: int) -> int:
        """The epoch of the next frame, by the start of its exposure and its arrival."""
        lag_ns = float(host_time_ns - camera_time_ns)
        if self._previous_ns is not None:
            step_ns = camera_time_ns - self._previous_ns
            early = lag_ns < self._floor_ns - _EARLY_NS - _LARGEST_RATE_ERROR * step_ns
            late = lag_ns > self._floor_ns + _LATE_NS + _LARGEST_RATE_ERROR * step_ns
            if step_ns <= 0 or early or late:
                self._epoch += 1
                self._previous_ns = None
            else:
                self._floor_ns = min(lag_ns, self._floor_ns + _CREEP * step_ns)
        if self._previous_ns is None:
            self._floor_ns = lag_ns
        self._previous_ns = camera_time_ns
        return self._epoch
