"""The losses: the paper's, by equation, and the ones we added.

Equation numbers are the S2P3 paper's: (7) L_pseudo, (8) L_pose, (9) L_geo, (10) L_physics, (11) the total,
(12) L_chamfer. Every function returns one value per sample (B,), so that weights and the delta rule can be
applied sample by sample. An average over no pixel at all is zero.
"""

from __future__ import annotations

from collections.abc import Callable

import torch
import torch.nn.functional as F
from torch import Tensor

from s2p3 import physics
from s2p3.config import PhysicsVariant
from s2p3.inputs import degree_of_polarization

CLOUD_POINTS = 256
"""Points a depth map is thinned out to before clouds are compared (our choice)."""

_FLOOR = 1e-3  # of S0
_GAIN = (0.3, 1.0)  # range of the fitted dilution: below it a wrong pose could silence the loss


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
    """Point matching for the rotation alone, Eq. (8) without translations, as in the paper's pre-training:
    mean L1 distance, metres; arguments as `pose_loss`."""
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
    area = inside.sum((1, 2, 3)).clamp_min(1)
    mask_error = F.binary_cross_entropy_with_logits(mask_logits, mask, reduction="none").mean((1, 2, 3))
    coordinate_error = ((coordinates - true_coordinates).abs() * inside).sum((1, 2, 3)) / area
    cosine = (normals * true_normals).sum(1, keepdim=True)
    normal_error = ((1 - cosine) * inside).sum((1, 2, 3)) / area
    return mask_error + 2 * coordinate_error + 0.5 * normal_error


def discrepancy(predicted_mask: Tensor, rendered_mask: Tensor) -> Tensor:
    """delta of the delta rule: how far the teacher's predicted mask is from the one rendered at its pose, 0
    (equal) to 1 (disjoint).

    The paper normalizes the discrepancy to a scalar without saying how; ours is sum |a - b| / sum max(a, b).
    (B, 1, h, w).
    """
    difference = (predicted_mask - rendered_mask).abs().sum((1, 2, 3))
    union = torch.maximum(predicted_mask, rendered_mask).sum((1, 2, 3))
    return (difference / union.clamp_min(1e-3)).clamp(0, 1)


def pose_weight(delta: Tensor) -> Tensor:
    """lambda_1 of Eq. (7): 1 - delta (B,). The paper reduces the weight "also" where the predicted maps are
    chosen; that it applies on both sides of the threshold is our reading."""
    return 1 - delta


