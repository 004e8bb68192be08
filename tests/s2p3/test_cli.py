"""The command line as a newcomer meets it: help that reads well, and mistakes that cost one clear line."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path

import cv2
import h5py
import numpy as np
import pytest
import trimesh

from acquisition.rig import EXAMPLE, Rig
from calibration import Calibration
from dataset.session import Session
from dataset.session.seals import reopen, seal
from s2p3 import objects
from s2p3.cli import VERBS, Group, main
from s2p3.lab.rig import lab_rig
from s2p3.objects import ObjectModel

WIDTH = 100
NOBODY = "127.0.0.93"
"""An address of the loopback network at which no device of any test serves."""

Fails = Callable[..., str]


@pytest.fixture
def fails(capfd: pytest.CaptureFixture[str]) -> Fails:
    """Runs a command line that must end in a user's mistake, and returns the one line it prints."""

    def run(*words: object) -> str:
        capfd.readouterr()
        assert main([str(word) for word in words]) == 2
        out, err = capfd.readouterr()
        lines = err.splitlines()
        assert len(lines) == 1, err
        assert lines[0].startswith("s2p3: ")
        assert "Traceback" not in out
        return lines[0]

    return run


@pytest.fixture
def rig(tmp_path: Path) -> Path:
    """A rig whose devices do not answer."""
    path = tmp_path / "rig.toml"
    lab_rig(frame_rate=2.0, camera_address=NOBODY, arm_host=NOBODY).save(path)
    return path


def all_commands() -> list[str]:
    words = [""]
    for name, verb in VERBS.items():
        words.append(name)
        if isinstance(verb, Group):
            words += [f"{name} {inner}" for inner in verb.verbs]
    return words


