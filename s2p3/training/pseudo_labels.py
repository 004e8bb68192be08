"""What the teacher says about captured crops: poses, masks, normals, and how far to trust them.

A frozen teacher is run once over the upright crops; its answers are warped along with the augmentation,
exactly for in-plane rotation, instead of running it on every augmented crop (our choice). A teacher that
follows its student answers on each batch.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
import torch.nn.functional as F
from torch import Tensor

from s2p3 import losses
from s2p3.config import ExperimentConfig, SelfSupervisionConfig
from s2p3.inputs import NetworkInput, View
from s2p3.networks.pose_head import decode_pose
from s2p3.networks.teacher import MAP_STRIDE, Teacher, TeacherOutput
from s2p3.objects import ObjectModel
from s2p3.rendering.differentiable import RenderMesh, RenderOutput, render
from s2p3.training.batches import form_input, turn_maps, turn_vectors, view_window
from s2p3.training.crops import Crops

_CHUNK = 32


@dataclass(frozen=True)
class PseudoLabels:
    """The teacher's answers for N crops.

    Attributes:
        rotation, translation: (N, 3, 3) and (N, 3), its pose.
        mask: (N, 1, S/4, S/4), 0 to 1, and normals: (N, 3, S/4, S/4): its predicted maps.
        rendered_mask, rendered_normals: the same rendered at its pose.
        delta: (N,) discrepancy between the two masks.
    """

    rotation: Tensor
    translation: Tensor
    mask: Tensor
    normals: Tensor
    rendered_mask: Tensor
    rendered_normals: Tensor
    delta: Tensor

    def threshold(self, settings: SelfSupervisionConfig) -> float:
        """The r of the delta rule over these crops."""
        return settings.threshold or float(torch.quantile(self.delta, settings.threshold_quantile))


@torch.no_grad()
def labels_of(output: TeacherOutput, seen: NetworkInput, mesh: RenderMesh, diameter_m: float) -> PseudoLabels:
    """What a teacher's answer on a batch says."""
    rotation, translation, _ = decode_pose(output.pose, seen.K, seen.size, diameter_m)
    mask = output.mask_logits.sigmoid()
    drawn = pooled_maps(render(mesh, rotation, translation, seen.K, seen.size, seen.size, silhouette=False))
    return PseudoLabels(
        rotation, translation, mask, output.normals, *drawn, losses.discrepancy(mask, drawn[0])
    )


@torch.no_grad()
def make_labels(
    teacher: Teacher, crops: Crops, model: ObjectModel, mesh: RenderMesh, config: ExperimentConfig
) -> PseudoLabels:
    """Runs the teacher over every crop at the nominal zoom."""
    teacher.eval()
    parts = []
    for start in range(0, len(crops), _CHUNK):
        indices = torch.arange(start, min(start + _CHUNK, len(crops)))
        view = View.centred(len(indices), config.input.zoom)
        seen = form_input(crops, indices, view, model.refractive_index, config)
        parts.append(labels_of(teacher(seen.polarization, seen.priors), seen, mesh, model.diameter))
    names = vars(parts[0])
    return PseudoLabels(**{name: torch.cat([getattr(part, name) for part in parts]) for name in names})


@torch.no_grad()
def warp_labels(
    labels: PseudoLabels,
    crops: Crops,
    indices: Tensor,
    view: View,
    mesh: RenderMesh,
    config: ExperimentConfig,
) -> PseudoLabels:
    """The labels of the chosen crops as they look through `view`; the teacher's pose is rendered anew."""
    size = config.input.size
    window = view_window(crops, indices, view, config, size // MAP_STRIDE)
    side = crops.stokes.shape[-1]
    labelled_half = config.input.zoom * side / config.input.canonical_zoom / 2
    grid = (window.source + 0.5 - side / 2) / labelled_half  # -1 to 1 across the region the teacher saw
    maps = torch.cat([labels.mask[indices], labels.normals[indices]], dim=1)
    maps = F.grid_sample(maps, grid, padding_mode="border", align_corners=False)
    rotation = window.rotation @ labels.rotation[indices]
    translation = turn_vectors(window.rotation, labels.translation[indices])
    K = view_window(crops, indices, view, config, size).K
    return PseudoLabels(
        rotation,
        translation,
        maps[:, :1],
        F.normalize(turn_maps(window.rotation, maps[:, 1:]), dim=1),
        *pooled_maps(render(mesh, rotation, translation, K, size, size, silhouette=False)),
        labels.delta[indices],
    )


def pooled_maps(rendered: RenderOutput) -> tuple[Tensor, Tensor]:
    """Mask and unit normals of a rendering, at the resolution of the teacher's maps."""
    normals = F.avg_pool2d(rendered.normals, MAP_STRIDE)
    return F.avg_pool2d(rendered.mask, MAP_STRIDE), F.normalize(normals, dim=1)
