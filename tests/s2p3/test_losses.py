"""Every loss on cases worked out by hand, and the gradients of the paper's."""

from __future__ import annotations

import math

import pytest
import torch
from torch import Tensor

from s2p3 import losses, physics
from s2p3.objects import Symmetry

POINTS = torch.tensor([[0.1, 0, 0], [0, 0.2, 0], [0, 0, 0.3]], dtype=torch.float64)
IDENTITY = torch.eye(4, dtype=torch.float64)[None]
EYE = torch.eye(3, dtype=torch.float64)[None]
ZERO = torch.zeros(1, 3, dtype=torch.float64)


def about_z(angle: float) -> Tensor:
    cos, sin = math.cos(angle), math.sin(angle)
    return torch.tensor([[[cos, -sin, 0], [sin, cos, 0], [0, 0, 1]]], dtype=torch.float64)


def test_pose_loss_of_a_shift_is_its_l1_length() -> None:
    shift = torch.tensor([[0.001, -0.002, 0.003]], dtype=torch.float64)
    assert losses.pose_loss(POINTS, EYE, shift, EYE, ZERO, IDENTITY) == pytest.approx(0.006)


def test_pose_loss_of_a_quarter_turn_by_hand() -> None:
    # (.1, 0, 0) -> (0, .1, 0): .2 apart in L1; (0, .2, 0) -> (-.2, 0, 0): .4; (0, 0, .3) stays
    loss = losses.pose_loss(POINTS, about_z(math.pi / 2), ZERO, EYE, ZERO, IDENTITY)
    assert loss == pytest.approx(0.2)


def test_a_symmetry_costs_nothing() -> None:
    half_turn = torch.eye(4, dtype=torch.float64)
    half_turn[:3, :3] = about_z(math.pi)[0]
    both = torch.stack([IDENTITY[0], half_turn])
    assert losses.rotation_loss(POINTS, about_z(math.pi), EYE, both) == pytest.approx(0)
    assert losses.rotation_loss(POINTS, about_z(math.pi), EYE, IDENTITY) > 0.1
    axis = torch.from_numpy(Symmetry(axis=torch.tensor([0.0, 0, 1]).numpy()).sampled(36)).double()
    assert losses.rotation_loss(POINTS, about_z(math.radians(70)), EYE, axis) == pytest.approx(0, abs=1e-9)


def test_translation_loss_by_hand() -> None:
    site, target = torch.tensor([[0.1, 0.0, 1.1]]), torch.tensor([[0.0, -0.05, 1.0]])
    # 2 (.1 + .05) + .5 (.1 relative depth of .5 m, in diameters of .1 m)
    assert losses.translation_loss(site, target, torch.tensor([0.5]), 0.1) == pytest.approx(0.3 + 0.25)


def test_discrepancy_runs_from_zero_to_one() -> None:
    left, right = torch.zeros(1, 1, 4, 4), torch.zeros(1, 1, 4, 4)
    left[..., :2] = 1
    right[..., 2:] = 1
    assert losses.discrepancy(left, left) == pytest.approx(0)
    assert losses.discrepancy(left, right) == pytest.approx(1)
    assert losses.discrepancy(left, torch.ones(1, 1, 4, 4)) == pytest.approx(0.5)


def test_delta_rule_takes_rendered_maps_where_the_teacher_agrees_with_itself() -> None:
    rendered, predicted = torch.ones(3, 1, 2, 2), torch.zeros(3, 1, 2, 2)
    chosen = losses.pseudo_maps(torch.tensor([0.05, 0.1, 0.11]), 0.1, rendered, predicted)
    assert chosen[:, 0, 0, 0].tolist() == [1, 1, 0]


def test_mask_loss_is_the_mean_square() -> None:
    mask, target = torch.zeros(1, 1, 2, 2), torch.tensor([[[[1.0, 0.5], [0, 0]]]])
    assert losses.mask_loss(mask, target) == pytest.approx(1.25 / 4)


def test_normals_loss_counts_where_both_see_the_object() -> None:
    normals, target = torch.zeros(1, 3, 1, 3), torch.zeros(1, 3, 1, 3)
    normals[0, 2] = target[0, 2] = 1
    target[0, :, 0, 1] = torch.tensor([1.0, 0, 0])
    target[0, :, 0, 2] = torch.tensor([0.0, 0, -1])
    seen = torch.tensor([[[[1.0, 1, 0]]]])
    assert losses.normals_loss(normals, target, seen, torch.ones(1, 1, 1, 3)) == pytest.approx((0 + 1) / 3)


