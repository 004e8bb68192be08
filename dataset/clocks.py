"""Relating a device's clock to the host's from nothing but arrival times.

A sample can reach the host late, never early, so the truth lies along the lower envelope of host time against
device time. That envelope is a chain of straight pieces, because a crystal's rate follows its temperature;
it begins anew where the device restarted or its clock was set. The constant part of the latency cannot be
told from an offset between the clocks; it is estimated from motion instead.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.optimize import linprog

from dataset.errors import ToolkitError
from dataset.frames import ClockFit

Floats = NDArray[np.float64]
Times = NDArray[np.int64]

_WINDOW_S = 1.0
_FEWEST_WINDOWS, _ENOUGH_WINDOWS, _MOST_WINDOWS = 8, 24, 400  # shorter for a short capture, longer for hours
_SAMPLES_PER_WINDOW = 4  # and longer ones for single pictures, of which each can be late
_PAUSE_STEPS = 10
_PIECE_S = 300.0  # our choice: a rate that changes by 1 ppm in ten minutes bends by 20 us within a piece
_WINDOWS_PER_PIECE = 20
_CRYSTAL_PPM = 50.0  # our choice: how far a device's rate is expected from the host's before the data speak
_TYPICAL_BEND_PPM, _LARGEST_BEND_PPM = (
    0.5,
    5.0,
)  # from one piece to the next, as a camera warms up; our choice
_LARGEST_RATE_ERROR = 0.01  # beyond it the times are in another unit
_LARGEST_SPAN_RATIO = 3.0  # of a whole run on both clocks; late arrivals stretch a short one
_ROUNDS = 4

FEWEST_SAMPLES = 5
"""Fewer arrivals than this cannot show a rate; the device's is then taken as the host's."""
ARRIVAL_SIGMA_NS = 5e6
"""How late a single arrival may be on a busy host (our choice)."""

_BUSY_NS = 1_000_000_000  # our choice: the latest that a host which stood still explains an arrival
_JUMP_NS = 200_000_000  # our choice: what a busy host explains less well than a clock that was set
_JUMP_NEIGHBOURS = 30

_CHUNKS, _WITNESS = 4, 3


@dataclass(frozen=True)
class DeviceClock:
    """A device's clock on the host's, over all samples of a recording: straight pieces, one after another.

    Attributes:
        first: row of the sample with which each piece begins; increasing, the first is 0.
        fits: the line of each piece.
        restarts: rows at which the device's clock was found to start anew or to jump.
    """

    first: tuple[int, ...]
    fits: tuple[ClockFit, ...]
    restarts: tuple[int, ...] = ()

    @property
    def sigma_ns(self) -> float:
        """The largest standard deviation of a piece."""
        return max(fit.sigma_ns for fit in self.fits)

    def to_host(self, device_ns: ArrayLike) -> Times:
        """(N,) host nanoseconds of all N samples, in the order in which they were recorded."""
        device = np.asarray(device_ns, dtype=np.int64)
        host = np.empty_like(device)
        for begin, end, fit in self._pieces(len(device)):
            host[begin:end] = fit.to_host(device[begin:end])
        return host

    def sigmas_ns(self, count: int) -> Floats:
        """(count,) standard deviation of the host time of each sample, nanoseconds."""
        sigmas = np.empty(count)
        for begin, end, fit in self._pieces(count):
            sigmas[begin:end] = fit.sigma_ns
        return sigmas

    def _pieces(self, count: int) -> list[tuple[int, int, ClockFit]]:
        ends = (*self.first[1:], count)
        return [(a, min(b, count), fit) for a, b, fit in zip(self.first, ends, self.fits, strict=True)]


def fit_clock(device_ns: ArrayLike, host_ns: ArrayLike, starts: Sequence[int] = (0,)) -> DeviceClock:
    """The chain of lines host = a + b * device along the lower envelope of the arrivals.

    Of each second the earliest arrival; then, piece by piece of five minutes, the lines that lie under all
    of them and least so, where an arrival counts the less the later it is. Rates are drawn towards 1 with the
    accuracy of a crystal and towards the neighbouring piece's, which only shows where there is little data.

    Args:
        device_ns: (N,) times on the device's clock, nanoseconds. Where they go back, or jump ahead of the
            host's by more than 0.2 s for good, the clock begins anew.
        host_ns: (N,) when each was first seen, host monotonic nanoseconds; packets read together share one.
        starts: rows at which the device is known to have started anew; the first is 0.

    Returns:
        The clock. Its sigmas say how far above the line the best arrivals lie, in the stretch of each piece
        where they lie farthest: they cover jitter, arrivals that were all late for a while, and a rate that
        changed within a piece; they cannot see a latency that is always there.

    Raises:
        ToolkitError: no sample, lengths that differ, host times that go back, or clocks whose rates differ
            by more than 1 %.
    """
    device, host = np.asarray(device_ns, dtype=np.int64), np.asarray(host_ns, dtype=np.int64)
    _check(device, host)
    found = [row for row in _restarts(device, host) if row not in starts]
    begins = sorted({*(row for row in starts if row < len(device)), *found})
    first: list[int] = []
    fits: list[ClockFit] = []
    for begin, end in zip(begins, [*begins[1:], len(device)], strict=True):
        rows, lines = _fit_run(device[begin:end], host[begin:end])
        first += [begin + row for row in rows]
        fits += lines
    return DeviceClock(tuple(first), tuple(fits), tuple(found))


def _check(device: Times, host: Times) -> None:
    if device.ndim != 1 or device.shape != host.shape:
        raise ToolkitError(f"fit_clock: {device.shape} device and {host.shape} host times; give N of each")
    if len(device) == 0:
        raise ToolkitError("fit_clock: no sample, so no clock; record at least one")
    step = np.diff(host)
    if step.size and step.min() < 0:
        index = int(np.argmax(step < 0)) + 1
        raise ToolkitError(
            f"fit_clock: the host time goes from {host[index - 1]} to {host[index]} ns at sample {index}: "
            "this computer was restarted in between; use only the samples before or after"
        )


def _restarts(device: Times, host: Times) -> list[int]:
    """Rows before which the device's clock went back, or jumped ahead and stayed there.

    An arrival that was very late, and those lost behind it, look like a jump at first; but then the arrivals
    before it were on time with those after it.
    """
    device_step, host_step = np.diff(device), np.diff(host)
    back = device_step < 0
    ahead = device_step - host_step > _JUMP_NS
    rows = []
    for row in np.flatnonzero(back | ahead) + 1:
        if not back[row - 1]:
            near = slice(max(0, row - _JUMP_NEIGHBOURS), row), slice(row, row + _JUMP_NEIGHBOURS)
            before, after = ((host[part] - device[part]).min() for part in near)
            if before - after < _JUMP_NS:
                continue
        rows.append(int(row))
    return rows


def _fit_run(device: Times, host: Times) -> tuple[list[int], list[ClockFit]]:
    """The rows at which the pieces of one uninterrupted run begin, and their lines."""
    span_ns = int(device[-1]) - int(device[0])
    lateness = ((host - host[0]) - (device - device[0])).astype(np.float64)  # ns; small, so exact as a float
    offset_ns = int(host[0]) - int(device[0])
    unknown = [
        ClockFit(float(offset_ns + lateness.min()), 1.0, max(ARRIVAL_SIGMA_NS, float(np.ptp(lateness))))
    ]
    if len(device) < FEWEST_SAMPLES or span_ns == 0:
        return [0], unknown
    span_ratio = float(host[-1] - host[0]) / span_ns
    if not 1 / _LARGEST_SPAN_RATIO < span_ratio < _LARGEST_SPAN_RATIO:
        if abs(lateness[-1]) > _BUSY_NS:
            raise _other_unit(span_ratio)
        return [0], unknown
    elapsed = (device - device[0]) * 1e-9
    pieces = max(1, round(elapsed[-1] / _PIECE_S))
    times, earliest = _window_minima(elapsed, lateness, max(_MOST_WINDOWS, pieces * _WINDOWS_PER_PIECE))
    knots = _knots(times, float(elapsed[-1]), pieces)
    values = _lower_chain(times, earliest, knots)
    slopes = np.diff(values) / np.diff(knots)
    if np.abs(slopes).max() > _LARGEST_RATE_ERROR * 1e9:
        if np.ptp(values) > _BUSY_NS:
            raise _other_unit(1 + slopes[np.argmax(np.abs(slopes))] * 1e-9)
        return [0], unknown
    heights = earliest - np.interp(times, knots, values)
    first, fits = [], []
    for index, slope in enumerate(slopes):
        inside = (times >= knots[index]) & (times <= knots[index + 1])
        # host = host[0] + (device - device[0]) + value + slope * (elapsed - knot), gathered by device.
        a_ns = offset_ns + values[index] - slope * (knots[index] + int(device[0]) * 1e-9)
        fits.append(ClockFit(float(a_ns), 1.0 + slope * 1e-9, _witnessed(heights[inside])))
        first.append(int(np.searchsorted(elapsed, knots[index])))
    return first, fits


def _knots(times_s: Floats, span_s: float, pieces: int) -> Floats:
    """Where pieces meet: at equal distances, but for those between which too little arrived to place a line,
    as in a pause."""
    knots, begun = [0.0], 0
    for knot in np.linspace(0.0, span_s, pieces + 1)[1:-1]:
        ended = int(np.searchsorted(times_s, knot))
        if min(ended - begun, len(times_s) - ended) >= _WITNESS:
            knots.append(float(knot))
            begun = ended
    return np.array([*knots, span_s])


def _other_unit(ratio: float) -> ToolkitError:
    return ToolkitError(
        f"fit_clock: {ratio:.4g} s pass on the host's clock in a second of the device's; its times are not "
        "in nanoseconds, or its clock was set during the recording: record again"
    )


def _window_minima(elapsed_s: Floats, lateness_ns: Floats, most: int) -> tuple[Floats, Floats]:
    """The least late sample of every window: its time and its lateness."""
    busy_s = _without_pauses(elapsed_s)
    span = float(busy_s[-1])
    wanted = min(max(span / _WINDOW_S, _ENOUGH_WINDOWS), len(elapsed_s) / _SAMPLES_PER_WINDOW)
    count = int(np.clip(wanted, _FEWEST_WINDOWS, most))
    window = np.minimum((busy_s * (count / span)).astype(np.int64), count - 1)
    order = np.lexsort((lateness_ns, window))
    chosen = order[np.flatnonzero(np.diff(window[order], prepend=-1))]
    return elapsed_s[chosen], lateness_ns[chosen]


def _without_pauses(elapsed_s: Floats) -> Floats:
    """Times on which a pause is no longer than ten samples usually are apart, or a window."""
    steps = np.diff(elapsed_s)
    longest = max(_WINDOW_S, _PAUSE_STEPS * float(np.median(steps)))
    if steps.max() <= longest:
        return elapsed_s
    return np.concatenate([elapsed_s[:1], elapsed_s[0] + np.cumsum(np.minimum(steps, longest))])


def _lower_chain(times_s: Floats, values_ns: Floats, knots_s: Floats) -> Floats:
    """Values at the knots of the polyline that no value lies under and the values lie least above.

    A linear program: with equal weights the maximum of likelihood where lateness is exponential. The weights
    are then lowered for what turned out late, so that a minute in which all was late does not pull.
    """
    pieces = len(knots_s) - 1
    share = np.clip((times_s[:, None] - knots_s[:-1]) / np.diff(knots_s), 0.0, 1.0)
    # Unknowns: the value at the first knot, each piece's rate (ppm), and the sizes of what is penalised.
    lengths = 1e3 * np.diff(knots_s)  # a ppm gains this many nanoseconds over a piece
    line = np.column_stack([np.ones(len(times_s)), share * lengths])
    penalised = np.eye(pieces) - np.eye(pieces, k=-1)  # the first rate, then the bends
    zeros = np.zeros((pieces, 1))
    limits = np.block(
        [
            [line, np.zeros((len(times_s), pieces))],
            [zeros, penalised, -np.eye(pieces)],
            [zeros, -penalised, -np.eye(pieces)],
        ]
    )
    lowest = float(values_ns.min())
    right = np.concatenate([values_ns - lowest, np.zeros(2 * pieces)])
    typical = np.array([_CRYSTAL_PPM] + [_TYPICAL_BEND_PPM] * (pieces - 1))
    largest = np.array([2e6 * _LARGEST_RATE_ERROR] + [_LARGEST_BEND_PPM] * (pieces - 1))
    bounds = [(None, None)] * (1 + pieces) + [(0.0, float(size)) for size in largest]
    heights = values_ns - lowest
    scale = float(np.median(heights)) + 1.0
    weights = np.full(len(times_s), 1.0 / scale)
    for _ in range(_ROUNDS):
        cost = np.concatenate([-(weights @ line), 1.0 / typical])
        found = linprog(cost, A_ub=limits, b_ub=right, bounds=bounds, method="highs")
        if not found.success:
            raise ToolkitError(f"fit_clock: no line lies under the arrivals ({found.message}); record again")
        heights = values_ns - lowest - line @ found.x[: 1 + pieces]
        scale = float(np.quantile(heights, 0.25)) + 1.0
        weights = 1.0 / (scale + np.maximum(heights, 0.0))
    rates = found.x[1 : 1 + pieces]
    return lowest + found.x[0] + np.concatenate([[0.0], np.cumsum(rates * lengths)])


def _witnessed(heights_ns: Floats) -> float:
    """How far above the line its witnesses lie: the third lowest arrival, in the worst stretch of a piece.

    Where there are only a few arrivals, three of them may agree by chance: then the typical one.
    """
    chunks = int(np.clip(len(heights_ns) // (_WITNESS + 1), 1, _CHUNKS))
    worst = max(np.sort(chunk)[:_WITNESS][-1] for chunk in np.array_split(heights_ns, chunks))
    typical = np.median(heights_ns) if len(heights_ns) < _ENOUGH_WINDOWS else 0.0
    return float(max(worst, typical)) + 1.0
