"""What a study of self-supervision consists of: its sets, its rows, and where each of them is kept."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

from dataset.errors import ToolkitError
from s2p3.config import ExperimentConfig, SelfSupervisionConfig, load
from s2p3.training.checkpoint import read_info

TRACED_SEED, ANALYTIC_SEED, HELD_OUT_SEED = 0, 1, 2
TRACED_HELD_OUT, ANALYTIC_HELD_OUT = 60, 300  # frames
DETECTOR_FRAMES, DETECTOR_SEED = 1800, 3
ADAPTED_TO, VALIDATION, TEST = "captured", "captured-val", "captured-test"
CAPTURED_SETS = {ADAPTED_TO: (1920, 100), VALIDATION: (280, 101), TEST: (1000, 102)}
"""Frames and seed of the set to adapt to and of those to judge by."""

Change = Callable[[SelfSupervisionConfig], SelfSupervisionConfig]

BEFORE, TEACHER, ADAPTED_TEACHER = "student before", "teacher", "teacher, AdaBN alone"
ADABN = "student, AdaBN alone"
DISTILLED = "student, pose-only distillation"
WITHOUT_PHYSICS = "student, without physics"
DOLP = "student, DoLP physics (the paper's)"
STOKES = "student, Stokes physics (ours)"
"""The rows' names; folders and results on disk go by them."""


def _adapted(settings: SelfSupervisionConfig) -> SelfSupervisionConfig:
    """AdaBN, also where an object's settings go without it."""
    return replace(settings, adapt_batches=SelfSupervisionConfig().adapt_batches)


TRAINED: dict[str, Change] = {
    ADABN: lambda settings: replace(_adapted(settings), steps=0, epochs=0),
    DISTILLED: lambda settings: replace(
        settings, pose_weight=1.0, mask_weight=0.0, normals_weight=0.0, physics="none"
    ),
    WITHOUT_PHYSICS: lambda settings: replace(settings, physics="none"),
    DOLP: lambda settings: replace(settings, physics="dolp"),
    STOKES: lambda settings: replace(settings, physics="stokes"),
}
"""The rows that start from the pre-trained student, and how each departs from the object's settings."""

CHANGES = {ADAPTED_TEACHER: _adapted, **TRAINED}
"""The rows that see captured frames."""

ROWS = (BEFORE, TEACHER, *CHANGES)
"""All rows, in the table's order."""


@dataclass(frozen=True)
class Study:
    """One object's study.

    Attributes:
        name: of the object.
        out: folder of everything the study makes.
        seeds: each trains teacher, student and every row anew; the sets and the detector are common.
        domain: name of the one that the training sets are drawn from.
        traced, analytic: synthetic frames to train on, by backend.
        judged: name of the captured set that is evaluated.
    """

    name: str
    out: Path
    seeds: tuple[int, ...]
    domain: str
    traced: int
    analytic: int
    judged: str

    @property
    def settings_file(self) -> Path:
        return Path(__file__).with_name(f"{self.name}.toml")

    @property
    def detector_set(self) -> Path:
        return self.out / "detector.h5"

    @property
    def detector(self) -> Path:
        return self.out / "detector" / "detector.safetensors"

    def set(self, name: str) -> Path:
        return self.out / f"{name}.h5"

    @property
    def captured(self) -> dict[str, tuple[int, int]]:
        """Frames and seed of the captured sets in use: while settings are tuned there is no test set yet."""
        return {name: CAPTURED_SETS[name] for name in (ADAPTED_TO, self.judged)}

    def found(self, name: str) -> Path:
        """The detector's answers for a captured set: every row of every seed sees the same."""
        return self.detector.with_name(f"{name}.npz")

    def training_sets(self) -> list[Path]:
        sets = {"traced": self.traced, "analytic": self.analytic}
        return [self.set(name) for name, count in sets.items() if count]

    def held_out(self) -> list[str]:
        return [f"{path.stem}-held-out" for path in self.training_sets()]

    @property
    def rendered(self) -> Path:
        """How long each set took to render: name, workers, seconds."""
        return self.out / "rendered.tsv"

    def checkpoint(self, row: str, seed: int) -> Path:
        folder = self.out / f"seed-{seed}" / row.replace(" ", "-").replace(",", "").replace("'", "")
        kind = {BEFORE: "student", TEACHER: "teacher", ADAPTED_TEACHER: "teacher"}.get(row, "adapted")
        return folder / f"{kind}.safetensors"

    def evaluation(self, row: str, seed: int, what: str) -> Path:
        return self.checkpoint(row, seed).with_name(f"{what}.json")

    def experiment(self, seed: int) -> ExperimentConfig:
        config = load(self.settings_file)
        return replace(
            config,
            teacher=replace(config.teacher, seed=seed),
            student=replace(config.student, seed=seed),
            self_supervision=replace(config.self_supervision, seed=seed),
        )

    def stage(self, row: str, seed: int) -> tuple[Path, str, object]:
        """The checkpoint of a row, and the part of its experiment that it was trained by: name and value."""
        config, path = self.experiment(seed), self.checkpoint(row, seed)
        if row in (TEACHER, BEFORE):
            return path, path.stem, getattr(config, path.stem)
        return path, "self_supervision", CHANGES[row](config.self_supervision)


def check_sets(study: Study) -> None:
    """Raises ToolkitError: the folder's sets are another study's. A new folder notes what they will be."""
    note = study.out / "study.json"
    wanted = {"domain": study.domain, "traced": study.traced, "analytic": study.analytic}
    if not note.exists():
        study.out.mkdir(parents=True, exist_ok=True)
        note.write_text(json.dumps(wanted) + "\n", encoding="utf-8")
    held = json.loads(note.read_text(encoding="utf-8"))
    if held != wanted:
        raise ToolkitError(f"{study.out} holds a study of {held}, not of {wanted}; choose another --out")


def check_settings(study: Study) -> None:
    """Raises ToolkitError: a checkpoint in the folder was trained by settings other than those of today."""
    stages = [study.stage(row, seed) for seed in study.seeds for row in ROWS]
    stages.append((study.detector, "detector", study.experiment(0).detector))
    for path, name, settings in stages:
        if path.exists():
            config, today = read_info(path).config, study.experiment(0)
            shared = all(getattr(config, part) == getattr(today, part) for part in ("input", "augmentation"))
            if not shared or config.network != today.network or getattr(config, name) != settings:
                raise ToolkitError(
                    f"{path}: was trained by other settings than {study.settings_file.name} now holds; "
                    "delete it with what was made from it, or choose another --out"
                )
