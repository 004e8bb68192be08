"""How work that takes long says how far it is: by a function that it is given."""

from __future__ import annotations

from collections.abc import Callable

Progress = Callable[[int, int], None]
"""Told how much is done, and of how much."""


def silent(done: int, total: int) -> None:
    """Shows nothing."""
    del done, total
