"""What a study found, by row and seed, with paired differences."""

from __future__ import annotations

import json
from collections.abc import Iterable
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
from plan import ADABN, BEFORE, ROWS, TEACHER, TRAINED, Study

from s2p3.evaluation import Evaluation
from s2p3.training.checkpoint import read_info


def minutes_of(study: Study) -> dict[str, float]:
    """What the trainings took, on average, a process and a thread each: from their logs."""

    def seconds(log: Path) -> float:
        """Of all sessions of a training: each counts from zero."""
        times = [0.0, *(json.loads(line)["seconds"] for line in log.read_text(encoding="utf-8").splitlines())]
        return sum(now - before if now > before else now for before, now in pairwise(times))

    def spent(checkpoints: Iterable[Path]) -> float:
        logs = [path.with_suffix(".log.jsonl") for path in checkpoints]
        return round(float(np.mean([seconds(log) for log in logs])) / 60, 1)

    trained = [row for row in TRAINED if row != ADABN]
    lines = study.rendered.read_text(encoding="utf-8").splitlines() if study.rendered.exists() else []
    sets = sum(int(workers) * float(spent) for _, workers, spent in (line.split("\t") for line in lines))
    return {
        **({"all sets": round(sets / 60)} if lines else {}),
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
        "differences": {row: {other: above(row, other) for other in ROWS if other != row} for row in TRAINED},
    }
