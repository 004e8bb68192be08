"""What the teacher says about captured crops: poses, masks, normals, and how far to trust them.

A frozen teacher is run once over the upright crops; its answers are carried along with the augmentation,
exactly for in-plane rotation, instead of running it on every augmented crop (our choice). Where labels are
refined, it looks twice: at the detector's box, and at the box of the pose found there. A teacher that follows
its student answers on each batch.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TypeVar

import torch
import torch.nn.functional as F
from torch import Tensor

from s2p3 import losses
from s2p3.config import ExperimentConfig, SelfSupervisionConfig
from s2p3.inputs import NetworkInput, View
from s2p3.networks.pose_head import decode_pose
from s2p3.networks.teacher import MAP_STRIDE, Teacher, TeacherOutput
from s2p3.objects import ObjectModel
from s2p3.rendering.differentiable import RenderMesh, render
from s2p3.training.batches import form_input, turn_maps, turn_vectors, view_window
from s2p3.training.captured_losses import pooled_maps
from s2p3.training.crops import Crops
from s2p3.training.refinement import refine

_CHUNK = 32
_LEAST_ZOOM = 0.5  # of a second look, boxes: a pose far away is a wrong one

_Part = TypeVar("_Part", "PseudoLabels", View)


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
    teacher: Teacher,
    crops: Crops,
    model: ObjectModel,
    mesh: RenderMesh,
    config: ExperimentConfig,
    settings: SelfSupervisionConfig | None = None,
) -> tuple[PseudoLabels, View]:
    """Runs the teacher over every crop at the nominal zoom; where `settings` ask for it, refines what it
    says, has it look again, and refines that.

    Returns the labels and the views, upright, that their maps cover.
    """
    teacher.eval()
    parts, looked = [], []
    for start in range(0, len(crops), _CHUNK):
        indices = torch.arange(start, min(start + _CHUNK, len(crops)))

        def look(view: View, indices: Tensor = indices) -> tuple[PseudoLabels, NetworkInput]:
            seen = form_input(crops, indices, view, model.refractive_index, config)
            said = labels_of(teacher(seen.polarization, seen.priors), seen, mesh, model.diameter)
            if settings is not None and settings.refine_steps:
                said = refine(said, seen, mesh, model, settings)
            return said, seen

        view = View.centred(len(indices), config.input.zoom)
        said, seen = look(view)
        if settings is not None and settings.refine_steps:
            closer = _closer(view, said, seen, mesh, config)
            again, _ = look(closer)
            better = again.delta < said.delta
            said, view = _chosen(better, again, said), _chosen(better, closer, view)
        parts.append(said)
        looked.append(view)
    return _joined(parts), _joined(looked)


def _joined(parts: Sequence[_Part]) -> _Part:
    """One of the tensors of all."""
    names = vars(parts[0])
    return type(parts[0])(**{name: torch.cat([getattr(part, name) for part in parts]) for name in names})


def _chosen(rows: Tensor, these: _Part, others: _Part) -> _Part:
    """These where `rows` (N,) says so, elsewhere the others."""
    chosen = {
        name: torch.where(rows.view(-1, *(1,) * (value.ndim - 1)), value, getattr(others, name))
        for name, value in vars(these).items()
    }
    return type(these)(**chosen)


def _closer(
    view: View, labels: PseudoLabels, seen: NetworkInput, mesh: RenderMesh, config: ExperimentConfig
) -> View:
    """The upright view of the box around the object at the labels' poses, seen through `view` so far."""
    points = losses.transform(mesh.vertices, labels.rotation, labels.translation)
    pixels = torch.einsum("bij,bnj->bni", seen.K[:, :2], points / points[..., 2:])
    low, high = pixels.amin(1), pixels.amax(1)
    boxes_per_pixel = view.zoom / seen.size
    side = (high - low).amax(1) * boxes_per_pixel
    offset = ((low + high) / 2 - (seen.size - 1) / 2) * boxes_per_pixel[:, None]
    zoom = (config.input.zoom * side).clamp(_LEAST_ZOOM, config.input.canonical_zoom)
    return View(zoom, view.shift + offset, torch.zeros_like(zoom))


@torch.no_grad()
def carry_labels(
    labels: PseudoLabels,
    looked: View,
    crops: Crops,
    indices: Tensor,
    view: View,
    mesh: RenderMesh,
    config: ExperimentConfig,
) -> PseudoLabels:
    """The labels of the chosen crops as they look through `view`; the teacher's pose is rendered anew.

    labels, looked: of all crops, of `make_labels`.
    """
    size = config.input.size
    window = view_window(crops, indices, view, config, size // MAP_STRIDE)
    side = crops.stokes.shape[-1]
    boxes = (window.source + 0.5 - side / 2) * (config.input.canonical_zoom / side)  # from the crop's centre
    shift, zoom = looked.shift[indices, None, None], looked.zoom[indices, None, None, None]
    grid = (boxes - shift) / (zoom / 2)  # -1 to 1 across the region the teacher saw
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
