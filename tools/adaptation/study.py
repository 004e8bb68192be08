"""Does self-supervision help? Synthetic sets of one object, frames of another domain, every control.

    python tools/adaptation/study.py --object cup --out out/study    goes on where it was stopped
    python tools/adaptation/study.py --object cup --out out/study --judged captured-val    for tuning

Teacher and student are trained on path-traced and analytic sets of the domain `plain` (or, with --domain
synthetic, of the varied one); the detector, whose boxes all share, on analytic images of the varied one. The
"captured" frames are of the domain `captured` (other things on the table, another index, light, background,
noise, blur, occluders), in three sets: one to adapt to, whose poses nobody reads; one to tune OBJECT.toml
(beside this file) on; and the test. Results go to docs/adaptation/OBJECT-DOMAIN.json, of which page.py makes
docs/adaptation.md.
"""

from __future__ import annotations

import argparse
import json
import multiprocessing
import sys
import time
from collections.abc import Callable, Iterable
from concurrent.futures import ProcessPoolExecutor, as_completed
from dataclasses import dataclass, replace
from datetime import date
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import torch
from page import RESULTS, table, write_page

from dataset.errors import ToolkitError
from dataset.session import Session
from s2p3 import objects
from s2p3.config import ExperimentConfig, SelfSupervisionConfig, load
from s2p3.evaluation import Evaluation, evaluate, find_objects
from s2p3.networks.detector import Detection
from s2p3.provenance import checked_out_commit
from s2p3.synthesis import (
    CAPTURED,
    DOMAINS,
    SYNTHETIC,
    Analytic,
    Domain,
    PathTraced,
    session_camera,
    synthesize,
)
from s2p3.synthesis.scene import Backend
from s2p3.training import captured_crops, self_supervise, train_detector, train_student, train_teacher
from s2p3.training.adaptation import adapt_batch_norm
from s2p3.training.checkpoint import CheckpointInfo, read_info, save
from s2p3.training.pretrain import load_teacher

TRACED_SEED, ANALYTIC_SEED, HELD_OUT_SEED = 0, 1, 2
TRACED_HELD_OUT, ANALYTIC_HELD_OUT = 60, 300  # frames
DETECTOR_FRAMES, DETECTOR_SEED = 1800, 3
CAPTURED_SETS = {"captured": (1920, 100), "captured-val": (280, 101), "captured-test": (1000, 102)}
"""Frames and seed of the set to adapt to and of those to judge by."""

Change = Callable[[SelfSupervisionConfig], SelfSupervisionConfig]

ADABN = SelfSupervisionConfig().adapt_batches
TRAINED: dict[str, Change] = {
    "student, AdaBN alone": lambda settings: replace(settings, steps=0, epochs=0, adapt_batches=ADABN),
    "student, pose-only distillation": lambda settings: replace(
        settings, pose_weight=1.0, mask_weight=0.0, normals_weight=0.0, physics="none"
    ),
    "student, without physics": lambda settings: replace(settings, physics="none"),
    "student, DoLP physics (the paper's)": lambda settings: replace(settings, physics="dolp"),
    "student, Stokes physics (ours)": lambda settings: replace(settings, physics="stokes"),
}
"""The rows that start from the pre-trained student, and how each departs from the object's settings."""

BEFORE, TEACHER, ADAPTED_TEACHER = "student before", "teacher", "teacher, AdaBN alone"
ROWS = (BEFORE, TEACHER, ADAPTED_TEACHER, *TRAINED)
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

    def found(self, name: str) -> Path:
        """The detector's answers for a captured set: every row of every seed sees the same."""
        return self.detector.with_name(f"{name}.npz")

    def training_sets(self) -> list[Path]:
        sets = {"traced": self.traced, "analytic": self.analytic}
        return [self.set(name) for name, count in sets.items() if count]

    def held_out(self) -> list[str]:
        return [f"{path.stem}-held-out" for path in self.training_sets()]

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
        change = TRAINED.get(row, lambda settings: settings)
        return path, "self_supervision", change(config.self_supervision)


def make_sets(study: Study, workers: int) -> None:
    """Renders the sets that are missing."""
    trained_on = DOMAINS[study.domain]
    makers: list[tuple[Path, int, int, Domain, Backend]] = [
        (study.set(name), count, seed, CAPTURED, Analytic()) for name, (count, seed) in CAPTURED_SETS.items()
    ]
    makers.append((study.detector_set, DETECTOR_FRAMES, DETECTOR_SEED, SYNTHETIC, Analytic()))
    backends: dict[str, tuple[Backend, int, int, int]] = {}
    if study.analytic:
        backends["analytic"] = (Analytic(), study.analytic, ANALYTIC_SEED, ANALYTIC_HELD_OUT)
    if study.traced:
        backends["traced"] = (PathTraced.here(), study.traced, TRACED_SEED, TRACED_HELD_OUT)
    for name, (backend, count, seed, held_out) in backends.items():
        makers.append((study.set(name), count, seed, trained_on, backend))
        makers.append((study.set(f"{name}-held-out"), held_out, HELD_OUT_SEED, trained_on, backend))
    model = objects.build(study.name)
    for path, count, seed, domain, backend in makers:
        if not path.exists():
            print(f"{path.name}: {count} frames", flush=True)
            print(synthesize(model, count, session_camera(), seed, path, workers, None, domain, backend))


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


