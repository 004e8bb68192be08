"""Any field of the experiment is an option; what is not given is as in the preset, file or checkpoint."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from acquisition import typed_toml
from s2p3 import cli, presets
from s2p3.commands.experiment import Part, named_in
from s2p3.config import ExperimentConfig


@pytest.fixture
def parsed(monkeypatch: pytest.MonkeyPatch) -> list[ExperimentConfig]:
    """The experiments that the verbs were called with."""
    seen: list[ExperimentConfig] = []

    def note(part: Part, base: ExperimentConfig) -> ExperimentConfig:
        seen.append(replace(base, **vars(part)))
        raise KeyboardInterrupt

    monkeypatch.setattr(Part, "within", note)
    return seen


def words(*more: Any) -> list[str]:
    return ["train", "student", "s.h5", "--object", "cup", "--out", "out", *map(str, more)]


def test_a_field_is_overridden_and_the_rest_is_the_presets(parsed: list[ExperimentConfig]) -> None:
    cli.main(words("--preset", "paper", "--config.student.steps", 7, "--config.network.imagenet", False))
    paper = presets.paper()
    assert parsed == [
        replace(
            paper,
            student=replace(paper.student, steps=7),
            network=replace(paper.network, imagenet=False),
        )
    ]


def test_a_files_values_are_overridden(parsed: list[ExperimentConfig], tmp_path: Path) -> None:
    path = tmp_path / "experiment.toml"
    path.write_text("[student]\nseed = 5\nbatch = 4\n[augmentation]\nblur = 0.25\n")
    cli.main(words("--config", path, "--config.student.batch", 8))
    (found,) = parsed
    assert (found.student.seed, found.student.batch, found.augmentation.blur) == (5, 8, 0.25)


def test_a_students_own_experiment_is_the_default_of_its_adaptation(tmp_path: Path) -> None:
    base = presets.fast()
    stored = replace(base, self_supervision=replace(base.self_supervision, physics="stokes"))
    (tmp_path / "student.json").write_text(json.dumps({"config": typed_toml.dumps(stored)}))
    assert named_in(["--student", str(tmp_path / "student.safetensors"), "--threads", "2"]) == stored
    assert named_in(["--student", str(tmp_path / "nothing.safetensors")]) == base
    assert (
        named_in(["--student", str(tmp_path / "student.safetensors"), "--preset", "paper"]) == presets.paper()
    )


def test_a_file_overrides_only_the_fields_that_it_holds(
    parsed: list[ExperimentConfig], tmp_path: Path
) -> None:
    paper, path = presets.paper(), tmp_path / "experiment.toml"
    (tmp_path / "student.json").write_text(json.dumps({"config": typed_toml.dumps(paper)}))
    path.write_text("[self_supervision]\nphysics_weight = 0.5\n[student]\nsteps = 3\n")
    wanted = replace(
        paper,
        self_supervision=replace(paper.self_supervision, physics_weight=0.5),
        student=replace(paper.student, steps=3),
    )
    assert named_in(["--student", str(tmp_path / "student.safetensors"), "--config", str(path)]) == wanted
    cli.main(words("--preset", "paper", "--config", path))
    assert parsed == [wanted]


@pytest.mark.parametrize(
    ("more", "said"),
    [
        (["--config.input.size", "100"], "input.size 100 does not fit"),
        (["--config.student.batch", "0"], "s2p3: batch = 0 is out of range; give a number of 1 or more\n"),
        (["--config.student.learning-rate", "nan"], "s2p3: learning_rate = nan is out of range"),
        (["--config", "nothing.toml"], "nothing.toml: no such file"),
    ],
)
def test_what_does_not_fit_is_told_in_a_line(
    more: list[str], said: str, capfd: pytest.CaptureFixture[str]
) -> None:
    assert cli.main(words(*more)) == 2
    assert said in capfd.readouterr().err


def test_help_lists_the_fields_a_stage_depends_on(capfd: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit):
        cli.main(["train", "student", "--preset", "paper", "--help"])
    text = " ".join(capfd.readouterr().out.replace("│", " ").split())
    assert "--config.student.learning-rate FLOAT The peak of the schedule. (default: 0.0001)" in text
    assert "--split NAME Train on this split of the sessions only. (optional)" in text
    assert "--config.teacher" not in text
    assert "--config.detector" not in text
    with pytest.raises(SystemExit):
        cli.main(["train", "supervised", "--help"])
    text = " ".join(capfd.readouterr().out.replace("│", " ").split())
    assert "--split NAME Train on this split of the sessions only. (default: train)" in text
