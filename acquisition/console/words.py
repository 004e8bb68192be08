"""What the console's page says, as HTML: which devices are there, how the recording goes, what is blinded."""

from __future__ import annotations

from html import escape

import numpy as np

from acquisition.clocks import DOUBTFUL_NS
from acquisition.console.feeds import Feed
from acquisition.console.recording import Recording
from acquisition.console.station import Station
from dataset.errors import ToolkitError
from dataset.frames import RobotSample

_GOOD, _WARN, _BAD, _IDLE = "#37b24d", "#f59f00", "#f03e3e", "#868e96"
_MOVING_M = 2e-4  # between two looks of the page
_TOO_BRIGHT, _MUCH_TOO_BRIGHT = 1e-4, 1e-2  # share of saturated super-pixels (our choice)
_LEGENDS = {
    "S0": ("dark", "bright, then saturated", "#000,#fff 94%,#ff3c3c 94%"),
    "DoLP": ("0 unpolarized", "1 fully polarized", "#440154,#3b528b,#21918c,#5ec962,#fde725"),
    "AoLP": ("0&deg;", "180&deg;, as bright as polarized", "#f22,#ff2,#2f2,#2ff,#22f,#f2f,#f22"),
}
_STATE_COLOURS = {
    "starting": _WARN,
    "recording": _BAD,
    "paused": _WARN,
    "stopping": _WARN,
    "complete": _GOOD,
    "failed": _BAD,
}


def devices(station: Station, motion: str) -> str:
    """A line for each device and each clock."""
    camera, arm = station.camera, station.arm
    name = f"{camera.info.model} #{camera.info.serial}, " if camera.info is not None else ""
    lines = [
        _line("Camera", camera.problem, f"{name}{camera.rate:.1f} frames/s", camera.rate > 0),
        _line("Arm", arm.problem, motion, True),
        _line("Camera clock", *_clock(camera)),
        _line("Arm clock", *_clock(arm)),
    ]
    return _box("".join(lines))


def motion(before: RobotSample | None, now: RobotSample | None) -> str:
    """Whether the arm moves, and where its tool is."""
    if now is None:
        return ""
    x, y, z = now.T_base_tcp.translation
    moved = before is not None and (
        float(np.linalg.norm(now.T_base_tcp.translation - before.T_base_tcp.translation)) > _MOVING_M
    )
    return f"{'moving' if moved else 'at rest'}, tool at {x:.3f}  {y:.3f}  {z:.3f} m"


def recording(current: Recording | None, covered: int, cells: int) -> str:
    """The counters of the newest recording."""
    if current is None:
        return _box(f'<div style="color:{_IDLE}">Nothing recorded yet.</div>')
    said, state_colour = bool(current.message), _STATE_COLOURS[current.state]
    colour = _WARN if current.state == "complete" else state_colour  # of what is doubtful about it
    minutes, seconds = divmod(int(current.seconds), 60)
    counters = (
        _counter("stored", f"{current.stored}")
        + _counter("dropped", f"{current.dropped}", _BAD if current.dropped else "")
        + _counter("time", f"{minutes}:{seconds:02d}")
        + _counter("views", f"{covered}/{cells}")
    )
    return _box(
        f'<div style="font-weight:600"><span style="color:{state_colour}">&#9679; {current.state}</span> '
        f"{escape(current.path.name)}</div>"
        f'<div style="display:flex;justify-content:space-between;margin-top:.5em">{counters}</div>'
        + (f'<div style="color:{colour};margin-top:.5em">{escape(current.message)}</div>' if said else "")
    )


def legend(view: str) -> str:
    """What the colours of a picture mean."""
    bar = "height:.5em;border-radius:3px;margin:.1em 0;background:linear-gradient(to right,"
    left, right, colours = _LEGENDS[view]
    return (
        f'<div style="margin:.1em .8em;font-size:.78em;opacity:.9"><div style="{bar}{colours})"></div>'
        f'<div style="display:flex;justify-content:space-between"><span>{left}</span><span>{right}</span>'
        "</div></div>"
    )


def exposure(saturated: float, dark: float) -> str:
    """A warning where part of the picture is blinded, with what to do."""
    if saturated > _TOO_BRIGHT:
        colour = _BAD if saturated > _MUCH_TOO_BRIGHT else _WARN
        text = f"{100 * saturated:.2f} % saturated (red): shorten the exposure"
    elif dark > 0.5:
        colour, text = _WARN, f"{100 * dark:.0f} % too dark to tell polarization: lengthen the exposure"
    else:
        colour, text = _GOOD, f"exposure good: {100 * saturated:.2f} % saturated, {100 * dark:.0f} % dark"
    return (
        f'<div style="background:{colour};color:#fff;border-radius:4px;padding:.35em .7em;font-weight:600;'
        f'font-size:.85em;margin:.2em .8em">{text}</div>'
    )


def notice(text: str) -> str:
    """Why something that was asked for was not done."""
    return _box(f'<div style="color:{_BAD}">{escape(text)}</div>') if text else ""


def _clock(feed: Feed) -> tuple[str | None, str, bool]:
    """Problem, text and whether it is known well."""
    try:
        fit = feed.clock.fit()
    except ToolkitError as error:
        return str(error), "", False
    if fit is None:
        return None, "measuring", False
    newest = fit.fits[-1]
    text = f"{1e6 * (1 / newest.b - 1):+.0f} ppm, within {newest.sigma_ns * 1e-6:.2f} ms"
    good = not fit.restarts and newest.sigma_ns <= DOUBTFUL_NS
    return None, text + (", was set just now" if fit.restarts else ""), good


def _line(name: str, problem: str | None, text: str, good: bool) -> str:
    colour = _BAD if problem is not None else _GOOD if good else _WARN
    return (
        f'<div style="display:flex;gap:.5em;margin-bottom:.2em"><span style="color:{colour}">&#9679;</span>'
        f'<span style="min-width:7.6em;font-weight:600;white-space:nowrap">{name}</span>'
        f"<span>{escape(text if problem is None else problem)}</span></div>"
    )


def _counter(name: str, value: str, colour: str = "") -> str:
    style = f"color:{colour};" if colour else ""
    return (
        f'<div style="text-align:center"><div style="{style}font-size:1.5em;font-weight:700;'
        f'font-variant-numeric:tabular-nums">{value}</div><div style="opacity:.6">{name}</div></div>'
    )


def _box(inner: str) -> str:
    return f'<div style="padding:.2em .9em .5em;font-size:.82em;line-height:1.35">{inner}</div>'
