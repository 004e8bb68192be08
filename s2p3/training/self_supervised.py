"""The self-supervised stage: the student learns from the teacher's pseudo labels and from the polarization
itself.

Takes `Crops`: Stokes values in predicted boxes, predicted masks, crop intrinsics, depth where a depth camera
was there. No pose of a captured frame is an argument, so none can be used.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

import torch
import torch.nn.functional as F
from torch import Tensor

from dataset.errors import ToolkitError
from s2p3 import losses, physics
from s2p3.config import ExperimentConfig, NetworkConfig, SelfSupervisionConfig
from s2p3.inputs import NetworkInput, View
from s2p3.networks.pose_head import decode_pose
from s2p3.networks.student import Student
from s2p3.networks.teacher import MAP_STRIDE, Teacher, TeacherOutput, pose_of
from s2p3.objects import ObjectModel
from s2p3.progress import Report, quiet
from s2p3.rendering.differentiable import RenderMesh, RenderOutput, render
from s2p3.training import checkpoint
from s2p3.training.batch_norm import adapt_batch_norm, freeze_norms, set_momentum
from s2p3.training.batches import form_input
from s2p3.training.checkpoint import CheckpointInfo
from s2p3.training.crops import Crops, crops_hash
from s2p3.training.loop import Forward, Losses, Run, optimize
from s2p3.training.mean_teacher import MeanTeacher
from s2p3.training.physics_signal import captured_signal, report_signal
from s2p3.training.pseudo_labels import PseudoLabels, labels_of, make_labels, pooled_maps, warp_labels
from s2p3.training.supervised import load_student, load_teacher, model_tensors

_BATCH_NORM_MOMENTUM = 0.02


def self_supervise(
    crops: Crops,
    model: ObjectModel,
    teacher: Path,
    student: Path,
    out: Path,
    settings: SelfSupervisionConfig | None = None,
    *,
    workers: int = 0,
    report: Report = quiet,
) -> Path:
    """Adapts the pre-trained student to captured frames and writes `out`/adapted.safetensors, which is
    returned. NAME.signal.json beside it says what the frames' polarization tells, at the teacher's poses.

    Args:
        crops: of captured frames, see `crops.captured_crops`.
        teacher, student: checkpoints of the pre-trained networks.
        settings: weights and schedule; by default those the student's experiment holds.
        workers, report: see `loop.Run`.

    Raises ToolkitError: checkpoints of another object or of different inputs; a depth loss without depth, or
        one on polarization that the networks do not see; a teacher that is to follow a student of another
        architecture; see also `loop.optimize`.
    """
    path = checkpoint.to_write(out / "adapted.safetensors")
    pair = load_pair(teacher, student, model)
    settings = settings or pair.config.self_supervision
    if settings.physics != "none" and pair.config.input.modality != "polarization":
        raise ToolkitError(
            f'self_supervision.physics = "{settings.physics}" teaches by polarization, which {student} does '
            'not see; set physics = "none", or train with the method self6d'
        )
    if settings.depth != "none" and crops.depth is None:
        raise ToolkitError(
            f'self_supervision.depth = "{settings.depth}" needs depth, and the session has none; '
            'record it, or set depth = "none"'
        )
    network: Student | Teacher | MeanTeacher = pair.student
    if settings.adapt_batches:
        adapt_batch_norm(pair.student, crops, model.refractive_index, pair.config, settings)
        if settings.adapt_teacher:
            adapt_batch_norm(pair.teacher, crops, model.refractive_index, pair.config, settings)
    mesh = RenderMesh.from_mesh(model.mesh)
    labels = make_labels(pair.teacher, crops, model, mesh, pair.config)
    if pair.config.input.modality == "polarization":
        signal = captured_signal(crops, labels.rotation, labels.translation, model)
        report_signal(signal, path, settings.physics)
    if settings.freeze_norms:
        freeze_norms(pair.student)
    set_momentum(pair.student, _BATCH_NORM_MOMENTUM)
    if settings.teacher == "ema":
        network = _following(pair, student, settings)
    data = CapturedData(crops, labels, mesh, model.refractive_index, pair.config)
    objective = _Objective(
        mesh,
        *model_tensors(model),
        labels.threshold(settings),
        model.diameter,
        model.refractive_index,
        settings,
    )
    hashes = pair.hashes | {"crops": crops_hash(crops)}
    fingerprint = f"{hashes} {model.fingerprint} {pair.config}"
    run = Run("self-supervision", path, fingerprint, workers, report)
    trained = optimize(network, data, objective, settings, run)
    kept = trained.network.student if isinstance(trained.network, MeanTeacher) else trained.network
    config = replace(pair.config, self_supervision=settings)
    info = CheckpointInfo.of("student", "self-supervised", model, trained.step, config, hashes)
    checkpoint.save(path, kept.state_dict(), info)
    return path


@dataclass(frozen=True)
class Pair:
    """Teacher and student that see the same, how the teacher is built, the student's experiment, and hashes
    of both files."""

    teacher: Teacher
    teacher_network: NetworkConfig
    student: Student | Teacher
    config: ExperimentConfig
    hashes: dict[str, str]


def load_pair(teacher: Path, student: Path, model: ObjectModel) -> Pair:
    """Reads both. Raises ToolkitError: of another object, or of different inputs."""
    guide, guide_info = load_teacher(teacher, model)
    network, info = load_student(student, model)
    if guide_info.config.input != info.config.input:
        raise ToolkitError(
            f"{teacher} and {student} expect different inputs; train both with one experiment.toml"
        )
    hashes = {"teacher": checkpoint.file_hash(teacher), "student": checkpoint.file_hash(student)}
    return Pair(guide, guide_info.config.network, network, info.config, hashes)


@dataclass(frozen=True)
class CapturedBatch:
    """What the networks see of B crops, and what the teacher says about them."""

    seen: NetworkInput
    target: PseudoLabels


@dataclass(frozen=True)
class CapturedData:
    """Augmented batches of captured crops, see `loader.Data`."""

    crops: Crops
    labels: PseudoLabels
    mesh: RenderMesh
    refractive_index: float
    config: ExperimentConfig

    def __len__(self) -> int:
        return len(self.crops)

    @torch.no_grad()
    def __call__(self, rows: Tensor, generator: torch.Generator) -> CapturedBatch:
        view = View.random(len(rows), self.config.augmentation, generator)
        seen = form_input(self.crops, rows, view, self.refractive_index, self.config, generator)
        return CapturedBatch(seen, warp_labels(self.labels, self.crops, rows, view, self.mesh, self.config))


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

    def __call__(self, forward: Forward, batch: CapturedBatch) -> Losses:
        seen, target, settings = batch.seen, batch.target, self.settings
        output = forward(seen.polarization, seen.priors)
        if isinstance(output, tuple):  # a `MeanTeacher`: its teacher answers anew
            output, said = output
            target = labels_of(said, seen, self.mesh, self.diameter_m)
        rotation, translation, _ = decode_pose(pose_of(output), seen.K, seen.size, self.diameter_m)
        rendered = render(self.mesh, rotation, translation, seen.K, seen.size, seen.size)
        pose = (target.rotation, target.translation)
        distance = losses.pose_loss(self.points, rotation, translation, *pose, self.symmetries)
        weighted = losses.pose_weight(target.delta) * distance / self.diameter_m
        mask_error, normals_error = self._geometry(output, rendered, target)
        terms = {"pose": weighted.mean(), "mask": mask_error, "normals": normals_error}
        if settings.physics != "none":
            terms["physics"] = self._physics(seen, rendered, target.mask).mean()
        if settings.depth != "none":
            surface = visible_surface(self.mesh, rotation, translation, seen)
            terms["depth"] = self._depth(seen, surface, target.mask).mean() / self.diameter_m
        weights = {name: getattr(settings, f"{name}_weight") for name in terms}
        return {"total": torch.stack([weights[name] * terms[name] for name in terms]).sum(), **terms}

    def _geometry(
        self, output: Tensor | TeacherOutput, rendered: RenderOutput, target: PseudoLabels
    ) -> tuple[Tensor, Tensor]:
        """L_mask and L_normals of what is rendered at the student's pose; of the large student, plus those of
        what it predicts."""
        rule = (target.delta, self.threshold)
        true_mask = losses.pseudo_maps(*rule, target.rendered_mask, target.mask)
        true_normals = losses.pseudo_maps(*rule, target.rendered_normals, target.normals)
        maps = [pooled_maps(rendered)]
        if isinstance(output, TeacherOutput):
            maps.append((output.mask_logits.sigmoid(), output.normals))
        masks = [losses.mask_loss(mask, true_mask).mean() for mask, _ in maps]
        normals = [losses.normals_loss(n, true_normals, mask, true_mask).mean() for mask, n in maps]
        return torch.stack(masks).sum(), torch.stack(normals).sum()

    def _physics(self, seen: NetworkInput, rendered: RenderOutput, predicted_mask: Tensor) -> Tensor:
        """L_physics where the rendered and the teacher's predicted mask agree and there is a measurement (our
        choice of pixels)."""
        inside = (rendered.mask.detach() > 0.5) & (enlarged(predicted_mask) > 0.5) & seen.valid
        stokes = smoothed(seen.stokes, seen.valid, self.settings.smoothing)
        rays = physics.pixel_rays(seen.K, seen.size, seen.size)
        return losses.physics_loss(
            self.settings.physics,
            stokes,
            rendered.normals_interior,
            rays,
            inside.float(),
            self.refractive_index,
        )

    def _depth(self, seen: NetworkInput, surface: RenderOutput, predicted_mask: Tensor) -> Tensor:
        """The losses of the paper's depth ablation, metres, on what is measured in the predicted mask."""
        assert seen.depth is not None
        inside = (enlarged(predicted_mask) > 0.5).float()
        if self.settings.depth == "pixel":
            return losses.depth_loss(surface.depth, seen.depth, inside)
        return losses.chamfer_loss(*clouds(seen, surface, inside))


