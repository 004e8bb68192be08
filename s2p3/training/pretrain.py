"""Supervised pre-training of teacher and student on synthetic sessions.

The paper supervises both by poses alone: point matching for the rotation, L1 for the translation. The
teacher's dense losses (`dense_weight`) and the warm start are our choice; `s2p3.config.paper` turns them off.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import torch
from torch import Tensor

from dataset.errors import ToolkitError
from s2p3 import inputs, losses
from s2p3.config import ExperimentConfig, PretrainConfig
from s2p3.inputs import View
from s2p3.networks.build import build_student, build_teacher
from s2p3.networks.pose_head import decode_pose, ray_rotation, site_from_translation
from s2p3.networks.student import Student
from s2p3.networks.teacher import Teacher, pose_of
from s2p3.objects import ObjectModel
from s2p3.training import checkpoint
from s2p3.training.batches import Targets, form_input, form_targets
from s2p3.training.checkpoint import CheckpointInfo
from s2p3.training.crops import LabelledCrops, fingerprint, labelled_crops
from s2p3.training.loop import LoopConfig, Losses, optimize, sample_indices, steps_of
from s2p3.training.progress import OnStep

MODEL_POINTS = 300
_SYMMETRY_STEPS = 36


def train_teacher(
    sessions: Sequence[Path],
    model: ObjectModel,
    config: ExperimentConfig,
    out: Path,
    cache: Path | None = None,
    on_step: OnStep | None = None,
) -> Path:
    """Pre-trains the teacher and writes `out`/teacher.safetensors, which is returned.

    Args:
        sessions: with poses of the object, usually synthetic.
        cache: folder for the crops, shared between trainings.
        on_step: see `loop.optimize`.

    Raises ToolkitError: a session lacks the object; see also `loop.optimize`.
    """
    settings = config.teacher
    crops = labelled_crops(sessions, model, config.input, cache)
    torch.manual_seed(settings.seed)
    network = build_teacher(config, imagenet=True)
    points, symmetries = model_tensors(model)

    def loss_at(generator: torch.Generator) -> Losses:
        batch, targets = _draw(crops, model, config, settings.batch, generator)
        output = network(batch.polarization, batch.priors)
        terms = pose_terms(output.pose, batch.K, targets, batch.size, model.diameter, points, symmetries)
        if settings.dense_weight > 0:
            maps = (output.mask_logits, output.normals, output.coordinates)
            dense = losses.dense_loss(*maps, targets.mask, targets.normals, targets.coordinates).mean()
            terms["dense"] = dense
            terms["total"] = terms["total"] + settings.dense_weight * dense
        return terms

    path = out / "teacher.safetensors"
    data = fingerprint(sessions, model, config.input)
    steps = steps_of(settings.steps, settings.epochs, settings.batch, len(crops))
    trained = optimize(network, loss_at, _loop(settings, steps), path, f"{data} {config}", "teacher", on_step)
    info = CheckpointInfo.of("teacher", "pretrained", model, steps, config, data)
    checkpoint.save(path, trained.state_dict(), info)
    return path


def train_student(
    sessions: Sequence[Path],
    model: ObjectModel,
    config: ExperimentConfig,
    out: Path,
    cache: Path | None = None,
    teacher: Path | None = None,
    on_step: OnStep | None = None,
) -> Path:
    """Pre-trains the student and writes `out`/student.safetensors, which is returned; arguments as
    `train_teacher`.

    Args:
        teacher: checkpoint whose encoders the student starts from; needed where `config.student.warm_start`
            is set.

    Raises ToolkitError: the warm start lacks its teacher; see also `train_teacher`.
    """
    settings = config.student
    crops = labelled_crops(sessions, model, config.input, cache)
    torch.manual_seed(settings.seed)
    network = build_student(config, imagenet=True)
    if settings.warm_start:
        if teacher is None:
            raise ToolkitError(
                "student.warm_start needs the teacher's checkpoint; give it, or set warm_start = false"
            )
        network.encoder.load_state_dict(load_teacher(teacher, model.name)[0].encoder.state_dict())
    points, symmetries = model_tensors(model)

    def loss_at(generator: torch.Generator) -> Losses:
        batch, targets = _draw(crops, model, config, settings.batch, generator)
        output = network(batch.polarization, batch.priors)
        return pose_terms(pose_of(output), batch.K, targets, batch.size, model.diameter, points, symmetries)

    path = out / "student.safetensors"
    data = fingerprint(sessions, model, config.input)
    steps = steps_of(settings.steps, settings.epochs, settings.batch, len(crops))
    trained = optimize(network, loss_at, _loop(settings, steps), path, f"{data} {config}", "student", on_step)
    info = CheckpointInfo.of("student", "pretrained", model, steps, config, data)
    checkpoint.save(path, trained.state_dict(), info)
    return path


def load_teacher(path: Path, object_name: str | None = None) -> tuple[Teacher, CheckpointInfo]:
    """Reads a teacher. Raises ToolkitError as `checkpoint.read_info` and `checkpoint.load_weights`."""
    info = checkpoint.read_info(path, "teacher", object_name)
    return checkpoint.load_weights(build_teacher(info.config), path), info


def load_student(path: Path, object_name: str | None = None) -> tuple[Student | Teacher, CheckpointInfo]:
    """Reads a student. Raises ToolkitError as `checkpoint.read_info` and `checkpoint.load_weights`."""
    info = checkpoint.read_info(path, "student", object_name)
    return checkpoint.load_weights(build_student(info.config), path), info


def model_tensors(model: ObjectModel) -> tuple[Tensor, Tensor]:
    """Surface points (MODEL_POINTS, 3) and symmetries (M, 4, 4) of an object, as the losses take them."""
    points = torch.from_numpy(model.surface_points(MODEL_POINTS)).float()
    return points, torch.from_numpy(model.symmetry.sampled(_SYMMETRY_STEPS)).float()


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


def _draw(
    crops: LabelledCrops, model: ObjectModel, config: ExperimentConfig, batch: int, generator: torch.Generator
) -> tuple[inputs.NetworkInput, Targets]:
    indices = sample_indices(len(crops), batch, generator)
    view = View.random(batch, config.augmentation, generator)
    seen = form_input(crops, indices, view, model.refractive_index, config, generator, degrade_mask=True)
    return seen, form_targets(crops, indices, view, config)


def _loop(settings: PretrainConfig, steps: int) -> LoopConfig:
    return LoopConfig(
        steps,
        settings.learning_rate,
        settings.schedule,
        settings.weight_decay,
        settings.clip_norm,
        settings.ema,
        settings.seed,
        settings.checkpoint_every,
    )
