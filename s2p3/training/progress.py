"""How long work is shown: a bar with the latest losses and the time left."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager

from rich.console import Console
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
def reporting(label: str, total: int, on_step: OnStep | None = None) -> Iterator[OnStep]:
    """Yields the caller's `on_step`, or without one the function that moves a new progress bar."""
    if on_step is not None:
        yield on_step
        return
    with progress_bar(label, total) as report:
        yield report


@contextmanager
def progress_bar(label: str, total: int) -> Iterator[OnStep]:
    """A rich progress bar on stderr, from the first step on; yields the function that moves it."""
    columns = (
        TextColumn("{task.description}"),
        BarColumn(),
        MofNCompleteColumn(),
        TimeElapsedColumn(),
        TimeRemainingColumn(),
        TextColumn("{task.fields[values]}"),
    )
    bar = Progress(*columns, console=Console(stderr=True))
    task = bar.add_task(label, total=total, values="")
    with ExitStack() as stack:

        def report(step: int, steps: int, values: dict[str, float]) -> None:
            if not bar.live.is_started:
                stack.enter_context(bar)
            shown = f"loss {values['total']:.3f}" if "total" in values else ""
            bar.update(task, completed=step, total=steps, values=shown)

        yield report
