"""An experiment file says what a training does, and says so clearly where it is wrong."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import pytest

from dataset.errors import ToolkitError
from s2p3 import config, presets


@pytest.mark.parametrize("name", presets.PRESETS)
def test_presets_survive_a_round_trip_through_toml(name: str, tmp_path: Path) -> None:
    preset = presets.PRESETS[name]()
    config.save(preset, tmp_path / "experiment.toml")
    assert config.load(tmp_path / "experiment.toml") == preset


def test_the_paper_preset_holds_the_papers_values() -> None:
    paper = presets.paper()
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
    baseline = presets.paper().self6d
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


STAGE = {
    "steps": [-1],
    "epochs": [-1],
    "batch": [0],
    "learning_rate": [-1e-3, float("nan"), float("inf")],
    "weight_decay": [-0.1],
    "clip_norm": [0, -1, float("inf")],
    "ema": [-0.1, 1],
    "checkpoint_every": [0],
}
SUPERVISED = STAGE | {"validations": [-1], "holdout": [-0.1, 1]}
OUT_OF_RANGE = {
    "input": {"zoom": [0, -1.4], "canonical_size": [1, 31], "canonical_zoom": [0, 1.3]},
    "augmentation": {
        "zoom_min": [0],
        "zoom_max": [1.1],
        "shift": [-0.1],
        "rotation_deg": [-1, 181],
        "noise": [-0.1],
        "gain": [-0.1, 1],
        "dolp": [-0.1, 1.1],
        "blur": [-0.1, 1.1],
    },
    "network": {"decoder_channels": [1], "head_channels": [0], "head_hidden": [0]},
    "student": SUPERVISED | {"dense_weight": [-1]},
    "detector": SUPERVISED | {"level": [0, 33, 1000], "threshold": [-0.1, 1.1], "minimum_score": [-0.1, 1.1]},
    "self_supervision": STAGE
    | {
        "pose_weight": [-1],
        "mask_weight": [-1],
        "normals_weight": [-1],
        "physics_weight": [-1],
        "depth_weight": [-1],
        "smoothing": [-1, 0, 4],
        "threshold": [-0.1, 1.1],
        "threshold_quantile": [-0.1, 1.1],
        "teacher_decay": [-0.1, 1],
        "adapt_batches": [-1],
    },
    "self6d": STAGE
    | {
        "pose_weight": [-1],
        "mask_weight": [-1],
        "chamfer_weight": [-1],
        "chamfer_limit_m": [0],
        "colour_weight": [-1],
        "structure_weight": [-1],
        "perceptual_weight": [-1],
    },
}


@pytest.mark.parametrize("table", OUT_OF_RANGE)
def test_a_number_out_of_range_is_refused_with_the_range(table: str) -> None:
    base = getattr(presets.fast(), table)
    numbers = {name for name, value in vars(base).items() if type(value) in (int, float)}
    assert numbers - {*OUT_OF_RANGE[table]} <= {"size", "total_stride", "seed"}  # none is forgotten
    for name, values in OUT_OF_RANGE[table].items():
        for value in values:
            with pytest.raises(ToolkitError, match=rf"^{name} = \S+ is out of range; give a number"):
                dataclasses.replace(base, **{name: value})


def test_a_number_out_of_range_in_a_file_is_told_with_its_place(tmp_path: Path) -> None:
    path = tmp_path / "experiment.toml"
    path.write_text("[detector]\nlevel = 1000\n")
    with pytest.raises(ToolkitError) as told:
        config.load(path)
    assert str(told.value) == f"{path}: [detector] level = 1000 is out of range; give a number from 1 to 32"


def test_the_ends_of_a_range_are_in_it() -> None:
    base = presets.fast()
    dataclasses.replace(base.self_supervision, steps=0, epochs=0, threshold=1.0, smoothing=1, ema=0.0)
    dataclasses.replace(base.detector, level=32, threshold=0.0, minimum_score=1.0)
    dataclasses.replace(base.augmentation, zoom_min=1.6, shift=0.0, rotation_deg=180.0, blur=1.0, gain=0.0)
    dataclasses.replace(base.input, zoom=1.9, canonical_size=32)


def test_an_input_is_not_enlarged_from_fewer_pixels(tmp_path: Path) -> None:
    for preset in presets.PRESETS.values():
        seen = preset().input
        assert seen.canonical_size * seen.zoom / seen.canonical_zoom >= seen.size
    (tmp_path / "large.toml").write_text("[input]\nsize = 128\n")
    with pytest.raises(ToolkitError, match=r"canonical_size 96 covers 1\.9 boxes.* set .* to 174 or more"):
        config.load(tmp_path / "large.toml")
