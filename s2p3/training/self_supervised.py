"""The self-supervised stage: the student learns from the frozen teacher's pseudo labels and from the
polarization itself.

Takes `Crops`: Stokes values in predicted boxes, predicted masks, crop intrinsics. No pose of a captured frame
is an argument, so none can be used.
"""

from __future__ import annotations

import hashlib
from dataclasses import dataclass
from pathlib import Path

import torch
import torch.nn.functional as F
from torch import Tensor

from dataset.errors import ToolkitError
from s2p3 import losses, physics
from s2p3.config import ExperimentConfig, SelfSupervisionConfig
from s2p3.inputs import NetworkInput, View
from s2p3.networks.pose_head import decode_pose
from s2p3.networks.teacher import MAP_STRIDE, pose_of
from s2p3.objects import ObjectModel
from s2p3.rendering.differentiable import RenderMesh, RenderOutput, render
from s2p3.training import checkpoint
from s2p3.training.adaptation import adapt_batch_norm, set_momentum
from s2p3.training.batches import form_input
from s2p3.training.checkpoint import CheckpointInfo
from s2p3.training.crops import Crops
from s2p3.training.loop import Forward, Losses, optimize
from s2p3.training.pretrain import load_student, load_teacher, model_tensors
from s2p3.training.progress import OnStep
from s2p3.training.pseudo_labels import PseudoLabels, carry_labels, make_labels, pooled_maps

_BATCH_NORM_MOMENTUM = 0.02


def self_supervise(
    crops: Crops,
    model: ObjectModel,
    teacher: Path,
    student: Path,
    out: Path,
    settings: SelfSupervisionConfig | None = None,
    on_step: OnStep | None = None,
    workers: int = 0,
) -> Path:
    """Adapts the pre-trained student to captured frames and writes `out`/adapted.safetensors, which is
    returned.

    Args:
        crops: of captured frames, see `crops.captured_crops`.
        teacher, student: checkpoints of the pre-trained networks.
        settings: weights and schedule; by default those the student's experiment holds.
        on_step, workers: see `loop.optimize`.

    Raises ToolkitError: checkpoints of another object or of different inputs; see also `loop.optimize`.
    """
    guide, guide_info = load_teacher(teacher, model.name)
    network, info = load_student(student, model.name)
    config = info.config
    if guide_info.config.input != config.input:
        raise ToolkitError(
            f"{teacher} and {student} expect different inputs; train both with one experiment.toml"
        )
    settings = settings or config.self_supervision
    if settings.adapt_batches:
        adapt_batch_norm(network, crops, model.refractive_index, config, settings)
        if settings.adapt_teacher:
            adapt_batch_norm(guide, crops, model.refractive_index, config, settings)
    labels = make_labels(guide, crops, model, config, settings)
    set_momentum(network, _BATCH_NORM_MOMENTUM)
    data = _CapturedData(crops, labels, RenderMesh.from_mesh(model.mesh), model.refractive_index, config)
    points, symmetries = model_tensors(model)
    objective = _Objective(
        data.mesh, points, symmetries, labels.threshold, model.diameter, model.refractive_index, settings
    )
    path = out / "adapted.safetensors"
    hashes = {"crops": hashlib.sha256(crops.stokes.numpy().tobytes()).hexdigest()[:16]}
    run = f"{hashes} {guide_info} {info}"
    trained = optimize(
        network, data, objective, settings, path, run, "self-supervision", workers=workers, on_step=on_step
    )
    info = CheckpointInfo.of("student", "self-supervised", model, trained.step, config, hashes)
    checkpoint.save(path, trained.network.state_dict(), info)
    return path


@dataclass(frozen=True)
class _Batch:
    """What the student sees of B crops, what the teacher says about them, and its pose rendered."""

    seen: NetworkInput
    target: PseudoLabels
    teacher_mask: Tensor
    teacher_normals: Tensor


@dataclass(frozen=True)
class _CapturedData:
    """Augmented batches of captured crops, see `loader.Data`."""

    crops: Crops
    labels: PseudoLabels
    mesh: RenderMesh
    refractive_index: float
    config: ExperimentConfig

    def __len__(self) -> int:
        return len(self.crops)

    @torch.no_grad()
    def __call__(self, rows: Tensor, generator: torch.Generator) -> _Batch:
        view = View.random(len(rows), self.config.augmentation, generator)
        seen = form_input(self.crops, rows, view, self.refractive_index, self.config, generator)
        target = carry_labels(self.labels, self.crops, rows, view, self.config)
        pose, size = (target.rotation, target.translation), seen.size
        maps = pooled_maps(render(self.mesh, *pose, seen.K, size, size, silhouette=False))
        return _Batch(seen, target, *maps)


@dataclass(frozen=True)
class _Objective:
    """The losses of one batch, Eq. (11): L_pseudo + L_physics with their weights."""

    mesh: RenderMesh
    points: Tensor
    symmetries: Tensor
    threshold: float
    diameter_m: float
    refractive_index: float
    settings: SelfSupervisionConfig

    def __call__(self, forward: Forward, batch: _Batch) -> Losses:
        seen, target = batch.seen, batch.target
        output = pose_of(forward(seen.polarization, seen.priors))
        rotation, translation, _ = decode_pose(output, seen.K, seen.size, self.diameter_m)
        rendered = render(self.mesh, rotation, translation, seen.K, seen.size, seen.size)
        mask, normals = pooled_maps(rendered)
        pose = (target.rotation, target.translation)
        rule = (target.delta, self.threshold)
        target_mask = losses.pseudo_maps(*rule, batch.teacher_mask, target.mask)
        target_normals = losses.pseudo_maps(*rule, batch.teacher_normals, target.normals)
        distance = losses.pose_loss(self.points, rotation, translation, *pose, self.symmetries)
        settings = self.settings
        terms = {
            "pose": (losses.pose_weight(target.delta) * distance).mean() / self.diameter_m,
            "mask": losses.mask_loss(mask, target_mask).mean(),
            "normals": losses.normals_loss(normals, target_normals, mask, target_mask).mean(),
        }
        total = (
            settings.pose_weight * terms["pose"]
            + settings.mask_weight * terms["mask"]
            + settings.normals_weight * terms["normals"]
        )
        if settings.physics != "none":
            terms["physics"] = self._physics(seen, rendered, target.mask).mean()
            total = total + settings.physics_weight * terms["physics"]
        return {"total": total, **terms}

    def _physics(self, seen: NetworkInput, rendered: RenderOutput, predicted_mask: Tensor) -> Tensor:
        """L_physics where the rendered and the teacher's predicted mask agree (our choice of pixels)."""
        fine = F.interpolate(predicted_mask, scale_factor=float(MAP_STRIDE), mode="bilinear")
        inside = (rendered.mask.detach() > 0.5) & (fine > 0.5)
        stokes = seen.stokes
        if self.settings.smoothing > 1:
            side = self.settings.smoothing
            stokes = F.avg_pool2d(stokes, side, 1, side // 2, count_include_pad=False)
        rays = physics.pixel_rays(seen.K, seen.size, seen.size)
        return losses.physics_loss(
            self.settings.physics,
            stokes,
            rendered.normals_interior,
            rays,
            inside.float(),
            self.refractive_index,
        )
