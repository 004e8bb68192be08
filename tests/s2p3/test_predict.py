"""`s2p3 predict` on a session and a folder of raw frames; no pose, mask or box of the truth is read."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import cv2
import h5py
import numpy as np
import pytest

from calibration import Calibration, IntrinsicsRecord
from dataset import SE3
from dataset.errors import ToolkitError
from dataset.frames import Mosaic
from dataset.polarimetry import Raw
from dataset.session import Session
from s2p3.cli import main
from s2p3.evaluation.predict import PoseEstimate
from s2p3.evaluation.predictions import Prediction
from s2p3.evaluation.shots import Shot, folder_shots, session_shots
from s2p3.networks.detector import Detection
from tests.s2p3.conftest import FRAMES


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory, cup_session: Path) -> Path:
    """The first three raw frames of the session, and its camera's calibration."""
    path = tmp_path_factory.mktemp("frames")
    with Session.open(cup_session) as session:
        for index in range(3):
            cv2.imwrite(str(path / f"{index}.png"), session.raw(index))
        assert session.intrinsics is not None
        record = IntrinsicsRecord(session.intrinsics, np.eye(9), 0.04, 0.05, 20, ())
    Calibration(None, record).save(path / "calibration.json")
    return path


def words(source: Path, networks: dict[str, Path]) -> list[str]:
    chosen = ["--network", str(networks["student"]), "--detector", str(networks["detector"])]
    return ["predict", str(source), "--object", "cup", *chosen]


def printed(arguments: list[str], capfd: pytest.CaptureFixture[str]) -> list[dict[str, object]]:
    capfd.readouterr()
    assert main(arguments) == 0
    return [json.loads(line) for line in capfd.readouterr().out.splitlines()]


