"""What losses on captured crops share: they count where the predicted mask says that the object is."""

from __future__ import annotations

import torch.nn.functional as F
from torch import Tensor

from s2p3 import losses, physics
from s2p3.config import SelfSupervisionConfig
from s2p3.inputs import NetworkInput
from s2p3.networks.teacher import MAP_STRIDE
from s2p3.rendering.differentiable import RenderMesh, RenderOutput, render


def physics_error(
    seen: NetworkInput,
    rendered: RenderOutput,
    predicted_mask: Tensor,
    refractive_index: float,
    settings: SelfSupervisionConfig,
) -> Tensor:
    """(B,) L_physics where the rendered and the teacher's predicted mask agree (our choice of pixels)."""
    inside = (rendered.mask.detach() > 0.5) & (enlarged(predicted_mask) > 0.5)
    stokes, side = seen.stokes, settings.smoothing
    if side > 1:
        stokes = F.avg_pool2d(stokes, side, 1, side // 2, count_include_pad=False)
    rays = physics.pixel_rays(seen.K, seen.size, seen.size)
    normals = rendered.normals_interior
    return losses.physics_loss(settings.physics, stokes, normals, rays, inside.float(), refractive_index)


def enlarged(maps: Tensor) -> Tensor:
    """A teacher's maps at the resolution of its input."""
    return F.interpolate(maps, scale_factor=float(MAP_STRIDE), mode="bilinear")


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


def pooled_maps(rendered: RenderOutput) -> tuple[Tensor, Tensor]:
    """Mask and unit normals of a rendering, at the resolution of the teacher's maps."""
    normals = F.avg_pool2d(rendered.normals, MAP_STRIDE)
    return F.avg_pool2d(rendered.mask, MAP_STRIDE), F.normalize(normals, dim=1)
