"""What the demo found, against the hidden truth of its lab: result.json, and the page with the pictures."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from calibration import Calibration, html
from calibration.steps import report_path
from dataset.session import Session
from dataset.transforms import SE3, rotation_error_deg, translation_error_mm
from s2p3 import metrics, objects
from s2p3.evaluation import Evaluation
from s2p3.evaluation.report import evaluation_section
from s2p3.lab import LabTruth
from s2p3.objects import ObjectModel


@dataclass(frozen=True)
class Target:
    """How far off a result may be, and how the page says it."""

    label: str
    unit: str
    limit: float


TARGETS = {
    ("intrinsics", "fx_rel_err"): Target("focal length", "relative", 2e-3),
    ("hand_eye", "rot_deg"): Target("hand-eye rotation", "deg", 0.05),
    ("hand_eye", "trans_mm"): Target("hand-eye translation", "mm", 0.5),
    ("clock", "offset_err_ms"): Target("clock offset", "ms", 1.0),
    ("tool_tip", "err_mm"): Target("tool tip", "mm", 0.2),
    ("object", "rot_deg"): Target("object rotation", "deg", 0.3),
    ("object", "trans_mm"): Target("object position", "mm", 1.0),
}


def compare(
    calibration: Calibration,
    truth: LabTruth,
    sessions: Sequence[Path],
    runs: Mapping[str, Evaluation],
    seconds: Mapping[str, float],
) -> dict[str, Any]:
    """The content of result.json.

    Args:
        calibration: everything recovered.
        truth: of the lab.
        sessions: every recording, for the frames' ledger.
        runs: evaluations "teacher", "before" and "after".
        seconds: of every step.
    """
    calibration.require("intrinsics", "hand_eye", "time_offset", "tool_tip")
    assert calibration.intrinsics is not None
    assert calibration.hand_eye is not None
    assert calibration.time_offset is not None
    assert calibration.tool_tip is not None
    found = calibration.objects[truth.object_name].T_base_obj
    captured, dropped = _frames(sessions)
    summaries = {name: run.summary for name, run in runs.items()}
    return {
        "intrinsics": {
            "fx_rel_err": abs(calibration.intrinsics.intrinsics.K[0, 0] / truth.fx - 1),
            "reproj_px": calibration.intrinsics.rms_px,
        },
        "hand_eye": {
            "rot_deg": float(rotation_error_deg(calibration.hand_eye.T_tcp_cam, truth.T_tcp_cam)),
            "trans_mm": float(translation_error_mm(calibration.hand_eye.T_tcp_cam, truth.T_tcp_cam)),
        },
        "clock": {"offset_err_ms": 1e3 * abs(calibration.time_offset.offset_s - truth.time_offset_s)},
        "tool_tip": {
            "err_mm": 1e3 * float(np.linalg.norm(calibration.tool_tip.tip_in_tcp - np.array(truth.tcp_tip)))
        },
        "object": {
            "rot_deg": _object_rotation_deg(found, truth),
            "trans_mm": float(translation_error_mm(found, truth.T_base_object)),
        },
        "frames": {"captured": captured, "dropped": dropped},
        "recall": {
            "metric": f"{summaries['after'].metric} at 10 % of the diameter, percent",
            "before": summaries["before"].recall_10,
            "after": summaries["after"].recall_10,
            "teacher": summaries["teacher"].recall_10,
            "targets": summaries["after"].targets,
            "missed": summaries["after"].missed,
        },
        "seconds": {**seconds, "total": round(sum(seconds.values()), 1)},
    }


def write_report(
    out: Path,
    result: Mapping[str, Any],
    calibration: Path,
    sequence: Path,
    model: ObjectModel,
    runs: Mapping[str, Evaluation],
) -> Path:
    """Writes OUT/result.json and OUT/report.html, and returns the page's path."""
    (out / "result.json").write_text(json.dumps(result, indent=1) + "\n", encoding="utf-8")
    with Session.open(sequence) as session:
        poses = evaluation_section(session, model, runs)
    page = html.page(
        f"S²P³ on the simulated lab: {model.name}",
        "Camera and arm calibrated, an object captured and annotated, a pose model trained without labels.",
        [poses, _against_truth(result, calibration, out), _time(result)],
        "Made by s2p3 demo. The truth is the simulated lab's own; the toolkit saw it for this page only.",
    )
    path = out / "report.html"
    path.write_text(page, encoding="utf-8")
    return path


def _against_truth(result: Mapping[str, Any], calibration: Path, out: Path) -> str:
    tiles = []
    for (part, key), target in TARGETS.items():
        value = result[part][key]
        good = value <= target.limit
        note = f"asked: within {target.limit:g} {target.unit}"
        tiles.append(html.Tile(target.label, f"{value:.2g} {target.unit}", note, "good" if good else "warn"))
    frames = result["frames"]
    ledger = f"{frames['captured']} frames stored, {frames['dropped']} dropped and in the ledger."
    found = calibration.parent.glob(report_path(calibration, "*").name)
    pages = sorted(path.relative_to(out) for path in found)
    return html.section(
        "Recovered, against the hidden truth",
        f"What calibration found from pictures, poses and touches. {ledger}",
        html.tiles(*tiles),
        html.links({page.stem.replace("-", " "): str(page) for page in pages}),
    )


def _time(result: Mapping[str, Any]) -> str:
    rows = [(name.replace("_", " "), f"{seconds:.0f} s") for name, seconds in result["seconds"].items()]
    return html.section("Time", "What each step took on this machine.", html.table(("step", "time"), rows))


def _object_rotation_deg(found: SE3, truth: LabTruth) -> float:
    """Up to the object's symmetry: no measurement tells how far a bottle is turned about its axis."""
    symmetry = objects.build(truth.object_name).symmetry
    estimated, true = SE3.stack([found]), SE3.stack([truth.T_base_object])
    return float(metrics.rotation_error_deg(estimated, true, symmetry)[0])


def _frames(sessions: Sequence[Path]) -> tuple[int, int]:
    captured = dropped = 0
    for path in sessions:
        with Session.open(path) as session:
            captured += len(session)
            dropped += len(session.drops)
    return captured, dropped
