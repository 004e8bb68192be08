"""How long work shows progress on the console, and how results are printed."""

from __future__ import annotations

import json
import time
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import ExitStack, contextmanager
from typing import TYPE_CHECKING, Any

from rich.console import Console
from rich.progress import (
    BarColumn,
    MofNCompleteColumn,
    Progress,
    TextColumn,
    TimeElapsedColumn,
    TimeRemainingColumn,
)

from s2p3.progress import Report

if TYPE_CHECKING:
    from acquisition.recorder import OnProgress
    from acquisition.recorder import Progress as Recorded

_QUIET_S = 60.0

console = Console(stderr=True, highlight=False)
"""For people. Results that a script would read go to stdout."""


def say(text: str) -> None:
    """A line for people, as it is: a path in it is neither wrapped nor taken for markup."""
    console.print(text, markup=False, soft_wrap=True)


@contextmanager
def counting(label: str) -> Iterator[Callable[[int, int], None]]:
    """A progress bar with an ETA; call the yielded function with (done, in all)."""
    with progress_bars((label,)) as report:
        yield lambda done, total: report(label, done, total, {})


@contextmanager
def progress_bars(labels: Iterable[str] = ()) -> Iterator[Report]:
    """A progress bar with an ETA for each of these labels, and for every other that the yielded function is
    called with; where there is no terminal, a line now and then.

    Nothing is shown before the first call: a mistake found until then is told in one line.
    """
    if not console.is_terminal:
        yield _lines()
        return
    columns = (
        TextColumn("  {task.description}"),
        BarColumn(),
        MofNCompleteColumn(),
        TimeElapsedColumn(),
        TimeRemainingColumn(),
        TextColumn("{task.fields[loss]}"),
    )
    bars = Progress(*columns, console=console)
    tasks = {label: bars.add_task(label, total=None, loss="") for label in labels}
    with ExitStack() as stack:

        def report(label: str, done: int, total: int, values: Mapping[str, float]) -> None:
            if not bars.live.is_started:
                stack.enter_context(bars)
            if label not in tasks:
                tasks[label] = bars.add_task(label, total=total, loss="")
            bars.update(tasks[label], completed=done, total=total, loss=_loss(values))

        yield report


def _lines() -> Report:
    """For log files: a line at the end of each work, and one a minute on the way."""
    said: dict[str, tuple[str, float]] = {}

    def report(label: str, done: int, total: int, values: Mapping[str, float]) -> None:
        now, line = time.monotonic(), f"{label} {done}/{total} {_loss(values)}".rstrip()
        last, when = said.setdefault(label, ("", now))
        if line != last and (done == total or now > when + _QUIET_S):
            said[label] = (line, now)
            say(line)

    return report


def _loss(values: Mapping[str, float]) -> str:
    return f"loss {values['total']:.3f}" if "total" in values else ""


@contextmanager
def recording(label: str) -> Iterator[OnProgress]:
    """A progress bar for a recording."""
    with counting(label) as bar:

        def report(progress: Recorded) -> None:
            total = round(progress.frames / progress.done) if progress.done else progress.frames
            bar(progress.frames, max(total, progress.frames))

        yield report


def show(values: Mapping[str, Any], as_json: bool) -> None:
    """Prints one result: JSON for a script, aligned lines for a person."""
    if as_json:
        print(json.dumps(values, indent=1, default=str))
        return
    width = max((len(name) for name in values), default=0)
    for name, value in values.items():
        print(f"{name:<{width}}  {_readable(value)}")


def _readable(value: Any) -> str:
    if isinstance(value, float):
        return f"{value:.5g}"
    if isinstance(value, Mapping):
        return ", ".join(f"{name} {_readable(item)}" for name, item in value.items()) or "none"
    if isinstance(value, (list, tuple)):
        return ", ".join(_readable(item) for item in value) or "none"
    return str(value)
