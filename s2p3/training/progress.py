"""How long work is shown: a bar with the latest losses and the time left."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager

from rich.progress import (
    BarColumn,
    MofNCompleteColumn,
    Progress,
    TextColumn,
    TimeElapsedColumn,
    TimeRemainingColumn,
)

OnStep = Callable[[int, int, dict[str, float]], None]
"""Called with steps done, steps in all, and the latest values by name."""


@contextmanager
def progress_bar(label: str, total: int, done: int = 0) -> Iterator[OnStep]:
    """A rich progress bar; yields the function that moves it."""
    columns = (
        TextColumn("{task.description}"),
        BarColumn(),
        MofNCompleteColumn(),
        TimeElapsedColumn(),
        TimeRemainingColumn(),
        TextColumn("{task.fields[values]}"),
    )
    with Progress(*columns) as bar:
        task = bar.add_task(label, total=total, completed=done, values="")

        def report(step: int, steps: int, values: dict[str, float]) -> None:
            shown = f"loss {values['total']:.3f}" if "total" in values else ""
            bar.update(task, completed=step, total=steps, values=shown)

        yield report
