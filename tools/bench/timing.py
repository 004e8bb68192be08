"""Times functions against each other on a shared machine: in turns, so that what slows one slows all."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from statistics import median

Contenders = Mapping[str, Callable[[], object]]
Clock = Callable[[], float]
"""Seconds since some moment."""

wall_time: Clock = time.perf_counter
cpu_time: Clock = time.process_time
"""Of all threads of this process: for a machine that others use."""


def in_turns(
    contenders: Contenders, rounds: int = 40, warm_up: int = 3, clock: Clock = wall_time
) -> dict[str, float]:
    """Median milliseconds, by `clock`, of each function over rounds in which every one runs once."""
    for _ in range(warm_up):
        for run in contenders.values():
            run()
    times: dict[str, list[float]] = {name: [] for name in contenders}
    for _ in range(rounds):
        for name, run in contenders.items():
            start = clock()
            run()
            times[name].append(1e3 * (clock() - start))
    return {name: median(taken) for name, taken in times.items()}
