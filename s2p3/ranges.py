"""Which numbers a field of a configuration may hold."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any, NamedTuple

from dataset.errors import ToolkitError


class Range(NamedTuple):
    """The numbers that a field may hold, in words and as a test."""

    words: str
    holds: Callable[[float], bool]


def at_least(lowest: float, name: str = "") -> Range:
    """`lowest` or more; `name` says what that is."""
    called = f"{name} ({lowest:g})" if name else f"{lowest:g}"
    return Range(f"of {called} or more", lambda value: value >= lowest)


def between(lowest: float, highest: float) -> Range:
    """Both ends included."""
    return Range(f"from {lowest:g} to {highest:g}", lambda value: lowest <= value <= highest)


NOT_NEGATIVE, COUNT, SHARE = at_least(0), at_least(1), between(0, 1)
POSITIVE = Range("above 0", lambda value: value > 0)
BELOW_ONE = Range("from 0 to below 1", lambda value: 0 <= value < 1)
ODD = Range("that is odd", lambda value: value > 0 and value % 2 == 1)


def check(table: Any, **ranges: Range) -> None:
    """Raises ToolkitError: a field of `table` is outside its range, or not finite."""
    for name, (words, holds) in ranges.items():
        value = getattr(table, name)
        if not (math.isfinite(value) and holds(value)):
            raise ToolkitError(f"{name} = {value:g} is out of range; give a number {words}")
