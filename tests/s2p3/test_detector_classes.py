"""One detector for several objects: trained, saved, and asked for each by its name."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import numpy as np
import pytest
import torch
from torch import Tensor

from dataset.errors import ToolkitError
from dataset.session import Session
from s2p3 import presets
from s2p3.cli import main
from s2p3.evaluation import Finder
from s2p3.networks.detector import CELL, detect
from s2p3.objects import ObjectModel, build
from s2p3.training import train_detector
from s2p3.training.checkpoint import read_info
from s2p3.training.detection import box_distances, detector_losses, small_frames
from tests.s2p3.conftest import write_cup_session


@pytest.fixture(scope="module")
def fork_session(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("fork") / "fork.h5"
    write_cup_session(path, build("fork"), seed=1)
    return path


@pytest.fixture(scope="module")
def detector(
    cup_session: Path, fork_session: Path, cup: ObjectModel, tmp_path_factory: pytest.TempPathFactory
) -> Path:
    base = presets.quick()
    few = dataclasses.replace(base.detector, steps=3, batch=4, threshold=0.01, minimum_score=0.0)
    config = dataclasses.replace(base, detector=few)
    out = tmp_path_factory.mktemp("detector")
    return train_detector([cup_session, fork_session], [cup, build("fork")], config, out)


def test_every_session_shows_its_own_object(cup_session: Path, fork_session: Path) -> None:
    frames = small_frames([cup_session, fork_session], ["cup", "fork"], 4)
    shown = frames.masks.float().sum((2, 3)) > 0
    assert shown[:8].tolist() == [[True, False]] * 8
    assert shown[8:].tolist() == [[False, True]] * 8
    with pytest.raises(ToolkitError, match="no session shows knife"):
        small_frames([cup_session], ["cup", "knife"], 4)
    with pytest.raises(ToolkitError, match="'fork' has no poses"):
        small_frames([cup_session], ["fork"], 4)


def test_a_detector_is_asked_for_its_objects_by_name(detector: Path, cup_session: Path) -> None:
    assert read_info(detector, "detector", "fork").names == ("cup", "fork")
    assert Finder.load(detector, "fork").class_index == 1
    with pytest.raises(ToolkitError, match="was trained for 'cup', 'fork', not 'knife'"):
        Finder.load(detector, "knife")
    with Session.open(cup_session) as session:
        stokes = session.stokes(0).stack()
    found = [Finder.load(detector, name)(stokes) for name in ("cup", "fork")]
    assert found[0] is not None
    assert found[1] is not None
    assert found[0].score != found[1].score


def test_each_object_is_found_where_its_own_mask_is() -> None:
    """Two objects in one picture; cells answer for the one they show."""
    masks = torch.zeros(1, 2, 32, 40)
    masks[0, 0, 4:12, 6:18] = 1
    masks[0, 1, 18:28, 22:34] = 1
    cells = (16, 20)
    first, second = (box_distances(masks[:, c] > 0.5, cells)[0] for c in (0, 1))
    of_second = masks[:, 1:, ::CELL, ::CELL] > 0.5
    distances = torch.where(of_second, second, first)
    logits = torch.where(masks[:, :, ::CELL, ::CELL] > 0.5, 9.0, -9.0)
    losses = detector_losses(logits, distances, masks)
    assert losses["box"] == pytest.approx(0, abs=1e-6)
    assert losses["dice"] < 0.01
    assert detector_losses(logits.flip(1), distances, masks)["dice"] > 0.5

    def network(image: Tensor) -> tuple[Tensor, Tensor]:
        del image
        return logits, distances

    image = np.random.default_rng(0).random((3, 128, 160), dtype=np.float32)
    boxes = [detect(network, image, 4, 0.5, 0.5, c) for c in (0, 1)]
    assert boxes[0] is not None
    assert boxes[1] is not None
    np.testing.assert_allclose(boxes[0].box_xywh, [24, 16, 48, 32])
    np.testing.assert_allclose(boxes[1].box_xywh, [88, 72, 48, 40])
    assert not (boxes[0].mask & boxes[1].mask).any()


def test_the_command_line_trains_a_detector_of_several_objects(
    cup_session: Path, fork_session: Path, tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    words = ["train", "detector", str(cup_session), str(fork_session), "--object", "cup", "fork"]
    few = ["--preset", "quick", "--config.detector.steps", "1", "--workers", "0"]
    assert main([*words, *few, "--out", str(tmp_path)]) == 0
    assert read_info(tmp_path / "detector.safetensors").names == ("cup", "fork")
    mesh = ["--mesh", "thing.ply", "--out", str(tmp_path)]
    assert main([*words, *mesh]) == 2
    assert "--mesh is of one object" in capfd.readouterr().err.splitlines()[-1]
