"""A session as files that need no browser: a film, a few frames, the views it covers, its clocks."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np

from dataset.errors import ToolkitError
from dataset.pictures import Picture
from dataset.progress import Progress, silent
from dataset.session import Session
from s2p3.viewer.charts import UNTIMED_HZ, Floats, charts_of, drawn, drawn_coverage, seconds_of
from s2p3.viewer.look import SessionLook, titled
from s2p3.viewer.world import world_of

"""Called with (frames done, frames in all)."""

_FILM_TILE_PX, _PICTURE_TILE_PX = 408, 612
_SLOWEST_HZ, _FASTEST_HZ = 2.0, 30.0
_PICTURES = 5


def save_pictures(path: Path, out: Path, every: int = 1, on_progress: Progress = silent) -> list[Path]:
    """Writes the pictures of a session into a folder, replacing earlier ones.

    Args:
        path: of the session.
        out: folder; made where it is missing.
        every: the film shows every so-manieth frame.

    Returns:
        The files: NAME.mp4, at the recorded rate; five frames, `frame-INDEX.png`; `coverage.png` where it is
        known what was looked at; `clocks.png`.

    Raises:
        SessionError: no session, no frames, or a damaged frame.
        ToolkitError: the film cannot be written.
    """
    with Session.open(path) as session:
        look = SessionLook(session)
        out.mkdir(parents=True, exist_ok=True)
        indices = range(0, len(session), every)
        written = [_film(look, out / f"{path.stem}.mp4", indices, on_progress)]
        for index in np.unique(np.linspace(0, len(session) - 1, _PICTURES).round().astype(int)).tolist():
            written.append(_write(out / f"frame-{index:06d}.png", look.sheet(index, _PICTURE_TILE_PX)))
        world = world_of(session, look.objects)
        coverage = None if world is None else drawn_coverage(world)
        if coverage is not None:
            written.append(_write(out / "coverage.png", coverage))
        charts = charts_of(session, look.objects)
        if charts:
            written.append(_write(out / "clocks.png", np.vstack([drawn(chart) for chart in charts])))
    return written


def _film(look: SessionLook, path: Path, indices: range, on_progress: Progress) -> Path:
    first, seconds = look.sheet(indices[0], _FILM_TILE_PX), seconds_of(look.session)
    size = (first.shape[1], first.shape[0])
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*"mp4v"), _rate(seconds, indices), size)
    if not writer.isOpened():
        raise ToolkitError(f"{path} cannot be written as a film; check that the folder may be written to")
    try:
        for done, index in enumerate(indices, start=1):
            sheet = look.sheet(index, _FILM_TILE_PX)
            corner = sheet[-24:, : sheet.shape[1] // 3]
            when = "" if seconds is None else f", {seconds[index]:.2f} s"
            corner[:] = titled(corner, f"frame {index}{when}")
            writer.write(sheet)
            on_progress(done, len(indices))
    finally:
        writer.release()
    return path


def _rate(seconds: Floats | None, indices: range) -> float:
    """Frames per second at which the film runs as fast as the recording."""
    if seconds is None:
        return UNTIMED_HZ
    shown = seconds[indices.start : indices.stop : indices.step]
    span = float(shown[-1] - shown[0])
    return float(np.clip((len(shown) - 1) / span, _SLOWEST_HZ, _FASTEST_HZ)) if span > 0 else _SLOWEST_HZ


def _write(path: Path, picture: Picture) -> Path:
    _, coded = cv2.imencode(".png", picture)
    path.write_bytes(coded.tobytes())
    return path
