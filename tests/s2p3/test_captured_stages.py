"""From an object to an evaluated pose model by the command line alone, in a handful of steps."""

from __future__ import annotations

import dataclasses
import json
from pathlib import Path

import numpy as np
import pytest

from dataset.errors import SessionError, ToolkitError
from dataset.session import Session, write_split
from dataset.validate import validate
from s2p3 import config, presets
from s2p3.captured_stages import adapt, frames_of
from s2p3.cli import main
from s2p3.evaluation import Evaluation
from s2p3.objects import build
from s2p3.training.checkpoint import read_info

COUNT = 4


@pytest.fixture(scope="module")
def experiment(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """experiment.toml of a training that takes seconds and learns next to nothing."""
    base = presets.quick()
    few = dataclasses.replace(base.teacher, steps=2, batch=2, checkpoint_every=10)
    again = dataclasses.replace(base.self_supervision, steps=2, batch=2, adapt_batches=1)
    # A threshold below every score: an untrained detector must report something for the rest to work on.
    detector = dataclasses.replace(base.detector, steps=2, batch=2, threshold=0.01, minimum_score=0.0)
    path = tmp_path_factory.mktemp("experiment") / "experiment.toml"
    config.save(
        dataclasses.replace(base, detector=detector, teacher=few, student=few, self_supervision=again), path
    )
    return path


@pytest.fixture(scope="module")
def synthetic(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("synthetic") / "synthetic.h5"
    words = ["synthesize", "--object", "cup", "--count", str(COUNT), "--workers", "1", "--out", str(path)]
    assert main(words) == 0
    return path


@pytest.fixture(scope="module")
def networks(tmp_path_factory: pytest.TempPathFactory, synthetic: Path, experiment: Path) -> Path:
    """Folder with detector, teacher and student."""
    out = tmp_path_factory.mktemp("networks")
    for verb in ("detector", "teacher", "student"):
        words = [
            str(synthetic),
            "--object",
            "cup",
            "--config",
            str(experiment),
            "--out",
            str(out / verb),
            "--workers",
            "0",
        ]
        assert main(["train", verb, *words]) == 0
    return out


def checkpoint(networks: Path, name: str) -> Path:
    return networks / name / f"{name}.safetensors"


def test_a_synthesized_session_is_valid_and_holds_the_truth(synthetic: Path) -> None:
    assert validate(synthetic) == []
    with Session.open(synthetic) as session:
        assert (session.kind, len(session)) == ("synthetic", COUNT)
        assert session.objects == ("cup",)
        poses = session.object_poses("cup")
        for index in range(COUNT):
            inside = poses.mask(index)
            assert inside.any()
            stokes = session.stokes(index)
            assert stokes.dolp[inside & stokes.valid].mean() > 0.02
            centre = session.working_intrinsics.project(poses.T_cam_obj[index].translation[None])[0]
            x, y, width, height = poses.bbox_xywh[index]
            assert x - width < centre[0] < x + 2 * width
            assert y - height < centre[1] < y + 2 * height


def test_the_seed_decides_what_is_synthesized(synthetic: Path, tmp_path: Path) -> None:
    words = ["synthesize", "--object", "cup", "--count", "1", "--workers", "1"]
    with Session.open(synthetic) as session:
        first = session.raw(0)
    for seed, alike in (("0", True), ("1", False)):
        assert main([*words, "--seed", seed, "--out", str(tmp_path / f"{seed}.h5")]) == 0
        with Session.open(tmp_path / f"{seed}.h5") as session:
            assert np.array_equal(session.raw(0), first) == alike


@pytest.mark.parametrize("name", ["detector", "teacher", "student"])
def test_training_leaves_a_checkpoint_and_a_log(networks: Path, name: str) -> None:
    assert checkpoint(networks, name).exists()
    lines = checkpoint(networks, name).with_suffix(".log.jsonl").read_text().splitlines()
    assert json.loads(lines[-1])["step"] == 2


def test_a_trained_network_is_evaluated_on_every_target(
    networks: Path, synthetic: Path, tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    write_split(synthetic, "test", [0, 2, 3])
    common = ["--object", "cup", "--detector", str(checkpoint(networks, "detector"))]
    saved = tmp_path / "evaluation.json"
    for name in ("teacher", "student"):
        capfd.readouterr()
        network = ["--network", str(checkpoint(networks, name)), "--out", str(saved), "--json"]
        assert main(["evaluate", str(synthetic), *common, *network]) == 0
        summary = json.loads(capfd.readouterr().out)
        assert summary["targets"] == 3
        assert Evaluation.load(saved).summary.targets == 3
        assert len(Evaluation.load(saved).records) == 3


def test_self_supervision_adapts_the_student(networks: Path, synthetic: Path, experiment: Path) -> None:
    write_split(synthetic, "train", [0, 1, 3])
    words = [
        str(synthetic),
        "--object",
        "cup",
        "--out",
        str(networks / "adapted"),
        "--config",
        str(experiment),
    ]
    for name in ("detector", "teacher", "student"):
        words += [f"--{name}", str(checkpoint(networks, name))]
    assert main(["train", "self-supervised", *words, "--workers", "0"]) == 0
    assert checkpoint(networks, "adapted").exists()
    assert read_info(checkpoint(networks, "adapted")).step == 2
    assert checkpoint(networks, "adapted").read_bytes() != checkpoint(networks, "student").read_bytes()


def test_checkpoints_of_another_object_are_refused(networks: Path, synthetic: Path, tmp_path: Path) -> None:
    write_split(synthetic, "train", [0, 1])
    paths = [checkpoint(networks, name) for name in ("detector", "teacher", "student")]
    with pytest.raises(ToolkitError, match=r"cup.*knife|knife.*cup"):
        adapt(synthetic, "train", build("knife"), *paths, tmp_path)


def test_a_split_must_hold_frames(synthetic: Path) -> None:
    write_split(synthetic, "night", [1, 3])
    write_split(synthetic, "noon", [])
    with Session.open(synthetic) as session:
        assert frames_of(session, "night") == [1, 3]
        with pytest.raises(SessionError, match="the split 'noon' is empty"):
            frames_of(session, "noon")
