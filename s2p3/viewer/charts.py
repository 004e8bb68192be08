"""What a session says about its own time and accuracy: curves over time, and the views it covers."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

import cv2
import numpy as np
from numpy.typing import NDArray

from acquisition.stage import cell_colours
from dataset.pictures import Picture
from dataset.session import Session
from s2p3.viewer.world import World

Floats = NDArray[np.float64]

UNTIMED_HZ = 10.0
"""Frames a second at which a session is played whose times nobody measured (our choice)."""

_MOST_POINTS = 2000
_INK, _GRID, _LINE = (60, 60, 60), (225, 225, 225), (190, 110, 40)
_LEFT, _BELOW, _ABOVE, _RIGHT = 70, 34, 30, 16


@dataclass(frozen=True, eq=False)
class Chart:
    """One curve over a recording.

    Attributes:
        title: what it shows, with the unit.
        at: (K,) where along it, increasing: since the first frame, or which frame.
        values: (K,).
        unit: of `at`: seconds, "s", or "" for frames whose times nobody measured.
    """

    title: str
    at: Floats
    values: Floats
    unit: str = "s"


def seconds_of(session: Session) -> Floats | None:
    """(N,) when each frame arrived, seconds since the first; None where nobody measured."""
    host_ns = session.host_time_ns
    if len(host_ns) == 0 or (host_ns == -1).all():
        return None
    return ((host_ns - host_ns[0]) * 1e-9).astype(np.float64)


def charts_of(session: Session, objects: tuple[str, ...]) -> list[Chart]:
    """Frame interval, clocks, accuracy of the camera's pose, visibility: those that the session can tell."""
    seconds = seconds_of(session)
    clocks = [] if seconds is None else _clock_charts(session, seconds)
    at, unit = (np.arange(len(session), dtype=np.float64), "") if seconds is None else (seconds, "s")
    found = [*clocks, *_annotation_charts(session, objects, at, unit)]
    return [_thinned(chart) for chart in found if len(chart.at) > 1]


def _clock_charts(session: Session, seconds: Floats) -> Iterator[Chart]:
    host_ns, camera_ns = session.host_time_ns, session.camera_time_ns
    if (camera_ns != -1).any():
        yield Chart("Time between frames, ms", seconds[1:], (np.diff(camera_ns) * 1e-6).astype(np.float64))
    clocks = session.clocks
    if clocks.camera is not None:
        late_ms = ((host_ns - clocks.camera.to_host(camera_ns)) * 1e-6).astype(np.float64)
        yield Chart("Camera: arrival after its clock's fit, ms", seconds, late_ms)
    if clocks.robot is not None and session.robot is not None:
        trace = session.robot
        fitted_ns = clocks.robot.to_host(np.rint(trace.robot_time_s * 1e9).astype(np.int64))
        late_ms = ((trace.host_time_ns - fitted_ns) * 1e-6).astype(np.float64)
        arm_s = ((trace.host_time_ns - host_ns[0]) * 1e-9).astype(np.float64)
        yield Chart("Arm: arrival after its clock's fit, ms", arm_s, late_ms)


def _annotation_charts(session: Session, objects: tuple[str, ...], at: Floats, unit: str) -> Iterator[Chart]:
    for name, title, scale in (
        ("sigma_t", "Camera pose, sigma of position, mm", 1e3),
        ("sigma_r", "Camera pose, sigma of rotation, deg", float(np.rad2deg(1.0))),
    ):
        if session.contents.has(f"poses/{name}"):
            sigma = scale * np.asarray(session.contents.read(f"poses/{name}"), dtype=np.float64)
            if (sigma > 0).any():
                yield Chart(title, at, sigma, unit)
    for name in objects:
        yield Chart(f"{name}: share in view", at, session.object_poses(name).visible_fraction, unit)


