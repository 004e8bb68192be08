"""Every loss on cases worked out by hand, and the gradients of the paper's."""

from __future__ import annotations

import math

import pytest
import torch
from torch import Tensor

from s2p3 import losses, physics
from s2p3.config import PhysicsVariant
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
    assert losses.normals_loss(normals, target, seen, torch.ones(1, 1, 1, 3)) == pytest.approx((0 + 1) / 2)
    assert losses.normals_loss(normals, target, torch.zeros_like(seen), torch.ones(1, 1, 1, 3)) == 0


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
    # twice the coordinates' L1 of .3 (.1 in three channels)
    worse = losses.dense_loss(logits, normals, coordinates + 0.1, mask, normals, coordinates)
    assert worse == pytest.approx(2 * 0.3, rel=1e-4)


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
    assert loss == pytest.approx(min(abs(0.3 - diffuse), abs(0.3 - specular)))
    nothing = losses.physics_loss("dolp", stokes, normals, rays, 0 * mask, 1.5)
    assert nothing == losses.physics_loss("none", stokes, normals, rays, mask, 1.5) == 0


def test_a_pixel_without_light_shows_no_polarization() -> None:
    """To the loss, as to the networks."""
    normals, rays = tilted(0.8)
    stokes = torch.tensor([5e-4, 4e-4, 0.0], dtype=torch.float64).view(1, 3, 1, 1)
    mask = torch.ones(1, 1, 1, 1, dtype=torch.float64)
    loss = losses.physics_loss("dolp", stokes, normals, rays, mask, 1.5)
    assert loss == pytest.approx(min(float(rho) for rho in physics.analytic_dolp(normals, rays, 1.5)))


def test_stokes_physics_by_hand() -> None:
    """Seen along the axis, the azimuth of (.6, .8 up) is 53.1 degrees: 2 phi has cosine -.28 and sine .96."""
    normals, rays = tilted(0.8)
    diffuse, specular = (float(value) for value in physics.analytic_dolp(normals, rays, 1.5))
    stokes = torch.tensor([2.0, 0.1, -0.3], dtype=torch.float64).view(1, 3, 1, 1)
    mask = torch.ones(1, 1, 1, 1, dtype=torch.float64)
    to_diffuse = abs(0.05 - diffuse * -0.28) + abs(-0.15 - diffuse * 0.96)
    to_specular = abs(0.05 + specular * -0.28) + abs(-0.15 + specular * 0.96)
    loss = losses.physics_loss("stokes", stokes, normals, rays, mask, 1.5)
    assert loss == pytest.approx(min(to_diffuse, to_specular), abs=1e-6)


@pytest.mark.parametrize(("angle", "expected"), [(0.0, 0.0), (math.pi / 2, 0.0), (math.pi / 4, 0.4)])
def test_aolp_physics_costs_what_lies_between_the_two_directions(angle: float, expected: float) -> None:
    normals, rays = tilted(0.8)
    phi = math.atan2(0.8, 0.6) + angle  # diffuse, specular, and half way between
    stokes = torch.tensor([1.0, 0.4 * math.cos(2 * phi), 0.4 * math.sin(2 * phi)], dtype=torch.float64)
    mask = torch.ones(1, 1, 1, 1, dtype=torch.float64)
    loss = losses.physics_loss("aolp", stokes.view(1, 3, 1, 1), normals, rays, mask, 1.5)
    assert loss == pytest.approx(expected, abs=1e-6)


