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
from dataclasses import replace
from datetime import date
from pathlib import Path
from typing import Any

import numpy as np
import torch
from page import RESULTS, table, write_page
from plan import (
    ADAPTED_TEACHER,
    ADAPTED_TO,
    ANALYTIC_HELD_OUT,
    ANALYTIC_SEED,
    BEFORE,
    CHANGES,
    DETECTOR_FRAMES,
    DETECTOR_SEED,
    HELD_OUT_SEED,
    ROWS,
    TEACHER,
    TEST,
    TRACED_HELD_OUT,
    TRACED_SEED,
    VALIDATION,
    Study,
    check_sets,
    check_settings,
)
from results import result_of

from dataset.session import Session
from dataset.whole_files import replacing
from s2p3 import objects
from s2p3.evaluation import evaluate, find_objects
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
from s2p3.training import captured_crops, self_supervise, supervise, train_detector
from s2p3.training.batch_norm import adapt_batch_norm
from s2p3.training.checkpoint import CheckpointInfo, save
from s2p3.training.supervised import load_teacher


def make_sets(study: Study, workers: int) -> None:
    """Renders the sets that are missing."""
    trained_on = DOMAINS[study.domain]
    makers: list[tuple[Path, int, int, Domain, Backend]] = [
        (study.set(name), count, seed, CAPTURED, Analytic()) for name, (count, seed) in study.captured.items()
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
            started = time.perf_counter()
            camera = session_camera()
            print(synthesize(model, count, camera, seed, path, workers, domain=domain, backend=backend))
            with study.rendered.open("a", encoding="utf-8") as log:
                log.write(f"{path.name}\t{workers}\t{time.perf_counter() - started:.0f}\n")


def train_network(study: Study, what: str, seed: int) -> None:
    """Pre-trains a teacher, a student, or the detector."""
    config, model, cache = study.experiment(seed), objects.build(study.name), study.out / "crops"
    if what == "detector":
        train_detector([study.detector_set], model, config, study.detector.parent)
    else:
        path = study.checkpoint(what, seed)
        supervise(path.stem, study.training_sets(), model, config, path.parent, cache=cache)


def find_captured(study: Study, name: str) -> None:
    """Runs the detector over a captured set and keeps what it found."""
    with Session.open(study.set(name)) as session:
        found = find_objects(session, range(len(session)), study.detector, study.name)
        shape = session.stokes(0).s0.shape
    masks = [np.zeros(shape, bool) if one is None else one.mask for one in found]
    boxes = [np.zeros(4) if one is None else one.box_xywh for one in found]
    scores = [np.nan if one is None else one.score for one in found]
    with replacing(study.found(name)) as partial, partial.open("wb") as stream:
        np.savez_compressed(stream, mask=np.packbits(masks, axis=-1), box=boxes, score=scores)


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
    with Session.open(study.set(ADAPTED_TO)) as session:
        crops = captured_crops(session, range(len(session)), found_in(study, ADAPTED_TO), config.input)
    teacher, student = study.checkpoint(TEACHER, seed), study.checkpoint(BEFORE, seed)
    path, settings = study.checkpoint(row, seed), CHANGES[row](config.self_supervision)
    config = replace(config, self_supervision=settings)
    if row == ADAPTED_TEACHER:
        network, info = load_teacher(teacher, model.name)
        adapt_batch_norm(network, crops, model.refractive_index, config, settings)
        path.parent.mkdir(parents=True, exist_ok=True)
        save(path, network.state_dict(), CheckpointInfo.of("teacher", "AdaBN", model, 0, config, info.data))
    else:
        self_supervise(crops, model, teacher, student, path.parent, settings)


def judge_network(study: Study, row: str, seed: int, what: str) -> None:
    """Evaluates one row on the set called `what`."""
    model = objects.build(study.name)
    with Session.open(study.set(what)) as session:
        frames, network = range(len(session)), study.checkpoint(row, seed)
        if what in study.captured:
            found = found_in(study, what)
        else:
            found = find_objects(session, frames, study.detector, study.name)
        run = evaluate(session, frames, model, network, found)
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
    check_sets(study)
    check_settings(study)
    networks: list[Job] = [(study.detector, train_network, (study, "detector", study.seeds[0]))]
    detection: list[Job] = [(study.found(name), find_captured, (study, name)) for name in study.captured]
    adaptation: list[Job] = []
    evaluation: list[Job] = []
    for seed in study.seeds:
        for row in (TEACHER, BEFORE):
            networks.append((study.checkpoint(row, seed), train_network, (study, row, seed)))
        for row in CHANGES:
            adaptation.append((study.checkpoint(row, seed), adapt_network, (study, row, seed)))
        judged = [(row, study.judged) for row in ROWS]
        judged += [(row, name) for row in (TEACHER, BEFORE) for name in study.held_out()]
        for row, what in judged:
            evaluation.append((study.evaluation(row, seed, what), judge_network, (study, row, seed, what)))
    make_sets(study, workers)
    for jobs in (networks, detection, adaptation, evaluation):
        run_all(jobs, workers)


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
    parser.add_argument("--judged", choices=(VALIDATION, TEST), default=TEST, help="captured set to judge by")
    parser.add_argument("--workers", type=int, default=2)
    options = parser.parse_args()
    study = Study(
        options.object,
        options.out / options.object,
        tuple(options.seeds),
        options.domain,
        options.traced,
        options.analytic,
        options.judged,
    )
    run_study(study, options.workers)
    result = result_of(study)
    print(table(result))
    if options.judged == TEST:
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


if __name__ == "__main__":
    sys.exit(main())