def drawn(chart: Chart, width: int = 900, height: int = 220) -> Picture:
    """A chart as a BGR picture (height, width, 3)."""
    picture = np.full((height, width, 3), 255, np.uint8)
    known = np.isfinite(chart.values)
    low, high = (
        (float(v) for v in (chart.values[known].min(), chart.values[known].max())) if known.any() else (0, 1)
    )
    margin = 0.06 * (high - low) or max(abs(high), 1.0) * 0.1
    low, high = low - margin, high + margin
    start, end = float(chart.at[0]), float(max(chart.at[-1], chart.at[0] + 1e-9))
    across, up = width - _LEFT - _RIGHT, height - _ABOVE - _BELOW

    def at(time: Floats, value: Floats) -> NDArray[np.int32]:
        x = _LEFT + across * (time - start) / (end - start)
        y = _ABOVE + up * (high - value) / (high - low)
        return np.rint(np.stack([x, y], axis=-1)).astype(np.int32)

    for value in _ticks(low, high):
        row = int(at(np.array(start), np.array(value))[1])
        cv2.line(picture, (_LEFT, row), (width - _RIGHT, row), _GRID, 1)
        _write(picture, f"{value:g}", (6, row + 4))
    for time in _ticks(start, end):
        column = int(at(np.array(time), np.array(low))[0])
        cv2.line(picture, (column, _ABOVE), (column, height - _BELOW), _GRID, 1)
        _write(
            picture, f"{time:g} {chart.unit}".strip(), (min(column, width - 46) - 10, height - _BELOW + 18)
        )
    line = at(chart.at[known], chart.values[known])
    cv2.polylines(picture, [line.reshape(-1, 1, 2)], False, _LINE, 1, cv2.LINE_AA)
    _write(picture, chart.title, (_LEFT, 19))
    return picture


def drawn_coverage(world: World, side: int = 640) -> Picture | None:
    """The view sphere from above as a BGR picture (side, side, 3): the pole in the middle, the lowest ring
    outermost, cells coloured by frames, the camera's way over them. None where nothing was looked at."""
    if world.views is None or world.centre is None:
        return None
    lowest = world.views.lowest
    axis = (np.arange(side) - (side - 1) / 2) / (0.46 * side)
    x, y = np.meshgrid(axis, -axis)
    radius = np.hypot(x, y)
    elevation = np.pi / 2 - np.minimum(radius, 1.0) * (np.pi / 2 - lowest)
    azimuth = np.arctan2(y, x)
    level = np.cos(elevation)
    directions = np.stack([level * np.cos(azimuth), level * np.sin(azimuth), np.sin(elevation)], axis=-1)
    cells = np.maximum(world.views.cells(directions), 0)
    colours = cell_colours(world.counts)[..., ::-1]
    colours[world.counts == 0] = 235
    picture = colours[cells]
    picture[radius > 1] = 255
    edges = (np.diff(cells, axis=0, prepend=cells[:1]) != 0) | (
        np.diff(cells, axis=1, prepend=cells[:, :1]) != 0
    )
    picture[edges & (radius <= 1)] = 255
    away = world.path - world.centre
    away = away / np.linalg.norm(away, axis=1, keepdims=True)
    out = (np.pi / 2 - np.arcsin(np.clip(away[:, 2], -1, 1))) / (np.pi / 2 - lowest)
    turn = np.arctan2(away[:, 1], away[:, 0])
    dots = np.stack([out * np.cos(turn), -out * np.sin(turn)], axis=1) * 0.46 * side + (side - 1) / 2
    for dot in np.rint(dots).astype(int).tolist():
        cv2.circle(picture, dot, 2, _INK, -1, cv2.LINE_AA)
    covered, cells_in_all = int((world.counts > 0).sum()), len(world.counts)
    _write(picture, f"views: {covered} of {cells_in_all} cells, {len(world.path)} frames", (8, 18))
    return picture


def _thinned(chart: Chart) -> Chart:
    step = -(-len(chart.at) // _MOST_POINTS)
    return replace(chart, at=chart.at[::step], values=chart.values[::step])


def _ticks(low: float, high: float) -> list[float]:
    """Three to eight round numbers between two."""
    step = 10.0 ** np.floor(np.log10((high - low) / 2))
    while (high - low) / step > 7:
        step *= 2 if (high - low) / (2 * step) <= 7 else 5
    first = np.ceil(low / step)
    return [float(round(step * k, 12)) for k in np.arange(first, np.floor(high / step) + 1)]


def _write(picture: Picture, text: str, at: tuple[int, int]) -> None:
    cv2.putText(picture, text, at, cv2.FONT_HERSHEY_SIMPLEX, 0.42, _INK, 1, cv2.LINE_AA)
