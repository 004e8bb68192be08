"""`s2p3 capture ...`: record sessions with the devices of a rig."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING

from s2p3.commands.arguments import at_least
from s2p3.commands.output import counting, say

if TYPE_CHECKING:
    from acquisition.recorder import OnProgress, Progress


def intrinsics(*, rig: Path, out: Path, views: int = 24) -> None:
    """Take stills of the board from diverse directions, for the camera's intrinsics.

    Args:
        rig: rig.toml with the devices' addresses.
        out: session file to write; never overwritten.
        views: how many stills to take.
    """
    from acquisition.capture import capture_board
    from acquisition.rig import Rig

    at_least(1, views=views)
    with recording("stills") as report:
        done = capture_board(Rig.load(rig), out, kind="intrinsics", views=views, on_progress=report)
    say(summary(out, done))


def hand_eye(*, rig: Path, out: Path, views: int = 24) -> None:
    """Take stills of the board from diverse directions, for the camera's place on the arm.

    Args:
        rig: rig.toml with the devices' addresses.
        out: session file to write; never overwritten.
        views: how many stills to take.
    """
    from acquisition.capture import capture_board
    from acquisition.rig import Rig

    at_least(1, views=views)
    with recording("stills") as report:
        done = capture_board(Rig.load(rig), out, kind="hand_eye", views=views, on_progress=report)
    say(summary(out, done))


def board_motion(*, rig: Path, out: Path, seconds: float = 14.0) -> None:
    """Film the board while the arm moves, for the delay between the clocks.

    Args:
        rig: rig.toml with the devices' addresses.
        out: session file to write; never overwritten.
        seconds: how long to film.
    """
    from acquisition.capture import capture_board_motion
    from acquisition.rig import Rig

    at_least(1, seconds=seconds)
    with recording("frames") as report:
        done = capture_board_motion(Rig.load(rig), out, seconds=seconds, on_progress=report)
    say(summary(out, done))


def tool_tip(*, rig: Path, out: Path, points: int = 24) -> None:
    """Record the arm while you guide its tip by hand from point to point on the object.

    Args:
        rig: rig.toml with the arm's address and tool offset.
        out: session file to write; never overwritten.
        points: how many to touch; hold the tip still on each for a second.
    """
    from acquisition.capture import capture_touches
    from acquisition.rig import Rig

    at_least(1, points=points)
    with recording("points") as report:
        done = capture_touches(Rig.load(rig), out, count=points, on_progress=report)
    say(f"{out}: {done.frames} points touched")


def sequence(*, rig: Path, out: Path, seconds: float = 60.0) -> None:
    """Film the object from all around while the arm moves.

    Args:
        rig: rig.toml with the devices' addresses.
        out: session file to write; never overwritten.
        seconds: how long to film.
    """
    from acquisition.capture import capture_sequence
    from acquisition.rig import Rig

    at_least(1, seconds=seconds)
    with recording("frames") as report:
        done = capture_sequence(Rig.load(rig), out, seconds=seconds, on_progress=report)
    say(summary(out, done))


@contextmanager
def recording(label: str) -> Iterator[OnProgress]:
    """A progress bar for a recording."""
    with counting(label) as bar:

        def report(progress: Progress) -> None:
            total = round(progress.frames / progress.done) if progress.done else progress.frames
            bar(progress.frames, max(total, progress.frames))

        yield report


def summary(out: Path, done: Progress) -> str:
    """One line about a recording."""
    return f"{out}: {done.frames} frames stored, {done.dropped} dropped and in the ledger"
