"""The lab's hidden truth: drawn from its seed alone, plausible, kept on disk; and the lab's founding."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from acquisition.rig import Rig
from dataset.errors import ToolkitError
from dataset.transforms import SE3, rotation_error_deg, translation_error_mm
from s2p3 import objects
from s2p3.board import board_spec
from s2p3.lab import LabTruth, found_lab
from s2p3.lab.rig import BOARD, lab_rig
from s2p3.lab.truth import sample_truth

SIZE = board_spec(BOARD).size_m


def draw(seed: int, name: str = "cup") -> LabTruth:
    model = objects.build(name)
    return sample_truth(seed, name, model.refractive_index, SIZE, model.resting)


def test_the_same_seed_gives_the_same_truth_and_another_gives_another() -> None:
    assert draw(3) == draw(3)
    first, second = draw(3), draw(4)
    for field in ("fx", "tcp_cam", "base_object", "exposure_offset_s", "refractive_index", "tcp_tip"):
        assert getattr(first, field) != getattr(second, field)


@pytest.mark.parametrize("name", objects.NAMES)
def test_board_and_object_lie_on_the_table(name: str) -> None:
    truth = draw(1, name)
    model = objects.build(name)
    assert truth.T_base_object.apply(model.vertices)[:, 2].min() == pytest.approx(0.0, abs=1e-6)
    corners = truth.T_base_board.apply([[0, 0, 0], [SIZE[0], 0, 0], [0, SIZE[1], 0], [*SIZE, 0]])
    np.testing.assert_allclose(corners[:, 2], 0.0, atol=1e-9)
    assert truth.T_base_board.rotation[2, 2] == pytest.approx(-1.0)  # z into the board: down


def test_the_rig_knows_the_truth_roughly_and_not_exactly() -> None:
    truth, rig = draw(2), lab_rig(frame_rate=2.0)
    guess = SE3.from_pose6(np.array(rig.frames.T_tcp_cam_guess))
    assert 0.1 < translation_error_mm(guess, truth.T_tcp_cam) < 20
    assert 0.05 < rotation_error_deg(guess, truth.T_tcp_cam) < 10
    board = SE3.from_pose6(np.array(rig.frames.T_base_board_guess))
    assert 0.1 < translation_error_mm(board, truth.T_base_board) < 80
    assert 0.020 <= truth.exposure_offset_s <= 0.040


def test_truth_survives_the_disk(tmp_path: Path) -> None:
    truth = draw(7)
    truth.save(tmp_path / "lab" / "truth.json")
    assert LabTruth.load(tmp_path / "lab" / "truth.json") == truth


@pytest.mark.parametrize("text", ["", "[]", '{"seed": 1}'])
def test_a_spoilt_truth_is_named(tmp_path: Path, text: str) -> None:
    path = tmp_path / "truth.json"
    path.write_text(text)
    with pytest.raises(ToolkitError, match=r"truth\.json is not the truth of a simulated lab"):
        LabTruth.load(path)


def test_the_arms_own_error_is_small_smooth_and_depends_on_where_it_is() -> None:
    truth = draw(1)
    poses = SE3.from_rotvec(np.zeros((50, 3)), np.linspace([0.2, -0.2, 0.3], [0.5, 0.3, 0.6], 50))
    off = [float(translation_error_mm(pose, truth.T_base_flange(pose))) for pose in poses]
    assert 0.01 < max(off) < 0.2
    assert np.abs(np.diff(off)).max() < 0.02
    exact = replace(truth, arm_error_m=0.0, arm_error_rad=0.0)
    assert translation_error_mm(exact.T_base_flange(poses[0]), poses[0]) == pytest.approx(0.0)


def test_a_lab_is_founded_once_and_found_again(tmp_path: Path) -> None:
    truth_path, rig_path = found_lab(tmp_path, "cup", 1)
    truth, rig = LabTruth.load(truth_path), Rig.load(rig_path)
    assert replace(truth, latency_s=0.0) == replace(draw(1), latency_s=0.0)
    assert rig.camera.frame_rate is not None
    assert truth.latency_s < 1 / rig.camera.frame_rate  # delivered before the next one is exposed
    assert found_lab(tmp_path, "cup", 1) == (truth_path, rig_path)
    assert LabTruth.load(truth_path) == truth
    with pytest.raises(ToolkitError, match="holds a lab with cup, seed 1"):
        found_lab(tmp_path, "knife", 1)
