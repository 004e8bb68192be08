"""Runs detector and network over the frames of a session, and compares with the annotated poses.

The truth is read for comparing only: boxes and masks that reach the network are the detector's. Every frame
that shows the object is a target; one without an estimate counts as failed.
"""

from __future__ import annotations

import json
import math
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np

from dataset.errors import ToolkitError
from dataset.session import ObjectPoses, Session
from s2p3 import metrics
from s2p3.evaluation.predict import Estimator, Finder
from s2p3.evaluation.records import Record, Ruler, Subject
from s2p3.evaluation.summary import Difference, Summary, differences, grouped, of_same_targets, summarize
from s2p3.metrics import Floats
from s2p3.networks.detector import Detection
from s2p3.objects import ObjectModel, poses_of
from s2p3.progress import Report, quiet

MINIMUM_VISIBLE = 0.1
"""Share of the silhouette from which a frame is a target, as in the BOP challenge."""

KNOWN_VIEWS = "train"
"""Split whose views the new ones are measured from."""


@dataclass(frozen=True)
class Evaluation:
    """All targets of a split, and what they come to."""

    subject: Subject
    summary: Summary
    records: tuple[Record, ...]

    @staticmethod
    def of(records: Sequence[Record], subject: Subject) -> Evaluation:
        """The evaluation that consists of `records`; at least one."""
        return Evaluation(subject, summarize(records, subject), tuple(records))

    @property
    def errors_m(self) -> Floats:
        """(N,) ADD or ADD-S, as the subject says; infinite where missed."""
        return np.array([record.error_m(self.subject.metric) for record in self.records])

    def groups(self) -> dict[str, dict[str, Summary]]:
        """Summaries by how the targets are seen, see `summary.grouped`."""
        return grouped(self.records, self.subject)

    def paired_with(self, other: Evaluation) -> bool:
        """Whether both are of the same targets."""
        return of_same_targets(self.records, other.records, self.subject, other.subject)

    def above(self, other: Evaluation) -> dict[str, Difference]:
        """Every figure minus the other evaluation's, paired. Raises ToolkitError: of other targets."""
        return differences(self.records, other.records, self.subject, other.subject)

    def save(self, path: Path) -> None:
        """Writes JSON: subject, summary, summaries by group, every record; null for what is not finite."""
        content = {
            "subject": asdict(self.subject),
            "summary": asdict(self.summary),
            "groups": {
                title: {name: asdict(summary) for name, summary in group.items()}
                for title, group in self.groups().items()
            },
            "records": [asdict(record) for record in self.records],
        }
        path.write_text(json.dumps(finite(content), indent=1, allow_nan=False) + "\n", encoding="utf-8")

    @staticmethod
    def load(path: Path) -> Evaluation:
        """Reads what `save` wrote.

        Raises ToolkitError: no such file, or not an evaluation.
        """
        try:
            content = json.loads(path.read_text(encoding="utf-8"))
        except FileNotFoundError as error:
            raise ToolkitError(f"{path}: no such file; name one that `s2p3 evaluate --out` wrote") from error
        except (OSError, ValueError) as error:
            raise ToolkitError(f"{path}: cannot be read ({error}); evaluate again") from error
        try:
            subject = Subject(**content["subject"])
            return Evaluation.of([Record.from_json(row) for row in content["records"]], subject)
        except (ValueError, KeyError, TypeError) as error:
            raise ToolkitError(
                f"{path} is no saved evaluation; name one that `s2p3 evaluate --out` wrote"
            ) from error


def find_objects(
    session: Session, indices: Sequence[int], detector: Path, object_name: str, report: Report = quiet
) -> list[Detection | None]:
    """The detector's answer for each frame; reads Stokes images only.

    Raises ToolkitError: the detector is missing or of another object.
    """
    find = Finder.load(detector, object_name)
    found = []
    for count, index in enumerate(indices, start=1):
        found.append(find(session.stokes(index).stack()))
        report("detection", count, len(indices), {})
    return found


def evaluate(
    session: Session,
    indices: Sequence[int],
    model: ObjectModel,
    network: Path,
    detections: Sequence[Detection | None],
    report: Report = quiet,
) -> Evaluation:
    """Evaluates a teacher or student on frames of an annotated session.

    Args:
        indices: of the frames, usually a split.
        network: checkpoint or ONNX file of the teacher or student.
        detections: the detector's answers for `indices`, see `find_objects`.

    Raises ToolkitError: no frame of `indices` shows the object; a checkpoint missing or of another object.
    """
    estimate = Estimator.load(network, model)
    poses = poses_of(session, model)
    targets = targets_of(session, indices, poses, model.name)
    camera = session.working_intrinsics
    ruler = Ruler(model, camera, _known_views(session, poses))
    records = []
    for count, position in enumerate(targets, start=1):
        index = int(indices[position])
        stokes, detection = session.stokes(index).stack(), detections[position]
        depth = session.depth(index) if session.has_depth else None
        found = None if detection is None else estimate(stokes, detection, camera, depth)
        true = poses.T_cam_obj[index]
        sight = ruler.sight(index, float(poses.visible_fraction[index]), true)
        if found is None or not found.T_cam_obj.finite:
            records.append(Record.missed(sight))
        else:
            box = found.detection.box_xywh
            records.append(ruler.record(sight, found.T_cam_obj, true, box, found.score))
        report(f"evaluation of {network.stem}", count, len(targets), {})
    return Evaluation.of(records, Subject.of(model, camera.width, session.session_id))


def targets_of(session: Session, indices: Sequence[int], poses: ObjectPoses, object_name: str) -> list[int]:
    """Positions in `indices` of the frames that show enough of the object.

    Raises ToolkitError: there are none.
    """
    targets = [i for i, index in enumerate(indices) if poses.visible_fraction[index] >= MINIMUM_VISIBLE]
    if not targets:
        raise ToolkitError(
            f"{session.path}: none of the {len(indices)} frames shows {object_name!r}; choose another split"
        )
    return targets


def finite(value: Any) -> Any:
    """The same value, with None for every number in it that is not finite, as JSON needs."""
    if isinstance(value, dict):
        return {key: finite(item) for key, item in value.items()}
    if isinstance(value, (list, tuple)):
        return [finite(item) for item in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value


def _known_views(session: Session, poses: ObjectPoses) -> Floats:
    known = session.splits.get(KNOWN_VIEWS)
    seen = poses.T_cam_obj[np.zeros(0, np.int64) if known is None else known]
    return metrics.viewing_direction(seen[seen.finite])
