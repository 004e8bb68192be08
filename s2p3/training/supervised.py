"""Supervised training of teacher and student: on synthetic sessions at first, or, for the paper's upper
bound, on annotated captured ones.

The paper supervises both by poses alone: point matching for the rotation, L1 for the translation. The
teacher's dense losses (`dense_weight`) are our choice, and so is a student that starts from its teacher's
encoders; `s2p3.presets.paper` is without the former.
"""

from __future__ import annotations

import functools
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import torch
from torch import Tensor

from dataset.errors import ToolkitError
from s2p3 import inputs, losses
from s2p3.config import ExperimentConfig, FrameSource
from s2p3.inputs import View
from s2p3.networks.build import build_student, build_teacher
from s2p3.networks.pose_head import decode_pose, ray_rotation, site_from_translation
from s2p3.networks.student import Student
from s2p3.networks.teacher import Teacher, TeacherOutput, pose_of
from s2p3.objects import ObjectModel
from s2p3.progress import Report, quiet
from s2p3.training import checkpoint
from s2p3.training.batches import Targets, as_predicted, form_input, form_targets
from s2p3.training.checkpoint import CheckpointInfo
from s2p3.training.examples import CropSource, Examples
from s2p3.training.loop import Forward, Losses, Run, Score, optimize
from s2p3.training.physics_signal import labelled_signal, report_signal
from s2p3.training.scoring import PoseScorer

PoseNetwork = Literal["teacher", "student"]
Stage = Literal["pretrained", "supervised"]
ALL_FRAMES = FrameSource()
MODEL_POINTS = 300
_BUILDERS = {"teacher": build_teacher, "student": build_student}
_SYMMETRY_STEPS = 36


def supervise(
    kind: PoseNetwork,
    sessions: Sequence[Path],
    model: ObjectModel,
    config: ExperimentConfig,
    out: Path,
    *,
    teacher: Path | None = None,
    cache: Path | None = None,
    frames: FrameSource = ALL_FRAMES,
    stage: Stage = "pretrained",
    report: Report = quiet,
) -> Path:
    """Trains teacher or student and writes `out`/teacher.safetensors or student.safetensors, which is
    returned.

    Args:
        kind: which of the two.
        sessions: with poses of the object, usually synthetic.
        teacher: checkpoint of a teacher from whose encoders to start, instead of ImageNet's (our choice).
        cache: folder for the crops, shared between trainings.
        frames: which of the sessions to train on, and how they reach the training.
        stage: what the checkpoint calls this training.
        report: see `loop.Run`.

    Raises ToolkitError: a session lacks the object; a teacher of another object, or of other encoders; see
        also `loop.optimize`.
    """
    path, settings = checkpoint.to_write(out / f"{kind}.safetensors"), getattr(config, kind)
    start = None if teacher is None else _encoders_of(teacher, model, config)
    examples = Examples.of(sessions, model, config.input, settings, frames, cache, report)
    if config.input.modality == "polarization":
        signal = labelled_signal(examples.source, examples.rows, model)
        report_signal(signal, path, config.self_supervision.physics)
    torch.manual_seed(settings.seed)
    network = _BUILDERS[kind](config, imagenet=start is None)
    if start is not None:
        network.encoder.load_state_dict(start)
    hashes = examples.hashes | ({} if teacher is None else {"teacher": checkpoint.file_hash(teacher)})
    data = LabelledData(examples.source, examples.rows, model.refractive_index, config)
    objective = SupervisedObjective(*model_tensors(model), model.diameter, settings.dense_weight)
    score = None
    if examples.held_out is not None:
        scorer = PoseScorer(examples.held_out, model, config)
        score = Score(scorer.name, scorer, settings.validations, examples.origin)
    rows = examples.rows.tolist()
    fingerprint = f"{hashes} {config} {model.fingerprint} {rows} {examples.origin}"
    run = Run(kind, path, fingerprint, frames.workers, report)
    trained = optimize(network, data, objective, settings, run, score)
    info = CheckpointInfo.of(kind, stage, model, trained.step, config, hashes, trained.validation)
    checkpoint.save(path, trained.network.state_dict(), info)
    return path


def _encoders_of(teacher: Path, model: ObjectModel, config: ExperimentConfig) -> dict[str, Tensor]:
    """The weights of a teacher's encoders. Raises ToolkitError: they do not fit the experiment's."""
    guide, info = load_teacher(teacher, model)
    theirs, ours = (
        (one.input.modality, one.input.aolp, one.network.total_stride) for one in (info.config, config)
    )
    if theirs != ours:
        raise ToolkitError(
            f"{teacher}: its encoders see other channels than the student's, or at another stride; train "
            "both with one experiment.toml, or start without a teacher"
        )
    return guide.encoder.state_dict()


