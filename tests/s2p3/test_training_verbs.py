"""The training verbs on what cannot work: one line that says why, and exit code 2."""

from __future__ import annotations

import dataclasses
import json
import shutil
from pathlib import Path

import numpy as np
import pytest
import trimesh

from dataset.session import Session, write_split
from dataset.session.edit import write_depth
from s2p3 import presets
from s2p3.cli import main
from s2p3.config import ExperimentConfig
from s2p3.objects import ObjectModel, build
from s2p3.rendering import rasterize
from s2p3.training.checkpoint import read_info
from tests.s2p3.untrained import eager_detector_config, save_untrained

FEW = ["--preset", "quick", "--workers", "0"]


@pytest.fixture(scope="module")
def rgb(tmp_path_factory: pytest.TempPathFactory, cup: ObjectModel) -> dict[str, Path]:
    return save_untrained(tmp_path_factory.mktemp("rgb"), cup, with_modality("rgb"))


@pytest.fixture(scope="module")
def rgbd(tmp_path_factory: pytest.TempPathFactory, cup: ObjectModel) -> dict[str, Path]:
    return save_untrained(tmp_path_factory.mktemp("rgbd"), cup, with_modality("rgbd"))


@pytest.fixture(scope="module")
def session(tmp_path_factory: pytest.TempPathFactory, cup_session: Path) -> Path:
    """With a split train, a split empty, and no depth."""
    path = Path(shutil.copy(cup_session, tmp_path_factory.mktemp("session") / "cup.h5"))
    write_split(path, "train", [0, 1, 2])
    write_split(path, "empty", [])
    return path


@pytest.fixture(scope="module")
def with_depth(tmp_path_factory: pytest.TempPathFactory, session: Path, cup: ObjectModel) -> Path:
    path = Path(shutil.copy(session, tmp_path_factory.mktemp("depth") / "cup.h5"))
    with Session.open(path) as opened:
        camera, poses = opened.working_intrinsics, opened.object_poses("cup")
        depths = [rasterize(cup.mesh, pose, camera).depth for pose in poses.T_cam_obj]
    write_depth(path, [np.rint(1000 * depth).astype(np.uint16) for depth in depths])
    return path


def with_modality(modality: str) -> ExperimentConfig:
    base = eager_detector_config()
    seen = dataclasses.replace(base.input, modality=modality)  # type: ignore[arg-type]
    return dataclasses.replace(base, input=seen)


def adapting(session: Path, networks: dict[str, Path], out: Path, name: str = "cup") -> list[str]:
    chosen = [word for kind in networks for word in (f"--{kind}", str(networks[kind]))]
    few = ["--workers", "0", "--config.self-supervision.steps", "1", "--config.self-supervision.batch", "2"]
    few += ["--config.self-supervision.adapt-batches", "1"]
    return ["train", "self-supervised", str(session), "--object", name, *chosen, *few, "--out", str(out)]


def refused(words: list[str], said: str, capfd: pytest.CaptureFixture[str]) -> None:
    capfd.readouterr()
    assert main(words) == 2
    (line,) = capfd.readouterr().err.splitlines()
    assert line.startswith("s2p3: ")
    assert said in line


