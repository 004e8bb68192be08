"""`s2p3 capture ...`: record sessions with the devices of a rig."""

from __future__ import annotations

import math
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Literal

from dataset.errors import ToolkitError
from s2p3.commands.arguments import at_least
from s2p3.console_output import recording, say

if TYPE_CHECKING:
    from acquisition.clearance import CarriedCamera
    from acquisition.recorder import Progress
    from acquisition.rig import Rig
    from acquisition.routes import Floats, Route


def intrinsics(*, rig: Path, out: Path, views: int = 24, dry_run: bool = False) -> None:
    """Take stills of the board from diverse directions, for the camera's intrinsics.

    Args:
        rig: rig.toml with the devices' addresses.
        out: session file to write; never overwritten.
        views: how many stills to take.
        dry_run: move nothing: plan, and draw the route on a page beside OUT.
    """
    _stills("intrinsics", rig, out, views, dry_run)


def hand_eye(*, rig: Path, out: Path, views: int = 24, dry_run: bool = False) -> None:
    """Take stills of the board from diverse directions, for the camera's place on the arm.

    Args:
        rig: rig.toml with the devices' addresses.
        out: session file to write; never overwritten.
        views: how many stills to take.
        dry_run: move nothing: plan, and draw the route on a page beside OUT.
    """
    _stills("hand_eye", rig, out, views, dry_run)


def board_motion(*, rig: Path, out: Path, seconds: float = 14.0, dry_run: bool = False) -> None:
    """Film the board while the arm moves, for the delay between the clocks.

    Args:
        rig: rig.toml with the devices' addresses.
        out: session file to write; never overwritten.
        seconds: how long to film.
        dry_run: move nothing: plan, and draw the route on a page beside OUT.
    """
    from acquisition.capture import capture_board_motion
    from acquisition.rig import Rig

    at_least(1, seconds=seconds)
    if dry_run:
        _draw_sweep(Rig.load(rig), out)
        return
    with recording("frames") as report:
        done = capture_board_motion(Rig.load(rig), out, seconds=seconds, on_progress=report)
    say(summary(out, done))


def tool_tip(*, rig: Path, out: Path, poses: int = 16) -> None:
    """Record the arm while you tilt it by hand about its tip, which stays in one point: a punched hole.

    Args:
        rig: rig.toml with the arm's address and tool offset.
        out: session file to write; never overwritten.
        poses: how many; tilt by 20-30 degrees to all sides and turn, hold still for a second at each.
    """
    from acquisition.capture import capture_tool_tip
    from acquisition.rig import Rig

    at_least(6, poses=poses)
    with recording("poses") as report:
        done = capture_tool_tip(Rig.load(rig), out, count=poses, on_progress=report)
    say(f"{out}: {done.frames} poses about the tip")


def touches(*, rig: Path, out: Path, points: int = 24) -> None:
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


def polarizer(
    *,
    rig: Path,
    out: Path,
    angles: int = 36,
    frames: int = 2,
    step_deg: float = 5.0,
    unread: bool = False,
) -> None:
    """Take stills of an even lamp behind a linear polarizer, which you turn when asked.

    Args:
        rig: rig.toml with the camera's address.
        out: session file to write; never overwritten.
        angles: how many; together they should cover 180 degrees evenly.
        frames: stills at each angle: more of them, less noise.
        step_deg: from one angle to the next, counter-clockwise as the image shows it.
        unread: the polarizer has no dial: turn it by about a step, the pictures tell the angle.
    """
    from acquisition.capture import capture_polarizer
    from acquisition.rig import Rig

    at_least(6, angles=angles)
    at_least(1, frames=frames)
    done = capture_polarizer(Rig.load(rig), out, _asked_turns(angles, step_deg, unread), frames=frames)
    say(summary(out, done))


def _asked_turns(count: int, step_deg: float, unread: bool) -> Iterator[float]:
    """Asks for one angle after the other; radians, NaN where nobody reads them."""
    for index in range(count):
        angle = index * step_deg
        where = f"on by about {step_deg:g} degrees" if unread else f"to {angle:g} degrees"
        say(f"[{index + 1}/{count}] turn the polarizer {where}, then press Enter")
        if not sys.stdin.readline():
            raise ToolkitError(
                f"the input ended at angle {index + 1} of {count}; press Enter at each, or pipe in as many"
            )
        yield float("nan") if unread else math.radians(angle)


def sequence(
    *, rig: Path, out: Path, seconds: float = 60.0, append: bool = False, dry_run: bool = False
) -> None:
    """Film the object from all around while the arm moves.

    Args:
        rig: rig.toml with the devices' addresses.
        out: session file to write; never overwritten.
        seconds: how long to film.
        append: go on with OUT, a sequence that was interrupted and has been repaired.
        dry_run: move nothing: plan, and draw the route on a page beside OUT.
    """
    from acquisition.capture import capture_sequence
    from acquisition.rig import Rig

    at_least(1, seconds=seconds)
    if dry_run:
        _draw_sequence(Rig.load(rig), out)
        return
    with recording("frames") as report:
        done = capture_sequence(Rig.load(rig), out, seconds=seconds, append=append, on_progress=report)
    say(summary(out, done))


def _stills(kind: Literal["intrinsics", "hand_eye"], rig: Path, out: Path, views: int, dry_run: bool) -> None:
    from acquisition.capture import capture_board
    from acquisition.rig import Rig

    at_least(1, views=views)
    if dry_run:
        _draw_stills(Rig.load(rig), out, views)
        return
    with recording("stills") as report:
        done = capture_board(Rig.load(rig), out, kind=kind, views=views, on_progress=report)
    say(summary(out, done))


def _draw_stills(rig: Rig, out: Path, views: int) -> None:
    from acquisition.dry_run import NOMINAL_SIZE
    from acquisition.routes import board_stills

    _draw(rig, out, lambda carried, q: board_stills(rig, carried, q, NOMINAL_SIZE, views))


def _draw_sweep(rig: Rig, out: Path) -> None:
    from acquisition.dry_run import NOMINAL_SIZE
    from acquisition.routes import board_sweep

    _draw(rig, out, lambda carried, q: board_sweep(rig, carried, q, NOMINAL_SIZE))


def _draw_sequence(rig: Rig, out: Path) -> None:
    from acquisition.routes import object_sweeps

    _draw(rig, out, lambda carried, q: object_sweeps(rig, carried, q))


def _draw(rig: Rig, out: Path, plan: Callable[[CarriedCamera, Floats], Route]) -> None:
    from acquisition.dry_run import dry_run

    page = out.with_suffix(".html")
    route = dry_run(rig, page, plan)
    say(
        f"{page}: {route.reached} of {route.views} views within reach, {100 * route.coverage:.0f} % of the "
        f"upper hemisphere seen, rotations up to {route.rotation_spread_deg:.0f} deg, about "
        f"{route.duration_s:.0f} s; nothing has moved"
    )


def summary(out: Path, done: Progress) -> str:
    """What a recording holds, and a line for each thing about it that is doubtful."""
    lines = [f"{out}: {done.frames} frames stored, {done.dropped} dropped and in the ledger"]
    return "\n".join([*lines, *(f"warning: {warning}" for warning in done.warnings)])
