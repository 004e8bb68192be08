"""`s2p3 capture`: record sessions with the devices of a rig."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Literal

import tyro

from s2p3.commands.output import console, counting

if TYPE_CHECKING:
    from acquisition.recorder import OnProgress, Progress


def capture(
    what: tyro.conf.Positional[Literal["intrinsics", "hand-eye", "board-motion", "tool-tip", "sequence"]],
    *,
    rig: Path,
    out: Path,
    views: int = 24,
    seconds: float = 60.0,
    points: int = 24,
) -> None:
    """Record a session with the devices of a rig; try it on the simulated ones with `s2p3 simulate`.

    Args:
        what: `intrinsics` and `hand-eye`: stills of the board; `board-motion`: the board filmed in motion,
            for the clock offset; `tool-tip`: points touched by hand; `sequence`: the object filmed from
            above.
        rig: rig.toml with the devices' addresses.
        out: session file to write; never overwritten.
        views: stills to take.
        seconds: of filming.
        points: to touch.
    """
    from acquisition import capture as captures
    from acquisition.rig import Rig

    devices = Rig.load(rig)
    with recording(what) as report:
        if what == "intrinsics":
            done = captures.capture_board(devices, out, kind="intrinsics", views=views, on_progress=report)
        elif what == "hand-eye":
            done = captures.capture_board(devices, out, kind="hand_eye", views=views, on_progress=report)
        elif what == "board-motion":
            done = captures.capture_board_motion(devices, out, seconds=seconds, on_progress=report)
        elif what == "tool-tip":
            done = captures.capture_touches(devices, out, count=points, on_progress=report)
        else:
            done = captures.capture_sequence(devices, out, seconds=seconds, on_progress=report)
    console.print(summary(out, done))


@contextmanager
def recording(label: str) -> Iterator[OnProgress]:
    """A progress bar for a recording."""
    with counting(label) as bar:

        def report(progress: Progress) -> None:
            total = (
                round(progress.frames / progress.done)
                if progress.done and progress.frames
                else progress.frames
            )
            bar(progress.frames, max(total, progress.frames))

        yield report


def summary(out: Path, done: Progress) -> str:
    """One line about a recording."""
    return f"{out}: {done.frames} stored, {done.dropped} dropped and in the ledger"
