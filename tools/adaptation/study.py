"""Does self-supervision help? Synthetic sets of one object, frames of another domain, every control.

    python tools/adaptation/study.py --object cup --out out/study    goes on where it was stopped
    python tools/adaptation/study.py --object cup --out out/study --split val    for tuning; publishes nothing

Teacher and student are trained on path-traced and analytic sets of the domain `plain` (or, with --domain
synthetic, of the varied one); the detector, whose boxes all share, on analytic images of the varied one. The
"captured" frames are of the domain `captured` (other things on the table, another index, light, background,
noise, blur, occluders); their poses serve the evaluation only. OBJECT.toml beside this file holds what
was tuned on their split `val`. Results go to docs/adaptation/OBJECT-DOMAIN.json, of which page.py makes
docs/adaptation.md.
"""

from __future__ import annotations

import argparse
import json
import multiprocessing
import sys
import time
from collections.abc import Callable, Iterable, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from dataclasses import dataclass, replace
from datetime import date
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import torch
from page import RESULTS, table, write_page

from dataset.session import Session
from dataset.splits import split_session
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
from s2p3.training.checkpoint import CheckpointInfo, save
from s2p3.training.pretrain import load_teacher

CAPTURED_FRAMES, DETECTOR_FRAMES = 3200, 1800
SHARES = {"train": 0.6, "val": 0.0875}  # the rest, a thousand frames, is the test
TRACED_HELD_OUT, ANALYTIC_HELD_OUT = 60, 300  # frames
TRACED_SEED, ANALYTIC_SEED, HELD_OUT_SEED, DETECTOR_SEED, CAPTURED_SEED = 0, 1, 2, 3, 100

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
        split: of the captured frames, that is evaluated.
    """

    name: str
    out: Path
    seeds: tuple[int, ...]
    domain: str
    traced: int
    analytic: int
    split: str

    @property
    def settings_file(self) -> Path:
        return Path(__file__).with_name(f"{self.name}.toml")

    @property
    def captured(self) -> Path:
        return self.out / "captured.h5"

    @property
    def detector_set(self) -> Path:
        return self.out / "detector.h5"

    @property
    def detector(self) -> Path:
        return self.out / "detector" / "detector.safetensors"

    @property
    def found(self) -> Path:
        """The detector's answers for all captured frames: every row of every seed sees the same."""
        return self.out / "detector" / "found.npz"

    def training_sets(self) -> list[Path]:
        sets = {"traced": self.traced, "analytic": self.analytic}
        return [self.out / f"{name}.h5" for name, count in sets.items() if count]

    def held_out_sets(self) -> list[Path]:
        return [path.with_name(f"{path.stem}-held-out.h5") for path in self.training_sets()]

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


def make_sets(study: Study, workers: int) -> None:
    """Renders the sets that are missing, and divides the captured frames."""
    trained_on = DOMAINS[study.domain]
    makers: list[tuple[Path, int, int, Domain, Backend]] = [
        (study.captured, CAPTURED_FRAMES, CAPTURED_SEED, CAPTURED, Analytic()),
        (study.detector_set, DETECTOR_FRAMES, DETECTOR_SEED, SYNTHETIC, Analytic()),
    ]
    backends: dict[str, tuple[Backend, int, int, int]] = {}
    if study.analytic:
        backends["analytic"] = (Analytic(), study.analytic, ANALYTIC_SEED, ANALYTIC_HELD_OUT)
    if study.traced:
        backends["traced"] = (PathTraced.here(), study.traced, TRACED_SEED, TRACED_HELD_OUT)
    for name, (backend, count, seed, held_out) in backends.items():
        makers.append((study.out / f"{name}.h5", count, seed, trained_on, backend))
        makers.append((study.out / f"{name}-held-out.h5", held_out, HELD_OUT_SEED, trained_on, backend))
    model = objects.build(study.name)
    for path, count, seed, domain, backend in makers:
        if not path.exists():
            print(f"{path.name}: {count} frames", flush=True)
            print(synthesize(model, count, session_camera(), seed, path, workers, None, domain, backend))
    with Session.open(study.captured) as session:
        divided = "test" in session.splits
    if not divided:
        split_session(study.captured, "frame", **SHARES, seed=CAPTURED_SEED)


def train_network(study: Study, what: str, seed: int) -> None:
    """Pre-trains a teacher, a student, or the detector, which then looks at all captured frames."""
    config, model, cache = study.experiment(seed), objects.build(study.name), study.out / "crops"
    if what == "detector":
        if not study.detector.exists():
            train_detector([study.detector_set], model, config, study.detector.parent, _silent)
        find_captured(study)
    elif what == TEACHER:
        out = study.checkpoint(TEACHER, seed).parent
        train_teacher(study.training_sets(), model, config, out, cache, _silent)
    else:
        out, teacher = study.checkpoint(BEFORE, seed).parent, study.checkpoint(TEACHER, seed)
        train_student(study.training_sets(), model, config, out, cache, teacher, _silent)