@pytest.mark.parametrize("kind", ["teacher", "student", "detector"])
def test_a_session_without_the_object(
    kind: str, session: Path, tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    words = ["train", kind, str(session), "--object", "knife", *FEW, "--out", str(tmp_path)]
    refused(words, "object 'knife' has no poses", capfd)


@pytest.mark.parametrize(("split", "said"), [("empty", "holds no frame"), ("nowhere", "no split 'nowhere'")])
def test_a_split_that_is_empty_or_missing(
    split: str, said: str, session: Path, tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    common = [str(session), "--object", "cup", *FEW, "--split", split, "--out", str(tmp_path)]
    for verb in ("teacher", "supervised"):
        refused(["train", verb, *common], said, capfd)


@pytest.mark.parametrize(
    ("split", "said"), [("empty", "split 'empty' is empty"), ("nowhere", "no split 'nowhere'")]
)
def test_adapting_and_evaluating_on_an_empty_or_missing_split(
    split: str,
    said: str,
    session: Path,
    networks: dict[str, Path],
    tmp_path: Path,
    capfd: pytest.CaptureFixture[str],
) -> None:
    refused([*adapting(session, networks, tmp_path), "--split", split], said, capfd)
    chosen = ["--network", str(networks["student"]), "--detector", str(networks["detector"])]
    refused(["evaluate", str(session), "--object", "cup", *chosen, "--split", split], said, capfd)


def test_networks_of_another_object(
    session: Path, networks: dict[str, Path], tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    refused(adapting(session, networks, tmp_path, "fork"), "was trained for 'cup', not 'fork'", capfd)
    chosen = ["--network", str(networks["student"]), "--detector", str(networks["detector"])]
    refused(["predict", str(session), "--object", "fork", *chosen], "was trained for 'cup'", capfd)


def test_a_teacher_that_sees_something_else_than_its_student(
    session: Path,
    networks: dict[str, Path],
    rgb: dict[str, Path],
    tmp_path: Path,
    capfd: pytest.CaptureFixture[str],
) -> None:
    mixed = {**networks, "teacher": rgb["teacher"]}
    refused(adapting(session, mixed, tmp_path), "expect different inputs", capfd)


def test_nothing_is_detected(
    session: Path,
    networks: dict[str, Path],
    cup: ObjectModel,
    tmp_path: Path,
    capfd: pytest.CaptureFixture[str],
) -> None:
    base = eager_detector_config()
    strict = dataclasses.replace(base, detector=dataclasses.replace(base.detector, threshold=0.999))
    blind = {**networks, "detector": save_untrained(tmp_path, cup, strict)["detector"]}
    capfd.readouterr()
    assert main(adapting(session, blind, tmp_path)) == 2
    assert "found the object in none of the frames" in capfd.readouterr().err.splitlines()[-1]


def test_a_mesh_in_millimetres(session: Path, tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    cup = build("cup")
    path = tmp_path / "mug.ply"
    trimesh.Trimesh(1000 * cup.vertices, cup.faces).export(path)
    for verb in ("teacher", "detector"):
        words = ["train", verb, str(session), "--object", "mug", "--mesh", str(path), *FEW]
        refused([*words, "--out", str(tmp_path)], "millimetres", capfd)


def test_networks_that_see_depth_where_there_is_none(
    session: Path, rgbd: dict[str, Path], tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    capfd.readouterr()
    assert main(adapting(session, rgbd, tmp_path)) == 2
    assert "has no depth" in capfd.readouterr().err.splitlines()[-1]
    chosen = ["--network", str(rgbd["student"]), "--detector", str(rgbd["detector"])]
    refused(["predict", str(session), "--object", "cup", *chosen], "this network sees depth", capfd)


def test_the_baseline_wants_networks_without_polarization(
    with_depth: Path, networks: dict[str, Path], tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    capfd.readouterr()
    assert main([*adapting(with_depth, networks, tmp_path), "--method", "self6d"]) == 2
    assert "sees polarization" in capfd.readouterr().err.splitlines()[-1]


def test_both_methods_adapt_a_student(
    with_depth: Path,
    networks: dict[str, Path],
    rgb: dict[str, Path],
    tmp_path: Path,
    capfd: pytest.CaptureFixture[str],
) -> None:
    assert main(adapting(with_depth, networks, tmp_path / "s2p3")) == 0
    assert (
        "s2p3: warning: adapted: L_physics cannot help here" in capfd.readouterr().err
    )  # an untrained teacher
    few = ["--method", "self6d", "--config.self6d.steps", "1", "--config.self6d.batch", "2"]
    assert main([*adapting(with_depth, rgb, tmp_path / "self6d"), *few]) == 0
    for method in ("s2p3", "self6d"):
        info = read_info(tmp_path / method / "adapted.safetensors", "student", "cup")
        assert info.stage == "self-supervised"


def test_an_annotated_split_is_trained_on_as_synthetic_sets_are(session: Path, tmp_path: Path) -> None:
    few = ["--config.teacher.steps", "1", "--config.teacher.batch", "2", "--config.teacher.validations", "0"]
    words = ["train", "supervised", str(session), "--object", "cup", *FEW, *few, "--out", str(tmp_path)]
    assert main(words) == 0
    info = read_info(tmp_path / "teacher.safetensors", "teacher", "cup")
    assert (info.stage, info.step) == ("supervised", 1)
    assert presets.quick().teacher.steps != 1


@pytest.mark.parametrize("modality", ["rgb", "rgbd"])
def test_a_baseline_is_trained_and_predicts(
    modality: str,
    with_depth: Path,
    networks: dict[str, Path],
    tmp_path: Path,
    capfd: pytest.CaptureFixture[str],
) -> None:
    few = ["--config.student.steps", "1", "--config.student.batch", "2", "--config.student.validations", "0"]
    words = ["train", "student", str(with_depth), "--object", "cup", *FEW, *few, "--out", str(tmp_path)]
    assert main([*words, "--config.input.modality", modality]) == 0
    trained = tmp_path / "student.safetensors"
    assert read_info(trained, "student", "cup").config.input.modality == modality
    assert not trained.with_suffix(".signal.json").exists()  # it sees no polarization
    capfd.readouterr()
    chosen = ["--network", str(trained), "--detector", str(networks["detector"]), "--count", "1"]
    assert main(["predict", str(with_depth), "--object", "cup", *chosen]) == 0
    assert json.loads(capfd.readouterr().out)["found"]
