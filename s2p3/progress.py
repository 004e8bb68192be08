"""How work says how far it is: by a function that it is given. The library itself shows nothing."""

from __future__ import annotations

from collections.abc import Callable, Mapping

Report = Callable[[str, int, int, Mapping[str, float]], None]
"""Told what is being done, how much of it is done, of how much, and the latest values by name."""


def quiet(label: str, done: int, total: int, values: Mapping[str, float]) -> None:
    """Shows nothing."""
    del label, done, total, values