def find_captured(study: Study) -> None:
    """Runs the detector over all captured frames and keeps what it found."""
    with Session.open(study.captured) as session:
        found = find_objects(session, range(len(session)), study.detector, study.name, _silent)
        shape = session.stokes(0).s0.shape
    masks = [np.zeros(shape, bool) if one is None else one.mask for one in found]
    boxes = [np.zeros(4) if one is None else one.box_xywh for one in found]
    scores = [np.nan if one is None else one.score for one in found]
    np.savez_compressed(study.found, mask=np.packbits(masks, axis=-1), box=boxes, score=scores)


def found_in(study: Study, indices: Sequence[int]) -> list[Detection | None]:
    """What the detector found in captured frames."""
    with np.load(study.found) as kept, Session.open(study.captured) as session:
        width = session.working_intrinsics.width
        masks = np.unpackbits(kept["mask"][indices], axis=-1, count=width).astype(bool)
        rows = zip(kept["box"][indices], masks, kept["score"][indices], strict=True)
        return [None if np.isnan(score) else Detection(box, mask, float(score)) for box, mask, score in rows]


def adapt_network(study: Study, row: str, seed: int) -> None:
    """Trains one row on the captured split `train`; no pose is read."""
    config, model = study.experiment(seed), objects.build(study.name)
    with Session.open(study.captured) as session:
        indices = [int(index) for index in session.splits["train"]]
        crops = captured_crops(session, indices, found_in(study, indices), config.input)
    teacher, student = study.checkpoint(TEACHER, seed), study.checkpoint(BEFORE, seed)
    path = study.checkpoint(row, seed)
    if row == ADAPTED_TEACHER:
        network, info = load_teacher(teacher, model.name)
        settings = replace(config.self_supervision, adapt_batches=ADABN)
        adapt_batch_norm(network, crops, model.refractive_index, config, settings)
        path.parent.mkdir(parents=True, exist_ok=True)
        save(path, network.state_dict(), CheckpointInfo.of("teacher", "AdaBN", model, 0, config, info.data))
    else:
        settings = TRAINED[row](config.self_supervision)
        self_supervise(crops, model, teacher, student, path.parent, settings, _silent)


def judge_network(study: Study, row: str, seed: int, what: str) -> None:
    """Evaluates one row on `what`: a split of the captured frames, or the held-out synthetic set so named."""
    model = objects.build(study.name)
    captured = what in (*SHARES, "test")
    with Session.open(study.captured if captured else study.out / f"{what}.h5") as session:
        indices = [int(index) for index in session.splits[what]] if captured else list(range(len(session)))
        found = found_in(study, indices) if captured else None
        network = study.checkpoint(row, seed)
        run = evaluate(session, indices, model, network, study.detector, found, _silent)
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
    guides: list[Job] = [(study.found, train_network, (study, "detector", study.seeds[0]))]
    students: list[Job] = []  # they may start from their teacher's encoders
    adaptation: list[Job] = []
    evaluation: list[Job] = []
    for seed in study.seeds:
        for jobs, row in ((guides, TEACHER), (students, BEFORE)):
            jobs.append((study.checkpoint(row, seed), train_network, (study, row, seed)))
        for row in (ADAPTED_TEACHER, *TRAINED):
            adaptation.append((study.checkpoint(row, seed), adapt_network, (study, row, seed)))
        judged = [(row, study.split) for row in ROWS]
        judged += [(row, path.stem) for row in (TEACHER, BEFORE) for path in study.held_out_sets()]
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
            found.append({"seed": seed, "metric": summary.metric, **row_figures})
        return found

    def above(row: str, other: str) -> list[dict[str, float]]:
        found = []
        for seed in study.seeds:
            runs = [Evaluation.load(study.evaluation(name, seed, study.split)) for name in (row, other)]
            difference = runs[0].above(runs[1])["recall_10"]
            low, high = difference.interval
            found.append({"seed": seed, "value": difference.value, "low": low, "high": high})
        return found

    return {
        "split": study.split,
        "minutes": minutes_of(study),
        "rows": {row: figures(row, study.split) for row in ROWS},
        "in_domain": {
            path.stem: {row: figures(row, path.stem) for row in (TEACHER, BEFORE)}
            for path in study.held_out_sets()
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
        "--split", choices=(*SHARES, "test"), default="test", help="captured frames to judge by"
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
        options.split,
    )
    run_study(study, options.workers)
    result = result_of(study)
    print(table(result))
    if options.split == "test":
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
