"""The steps of a calibration: what they leave in calibration.json and in their report."""

import base64
import re
import shutil
from dataclasses import replace
from pathlib import Path

import cv2
import h5py
import numpy as np
import pytest

from calibration import Calibration, apply_calibration
from calibration.detection import detect
from calibration.polarizer_steps import add_polarizer
from calibration.records import (
    FixedCameraRecord,
    HandEyeRecord,
    PolarizerRecord,
    TimeOffsetRecord,
    ToolTipRecord,
)
from calibration.sessions import arm_trace, detect_session, views_at_rest
from calibration.steps import add_hand_eye, add_intrinsics, add_time_offset, report_path
from dataset.errors import CalibrationError
from dataset.session import Session
from dataset.session.seals import leave_open, seal
from dataset.transforms import SE3, translation_error_mm

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


@pytest.fixture(scope="module")
def known(world, stills, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A calibration.json that held everything when the intrinsics were calibrated once more."""
    path = tmp_path_factory.mktemp("known") / "calibration.json"
    still = SE3.identity()
    Calibration(
        tool_tip=ToolTipRecord(np.zeros(3), np.eye(3), 1e-4, 12, 0, np.zeros(6), ()),
        fixed_camera=FixedCameraRecord(still, still, np.eye(12), 0.1, 0.1, 0.01, 1e-5, 1e-5, 20, ()),
        time_offset=TimeOffsetRecord(0.03, 1e-4, 0.1, ()),
    ).save(path)
    add_intrinsics(stills[0], world.spec, path)
    return path


def copied(known: Path, folder: Path) -> Path:
    return Path(shutil.copy(known, folder / "calibration.json"))


def test_new_intrinsics_take_away_what_hung_on_the_old_ones(known: Path) -> None:
    found = Calibration.load(known)
    assert found.intrinsics is not None
    assert found.intrinsics.mosaic == "colour"
    assert found.tool_tip is not None
    assert found.hand_eye is None
    assert found.fixed_camera is None
    assert found.time_offset is None


def test_pictures_of_another_resolution_are_refused(world, stills, known: Path, tmp_path: Path) -> None:
    calibration = copied(known, tmp_path)
    before = Calibration.load(calibration)
    assert before.intrinsics is not None
    halved = replace(before.intrinsics, intrinsics=before.intrinsics.intrinsics.at(2))
    replace(before, intrinsics=halved).save(calibration)
    with pytest.raises(CalibrationError, match="2448x2048 pixels, the intrinsics are for 1224x1024"):
        add_hand_eye(stills[0], world.spec, calibration)


def of_camera(serial: str, session: Path, folder: Path) -> Path:
    """A copy of a session, as a camera of that serial number would have recorded it."""
    path = Path(shutil.copy(session, folder / f"{serial}.h5"))
    with h5py.File(path, "r+") as file:
        file["camera"].attrs["serial"] = serial
        leave_open(file["camera"])
        seal(file)
    return path


def test_pictures_of_another_camera_are_refused(world, stills, known: Path, tmp_path: Path) -> None:
    calibration, other = copied(known, tmp_path), of_camera("4711", stills[0], tmp_path)
    said = "4711.h5: camera 4711, the calibration is of camera "
    for step in (add_hand_eye, add_time_offset):
        placed = HandEyeRecord(
            world.T_tcp_cam, world.T_base_board, np.eye(12), 0.1, 0.1, 0.01, 1e-5, 1e-5, 20, ()
        )
        replace(Calibration.load(calibration), hand_eye=placed).save(calibration)
        with pytest.raises(CalibrationError, match=said):
            step(other, world.spec, calibration)
    with pytest.raises(CalibrationError, match=said):
        apply_calibration(other, Calibration.load(calibration))
    with pytest.raises(CalibrationError, match=said):
        add_polarizer(other, calibration)
    apply_calibration(of_camera("", stills[0], tmp_path), Calibration.load(calibration))


@pytest.mark.parametrize(("serial", "kept"), [("4711", False), (None, True)])
def test_a_new_cameras_intrinsics_take_away_the_old_ones_polarizers(
    serial: str | None, kept: bool, world, stills, tmp_path: Path
) -> None:
    calibration = tmp_path / "calibration.json"
    (tmp_path / "response.npz").touch()
    old = PolarizerRecord(
        "response.npz", "0", np.ones(3), 0.01, 0.01, np.eye(2), 1e-3, 0.0, 72, (), (), serial, tmp_path
    )
    Calibration(polarizer=old).save(calibration)
    add_intrinsics(stills[0], world.spec, calibration)
    assert (Calibration.load(calibration).polarizer is not None) == kept


def test_another_board_than_hand_eyes_is_refused_for_the_clocks(
    world, stills, known: Path, tmp_path: Path
) -> None:
    calibration = copied(known, tmp_path)
    placed = HandEyeRecord(
        world.T_tcp_cam, world.T_base_board, np.eye(12), 0.1, 0.1, 0.01, 1e-5, 1e-5, 20, ()
    )
    replace(Calibration.load(calibration), hand_eye=placed).save(calibration)
    with pytest.raises(CalibrationError, match="calibrated with another board"):
        add_time_offset(stills[0], replace(world.spec, square_m=0.031), calibration)


def test_either_place_of_the_camera_takes_the_place_of_the_other(
    world, stills, known: Path, tmp_path: Path
) -> None:
    calibration = copied(known, tmp_path)
    still = FixedCameraRecord(SE3.identity(), SE3.identity(), np.eye(12), 0.1, 0.1, 0.01, 1e-5, 1e-5, 20, ())
    Calibration.load(calibration).merged(Calibration(fixed_camera=still)).save(calibration)
    add_hand_eye(stills[0], world.spec, calibration)
    found = Calibration.load(calibration)
    assert found.fixed_camera is None
    assert found.hand_eye is not None
    with Session.open(stills[0]) as session:
        np.testing.assert_array_equal(found.hand_eye.tcp_offset, session.tcp_offset)


def test_a_trace_with_nan_is_refused(stills, tmp_path: Path) -> None:
    path = Path(shutil.copy(stills[0], tmp_path / "nan.h5"))
    with h5py.File(path, "r+") as file:
        file["robot/pose"][300:310] = np.nan
        leave_open(file["robot/pose"])
        seal(file)
    with Session.open(path) as session, pytest.raises(CalibrationError, match=r"in 10 of .* sample 300"):
        arm_trace(session)


def test_refined_intrinsics_are_kept_and_their_own_pictures_do_not_count_twice(
    world, stills, known: Path, tmp_path: Path
) -> None:
    calibration = copied(known, tmp_path)
    before = Calibration.load(calibration).intrinsics
    add_hand_eye(stills[0], world.spec, calibration, refine_camera=True)
    found = Calibration.load(calibration)
    assert found.hand_eye is not None
    assert translation_error_mm(found.hand_eye.T_tcp_cam, world.T_tcp_cam) < 0.5
    after = found.intrinsics
    assert after.sources == before.sources
    assert after.intrinsics.K[0, 0] != before.intrinsics.K[0, 0]
    ratio = np.sqrt(after.covariance[0, 0] / before.covariance[0, 0])
    assert ratio > 0.75  # 0.71 if the pictures counted twice; the arm's poses add little


def test_a_view_taken_in_motion_is_skipped_and_every_overlay_shows_its_own_view(
    world, shaken: Path, known: Path, tmp_path: Path
) -> None:
    calibration = copied(known, tmp_path)
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