def enlarged(maps: Tensor) -> Tensor:
    """A teacher's maps at the resolution of its input."""
    return F.interpolate(maps, scale_factor=float(MAP_STRIDE), mode="bilinear")


def smoothed(stokes: Tensor, valid: Tensor, side: int) -> Tensor:
    """Stokes values (B, 3, S, S) averaged over the valid pixels (B, 1, S, S) of boxes of odd `side`."""
    if side == 1:
        return stokes
    weight = valid.to(stokes.dtype)
    sums = F.avg_pool2d(torch.cat([stokes * weight, weight], dim=1), side, 1, side // 2)
    return sums[:, :3] / sums[:, 3:].clamp_min(1e-6)


def visible_surface(
    mesh: RenderMesh, rotation: Tensor, translation: Tensor, seen: NetworkInput
) -> RenderOutput:
    """The object at the student's pose, for losses per visible pixel: a depth has no outline to move."""
    return render(mesh, rotation, translation, seen.K, seen.size, seen.size, silhouette=False)


def clouds(seen: NetworkInput, surface: RenderOutput, inside: Tensor) -> tuple[Tensor, Tensor]:
    """Measured points inside a mask, and points of the visible surface, each (B, n, 3)."""
    assert seen.depth is not None
    measured = losses.back_project(seen.depth, inside, seen.K, losses.CLOUD_POINTS)
    drawn = losses.back_project(surface.depth, surface.mask, seen.K, losses.CLOUD_POINTS)
    return measured, drawn


def _following(pair: Pair, path: Path, settings: SelfSupervisionConfig) -> MeanTeacher:
    """Raises ToolkitError: teacher and student are not of one architecture."""
    built = [
        (network.total_stride, network.decoder_channels)
        for network in (pair.teacher_network, pair.config.network)
    ]
    if not isinstance(pair.student, Teacher) or built[0] != built[1]:
        raise ToolkitError(
            f"{path}: a teacher can follow only a student of its own architecture; train both with one "
            'experiment.toml and network.student = "large", or set self_supervision.teacher = "frozen"'
        )
    return MeanTeacher(pair.student, pair.teacher, settings.teacher_decay)