def train_network(study: Study, what: str, seed: int) -> None:
    """Pre-trains a teacher, a student, or the detector, which then looks at the captured sets."""
    config, model, cache = study.experiment(seed), objects.build(study.name), study.out / "crops"
    if what == "detector":
        if not study.detector.exists():
            train_detector([study.detector_set], model, config, study.detector.parent, _silent)
        for name in CAPTURED_SETS:
            find_captured(study, name)
    elif what == TEACHER:
        out = study.checkpoint(TEACHER, seed).parent
        train_teacher(study.training_sets(), model, config, out, cache, _silent)
    else:
        out, teacher = study.checkpoint(BEFORE, seed).parent, study.checkpoint(TEACHER, seed)
        train_student(study.training_sets(), model, config, out, cache, teacher, _silent)


def find_captured(study: Study, name: str) -> None:
    """Runs the detector over a captured set and keeps what it found."""
    with Session.open(study.set(name)) as session:
        found = find_objects(session, range(len(session)), study.detector, study.name, _silent)
        shape = session.stokes(0).s0.shape
    masks = [np.zeros(shape, bool) if one is None else one.mask for one in found]
    boxes = [np.zeros(4) if one is None else one.box_xywh for one in found]
    scores = [np.nan if one is None else one.score for one in found]
    np.savez_compressed(study.found(name), mask=np.packbits(masks, axis=-1), box=boxes, score=scores)


def found_in(study: Study, name: str) -> list[Detection | None]:
    """What the detector found in the frames of a captured set."""
    with np.load(study.found(name)) as kept, Session.open(study.set(name)) as session:
        width = session.working_intrinsics.width
        masks = np.unpackbits(kept["mask"], axis=-1, count=width).astype(bool)
        rows = zip(kept["box"], masks, kept["score"], strict=True)
        return [None if np.isnan(score) else Detection(box, mask, float(score)) for box, mask, score in rows]


def adapt_network(study: Study, row: str, seed: int) -> None:
    """Trains one row on the captured set to adapt to; no pose is read."""
    config, model = study.experiment(seed), objects.build(study.name)
    with Session.open(study.set("captured")) as session:
        crops = captured_crops(session, range(len(session)), found_in(study, "captured"), config.input)
    teacher, student = study.checkpoint(TEACHER, seed), study.checkpoint(BEFORE, seed)
    path, settings = study.checkpoint(row, seed), config.self_supervision
    if row == ADAPTED_TEACHER:
        network, info = load_teacher(teacher, model.name)
        adapt_batch_norm(network, crops, model.refractive_index, config, settings)
        path.parent.mkdir(parents=True, exist_ok=True)
        save(path, network.state_dict(), CheckpointInfo.of("teacher", "AdaBN", model, 0, config, info.data))
    else:
        self_supervise(crops, model, teacher, student, path.parent, TRAINED[row](settings), _silent)


def judge_network(study: Study, row: str, seed: int, what: str) -> None:
    """Evaluates one row on the set called `what`."""
    model = objects.build(study.name)
    found = found_in(study, what) if what in CAPTURED_SETS else None
    with Session.open(study.set(what)) as session:
        network = study.checkpoint(row, seed)
        run = evaluate(session, range(len(session)), model, network, study.detector, found, _silent)
    run.save(study.evaluation(row, seed, what))


Job = tuple[Path, Callable[..., None], tuple[Any, ...]]
"""A file, the function that makes it, and that function's arguments."""


def run_all(jobs: Iterable[Job], workers: int) -> None:
    """Runs the jobs whose file is missing, a process and a thread each."""
    missing = [(path, run, arguments) for path, run, arguments in jobs if not path.exists()]
    context = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(workers, context, torch.set_num_threads, (1,)) as pool:
        started = {pool.submit(run, *arguments): path for path, run, arguments in missing}
        for done in as_completed(started):
            done.result()
            print(f"{time.strftime('%H:%M:%S')} {started[done].parent.name}/{started[done].name}", flush=True)


