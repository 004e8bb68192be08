"""Sessions of kind "polarizer": a frame and where the polarizer stood stay together, whatever happens."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from dataset import CameraInfo, RawFrame
from dataset.session import Session, SessionWriter
from dataset.validate import repair, validate


def test_a_continued_session_stays_sound(
    tmp_path: Path, camera: CameraInfo, make_frame: Callable[..., RawFrame]
) -> None:
    path = tmp_path / "s.h5"
    with SessionWriter(path, "polarizer", camera) as writer:
        record(writer, range(3), make_frame)
    with SessionWriter.append(path, "polarizer", camera) as writer:
        record(writer, range(3, 5), make_frame)
    assert validate(path) == []
    with Session.open(path) as session:
        np.testing.assert_array_equal(session.polarizer_angles, 0.1 * np.arange(5))


@pytest.mark.parametrize("ending", ["killed", "interrupted"])
def test_a_frame_without_its_angle_is_kept_and_its_angle_unknown(
    tmp_path: Path, camera: CameraInfo, make_frame: Callable[..., RawFrame], ending: str
) -> None:
    path = tmp_path / "s.h5"
    writer = SessionWriter(path, "polarizer", camera)
    record(writer, range(3), make_frame)
    writer.add_frame(make_frame(3))
    if ending == "killed":
        killed = path.read_bytes()
        writer.finish()
        path.write_bytes(killed)
    else:
        writer.close()
    assert repair(path).frames == 4
    assert validate(path) == []
    with Session.open(path) as session:
        np.testing.assert_array_equal(session.polarizer_angles, [0, 0.1, 0.2, np.nan])
        np.testing.assert_array_equal(session.raw(3), make_frame(3).pixels)


def record(writer: SessionWriter, indices: range, make_frame: Callable[..., RawFrame]) -> None:
    """Frames, each with an angle of its own."""
    for index in indices:
        writer.add_frame(make_frame(index))
        writer.add_polarizer_angle(0.1 * index)
