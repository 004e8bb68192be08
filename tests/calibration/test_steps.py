"""The steps of a calibration: what they leave in calibration.json and in their report."""

import base64
import re
import shutil
from pathlib import Path

import cv2
import h5py
import numpy as np
import pytest

from calibration import Calibration
from calibration.detection import detect
from calibration.sessions import detect_session, views_at_rest
from calibration.steps import add_hand_eye, add_intrinsics, report_path
from dataset.session import Session
from dataset.session.seals import leave_open, seal
from dataset.transforms import translation_error_mm

_SHAKEN = 2


@pytest.fixture(scope="module")
def shaken(stills, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The stills, with the arm shaking while one of them was taken."""
    path = tmp_path_factory.mktemp("shaken") / "board.h5"
    shutil.copy(stills[0], path)
    with h5py.File(path, "r+") as file:
        times = file["robot/robot_time_s"][:]
        during = (times > 2 * _SHAKEN + 0.3) & (times < 2 * _SHAKEN + 1.3)
        pose = file["robot/pose"][:]
        pose[during, 0] += np.where(np.arange(during.sum()) % 2, 2e-3, -2e-3)
        file["robot/pose"][:] = pose
        leave_open(file["robot/pose"])
        seal(file)
    return path


def overlays(page: str) -> list[tuple[np.ndarray, np.ndarray]]:
    """The pictures (h, w) of a report with rings on them, and the rings' centres (n, 2) in pixels."""
    found = []
    for figure in re.findall(r"<svg.*?</svg>", page, re.DOTALL):
        image = re.search(r'<image href="data:image/[a-z]+;base64,([^"]+)"', figure)
        if image is not None:
            coded = np.frombuffer(base64.b64decode(image.group(1)), np.uint8)
            rings = re.findall(r'<circle cx="([\d.]+)" cy="([\d.]+)"', figure)
            found.append((cv2.imdecode(coded, cv2.IMREAD_GRAYSCALE), np.array(rings, float) - 0.5))
    return found


def test_a_view_taken_in_motion_is_skipped_and_every_overlay_shows_its_own_view(
    world, stills, shaken: Path, tmp_path: Path
) -> None:
    calibration = tmp_path / "calibration.json"
    add_intrinsics(stills[0], world.spec, calibration)
    record = add_hand_eye(shaken, world.spec, calibration).record
    with Session.open(shaken) as session:
        views, _ = views_at_rest(session, detect_session(session, world.spec))
    assert [index for index, _ in views] == [0, 1, 3, 4, 5, 6]
    assert record.views == len(views)
    assert translation_error_mm(Calibration.load(calibration).hand_eye.T_tcp_cam, world.T_tcp_cam) < 1.0

    pictures = overlays(report_path(calibration, "hand-eye").read_text(encoding="utf-8"))
    assert len(pictures) == 3
    for picture, rings in pictures:
        corners = detect(picture, world.spec)
        assert corners is not None
        apart = np.linalg.norm(corners.pixels[:, None] - rings[None], axis=2).min(axis=1)
        assert len(rings) >= len(corners)
        assert np.median(apart) < 0.5
        assert apart.max() < 2.0
