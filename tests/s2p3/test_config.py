"""An experiment file says what a training does, and says so clearly where it is wrong."""

from __future__ import annotations

from pathlib import Path

import pytest

from dataset.errors import ToolkitError
from s2p3 import config


@pytest.mark.parametrize("name", config.PRESETS)
def test_presets_survive_a_round_trip_through_toml(name: str, tmp_path: Path) -> None:
    preset = config.PRESETS[name]()
    config.save(preset, tmp_path / "experiment.toml")
    assert config.load(tmp_path / "experiment.toml") == preset


def test_the_paper_preset_holds_the_papers_values() -> None:
    paper = config.paper()
    assert paper.input.size == 256
    assert paper.input.background == "mask"
    for stage, batch in ((paper.teacher, 8), (paper.student, 8), (paper.self_supervision, 4)):
        assert (stage.epochs, stage.batch) == (100, batch)
        assert (stage.learning_rate, stage.schedule) == (1e-4, "halving")
    weights = paper.self_supervision
    assert weights.pose_weight == weights.mask_weight == 1
    assert weights.normals_weight == weights.physics_weight == 1
    assert (weights.physics, weights.teacher, weights.depth) == ("dolp", "frozen", "none")
    assert (paper.input.modality, paper.network.student) == ("polarization", "direct")
    assert paper.teacher.dense_weight == 0


def test_the_baseline_has_the_published_weights() -> None:
    baseline = config.paper().self6d
    assert (baseline.epochs, baseline.batch, baseline.learning_rate) == (100, 6, 1e-4)
    assert (baseline.schedule, baseline.clip_norm) == ("flat", 1.0)
    assert (baseline.pose_weight, baseline.mask_weight, baseline.chamfer_weight) == (10, 1, 100)
    assert (baseline.colour_weight, baseline.structure_weight, baseline.perceptual_weight) == (0.2, 1, 0.15)


def test_an_unknown_field_is_named_with_the_nearest_valid_one(tmp_path: Path) -> None:
    path = tmp_path / "experiment.toml"
    path.write_text("[teacher]\nlearning_rat = 1e-3\n")
    with pytest.raises(ToolkitError, match=r"learning_rat.*learning_rate"):
        config.load(path)


@pytest.mark.parametrize(
    ("text", "what"),
    [
        ("[input]\nsize = 100\n", "total_stride"),
        ("[augmentation]\nzoom_max = 3.0\n", "zoom_max"),
    ],
)
def test_values_that_do_not_fit_together_are_refused(text: str, what: str, tmp_path: Path) -> None:
    path = tmp_path / "experiment.toml"
    path.write_text(text)
    with pytest.raises(ToolkitError, match=what):
        config.load(path)
