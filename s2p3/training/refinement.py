"""Pseudo labels made better: the teacher's pose, moved until it explains the teacher's maps. Our extension.

A teacher's maps often know more than its pose head made of them. Gradient descent through the renderer finds
the pose at which L_mask, L_normals and L_physics of the single image are smallest; it becomes the label.
"""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import torch

from s2p3 import losses
from s2p3.config import SelfSupervisionConfig
from s2p3.inputs import NetworkInput
from s2p3.networks.pose_head import decode_pose, encode_pose
from s2p3.objects import ObjectModel
from s2p3.rendering.differentiable import RenderMesh, render
from s2p3.training.captured_losses import physics_error, pooled_maps
from s2p3.training.loop import rate_factor

if TYPE_CHECKING:
    from s2p3.training.pseudo_labels import PseudoLabels

_RATE = 0.01  # of Adam, for what a pose head gives: columns of a rotation, parts of the crop, relative depth


@torch.enable_grad()
def refine(
    labels: PseudoLabels,
    seen: NetworkInput,
    mesh: RenderMesh,
    model: ObjectModel,
    settings: SelfSupervisionConfig,
) -> PseudoLabels:
    """The labels of a batch after `settings.refine_steps` steps: other poses, what they render, and how far
    that is from the predicted masks."""
    crop = seen.K, seen.size, model.diameter
    start = encode_pose(labels.rotation, labels.translation, *crop)
    change = torch.zeros_like(start, requires_grad=True)
    optimizer = torch.optim.Adam([change], _RATE)
    for step in range(settings.refine_steps):
        optimizer.param_groups[0]["lr"] = _RATE * rate_factor("flat", step / settings.refine_steps)
        rotation, translation, _ = decode_pose(start + change, *crop)
        rendered = render(mesh, rotation, translation, seen.K, seen.size, seen.size)
        mask, normals = pooled_maps(rendered)
        loss = settings.mask_weight * losses.mask_loss(mask, labels.mask)
        loss = loss + settings.normals_weight * losses.normals_loss(
            normals, labels.normals, mask, labels.mask
        )
        if settings.physics != "none":
            polarization = physics_error(seen, rendered, labels.mask, model.refractive_index, settings)
            loss = loss + settings.physics_weight * polarization
        optimizer.zero_grad()
        loss.sum().backward()
        optimizer.step()
    with torch.no_grad():
        rotation, translation, _ = decode_pose(start + change, *crop)
        drawn = render(mesh, rotation, translation, seen.K, seen.size, seen.size, silhouette=False)
        mask, normals = pooled_maps(drawn)
    return replace(
        labels,
        rotation=rotation,
        translation=translation,
        rendered_mask=mask,
        rendered_normals=normals,
        delta=losses.discrepancy(labels.mask, mask),
    )
