"""The losses: the paper's, by equation, and the ones we added for pre-training.

Equation numbers are the S2P3 paper's: (7) L_pseudo, (8) L_pose, (9) L_geo, (10) L_physics, (11) the total.
Every function returns one value per sample (B,), so that weights and the delta rule can be applied sample by
sample.
"""

from __future__ import annotations

import torch
import torch.nn.functional as F
from torch import Tensor

from s2p3 import physics
from s2p3.config import PhysicsVariant

_FLOOR = 1e-3  # of S0


def transform(points: Tensor, rotation: Tensor, translation: Tensor) -> Tensor:
    """Points (P, 3) under B poses -> (B, P, 3)."""
    return points @ rotation.transpose(1, 2) + translation[:, None]


def pose_loss(
    points: Tensor,
    rotation: Tensor,
    translation: Tensor,
    target_rotation: Tensor,
    target_translation: Tensor,
    symmetries: Tensor,
) -> Tensor:
    """L_pose, Eq. (8): mean over the model's points of the L1 distance between the two poses, metres.

    Args:
        points: (P, 3) of the object, metres.
        rotation, translation: (B, 3, 3) and (B, 3), the student's.
        target_rotation, target_translation: the teacher's.
        symmetries: (M, 4, 4) motions that leave the object unchanged, the identity included; the nearest one
            counts.
    """
    targets = _symmetric_targets(points, target_rotation, symmetries) + target_translation[:, None, None]
    distance = (transform(points, rotation, translation)[:, None] - targets).abs().sum(-1).mean(-1)
    return distance.min(dim=1).values


def rotation_loss(points: Tensor, rotation: Tensor, target: Tensor, symmetries: Tensor) -> Tensor:
    """Point matching for the rotation alone, as in the paper's pre-training: mean L1 distance, metres;
    arguments as `pose_loss`."""
    zero = torch.zeros_like(rotation[:, 0])
    return pose_loss(points, rotation, zero, target, zero, symmetries)


def translation_loss(site: Tensor, target_site: Tensor, depth: Tensor, diameter_m: float) -> Tensor:
    """L1 of the scale-invariant translation: centre offset, in crop sides, times 2, plus depth, in diameters,
    times 0.5.

    The paper says "an L1 loss for translation"; these parts and their weights are our choice.

    Args:
        site, target_site: (B, 3), see `pose_head`.
        depth: (B,) true z, metres.
    """
    error = (site - target_site).abs()
    depth_error = error[:, 2] * depth / target_site[:, 2] / diameter_m
    return 2 * error[:, :2].sum(1) + 0.5 * depth_error


def dense_loss(
    mask_logits: Tensor,
    normals: Tensor,
    coordinates: Tensor,
    mask: Tensor,
    true_normals: Tensor,
    true_coordinates: Tensor,
) -> Tensor:
    """Supervision of the teacher's maps during pre-training (our choice; the paper supervises the pose only).

    Binary cross entropy of the mask, plus twice the L1 of the object coordinates and half of 1 - cos of the
    normals, both averaged over the visible object. All maps (B, C, h, w).
    """
    inside = (mask > 0.5).to(mask.dtype)
    area = inside.sum((1, 2, 3)) + 1
    mask_error = F.binary_cross_entropy_with_logits(mask_logits, mask, reduction="none").mean((1, 2, 3))
    coordinate_error = ((coordinates - true_coordinates).abs() * inside).sum((1, 2, 3)) / area
    cosine = (normals * true_normals).sum(1, keepdim=True)
    normal_error = ((1 - cosine) * inside).sum((1, 2, 3)) / area
    return mask_error + 2 * coordinate_error + 0.5 * normal_error


def discrepancy(predicted_mask: Tensor, rendered_mask: Tensor) -> Tensor:
    """delta: how far the teacher's predicted mask is from the one rendered at its pose, 0 (equal) to 1
    (disjoint).

    The paper normalizes the discrepancy to a scalar without saying how; ours is sum |a - b| / sum max(a, b).
    (B, 1, h, w).
    """
    difference = (predicted_mask - rendered_mask).abs().sum((1, 2, 3))
    union = torch.maximum(predicted_mask, rendered_mask).sum((1, 2, 3))
    return (difference / union.clamp_min(1e-3)).clamp(0, 1)


def pseudo_maps(delta: Tensor, threshold: float, rendered: Tensor, predicted: Tensor) -> Tensor:
    """The delta rule: the teacher's rendered map where delta <= r, the predicted one elsewhere. Maps (B, C,
    h, w)."""
    use_rendered = (delta <= threshold)[:, None, None, None]
    return torch.where(use_rendered, rendered, predicted)


def mask_loss(mask: Tensor, target: Tensor) -> Tensor:
    """L_mask, Eq. (9): mean squared error of (B, 1, h, w)."""
    return (mask - target).square().mean((1, 2, 3))


def normals_loss(normals: Tensor, target: Tensor, mask: Tensor, target_mask: Tensor) -> Tensor:
    """L_normals, Eq. (9): 1 - cosine similarity, averaged where both masks see the object (our choice). (B,
    3, h, w)."""
    both = ((mask.detach() > 0.3) & (target_mask > 0.5)).to(normals.dtype)
    cosine = (normals * target).sum(1, keepdim=True)
    return ((1 - cosine) * both).sum((1, 2, 3)) / (both.sum((1, 2, 3)) + 1)


def physics_loss(
    variant: PhysicsVariant,
    stokes: Tensor,
    normals: Tensor,
    rays: Tensor,
    mask: Tensor,
    refractive_index: float,
) -> Tensor:
    """L_physics, Eq. (10): per pixel the smaller of the distances to the diffuse and the specular prediction,
    averaged over `mask`.

    Args:
        variant: "dolp", the paper's: |rho - rho_hat|; "stokes", our extension: L1 distance of (S1, S2) / S0,
            which the angle of polarization enters too.
        stokes: (B, 3, h, w) measured.
        normals: (B, 3, h, w) rendered at the student's pose, unit inside `mask`, camera frame.
        rays: (B, 3, h, w) unit viewing rays.
        mask: (B, 1, h, w), 0 or 1.
        refractive_index: of the object.
    """
    s0, s1, s2 = stokes.unbind(1)
    s0 = s0.clamp_min(_FLOOR)
    diffuse, specular = physics.analytic_dolp(normals, rays, refractive_index)
    if variant == "dolp":
        dolp = (torch.hypot(s1, s2) / s0).clamp(max=1)
        error = torch.minimum((dolp - diffuse).abs(), (dolp - specular).abs())
    else:
        measured = torch.stack([s1 / s0, s2 / s0], dim=1)
        direction = physics.doubled_azimuth(normals, rays)
        to_diffuse = (measured - diffuse[:, None] * direction).abs().sum(1)
        to_specular = (measured + specular[:, None] * direction).abs().sum(1)
        error = torch.minimum(to_diffuse, to_specular)
    weight = mask[:, 0]
    return (error * weight).sum((1, 2)) / (weight.sum((1, 2)) + 1)


def _symmetric_targets(points: Tensor, rotation: Tensor, symmetries: Tensor) -> Tensor:
    """(B, M, P, 3): the points under every symmetry, then under each rotation."""
    moved = points @ symmetries[:, :3, :3].transpose(1, 2) + symmetries[:, None, :3, 3]
    return torch.einsum("bij,mpj->bmpi", rotation, moved)
