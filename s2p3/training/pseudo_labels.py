"""What the frozen teacher says about the captured crops: poses, masks, normals, and how far to trust them.

The teacher is run once over the upright crops; its answers are carried along with the augmentation, exactly
for in-plane rotation, instead of running it on every augmented crop (our choice).
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
import torch.nn.functional as F
from torch import Tensor

from s2p3 import losses
from s2p3.config import ExperimentConfig, SelfSupervisionConfig
from s2p3.inputs import View
from s2p3.networks.pose_head import decode_pose
from s2p3.networks.teacher import MAP_STRIDE, Teacher
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
        delta: (N,) discrepancy between its predicted mask and the one rendered at its pose.
        threshold: the r of the delta rule.
    """

    rotation: Tensor
    translation: Tensor
    mask: Tensor
    normals: Tensor
    delta: Tensor
    threshold: float


@torch.no_grad()
def make_labels(
    teacher: Teacher,
    crops: Crops,
    model: ObjectModel,
    config: ExperimentConfig,
    settings: SelfSupervisionConfig,
) -> PseudoLabels:
    """Runs the teacher over every crop at the nominal zoom."""
    mesh = RenderMesh.from_mesh(model.mesh)
    teacher.eval()
    rows = []
    for start in range(0, len(crops), _CHUNK):
        indices = torch.arange(start, min(start + _CHUNK, len(crops)))
        view = View.centred(len(indices), config.input.zoom)
        seen = form_input(crops, indices, view, model.refractive_index, config)
        output = teacher(seen.polarization, seen.priors)
        rotation, translation, _ = decode_pose(output.pose, seen.K, seen.size, model.diameter)
        mask = output.mask_logits.sigmoid()
        drawn, _ = pooled_maps(
            render(mesh, rotation, translation, seen.K, seen.size, seen.size, silhouette=False)
        )
        rows.append((rotation, translation, mask, output.normals, losses.discrepancy(mask, drawn)))
    rotation, translation, mask, normals, delta = (torch.cat(column) for column in zip(*rows, strict=True))
    threshold = settings.threshold or float(torch.quantile(delta, settings.threshold_quantile))
    return PseudoLabels(rotation, translation, mask, normals, delta, threshold)


def carry_labels(
    labels: PseudoLabels, crops: Crops, indices: Tensor, view: View, config: ExperimentConfig
) -> PseudoLabels:
    """The labels of the chosen crops as they look through `view`."""
    window = view_window(crops, indices, view, config, config.input.size // MAP_STRIDE)
    side = crops.stokes.shape[-1]
    labelled_half = config.input.zoom * side / config.input.canonical_zoom / 2
    grid = (window.source + 0.5 - side / 2) / labelled_half  # -1 to 1 across the region the teacher saw
    maps = torch.cat([labels.mask[indices], labels.normals[indices]], dim=1)
    maps = F.grid_sample(maps, grid, padding_mode="border", align_corners=False)
    return PseudoLabels(
        rotation=window.rotation @ labels.rotation[indices],
        translation=turn_vectors(window.rotation, labels.translation[indices]),
        mask=maps[:, :1],
        normals=F.normalize(turn_maps(window.rotation, maps[:, 1:]), dim=1),
        delta=labels.delta[indices],
        threshold=labels.threshold,
    )


def pooled_maps(rendered: RenderOutput) -> tuple[Tensor, Tensor]:
    """Mask and unit normals of a rendering, at the resolution of the teacher's maps."""
    normals = F.avg_pool2d(rendered.normals, MAP_STRIDE)
    return F.avg_pool2d(rendered.mask, MAP_STRIDE), F.normalize(normals, dim=1)