def test_a_session_gives_a_line_and_a_picture_for_every_frame(
    cup_session: Path, networks: dict[str, Path], tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "out"
    rows = printed([*words(cup_session, networks), "--out", str(out)], capfd)
    assert [row["frame"] for row in rows] == [str(index) for index in range(FRAMES)]
    assert len(list(out.glob("*.png"))) == FRAMES
    assert [json.loads(line) for line in (out / "poses.jsonl").read_text().splitlines()] == rows
    for row in rows:
        assert row["found"] == (row["T_cam_obj"] is not None) == (row["T_base_obj"] is not None)
    assert main([*words(cup_session, networks), "--out", str(out)]) == 2
    assert "exists; name another folder" in capfd.readouterr().err


def test_predictions_do_not_change_without_the_truth(
    cup_session: Path, networks: dict[str, Path], tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    blind = Path(shutil.copy(cup_session, tmp_path / "blind.h5"))
    with h5py.File(blind, "r+") as file:
        del file["poses"]
        del file["objects"]
    asked = ("frame", "found", "score", "box_xywh_px", "T_cam_obj")
    seeing, unseeing = (
        [[row[name] for name in asked] for row in printed(words(path, networks), capfd)]
        for path in (cup_session, blind)
    )
    assert seeing == unseeing


def test_a_folder_of_raw_frames_is_seen_as_the_session_is(
    cup_session: Path, folder: Path, networks: dict[str, Path], capfd: pytest.CaptureFixture[str]
) -> None:
    calibration = Calibration.load(folder / "calibration.json")
    with Session.open(cup_session) as session:
        frames = zip(
            session_shots(session, range(3)), folder_shots(folder, "mono", 12, calibration), strict=True
        )
        for mine, theirs in frames:
            np.testing.assert_allclose(mine.stokes, theirs.stokes, atol=1e-5)
            np.testing.assert_allclose(mine.intrinsics.K, theirs.intrinsics.K)
    options = ["--calibration", str(folder / "calibration.json"), "--mosaic", "mono", "--bits", "12"]
    rows = printed([*words(folder, networks), *options, "--count", "2"], capfd)
    assert [(row["frame"], row["T_base_obj"]) for row in rows] == [("0.png", None), ("1.png", None)]


@pytest.mark.parametrize(
    ("change", "bits", "said"),
    [
        (lambda raw: raw[:-4], 12, r"1\.png is .* uint16, 0\.png is .* uint16; keep them in folders"),
        (lambda raw: (raw >> 4).astype(np.uint8), 12, r"1\.png is .* uint8, 0\.png is .* uint16"),
        (lambda raw: raw | 4096, 12, r"1\.png holds the value \d+, more than --bits 12 allow; give"),
        (lambda raw: raw, 17, r"--bits 17 does not fit .*0\.png, which holds uint16; give 1 to 16"),
    ],
)
def test_a_later_frame_of_a_folder_is_checked_as_the_first(
    change: Callable[[Raw], Raw], bits: int, said: str, folder: Path, tmp_path: Path
) -> None:
    calibration = Calibration.load(folder / "calibration.json")
    raw = cv2.imread(str(folder / "0.png"), cv2.IMREAD_UNCHANGED)
    cv2.imwrite(str(tmp_path / "0.png"), raw)
    cv2.imwrite(str(tmp_path / "1.png"), change(raw))
    with pytest.raises(ToolkitError, match=said):
        list(folder_shots(tmp_path, "mono", bits, calibration))


def test_eight_bit_files_do_not_hold_twelve_bits(folder: Path, tmp_path: Path) -> None:
    calibration = Calibration.load(folder / "calibration.json")
    raw = cv2.imread(str(folder / "0.png"), cv2.IMREAD_UNCHANGED)
    cv2.imwrite(str(tmp_path / "0.png"), (raw >> 4).astype(np.uint8))
    with pytest.raises(ToolkitError, match=r"--bits 12 does not fit .*0\.png, which holds uint8"):
        next(folder_shots(tmp_path, "mono", 12, calibration))


@pytest.mark.parametrize(("known", "given"), [("colour", "mono"), ("mono", "colour")])
def test_a_folder_is_not_read_as_another_mosaic_than_the_calibrated(
    known: Mosaic, given: Mosaic, folder: Path
) -> None:
    calibration = Calibration.load(folder / "calibration.json")
    assert calibration.intrinsics is not None
    knowing = replace(calibration, intrinsics=replace(calibration.intrinsics, mosaic=known))
    with pytest.raises(ToolkitError, match=rf"0\.png: a {given} mosaic, .* for a {known} one"):
        next(folder_shots(folder, given, 12, knowing))
    told, by_default = (next(folder_shots(folder, given, 12, knowing)) for given in (known, None))
    np.testing.assert_array_equal(told.stokes, by_default.stokes)


def test_the_base_frame_is_reached_through_the_camera(cup_session: Path) -> None:
    with Session.open(cup_session) as session:
        shot = next(session_shots(session, [0]))
    pose = SE3.from_rotvec([0.1, 0.2, 0.3], [0.0, 0.0, 0.4])
    place = SE3.from_rotvec([0.0, 1.0, 0.0], [0.5, 0.1, 0.7])
    found = PoseEstimate(pose, 0.9, Detection(np.zeros(4), np.zeros((2, 2), bool), 0.9))
    moved = Shot(shot.name, shot.stokes, shot.intrinsics, place, 0)
    row = Prediction(moved, found, 0.01).to_json()
    np.testing.assert_allclose(row["T_base_obj"], (place @ pose).as_matrix())
    assert Prediction(Shot(shot.name, shot.stokes, shot.intrinsics, None, 0), found, 0).T_base_obj is None


@pytest.mark.parametrize(
    ("source", "options", "said"),
    [
        ("nowhere", [], "is no session (.h5), rig (.toml) or folder"),
        (".", [], "give --calibration calibration.json"),
        (".", ["--calibration", "calibration.json", "--mosaic", "mono"], "give --bits"),
        (".", ["--calibration", "nowhere.json"], "nowhere.json"),
        (
            ".",
            ["--calibration", "calibration.json", "--mosaic", "mono", "--bits", "99"],
            "0.png, which holds uint16; give",
        ),
        (".", ["--count", "0"], "--count 0 is too small"),
    ],
)
def test_what_cannot_be_predicted_on_is_refused(
    source: str,
    options: list[str],
    said: str,
    folder: Path,
    networks: dict[str, Path],
    monkeypatch: pytest.MonkeyPatch,
    capfd: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.chdir(folder)
    assert main([*words(Path(source), networks), *options]) == 2
    (line,) = capfd.readouterr().err.splitlines()
    assert said in line