def pseudo_maps(delta: Tensor, threshold: float, rendered: Tensor, predicted: Tensor) -> Tensor:
    """The delta rule below Eq. (9): the teacher's rendered map where delta <= r, the predicted one elsewhere.
    Maps (B, C, h, w)."""
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
    return _average((1 - cosine)[:, 0], both[:, 0])


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
        variant: what is compared, per pixel. "dolp", the paper's: |rho - rho_hat|. The others are ours.
            "stokes": the L1 distance of (S1, S2) / S0, which the angle of polarization enters too. "aolp":
            rho (1 - |cos 2(phi - alpha)|), the angle alone, as far as there is polarization. "dolp-gain":
            |rho - rho_hat| with rho_hat_s scaled by one factor an image, fitted to it, because diffuse light
            dilutes specular polarization.
        stokes: (B, 3, h, w) measured.
        normals: (B, 3, h, w) rendered at the student's pose, unit inside `mask`, camera frame.
        rays: (B, 3, h, w) unit viewing rays.
        mask: (B, 1, h, w), 0 or 1.
        refractive_index: of the object.
    """
    if variant == "none":
        return stokes.new_zeros(len(stokes))
    weight = mask[:, 0]
    error = _PHYSICS[variant](stokes, normals, rays, weight, refractive_index)
    return _average(error, weight)


def depth_loss(depth: Tensor, measured: Tensor, mask: Tensor) -> Tensor:
    """The pixel-wise loss of the depth ablation: mean L1 distance, metres, over the pixels of `mask` in which
    both know the depth.

    Args:
        depth: (B, 1, h, w) rendered at the student's pose; 0 outside the object.
        measured: (B, 1, h, w); 0: unknown.
        mask: (B, 1, h, w), 0 or 1.
    """
    known = mask * (measured > 0) * (depth.detach() > 0)
    return _average((depth - measured).abs()[:, 0], known[:, 0])


def chamfer_loss(points: Tensor, others: Tensor, limit_m: float = float("inf")) -> Tensor:
    """L_chamfer, Eq. (12): mean distance from every point to the nearest of the other set, and the same the
    other way round, metres.

    Args:
        points: (B, P, 3), one of the sets, NaN rows are not there.
        others: (B, Q, 3), the other.
        limit_m: pairs further apart than this do not count (Self6D++; none in the paper).

    A set of no points gives zero.
    """
    there, others_there = points.isfinite().all(-1), others.isfinite().all(-1)
    # NaNs are replaced before the distances, or their gradients would be NaN, too
    points = torch.where(there[..., None], points, 0.0)
    others = torch.where(others_there[..., None], others, 0.0)
    difference = points[:, :, None] - others[:, None]
    distances = difference.square().sum(-1).clamp_min(1e-16).sqrt()
    pair = there[:, :, None] & others_there[:, None]
    distances = torch.where(pair, distances, float("inf"))
    total = points.new_zeros(len(points))
    for dim in (2, 1):
        nearest = distances.amin(dim)
        counts = nearest < limit_m
        total = total + _average(torch.where(counts, nearest, 0.0), counts.to(nearest.dtype))
    return total


def back_project(depth: Tensor, mask: Tensor, K: Tensor, count: int) -> Tensor:
    """At most `count` points (B, count, 3) of a depth map, camera frame, metres, spread evenly over the
    pixels of `mask` in which it is known; NaN rows fill up.

    Args:
        depth: (B, 1, h, w); 0: unknown.
        mask: (B, 1, h, w).
        K: (B, 3, 3) of these pixels.
    """
    height, width = depth.shape[2:]
    rays = physics.pixel_rays(K, height, width)
    cloud = (rays / rays[:, 2:] * depth).flatten(2).transpose(1, 2)
    rows = []
    for points, known in zip(cloud, ((mask > 0.5) & (depth > 0)).flatten(1), strict=True):
        where = torch.nonzero(known)[:, 0]
        chosen = where[torch.linspace(0, max(len(where) - 1, 0), min(count, len(where))).long()]
        rows.append(F.pad(points[chosen], (0, 0, 0, count - len(chosen)), value=float("nan")))
    return torch.stack(rows)


def _dolp_error(stokes: Tensor, normals: Tensor, rays: Tensor, weight: Tensor, index: float) -> Tensor:
    del weight
    dolp = degree_of_polarization(stokes)
    diffuse, specular = physics.analytic_dolp(normals, rays, index)
    return torch.minimum((dolp - diffuse).abs(), (dolp - specular).abs())


def _gain_error(stokes: Tensor, normals: Tensor, rays: Tensor, weight: Tensor, index: float) -> Tensor:
    dolp = degree_of_polarization(stokes)
    diffuse, specular = physics.analytic_dolp(normals, rays, index)
    fitted = (dolp * specular * weight).sum((1, 2)) / (specular.square() * weight).sum((1, 2)).clamp_min(1e-6)
    gain = fitted.clamp(*_GAIN).detach()[:, None, None]  # detached: the pose must not explain itself away
    return torch.minimum((dolp - diffuse).abs(), (dolp - gain * specular).abs())


def _stokes_error(stokes: Tensor, normals: Tensor, rays: Tensor, weight: Tensor, index: float) -> Tensor:
    del weight
    measured = stokes[:, 1:] / stokes[:, :1].clamp_min(_FLOOR)
    diffuse, specular = physics.analytic_dolp(normals, rays, index)
    direction = physics.doubled_azimuth(normals, rays)
    to_diffuse = (measured - diffuse[:, None] * direction).abs().sum(1)
    to_specular = (measured + specular[:, None] * direction).abs().sum(1)
    return torch.minimum(to_diffuse, to_specular)


def _aolp_error(stokes: Tensor, normals: Tensor, rays: Tensor, weight: Tensor, index: float) -> Tensor:
    del weight, index
    measured = stokes[:, 1:] / stokes[:, :1].clamp_min(_FLOOR)
    along = (measured * physics.doubled_azimuth(normals, rays)).sum(1)
    length = torch.hypot(measured[:, 0], measured[:, 1])
    return length - along.abs()  # diffuse along the azimuth, specular across: the nearer counts


_PHYSICS: dict[PhysicsVariant, Callable[[Tensor, Tensor, Tensor, Tensor, float], Tensor]] = {
    "dolp": _dolp_error,
    "stokes": _stokes_error,
    "aolp": _aolp_error,
    "dolp-gain": _gain_error,
}


def _average(values: Tensor, weight: Tensor) -> Tensor:
    """Mean (B,) of (B, ...) by weights of 0 and 1; zero where nothing counts."""
    inner = tuple(range(1, values.dim()))
    return (values * weight).sum(inner) / weight.sum(inner).clamp_min(1)


def _symmetric_targets(points: Tensor, rotation: Tensor, symmetries: Tensor) -> Tensor:
    """(B, M, P, 3): the points under every symmetry, then under each rotation."""
    moved = points @ symmetries[:, :3, :3].transpose(1, 2) + symmetries[:, None, :3, 3]
    return torch.einsum("bij,mpj->bmpi", rotation, moved)