def test_a_gain_takes_up_diluted_specular_light() -> None:
    """Two pixels of specular light, its polarization halved by diffuse light: the ratio is what remains."""
    (steep, rays), (flat, _) = tilted(0.9), tilted(0.3)
    normals, rays = torch.cat([steep, flat], dim=3), torch.cat([rays, rays], dim=3)
    _, specular = physics.analytic_dolp(normals, rays, 1.5)
    stokes = torch.cat([torch.ones(1, 1, 1, 2), 0.5 * specular[:, None], torch.zeros(1, 1, 1, 2)], dim=1)
    mask = torch.ones(1, 1, 1, 2, dtype=torch.float64)
    assert losses.physics_loss("dolp-gain", stokes, normals, rays, mask, 1.5) == pytest.approx(0, abs=1e-5)
    assert losses.physics_loss("dolp", stokes, normals, rays, mask, 1.5) > 0.02
    swapped = normals.flip(3)  # the gain is one for the image: it does not excuse the wrong normals
    assert losses.physics_loss("dolp-gain", stokes, swapped, rays, mask, 1.5) > 0.01


def test_only_variants_with_the_angle_see_the_azimuth() -> None:
    normals, rays = tilted(0.8)
    _, specular = physics.analytic_dolp(normals, rays, 1.5)
    stokes = torch.cat([torch.ones(1, 1, 1, 1), -specular * physics.doubled_azimuth(normals, rays)], dim=1)
    mirrored = normals * torch.tensor([-1.0, 1, 1], dtype=torch.float64).view(1, 3, 1, 1)
    mask = torch.ones(1, 1, 1, 1, dtype=torch.float64)
    assert losses.physics_loss("dolp", stokes, mirrored, rays, mask, 1.5) == pytest.approx(0, abs=1e-6)
    assert losses.physics_loss("stokes", stokes, mirrored, rays, mask, 1.5) > 0.1
    assert losses.physics_loss("aolp", stokes, mirrored, rays, mask, 1.5) > 0.1


def test_the_pose_weighs_less_the_less_the_teacher_agrees_with_itself() -> None:
    assert losses.pose_weight(torch.tensor([0.0, 0.25])).tolist() == [1, 0.75]


def test_depth_loss_counts_pixels_that_both_know() -> None:
    depth = torch.tensor([0.5, 0.52, 0.0, 0.6]).view(1, 1, 2, 2)
    measured = torch.tensor([0.51, 0.0, 0.7, 0.63]).view(1, 1, 2, 2)
    assert losses.depth_loss(depth, measured, torch.ones(1, 1, 2, 2)) == pytest.approx((0.01 + 0.03) / 2)
    assert losses.depth_loss(depth, measured, torch.zeros(1, 1, 2, 2)) == 0


def test_chamfer_loss_by_hand() -> None:
    """Two points against three: .1 and .2 one way; .1, .2 and .5 (from the nearer) the other."""
    points = torch.tensor([[[0.0, 0, 0], [1.0, 0, 0]]])
    others = torch.tensor([[[0.0, 0.1, 0], [1.0, 0, 0.2], [1.5, 0, 0]]])
    assert losses.chamfer_loss(points, others) == pytest.approx((0.1 + 0.2) / 2 + (0.1 + 0.2 + 0.5) / 3)
    near = losses.chamfer_loss(points, others, limit_m=0.3)
    assert near == pytest.approx((0.1 + 0.2) / 2 + (0.1 + 0.2) / 2)
    missing = torch.cat([points, torch.full((1, 2, 3), float("nan"))], dim=1)
    assert losses.chamfer_loss(missing, others) == pytest.approx(losses.chamfer_loss(points, others))
    assert losses.chamfer_loss(torch.full((1, 2, 3), float("nan")), others) == 0


def test_a_depth_map_becomes_points_that_project_onto_their_pixels() -> None:
    K = torch.tensor([[[100.0, 0, 1.5], [0, 110.0, 1.5], [0, 0, 1]]])
    depth = torch.zeros(1, 1, 4, 4)
    depth[0, 0, 1, 2], depth[0, 0, 3, 0], depth[0, 0, 0, 0] = 0.5, 0.8, 0.9
    mask = torch.ones(1, 1, 4, 4)
    mask[0, 0, 0, 0] = 0
    points = losses.back_project(depth, mask, K, 5)
    assert points.shape == (1, 5, 3)
    assert points[0, 2:].isnan().all()
    projected = points[0, :2] @ K[0].T
    torch.testing.assert_close(projected[:, :2] / projected[:, 2:], torch.tensor([[2.0, 1], [0, 3]]))
    assert losses.back_project(depth, mask, K, 1).shape == (1, 1, 3)