@pytest.mark.parametrize("command", all_commands())
def test_help_reads_well(
    command: str, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("COLUMNS", str(WIDTH))
    with pytest.raises(SystemExit) as ended:
        main([*command.split(), "--help"])
    assert ended.value.code == 0
    usage, blank, purpose, *rest = capsys.readouterr().out.splitlines()
    assert usage.startswith(f"usage: s2p3 {command}".strip())
    assert blank == ""
    assert purpose.endswith(".")
    assert max(map(len, [purpose, *rest])) <= WIDTH
    text = "\n".join(rest)
    assert "{None}" not in text
    assert "Args:" not in text
    for line in rest:
        if line.startswith("│ --"):
            assert len(line.strip("│ ").split(" ", 2)) > 1, f"{line!r} has no explanation"


def test_the_top_level_help_names_every_verb(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit):
        main(["--help"])
    words = capsys.readouterr().out
    for command in all_commands():
        assert all(word in words for word in command.split())


@pytest.mark.parametrize("words", [[], ["fly"], ["dataset"], ["dataset", "fly"], ["decode", "--wrong"]])
def test_words_that_are_no_command_line_end_with_code_2(
    words: list[str], capsys: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(SystemExit) as ended:
        main(words)
    assert ended.value.code == 2
    assert "Traceback" not in capsys.readouterr().err


# A rig file.


def test_a_missing_rig_file(fails: Fails, tmp_path: Path) -> None:
    line = fails("capture", "sequence", "--rig", tmp_path / "no.toml", "--out", tmp_path / "s.h5")
    assert "no.toml" in line
    assert f"copy {EXAMPLE}" in line


def test_an_unknown_field_is_named_with_the_nearest_valid_one(fails: Fails, rig: Path) -> None:
    rig.write_text(rig.read_text().replace("exposure_us", "exposure_ms"))
    line = fails("doctor", "--rig", rig)
    assert "exposure_ms" in line
    assert "exposure_us" in line
    assert str(rig) in line


def test_a_rig_file_that_is_no_toml(fails: Fails, rig: Path) -> None:
    rig.write_text("[camera\naddress = 3")
    assert str(rig) in fails("simulate", "--rig", rig, "--lab", rig.parent / "lab")


# Devices that do not answer.


@pytest.mark.parametrize("verb", ["intrinsics", "hand-eye", "board-motion", "sequence"])
def test_an_unreachable_camera(fails: Fails, rig: Path, tmp_path: Path, verb: str) -> None:
    started = time.monotonic()
    line = fails("capture", verb, "--rig", rig, "--out", tmp_path / "s.h5")
    assert time.monotonic() - started < 5
    assert NOBODY in line
    assert "camera" in line
    assert "check" in line
    assert not (tmp_path / "s.h5").exists()


def test_an_unreachable_arm(fails: Fails, rig: Path, tmp_path: Path) -> None:
    started = time.monotonic()
    line = fails("capture", "tool-tip", "--rig", rig, "--out", tmp_path / "s.h5")
    assert time.monotonic() - started < 5
    assert NOBODY in line
    assert "check" in line
    assert not (tmp_path / "s.h5").exists()


# Session files.


@pytest.fixture
def foreign(tmp_path: Path) -> Path:
    path = tmp_path / "foreign.h5"
    with h5py.File(path, "w") as file:
        file["data"] = np.zeros(3)
    return path


@pytest.mark.parametrize("verb", ["info", "validate", "repair", "split"])
def test_a_foreign_hdf5_file(fails: Fails, foreign: Path, verb: str) -> None:
    before = foreign.read_bytes()
    assert str(foreign) in fails("dataset", verb, foreign)
    assert foreign.read_bytes() == before


@pytest.mark.parametrize("verb", ["info", "validate", "repair", "split"])
def test_a_file_that_is_not_hdf5(fails: Fails, tmp_path: Path, verb: str) -> None:
    path = tmp_path / "notes.h5"
    path.write_text("not a session")
    assert str(path) in fails("dataset", verb, path)


def test_a_newer_major_version(fails: Fails, cup_copy: Path) -> None:
    with h5py.File(cup_copy, "r+") as file:
        file.attrs["schema"] = "2.0"
    assert "2.0" in fails("dataset", "info", cup_copy)


@pytest.mark.parametrize(
    "words",
    [
        ["dataset", "info", "no.h5"],
        ["annotate", "no.h5", "--calibration", "CALIBRATION", "--object", "cup"],
        ["calibrate", "intrinsics", "no.h5", "--rig", "RIG"],
        ["train", "teacher", "no.h5", "--object", "cup", "--out", "OUT"],
        ["evaluate", "no.h5", "--object", "cup", "--network", "a", "--detector", "b"],
    ],
)
def test_a_session_that_does_not_exist(fails: Fails, rig: Path, tmp_path: Path, words: list[str]) -> None:
    Calibration().save(tmp_path / "calibration.json")
    files = {"RIG": rig, "OUT": tmp_path / "out", "CALIBRATION": tmp_path / "calibration.json"}
    line = fails(*(files.get(word, word) for word in words))
    assert "no.h5" in line or "intrinsics" in line


def test_a_missing_split(fails: Fails, cup_session: Path) -> None:
    words = ("--object", "cup", "--network", "a", "--detector", "b", "--split", "night")
    line = fails("evaluate", cup_session, *words)
    assert "night" in line
    assert "s2p3 dataset split" in line


def test_no_session_to_train_on(fails: Fails, tmp_path: Path) -> None:
    assert "synthesize" in fails("train", "detector", "--object", "cup", "--out", tmp_path)


# Calibrations and objects.


def test_a_missing_calibration(fails: Fails, cup_session: Path, tmp_path: Path) -> None:
    missing = tmp_path / "calibration.json"
    line = fails("annotate", cup_session, "--calibration", missing, "--object", "cup")
    assert str(missing) in line
    assert "s2p3 calibrate" in line
    assert str(missing) in fails("synthesize", "--object", "cup", "--out", "x.h5", "--intrinsics", missing)


def test_an_unknown_object(fails: Fails, tmp_path: Path) -> None:
    line = fails("synthesize", "--object", "spoon", "--out", tmp_path / "s.h5")
    assert "spoon" in line
    assert all(name in line for name in objects.NAMES)
    assert "spoon" in fails("demo", "--object", "spoon", "--out", tmp_path / "demo")


@pytest.fixture
def cup_mesh(cup: ObjectModel) -> trimesh.Trimesh:
    return trimesh.Trimesh(cup.vertices, cup.faces, process=False)


def test_a_mesh_with_a_hole(fails: Fails, cup_mesh: trimesh.Trimesh, tmp_path: Path) -> None:
    path = tmp_path / "mug.ply"
    cup_mesh.faces = cup_mesh.faces[:-1]
    cup_mesh.export(path)
    line = fails("synthesize", "--object", "mug", "--mesh", path, "--out", tmp_path / "s.h5")
    assert "not watertight" in line
    assert "3 open edges" in line


def test_a_mesh_in_millimetres(fails: Fails, cup_mesh: trimesh.Trimesh, tmp_path: Path) -> None:
    path = tmp_path / "mug.stl"
    cup_mesh.apply_scale(1000)
    cup_mesh.export(path)
    line = fails("synthesize", "--object", "mug", "--mesh", path, "--out", tmp_path / "s.h5")
    assert "millimetres" in line
    assert "0.001" in line


def test_a_folder_nobody_may_write_to(fails: Fails, tmp_path: Path) -> None:
    picture = tmp_path / "raw.png"
    cv2.imwrite(str(picture), np.full((8, 8), 100, np.uint8))
    (tmp_path / "taken").write_text("a file where the folder would be")
    assert "taken" in fails("decode", picture, "--layout", "mono", "--out", tmp_path / "taken")


@pytest.mark.parametrize(
    ("words", "option"),
    [
        (["calibrate", "board", "--out", "b.png", "--px-per-square", "3"], "--px-per-square 3"),
        (["capture", "intrinsics", "--out", "s.h5", "--views", "0"], "--views 0"),
        (["capture", "sequence", "--out", "s.h5", "--seconds", "-1"], "--seconds -1"),
        (["capture", "board-motion", "--out", "s.h5", "--seconds", "nan"], "--seconds nan"),
        (["capture", "touches", "--out", "s.h5", "--points", "0"], "--points 0"),
        (["capture", "tool-tip", "--out", "s.h5", "--poses", "5"], "--poses 5"),
        (["capture", "polarizer", "--out", "s.h5", "--angles", "2"], "--angles 2"),
    ],
)
def test_numbers_that_make_no_sense(fails: Fails, rig: Path, words: list[str], option: str) -> None:
    assert f"{option} is too small; give at least" in fails(*words, "--rig", rig)


def test_no_thread_to_train_on(fails: Fails, cup_session: Path, tmp_path: Path) -> None:
    line = fails("train", "teacher", cup_session, "--object", "cup", "--out", tmp_path, "--threads", "0")
    assert "--threads 0" in line


def test_a_synthetic_set_that_exists_is_kept(fails: Fails, cup_session: Path) -> None:
    before = cup_session.read_bytes()
    assert str(cup_session) in fails("synthesize", "--object", "cup", "--out", cup_session)
    assert cup_session.read_bytes() == before


def test_touches_in_a_session_need_the_rig(fails: Fails, tmp_path: Path) -> None:
    assert "--rig" in fails("calibrate", "object", tmp_path / "touches.h5", "--object", "cup")


# What works.


def test_doctor_without_a_rig_checks_this_machine(capfd: pytest.CaptureFixture[str]) -> None:
    code = main(["doctor", "--json"])
    checks = json.loads(capfd.readouterr().out)
    assert checks["packages"]["ok"]
    assert code == (0 if all(check["ok"] for check in checks.values()) else 2)


def test_the_board_is_drawn_to_print(rig: Path, tmp_path: Path) -> None:
    out = tmp_path / "prints" / "board.png"
    assert main(["calibrate", "board", "--rig", str(rig), "--out", str(out), "--px-per-square", "40"]) == 0
    board = Rig.load(rig).board
    height, width = cv2.imread(str(out), cv2.IMREAD_GRAYSCALE).shape
    assert (height, width) == (40 * board.squares_y + 40, 40 * board.squares_x + 40)


def test_points_touched_by_hand_locate_an_object_before_anything_else_is_calibrated(
    cup: ObjectModel, tmp_path: Path
) -> None:
    points = tmp_path / "points.txt"
    calibration = tmp_path / "calibration.json"
    np.savetxt(points, cup.surface_points(40, seed=2) + np.array([0.4, 0.1, 0.02]))
    words = ["calibrate", "object", str(points), "--object", "cup", "--calibration", str(calibration)]
    assert main(words) == 0
    found = Calibration.load(calibration)
    assert found.intrinsics is None
    np.testing.assert_allclose(found.objects["cup"].T_base_obj.translation, [0.4, 0.1, 0.02], atol=2e-4)
    assert "<svg" in (tmp_path / "calibration-object-cup.html").read_text(encoding="utf-8")


@pytest.fixture
def cup_copy(cup_session: Path, tmp_path: Path) -> Path:
    path = tmp_path / "cup.h5"
    path.write_bytes(cup_session.read_bytes())
    return path


def test_dataset_info_and_validate(cup_copy: Path, capfd: pytest.CaptureFixture[str]) -> None:
    assert main(["dataset", "info", str(cup_copy), "--json"]) == 0
    summary = json.loads(capfd.readouterr().out)
    assert summary["frames"] == 8
    assert main(["dataset", "info", str(cup_copy)]) == 0
    assert "synthetic" in capfd.readouterr().out
    assert main(["dataset", "validate", str(cup_copy)]) == 0
    assert main(["dataset", "validate", str(cup_copy), "--json"]) == 0
    assert json.loads(capfd.readouterr().out) == {"problems": []}


def test_dataset_validate_lists_every_problem(cup_copy: Path, capfd: pytest.CaptureFixture[str]) -> None:
    with h5py.File(cup_copy, "r+") as file:
        file["camera/exposure_us"][2] = -1.0
        file["poses/sigma_t"][:] = -1.0
        for changed in ("camera/exposure_us", "poses/sigma_t"):
            reopen(file[changed])
        seal(file)
    assert main(["dataset", "validate", str(cup_copy)]) == 2
    lines = capfd.readouterr().err.splitlines()
    assert [line.split(":")[0] for line in lines] == ["camera/exposure_us", "poses/sigma_t", "s2p3"]
    assert "2 problems" in lines[-1]


def test_dataset_repair_completes_an_interrupted_recording(cup_copy: Path) -> None:
    with h5py.File(cup_copy, "r+") as file:
        file.attrs["complete"] = False
    assert main(["dataset", "repair", str(cup_copy)]) == 0
    assert main(["dataset", "validate", str(cup_copy)]) == 0
    with Session.open(cup_copy) as session:
        assert len(session) == 8


@pytest.mark.parametrize("by", ["frame", "view"])
def test_dataset_split(cup_copy: Path, by: str, capfd: pytest.CaptureFixture[str]) -> None:
    words = ["dataset", "split", str(cup_copy), "--by", by, "--train", "0.5", "--val", "0.25"]
    assert main(words) == 0
    shown = dict(line.split() for line in capfd.readouterr().out.splitlines())
    with Session.open(cup_copy) as session:
        splits = session.splits
    assert {name: len(splits[name]) for name in ("train", "val", "test")} == {
        name: int(count) for name, count in shown.items()
    }
    assert sorted(np.concatenate(list(splits.values()))) == list(range(8))


def test_the_package_runs_as_the_command_line_does(cup_session: Path) -> None:
    words = [sys.executable, "-m", "s2p3", "dataset", "info"]
    done = subprocess.run([*words, str(cup_session), "--json"], capture_output=True, text=True, timeout=60)
    assert (done.returncode, json.loads(done.stdout)["frames"]) == (0, 8)
    done = subprocess.run([*words, "no.h5"], capture_output=True, text=True, timeout=60)
    assert done.returncode == 2
    assert done.stderr.startswith("s2p3: no.h5")


def test_a_reader_that_leaves_early_is_no_error(cup_session: Path) -> None:
    info = f"{sys.executable} -m s2p3.cli dataset info {cup_session}"
    buffered = {name: value for name, value in os.environ.items() if name != "PYTHONUNBUFFERED"}
    done = subprocess.run(
        ["bash", "-c", f"{info} | true; echo ${{PIPESTATUS[0]}}"],
        capture_output=True,
        text=True,
        timeout=60,
        check=True,
        env=buffered,
    )
    assert done.stdout.strip() == "0"
    assert done.stderr == ""
