"""The RGB-D baseline: self-supervision after Self6D++ (Wang et al. 2021), with the networks of this toolkit.

Student and teacher see no polarization. The student is drawn to the teacher's pose and mask, its rendering to
the captured image, and its surface to the measured depth; the teacher stays as it is, as in the published
code. BatchNorm statistics are frozen, as there.

Ours: the networks; Adam instead of Ranger; a rendering that is white, matt and lit from the camera, because
the objects have no texture and the camera's colours are averaged; LPIPS only where a file of its weights is
named, since no package ships them.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

import torch
from torch import Tensor

from dataset.errors import ToolkitError
from s2p3 import appearance_losses as appearance
from s2p3 import losses, physics
from s2p3.config import Self6DConfig
from s2p3.inputs import NetworkInput
from s2p3.networks.perceptual import Perceptual
from s2p3.networks.pose_head import decode_pose
from s2p3.networks.teacher import pose_of
from s2p3.objects import ObjectModel
from s2p3.progress import Report, quiet
from s2p3.rendering.differentiable import RenderMesh, RenderOutput, render
from s2p3.training import checkpoint
from s2p3.training.batch_norm import freeze_norms
from s2p3.training.checkpoint import CheckpointInfo
from s2p3.training.crops import Crops, crops_hash
from s2p3.training.loop import Forward, Losses, Run, optimize
from s2p3.training.pseudo_labels import make_labels, pooled_maps
from s2p3.training.self_supervised import (
    CapturedBatch,
    CapturedData,
    clouds,
    enlarged,
    load_pair,
    visible_surface,
)
from s2p3.training.supervised import model_tensors


def self_supervise_rgbd(
    crops: Crops,
    model: ObjectModel,
    teacher: Path,
    student: Path,
    out: Path,
    settings: Self6DConfig | None = None,
    *,
    workers: int = 0,
    report: Report = quiet,
) -> Path:
    """Adapts a pre-trained student without polarization to captured frames with depth; arguments and result
    as `self_supervise`.

    Raises ToolkitError: the networks see polarization; the session has no depth; see also `self_supervise`.
    """
    path = checkpoint.to_write(out / "adapted.safetensors")
    pair = load_pair(teacher, student, model)
    hashes = pair.hashes | {"crops": crops_hash(crops)}
    if pair.config.input.modality == "polarization":
        raise ToolkitError(
            f"{student} sees polarization, which the baseline must not; train teacher and student with "
            'input.modality = "rgb"'
        )
    if crops.depth is None:
        raise ToolkitError("the RGB-D baseline needs depth, and the session has none; record it, too")
    settings = settings or pair.config.self6d
    perceptual = Perceptual.load(Path(settings.lpips_weights)) if settings.lpips_weights else None
    mesh = RenderMesh.from_mesh(model.mesh)
    labels = make_labels(pair.teacher, crops, model, mesh, pair.config)
    freeze_norms(pair.student)
    data = CapturedData(crops, labels, mesh, model.refractive_index, pair.config)
    objective = _Objective(mesh, *model_tensors(model), model.diameter, perceptual, settings)
    fingerprint = f"{hashes} {model.fingerprint} {pair.config}"
    run = Run("self-supervision (RGB-D)", path, fingerprint, workers, report)
    trained = optimize(pair.student, data, objective, settings, run)
    config = replace(pair.config, self6d=settings)
    info = CheckpointInfo.of("student", "self-supervised", model, trained.step, config, hashes)
    checkpoint.save(path, trained.network.state_dict(), info)
    return path


@dataclass(frozen=True)
class _Objective:
    """The losses of Self6D++ on one batch, with its weights."""

    mesh: RenderMesh
    points: Tensor
    symmetries: Tensor
    diameter_m: float
    perceptual: Perceptual | None
    settings: Self6DConfig

    def __call__(self, forward: Forward, batch: CapturedBatch) -> Losses:
        seen, target, settings = batch.seen, batch.target, self.settings
        output = pose_of(forward(seen.polarization, seen.priors))
        rotation, translation, _ = decode_pose(output, seen.K, seen.size, self.diameter_m)
        rendered = render(self.mesh, rotation, translation, seen.K, seen.size, seen.size)
        surface = visible_surface(self.mesh, rotation, translation, seen)
        inside = (enlarged(target.mask) > 0.5).float()
        pose = (target.rotation, target.translation)
        distance = losses.pose_loss(self.points, rotation, translation, *pose, self.symmetries)
        limit = settings.chamfer_limit_m
        terms = {
            "pose": distance.mean() / self.diameter_m,
            "mask": appearance.mask_entropy(pooled_maps(rendered)[0], target.mask).mean(),
            "chamfer": losses.chamfer_loss(*clouds(seen, surface, inside), limit_m=limit).mean(),
            **self._appearance(seen, rendered, inside),
        }
        weights = {name: getattr(settings, f"{name}_weight") for name in terms}
        return {"total": torch.stack([weights[name] * terms[name] for name in terms]).sum(), **terms}

    def _appearance(self, seen: NetworkInput, rendered: RenderOutput, inside: Tensor) -> Losses:
        """Colour, structure and, with weights for it, perceptual distance, inside the predicted mask."""
        captured = (seen.stokes[:, :1] / 2).clamp(0, 1).expand(-1, 3, -1, -1)
        rays = physics.pixel_rays(seen.K, seen.size, seen.size)
        drawn = appearance.shaded(rendered.normals, rays)
        drawn = appearance.exposed_like(drawn, captured, inside * rendered.mask)
        terms = {
            "colour": appearance.colour_loss(drawn, captured, inside).mean(),
            "structure": appearance.structure_loss(drawn, captured, inside).mean(),
        }
        if self.perceptual is not None:
            self.perceptual.to(drawn.device)
            terms["perceptual"] = self.perceptual(drawn * inside, captured * inside).mean()
        return terms
