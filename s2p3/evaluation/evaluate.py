"""Runs detector and network over the frames of a session and compares with the annotated poses.

The truth is read for comparing only: boxes and masks that reach the network are the detector's. Every frame
that shows the object is a target; one without an estimate counts as failed.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np

from dataset import SE3
from dataset.errors import ToolkitError
from dataset.session import Session
from s2p3.evaluation import metrics
from s2p3.evaluation.metrics import Summary
from s2p3.evaluation.predict import Estimator, Finder
from s2p3.networks.detector import Detection
from s2p3.objects import ObjectModel
from s2p3.training.progress import OnStep, reporting

MINIMUM_VISIBLE = 0.1
"""Share of the silhouette from which a frame is a target, as in the BOP challenge."""

METRIC_POINTS = 1000
"""Points on the surface over which ADD and ADD-S are averaged."""


@dataclass(frozen=True)
class Record:
    """One target.

    Attributes:
        frame: index in the session.
        visible_fraction: of the silhouette.
        box_xywh: the detected box, or None where nothing was detected.
        T_cam_obj: the estimate, 4x4 as nested tuples, or None.
        error_m: ADD or ADD-S, see `Summary.metric`; infinite where missed.
        rotation_deg, translation_mm, depth_mm: errors, the last signed; NaN where missed.
    """

    frame: int
    visible_fraction: float
    box_xywh: tuple[float, ...] | None
    T_cam_obj: tuple[tuple[float, ...], ...] | None
    error_m: float
    rotation_deg: float
    translation_mm: float
    depth_mm: float


@dataclass(frozen=True)
class Evaluation:
    """All targets of a split, and what they come to."""

    summary: Summary
    records: tuple[Record, ...]

    def save(self, path: Path) -> None:
        """Writes JSON: the summary, and every record (an infinite error as null)."""
        rows = [{**asdict(record), "error_m": _finite(record.error_m)} for record in self.records]
        rows = [{name: _finite(value) for name, value in row.items()} for row in rows]
        text = json.dumps({"summary": asdict(self.summary), "records": rows}, indent=1)
        path.write_text(text, encoding="utf-8")

    @staticmethod
    def load(path: Path) -> Evaluation:
        """Reads what `save` wrote.

        Raises ToolkitError: no such file, or not an evaluation.
        """
        try:
            content = json.loads(path.read_text(encoding="utf-8"))
            summary = Summary(**content["summary"])
            return Evaluation(summary, tuple(_record_from(row) for row in content["records"]))
        except (OSError, ValueError, KeyError, TypeError) as error:
            raise ToolkitError(f"{path} is no saved evaluation ({error}); evaluate again") from error


def find_objects(
    session: Session, indices: Sequence[int], detector: Path, object_name: str, on_step: OnStep | None = None
) -> list[Detection | None]:
    """The detector's answer for each frame; reads Stokes images only.

    Raises ToolkitError: the detector is missing or of another object.
    """
    find = Finder.load(detector, object_name)
    found = []
    with reporting("detection", len(indices), on_step) as report:
        for count, index in enumerate(indices, start=1):
            found.append(find(session.stokes(index).stack()))
            report(count, len(indices), {})
    return found


def evaluate(
    session: Session,
    indices: Sequence[int],
    model: ObjectModel,
    network: Path,
    detector: Path,
    detections: Sequence[Detection | None] | None = None,
    on_step: OnStep | None = None,
) -> Evaluation:
    """Evaluates a teacher or student on frames of an annotated session.

    Args:
        indices: of the frames, usually a split.
        network: checkpoint of the teacher or student.
        detector: checkpoint of the detector.
        detections: the detector's answers for `indices` where `find_objects` has been run already.

    Raises ToolkitError: no frame of `indices` shows the object; checkpoints missing or of another object.
    """
    estimate = Estimator.load(network, model.name)
    find = Finder.load(detector, model.name)
    poses = session.object_poses(model.name)
    points = model.surface_points(METRIC_POINTS)
    targets = [i for i, index in enumerate(indices) if poses.visible_fraction[index] >= MINIMUM_VISIBLE]
    if not targets:
        raise ToolkitError(
            f"{session.path}: none of the {len(indices)} frames shows {model.name!r}; choose another split"
        )
    records = []
    with reporting("evaluation", len(targets), on_step) as report:
        for count, position in enumerate(targets, start=1):
            index = int(indices[position])
            stokes = session.stokes(index).stack()
            detection = find(stokes) if detections is None else detections[position]
            found = None if detection is None else estimate(stokes, detection, session.working_intrinsics)
            visible = float(poses.visible_fraction[index])
            pose = None if found is None else found.T_cam_obj
            box = None if found is None else found.detection.box_xywh
            records.append(_record(index, visible, box, pose, poses.T_cam_obj[index], points, model))
            report(count, len(targets), {})
    return Evaluation(summarize(records, model), tuple(records))


def metric_name(model: ObjectModel) -> str:
    """Which metric the object is judged by."""
    return "ADD-S" if model.symmetry.any else "ADD"


def summarize(records: Sequence[Record], model: ObjectModel) -> Summary:
    """What `records` come to."""
    errors = np.array([record.error_m for record in records])
    found = [record for record in records if record.T_cam_obj is not None]

    def median(name: str) -> float:
        return float(np.median([getattr(record, name) for record in found])) if found else float("nan")

    return Summary(
        metric=metric_name(model),
        targets=len(records),
        missed=len(records) - len(found),
        recall_10=metrics.recall(errors, 0.1 * model.diameter),
        recall_5=metrics.recall(errors, 0.05 * model.diameter),
        rotation_deg=median("rotation_deg"),
        translation_mm=median("translation_mm"),
        depth_mm=median("depth_mm"),
    )


def _record(
    frame: int,
    visible: float,
    box: np.ndarray | None,
    found: SE3 | None,
    true: SE3,
    points: metrics.Floats,
    model: ObjectModel,
) -> Record:
    if found is None or box is None:
        nan = float("nan")
        return Record(frame, visible, None, None, float("inf"), nan, nan, nan)
    estimated, wanted = SE3.stack([found]), SE3.stack([true])
    distance = metrics.add_s if model.symmetry.any else metrics.add
    offset = 1e3 * (found.translation - true.translation)
    return Record(
        frame=frame,
        visible_fraction=visible,
        box_xywh=tuple(float(value) for value in box),
        T_cam_obj=tuple(tuple(float(value) for value in row) for row in found.as_matrix()),
        error_m=float(distance(estimated, wanted, points)[0]),
        rotation_deg=float(metrics.rotation_error_deg(estimated, wanted, model.symmetry)[0]),
        translation_mm=float(np.linalg.norm(offset)),
        depth_mm=float(offset[2]),
    )


def _record_from(row: dict[str, Any]) -> Record:
    """A record as `Evaluation.save` wrote it; null stands for what was not finite."""
    errors = ("rotation_deg", "translation_mm", "depth_mm")
    numbers = {name: float("nan") for name in errors if row[name] is None}
    if row["error_m"] is None:
        numbers["error_m"] = float("inf")
    return Record(**{**row, **numbers})


def _finite(value: object) -> object:
    return None if isinstance(value, float) and not np.isfinite(value) else value
