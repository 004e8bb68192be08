"""The two stages that meet captured frames, addressed as a lab does: a session, the name of a split,
checkpoints.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

from dataset.errors import SessionError
from dataset.session import Session
from s2p3.config import Self6DConfig, SelfSupervisionConfig
from s2p3.evaluation import Estimator, Evaluation, evaluate, find_objects
from s2p3.evaluation.evaluate import targets_of
from s2p3.objects import ObjectModel, poses_of
from s2p3.progress import Report, quiet
from s2p3.training import captured_crops, self_supervise, self_supervise_rgbd
from s2p3.training.checkpoint import to_write
from s2p3.training.crops import depth_of
from s2p3.training.self_supervised import load_pair


def adapt(
    session: Path,
    split: str,
    model: ObjectModel,
    detector: Path,
    teacher: Path,
    student: Path,
    out: Path,
    settings: SelfSupervisionConfig | Self6DConfig | None = None,
    *,
    workers: int = 0,
    report: Report = quiet,
) -> Path:
    """Self-supervised training of a student on a split of captured frames; no pose of the session is read.

    Args:
        settings: of the paper's method, as the student's experiment has them when None, or of the RGB-D
            baseline.
        workers, report: see `loop.Run`.

    Returns:
        `out`/adapted.safetensors.

    Raises:
        SessionError: no such split.
        ToolkitError: the object is detected in no frame; checkpoints of another object.
    """
    to_write(out / "adapted.safetensors")  # this and the next are told before the detector has run
    config = load_pair(teacher, student, model).config
    with Session.open(session) as opened:
        indices = frames_of(opened, split)
        depth_of(opened, indices[0], config.input)
        detections = find_objects(opened, indices, detector, model.name, report)
        crops = captured_crops(opened, indices, detections, config.input)
    common = (crops, model, teacher, student, out)
    if isinstance(settings, Self6DConfig):
        return self_supervise_rgbd(*common, settings, workers=workers, report=report)
    return self_supervise(*common, settings, workers=workers, report=report)


def evaluate_split(
    session: Path,
    split: str,
    model: ObjectModel,
    networks: Mapping[str, Path],
    detector: Path,
    report: Report = quiet,
) -> dict[str, Evaluation]:
    """Evaluates networks on a split of an annotated session, in the same detected boxes; see
    `evaluation.evaluate`.

    Raises:
        SessionError: no such split, or the object was not annotated.
        ToolkitError: checkpoints of another object.
    """
    with Session.open(session) as opened:
        indices = frames_of(opened, split)
        targets_of(opened, indices, poses_of(opened, model), model.name)
        for network in networks.values():
            Estimator.load(network, model)  # a mistake is told before the detector has run
        found = find_objects(opened, indices, detector, model.name, report)
        return {
            name: evaluate(opened, indices, model, network, found, report)
            for name, network in networks.items()
        }


def frames_of(session: Session, split: str) -> list[int]:
    """Frame indices of a split, one at least.

    Raises:
        SessionError: the session has no such split, or it is empty.
    """
    indices = [int(index) for index in session.frames_in(split)]
    if not indices:
        raise SessionError(f"{session.path}: the split {split!r} is empty; choose another, or make it again")
    return indices