def load_teacher(path: Path, wanted: str | ObjectModel | None = None) -> tuple[Teacher, CheckpointInfo]:
    """Reads a teacher. Raises ToolkitError as `checkpoint.read_info` and `checkpoint.load_weights`."""
    info = checkpoint.read_info(path, "teacher", wanted)
    return checkpoint.load_weights(build_teacher(info.config), path), info


def load_student(
    path: Path, wanted: str | ObjectModel | None = None
) -> tuple[Student | Teacher, CheckpointInfo]:
    """Reads a student. Raises ToolkitError as `checkpoint.read_info` and `checkpoint.load_weights`."""
    info = checkpoint.read_info(path, "student", wanted)
    return checkpoint.load_weights(build_student(info.config), path), info


def model_tensors(model: ObjectModel) -> tuple[Tensor, Tensor]:
    """Surface points (MODEL_POINTS, 3) and symmetries (M, 4, 4) of an object, as the losses take them."""
    points = torch.from_numpy(model.surface_points(MODEL_POINTS)).float()
    return points, torch.from_numpy(model.symmetry.sampled(_SYMMETRY_STEPS)).float()


@dataclass(frozen=True)
class LabelledBatch:
    """What the networks see of B crops, and its truth."""

    seen: inputs.NetworkInput
    targets: Targets


@dataclass(frozen=True)
class LabelledData:
    """Augmented batches of labelled crops, see `loader.Data`.

    Attributes:
        source: of the crops.
        rows: of the source, to draw from.
        refractive_index: of the object.
        config: of the experiment.
    """

    source: CropSource
    rows: Tensor
    refractive_index: float
    config: ExperimentConfig

    def __len__(self) -> int:
        return len(self.rows)

    def __call__(self, rows: Tensor, generator: torch.Generator) -> LabelledBatch:
        crops, every = self.source.take(self.rows[rows]), torch.arange(len(rows))
        view = View.random(len(rows), self.config.augmentation, generator)
        cut = functools.partial(as_predicted, generator=generator)
        seen = form_input(crops, every, view, self.refractive_index, self.config, generator, cut)
        return LabelledBatch(seen, form_targets(crops, every, view, self.config))


@dataclass(frozen=True)
class SupervisedObjective:
    """Supervision by poses (the paper's), and of a network with a decoder by its maps, too (our choice).

    Attributes:
        points: (P, 3) of the object, metres.
        symmetries: (M, 4, 4) motions that leave it unchanged.
        diameter_m: of the object.
        dense_weight: of the maps' losses; 0 leaves them out.
    """

    points: Tensor
    symmetries: Tensor
    diameter_m: float
    dense_weight: float

    def __call__(self, forward: Forward, batch: LabelledBatch) -> Losses:
        seen, truth = batch.seen, batch.targets
        output: Tensor | TeacherOutput = forward(seen.polarization, seen.priors)
        terms = pose_terms(
            pose_of(output), seen.K, truth, seen.size, self.diameter_m, self.points, self.symmetries
        )
        if isinstance(output, TeacherOutput) and self.dense_weight > 0:
            maps = (output.mask_logits, output.normals, output.coordinates)
            dense = losses.dense_loss(*maps, truth.mask, truth.normals, truth.coordinates).mean()
            terms["dense"] = dense
            terms["total"] = terms["total"] + self.dense_weight * dense
        return terms


def pose_terms(
    output: Tensor,
    K: Tensor,
    targets: Targets,
    size: int,
    diameter_m: float,
    points: Tensor,
    symmetries: Tensor,
) -> Losses:
    """The pre-training losses of B head outputs: allocentric point matching in diameters, and the
    translation's L1."""
    _, _, allocentric = decode_pose(output, K, size, diameter_m)
    true_allocentric = ray_rotation(targets.translation).transpose(1, 2) @ targets.rotation
    true_site = site_from_translation(targets.translation, K, size, diameter_m)
    site = output[:, 6:9] + output.new_tensor([0.0, 0.0, 1.0])
    rotation = losses.rotation_loss(points, allocentric, true_allocentric, symmetries).mean() / diameter_m
    depth = targets.translation[:, 2]
    translation = losses.translation_loss(site, true_site, depth, diameter_m).mean()
    return {"total": rotation + translation, "rotation": rotation, "translation": translation}
