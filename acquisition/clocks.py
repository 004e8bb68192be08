"""What a recording should say about its clocks: how well exposures and the arm's poses are known in time."""

from __future__ import annotations

from collections.abc import Iterator

from dataset.clocks import DeviceClock
from dataset.session import Clocks

DOUBTFUL_NS = 400_000.0
"""A clock that is followed less closely is in doubt (our choice: 0.1 mm at 0.25 m/s)."""

_SPEED_MM_MS = 0.25


def clock_warnings(clocks: Clocks, *, moving: bool) -> Iterator[str]:
    """One line for each thing that is doubtful about the clocks of a recording.

    Args:
        clocks: as fitted at its end.
        moving: whether the arm moved while frames were exposed; at rest a late clock does no harm.
    """
    yield from clocks.problems
    for name, clock in (("camera", clocks.camera), ("arm", clocks.robot)):
        if clock is not None:
            yield from _warnings(name, clock, moving)


def _warnings(name: str, clock: DeviceClock, moving: bool) -> Iterator[str]:
    for row in clock.restarts:
        what = "frame" if name == "camera" else "sample"
        yield f"the {name}'s clock jumped or started anew at {what} {row}; it is fitted apart on either side"
    if moving and clock.sigma_ns > DOUBTFUL_NS:
        sigma_ms = clock.sigma_ns * 1e-6
        yield (
            f"the {name}'s clock is followed to {sigma_ms:.2g} ms only, {sigma_ms * _SPEED_MM_MS:.2g} mm at "
            "0.25 m/s: for a while everything arrived late, or too little came; close other programs, record "
            "longer, see: s2p3 doctor"
        )