def run_study(study: Study, workers: int) -> None:
    """Every step whose file is missing."""
    study.out.mkdir(parents=True, exist_ok=True)
    check_settings(study)
    last = study.found(list(CAPTURED_SETS)[-1])
    guides: list[Job] = [(last, train_network, (study, "detector", study.seeds[0]))]
    students: list[Job] = []  # they may start from their teacher's encoders
    adaptation: list[Job] = []
    evaluation: list[Job] = []
    for seed in study.seeds:
        for jobs, row in ((guides, TEACHER), (students, BEFORE)):
            jobs.append((study.checkpoint(row, seed), train_network, (study, row, seed)))
        for row in (ADAPTED_TEACHER, *TRAINED):
            adaptation.append((study.checkpoint(row, seed), adapt_network, (study, row, seed)))
        judged = [(row, study.judged) for row in ROWS]
        judged += [(row, name) for row in (TEACHER, BEFORE) for name in study.held_out()]
        for row, what in judged:
            evaluation.append((study.evaluation(row, seed, what), judge_network, (study, row, seed, what)))
    make_sets(study, workers)
    run_all(guides, workers)
    run_all(students, workers)
    run_all(adaptation, workers)
    run_all(evaluation, workers)


def minutes_of(study: Study) -> dict[str, float]:
    """What the trainings took, on average, a process and a thread each: from their logs."""

    def seconds(log: Path) -> float:
        """Of all sessions of a training: each counts from zero."""
        times = [0.0, *(json.loads(line)["seconds"] for line in log.read_text(encoding="utf-8").splitlines())]
        return sum(now - before if now > before else now for before, now in pairwise(times))

    def spent(checkpoints: Iterable[Path]) -> float:
        logs = [path.with_suffix(".log.jsonl") for path in checkpoints]
        return round(float(np.mean([seconds(log) for log in logs])) / 60, 1)

    trained = [row for row in TRAINED if row != "student, AdaBN alone"]
    return {
        "the detector": spent([study.detector]),
        "a teacher": spent(study.checkpoint(TEACHER, seed) for seed in study.seeds),
        "a student": spent(study.checkpoint(BEFORE, seed) for seed in study.seeds),
        "a self-supervised row": spent(
            study.checkpoint(row, seed) for seed in study.seeds for row in trained
        ),
    }


def result_of(study: Study) -> dict[str, Any]:
    """What the study found, ready for JSON."""

    def figures(row: str, what: str) -> list[dict[str, Any]]:
        found = []
        for seed in study.seeds:
            summary = Evaluation.load(study.evaluation(row, seed, what)).summary
            names = (
                "targets",
                "missed",
                "recall_10",
                "recall_5",
                "rotation_deg",
                "translation_mm",
                "depth_mm",
            )
            row_figures = {name: getattr(summary, name) for name in names}
            commit = read_info(study.checkpoint(row, seed)).commit
            found.append({"seed": seed, "metric": summary.metric, "commit": commit, **row_figures})
        return found

    def above(row: str, other: str) -> list[dict[str, float]]:
        found = []
        for seed in study.seeds:
            runs = [Evaluation.load(study.evaluation(name, seed, study.judged)) for name in (row, other)]
            difference = runs[0].above(runs[1])["recall_10"]
            low, high = difference.interval
            found.append({"seed": seed, "value": difference.value, "low": low, "high": high})
        return found

    return {
        "judged": study.judged,
        "minutes": minutes_of(study),
        "rows": {row: figures(row, study.judged) for row in ROWS},
        "in_domain": {
            name: {row: figures(row, name) for row in (TEACHER, BEFORE)} for name in study.held_out()
        },
        "differences": {
            row: {other: above(row, other) for other in ROWS if other != row} for row in ROWS[3:]
        },
    }


def main() -> int:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--object", choices=objects.NAMES, required=True)
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--seeds", type=int, nargs="+", default=[0, 1, 2])
    parser.add_argument("--domain", choices=("plain", "synthetic"), default="plain", help="trained on")
    parser.add_argument("--traced", type=int, default=400, help="path-traced frames to train on")
    parser.add_argument("--analytic", type=int, default=3600, help="analytic frames to train on")
    parser.add_argument(
        "--judged", choices=tuple(CAPTURED_SETS)[1:], default="captured-test", help="captured set to judge by"
    )
    parser.add_argument("--workers", type=int, default=2)
    options = parser.parse_args()
    study = Study(
        options.object,
        options.out,
        tuple(options.seeds),
        options.domain,
        options.traced,
        options.analytic,
        options.judged,
    )
    run_study(study, options.workers)
    result = result_of(study)
    print(table(result))
    if options.judged == "captured-test":
        publish(f"{study.name}-{study.domain}", result)
    return 0


def publish(name: str, result: dict[str, Any]) -> None:
    """Keeps a result with command, commit and date, and makes the page of all that are kept."""
    commit = checked_out_commit("docs/adaptation", "docs/adaptation.md")
    command = f"python tools/adaptation/study.py {' '.join(sys.argv[1:])}"
    kept = {"command": command, "commit": commit, "date": date.today().isoformat(), "result": result}
    RESULTS.mkdir(exist_ok=True)
    (RESULTS / f"{name}.json").write_text(json.dumps(kept, indent=1) + "\n", encoding="utf-8")
    write_page()


def _silent(*_: object) -> None:
    """Instead of a progress bar in a worker."""


if __name__ == "__main__":
    sys.exit(main())
