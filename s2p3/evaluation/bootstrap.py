"""How far figures may be off by chance: bootstrap intervals (Efron 1979) over targets.

Neighbouring frames of a film err alike, so blocks of consecutive targets are drawn, not single ones (circular
block bootstrap, Politis & Romano 1992); the block's length is our choice. Every figure of a run, and every
run of a comparison, is computed on the same draws.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]
Interval = tuple[float, float]

DRAWS = 1000
BLOCK = 10
"""Consecutive targets drawn together; fewer where there are few targets."""
LEVEL = 0.95

_SMALLEST_COUNT_OF_BLOCKS = 10
_CHUNK = 1_000_000  # values resampled at once


def resamples(count: int, draws: int = DRAWS, block: int = BLOCK, seed: int = 0) -> NDArray[np.int64]:
    """(draws, count) indices of targets, each row one resampling; the same for the same arguments."""
    length = max(1, min(block, count // _SMALLEST_COUNT_OF_BLOCKS))
    rng = np.random.default_rng(seed)
    starts = rng.integers(0, count, (draws, -(-count // length)))
    rows: NDArray[np.int64] = (starts[..., None] + np.arange(length)).reshape(draws, -1)[:, :count] % count
    return rows


def interval(
    statistic: Callable[[NDArray[np.int64]], Floats], rows: NDArray[np.int64], level: float = LEVEL
) -> Interval:
    """Percentile interval of a statistic, which maps indices (B, N) to figures (B,); NaN where no draw has
    one."""
    step = max(1, _CHUNK // max(1, rows.shape[1]))
    drawn = np.concatenate([statistic(rows[i : i + step]) for i in range(0, len(rows), step)])
    drawn = drawn[np.isfinite(drawn)]
    if not len(drawn):
        return float("nan"), float("nan")
    low, high = np.quantile(drawn, [(1 - level) / 2, (1 + level) / 2])
    return float(low), float(high)


def mean(values: Floats) -> Floats:
    """(B, N) -> (B,)."""
    averages: Floats = values.mean(axis=-1)
    return averages


def median(values: Floats) -> Floats:
    """(B, N) -> (B,), NaNs left out; NaN where a row has nothing else."""
    if np.isnan(values).all():
        return np.full(len(values), np.nan)
    ordered = np.sort(values, axis=-1)  # NaNs go last
    found, rows = np.isfinite(ordered).sum(axis=-1), np.arange(len(ordered))
    middle: Floats = (ordered[rows, np.maximum(found - 1, 0) // 2] + ordered[rows, found // 2]) / 2
    return np.where(found > 0, middle, np.nan)