def random(*shape: int) -> Tensor:
    generator = torch.Generator().manual_seed(sum(shape))
    return torch.rand(*shape, generator=generator, dtype=torch.float64)


SEEN = torch.ones(2, 1, 3, 3, dtype=torch.float64)
UNIT = torch.nn.functional.normalize(random(2, 3, 3, 3), dim=1)
CAMERA = torch.tensor([[[100.0, 0, 1], [0, 100.0, 1], [0, 0, 1]]], dtype=torch.float64).expand(2, -1, -1)

DIFFERENTIABLE = {
    "pose": (
        lambda r, t: losses.pose_loss(POINTS, r, t, EYE, ZERO, IDENTITY),
        (about_z(0.3), torch.tensor([[0.01, 0.02, 0.5]], dtype=torch.float64)),
    ),
    "rotation": (lambda r: losses.rotation_loss(POINTS, r, EYE, IDENTITY), (about_z(0.3),)),
    "translation": (
        lambda site: losses.translation_loss(site, random(2, 3) + 2, random(2), 0.1),
        (random(2, 3),),
    ),
    "dense": (
        lambda logits, normals, xyz: losses.dense_loss(
            logits, normals, xyz, SEEN, UNIT, random(2, 3, 3, 3) + 2
        ),
        (random(2, 1, 3, 3), random(2, 3, 3, 3), random(2, 3, 3, 3)),
    ),
    "mask": (lambda mask: losses.mask_loss(mask, SEEN), (random(2, 1, 3, 3),)),
    "normals": (lambda normals: losses.normals_loss(normals, UNIT, SEEN, SEEN), (random(2, 3, 3, 3),)),
    "depth": (lambda depth: losses.depth_loss(depth, SEEN * 2, SEEN), (random(2, 1, 3, 3) + 0.1,)),
    "chamfer": (losses.chamfer_loss, (random(2, 4, 3), random(2, 5, 3) + 0.2)),
    "back-projection": (
        lambda depth: losses.chamfer_loss(losses.back_project(depth, SEEN, CAMERA, 4), random(2, 5, 3)),
        (random(2, 1, 3, 3) + 0.1,),
    ),
}


@pytest.mark.parametrize("name", DIFFERENTIABLE)
def test_gradients_are_those_of_finite_differences(name: str) -> None:
    loss, arguments = DIFFERENTIABLE[name]
    assert torch.autograd.gradcheck(loss, tuple(argument.clone().requires_grad_() for argument in arguments))


@pytest.mark.parametrize("variant", ["dolp", "stokes", "aolp", "dolp-gain"])
def test_gradients_of_the_physics(variant: PhysicsVariant) -> None:
    # so strongly polarized that the gain is 1, and stays: a fitted gain is held while the pose moves
    stokes = torch.tensor([1.0, 0.6, 0.75], dtype=torch.float64).view(1, 3, 1, 1)
    _, rays = tilted(0.0)
    mask = torch.ones(1, 1, 1, 1, dtype=torch.float64)

    def loss(tilt: Tensor, turn: Tensor) -> Tensor:
        normal = torch.stack([turn.cos() * tilt.sin(), -turn.sin() * tilt.sin(), -tilt.cos()])
        return losses.physics_loss(variant, stokes, normal.view(1, 3, 1, 1), rays, mask, 1.5)

    at = tuple(torch.tensor(value, dtype=torch.float64, requires_grad=True) for value in (0.8, 0.9))
    assert torch.autograd.gradcheck(loss, at)