def test_dense_loss_vanishes_at_the_truth() -> None:
    mask = torch.zeros(1, 1, 4, 4)
    mask[..., 1:3] = 1
    normals = torch.zeros(1, 3, 4, 4)
    normals[:, 2] = -1
    coordinates = torch.rand(1, 3, 4, 4)
    logits = 40 * (mask - 0.5)
    assert losses.dense_loss(logits, normals, coordinates, mask, normals, coordinates) == pytest.approx(
        0, abs=1e-6
    )
    # twice the coordinates' L1 of .3 (.1 in three channels), over 8 pixels in 8 + 1
    worse = losses.dense_loss(logits, normals, coordinates + 0.1, mask, normals, coordinates)
    assert worse == pytest.approx(2 * 0.3 * 8 / 9, rel=1e-4)


def tilted(angle: float) -> tuple[Tensor, Tensor]:
    """One pixel on the optical axis whose normal is tilted by `angle` towards the right and up."""
    normal = torch.tensor(
        [0.6 * math.sin(angle), -0.8 * math.sin(angle), -math.cos(angle)], dtype=torch.float64
    )
    return normal.view(1, 3, 1, 1), torch.tensor([0.0, 0, 1], dtype=torch.float64).view(1, 3, 1, 1)


@pytest.mark.parametrize("kind", ["diffuse", "specular"])
@pytest.mark.parametrize("variant", ["dolp", "stokes"])
def test_physics_loss_vanishes_at_the_truth_of_either_reflection(kind: str, variant: str) -> None:
    normals, rays = tilted(0.8)
    diffuse, specular = physics.analytic_dolp(normals, rays, 1.5)
    rho, sign = (diffuse, 1.0) if kind == "diffuse" else (specular, -1.0)
    direction = physics.doubled_azimuth(normals, rays)
    stokes = torch.cat(
        [torch.full((1, 1, 1, 1), 2.0, dtype=torch.float64), 2 * sign * rho * direction], dim=1
    )
    mask = torch.ones(1, 1, 1, 1, dtype=torch.float64)
    at_truth = losses.physics_loss(variant, stokes, normals, rays, mask, 1.5)  # type: ignore[arg-type]
    off, _ = tilted(1.0)
    elsewhere = losses.physics_loss(variant, stokes, off, rays, mask, 1.5)  # type: ignore[arg-type]
    assert at_truth == pytest.approx(0, abs=1e-6)
    assert elsewhere > 0.01


def test_physics_loss_takes_the_nearer_of_the_two_by_hand() -> None:
    normals, rays = tilted(0.8)
    diffuse, specular = (float(value) for value in physics.analytic_dolp(normals, rays, 1.5))
    stokes = torch.tensor([1.0, 0.3, 0.0], dtype=torch.float64).view(1, 3, 1, 1)
    mask = torch.ones(1, 1, 1, 1, dtype=torch.float64)
    loss = losses.physics_loss("dolp", stokes, normals, rays, mask, 1.5)
    assert loss == pytest.approx(
        min(abs(0.3 - diffuse), abs(0.3 - specular)) / 2
    )  # one pixel over one plus one


def test_only_the_stokes_variant_sees_the_azimuth() -> None:
    normals, rays = tilted(0.8)
    _, specular = physics.analytic_dolp(normals, rays, 1.5)
    stokes = torch.cat([torch.ones(1, 1, 1, 1), -specular * physics.doubled_azimuth(normals, rays)], dim=1)
    mirrored = normals * torch.tensor([-1.0, 1, 1], dtype=torch.float64).view(1, 3, 1, 1)
    mask = torch.ones(1, 1, 1, 1, dtype=torch.float64)
    assert losses.physics_loss("dolp", stokes, mirrored, rays, mask, 1.5) == pytest.approx(0, abs=1e-6)
    assert losses.physics_loss("stokes", stokes, mirrored, rays, mask, 1.5) > 0.1


def test_gradients() -> None:
    torch.manual_seed(0)
    rotation = about_z(0.3).requires_grad_()
    translation = torch.tensor([[0.01, 0.02, 0.5]], dtype=torch.float64, requires_grad=True)
    assert torch.autograd.gradcheck(
        lambda r, t: losses.pose_loss(POINTS, r, t, EYE, ZERO, IDENTITY), (rotation, translation)
    )
    angle = torch.tensor(0.8, dtype=torch.float64, requires_grad=True)
    stokes = torch.tensor([1.0, 0.1, 0.2], dtype=torch.float64).view(1, 3, 1, 1)
    _, rays = tilted(0.0)
    mask = torch.ones(1, 1, 1, 1, dtype=torch.float64)

    def physics_of(tilt: Tensor) -> Tensor:
        normal = torch.stack([0.6 * tilt.sin(), -0.8 * tilt.sin(), -tilt.cos()]).view(1, 3, 1, 1)
        dolp = losses.physics_loss("dolp", stokes, normal, rays, mask, 1.5)
        return dolp + losses.physics_loss("stokes", stokes, normal, rays, mask, 1.5)

    assert torch.autograd.gradcheck(physics_of, (angle,))
