"""Relating a device's clock to the host's from nothing but arrival times.

A sample can reach the host late, never early, so the truth lies along the lower envelope of host time against
device time. The constant part of the latency cannot be told from an offset between the clocks; it is
estimated from motion instead.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.optimize import minimize_scalar

from dataset.errors import ToolkitError
from dataset.frames import ClockFit

Floats = NDArray[np.float64]

_WINDOW_S = 1.0
_FEWEST_WINDOWS, _MOST_WINDOWS = 8, 400  # shorter windows for a short capture, longer ones for hours
_SAMPLES_PER_WINDOW = 4  # and longer ones for single pictures, of which each can be late
FEWEST_SAMPLES = 5
_CRYSTAL_PPM = 50.0  # our choice: how far a device's rate is expected from the host's before the data speak
_LARGEST_RATE_ERROR = 0.01  # beyond it the times are in another unit
_LARGEST_SPAN_RATIO = 3.0  # of the whole capture on both clocks; late arrivals stretch a short one
_ROUNDS = 3


def fit_clock(device_ns: ArrayLike, host_ns: ArrayLike) -> ClockFit:
    """The line host = a + b * device along the lower envelope of the arrivals.

    The earliest arrival of each second, then the line that touches those from below; the rate is drawn
    towards 1 with the accuracy of a crystal, which only shows where the capture lasts a few seconds.

    Args:
        device_ns: (N,) times on the device's clock, nanoseconds, strictly increasing.
        host_ns: (N,) when each was first seen, host monotonic nanoseconds; packets read together share one.

    Returns:
        The fit. Its sigma is how much later than the line the earliest arrivals typically are: it bounds the
        jitter, and cannot see a latency that is always there.

    Raises:
        ToolkitError: fewer than 5 samples, lengths that differ, times that do not increase, or clocks whose
            rates differ by more than 1 %.
    """
    device, host = np.asarray(device_ns, dtype=np.int64), np.asarray(host_ns, dtype=np.int64)
    _check(device, host)
    elapsed = (device - device[0]) * 1e-9
    span_ratio = float(host[-1] - host[0]) / float(device[-1] - device[0])
    if not 1 / _LARGEST_SPAN_RATIO < span_ratio < _LARGEST_SPAN_RATIO:
        raise _other_unit(span_ratio)
    lateness = ((host - host[0]) - (device - device[0])).astype(np.float64)  # ns; small, so exact as a float
    times, earliest = _window_minima(elapsed, lateness)
    centre, slope, height = _lower_line(times, earliest)
    if abs(slope) > _LARGEST_RATE_ERROR * 1e9:
        raise _other_unit(1 + slope * 1e-9)
    b = 1.0 + slope * 1e-9
    # host = host[0] + (device - device[0]) + centre + slope * (elapsed - mean), gathered by powers of device.
    middle = float(times.mean())
    offset_ns = int(host[0]) - int(device[0])
    a_ns = offset_ns + centre - slope * (middle + int(device[0]) * 1e-9)
    return ClockFit(a_ns=float(a_ns), b=b, sigma_ns=height)


def _other_unit(ratio: float) -> ToolkitError:
    return ToolkitError(
        f"fit_clock: {ratio:.4g} s pass on the host's clock in a second of the device's; its times are not "
        "in nanoseconds, or its clock was set during the recording: record again"
    )


def _check(device: NDArray[np.int64], host: NDArray[np.int64]) -> None:
    if device.ndim != 1 or device.shape != host.shape:
        raise ToolkitError(f"fit_clock: {device.shape} device and {host.shape} host times; give N of each")
    if len(device) < FEWEST_SAMPLES:
        raise ToolkitError(
            f"fit_clock: {len(device)} samples cannot relate two clocks; record at least {FEWEST_SAMPLES}"
        )
    for name, times, allowed in (("device", device, 1), ("host", host, 0)):
        step = np.diff(times)
        if step.min() < allowed:
            index = int(np.argmax(step < allowed)) + 1
            raise ToolkitError(
                f"fit_clock: the {name} time goes from {times[index - 1]} to {times[index]} ns at sample "
                f"{index}: the device restarted or its clock was set: use only the samples before or after"
            )


def _window_minima(elapsed_s: Floats, lateness_ns: Floats) -> tuple[Floats, Floats]:
    """The least late sample of every window: its time and its lateness."""
    span = float(elapsed_s[-1])
    wanted = min(span / _WINDOW_S, len(elapsed_s) / _SAMPLES_PER_WINDOW)
    count = int(np.clip(wanted, _FEWEST_WINDOWS, _MOST_WINDOWS))
    window = np.minimum((elapsed_s * (count / span)).astype(np.int64), count - 1)
    order = np.lexsort((lateness_ns, window))
    first = np.flatnonzero(np.diff(window[order], prepend=-1))
    chosen = order[first]
    return elapsed_s[chosen], lateness_ns[chosen]


def _lower_line(times_s: Floats, values_ns: Floats) -> tuple[float, float, float]:
    """The value at the mean time, the slope per second, and the typical height of the values above the line.

    The line that no value lies under and the values lie least above: the maximum of likelihood where lateness
    is exponential. The crystal's accuracy keeps the slope of a short capture from following its jitter. For a
    given slope the best value is the lowest that touches; what remains is convex in the slope.
    """
    centred = times_s - times_s.mean()
    prior = _CRYSTAL_PPM * 1e3  # ns per second

    def touching(slope: float) -> float:
        return float((values_ns - slope * centred).min())

    scale, slope = float(np.median(values_ns) - values_ns.min()) + 1.0, 0.0
    for _ in range(_ROUNDS):
        weight = len(values_ns) / scale

        def cost(slope: float, weight: float = weight) -> float:
            return -weight * touching(slope) + 0.5 * (slope / prior) ** 2

        steepest = 2 * _LARGEST_RATE_ERROR * 1e9
        found = minimize_scalar(cost, bounds=(-steepest, steepest), method="bounded", options={"xatol": 1.0})
        slope = float(found.x)
        scale = float(np.median(values_ns - slope * centred)) - touching(slope) + 1.0
    return touching(slope), slope, scale
