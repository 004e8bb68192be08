"""The physical model against Fresnel's equations, its own inverse, and rotations of the camera."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from torch import Tensor

from dataset import ToolkitError
from s2p3 import physics

INDICES = [1.35, 1.5, 1.52, 2.0, 2.75]
K = torch.tensor([[[90.0, 0, 15.3], [0, 88.0, 11.8], [0, 0, 1]]], dtype=torch.float64)


def _complex_fresnel(theta: np.ndarray, n: complex) -> tuple[np.ndarray, np.ndarray]:
    cosine, bent = np.cos(theta), np.sqrt(n * n - np.sin(theta) ** 2)
    r_s = (cosine - bent) / (cosine + bent)
    r_p = (n * n * cosine - bent) / (n * n * cosine + bent)
    return np.abs(r_s) ** 2, np.abs(r_p) ** 2


@pytest.mark.parametrize(("n", "k"), [(1.5, 0.0), (2.75, 0.0), (2.75, 3.79), (1.1, 0.5)])
def test_fresnel_is_the_complex_formula(n: float, k: float) -> None:
    theta = np.linspace(0, np.pi / 2, 181)
    expected = _complex_fresnel(theta, n + 1j * k)
    reflectances = physics.fresnel(torch.from_numpy(np.cos(theta)), n, k)
    for ours, theirs in zip(reflectances, expected, strict=True):
        np.testing.assert_allclose(ours.numpy(), theirs, atol=1e-12)


@pytest.mark.parametrize("n", INDICES)
def test_degrees_of_polarization_follow_from_fresnel(n: float) -> None:
    cosine = torch.linspace(0.0, 1.0, 301, dtype=torch.float64)
    r_s, r_p = physics.fresnel(cosine, n)
    specular = (r_s - r_p) / (r_s + r_p)
    torch.testing.assert_close(physics.rho_specular(cosine, n), specular, atol=1e-10, rtol=0)
    inner = cosine > 0
    diffuse = (r_s - r_p) / (2 - r_s - r_p)
    torch.testing.assert_close(physics.rho_diffuse(cosine, n)[inner], diffuse[inner], atol=1e-10, rtol=0)


def test_published_numbers() -> None:
    brewster = math.cos(math.atan(1.5))
    assert physics.rho_specular(brewster, 1.5) == pytest.approx(1.0)
    assert physics.rho_diffuse(0.0, 1.5) == pytest.approx(5 / 13)  # 0.385: the diffuse maximum at n = 1.5


@pytest.mark.parametrize("n", INDICES)
def test_the_closed_forms_invert_the_model(n: float) -> None:
    theta = torch.linspace(0, math.pi / 2, 901, dtype=torch.float64)
    brewster = math.atan(n)
    diffuse, below, above = (
        torch.rad2deg(torch.asin(s.sqrt()))
        for s in physics.invert_dolp(physics.rho_diffuse(theta.cos(), n), n)
    )
    torch.testing.assert_close(diffuse, torch.rad2deg(theta), atol=1e-5, rtol=0)
    _, below, above = (
        torch.rad2deg(torch.asin(s.sqrt()))
        for s in physics.invert_dolp(physics.rho_specular(theta.cos(), n), n)
    )
    low = theta <= brewster
    torch.testing.assert_close(below[low], torch.rad2deg(theta[low]), atol=1e-4, rtol=0)
    torch.testing.assert_close(above[~low], torch.rad2deg(theta[~low]), atol=1e-4, rtol=0)


def test_a_dolp_above_the_diffuse_maximum_is_grazing() -> None:
    sin2, _, _ = physics.invert_dolp(torch.tensor([0.385, 0.6, 1.0]), 1.5)
    torch.testing.assert_close(sin2, torch.ones(3), atol=2e-3, rtol=0)


def _visible_normals(rays: Tensor, seed: int) -> Tensor:
    generator = torch.Generator().manual_seed(seed)
    normals = torch.randn(rays.shape, dtype=rays.dtype, generator=generator)
    normals = normals / normals.norm(dim=1, keepdim=True)
    facing = (normals * rays).sum(1, keepdim=True)
    return torch.where(facing > 0, -normals, normals)


def _stokes(normals: Tensor, rays: Tensor, index: float, kind: str) -> Tensor:
    diffuse, specular = physics.analytic_dolp(normals, rays, index)
    signed = diffuse if kind == "diffuse" else -specular
    polarized = signed[:, None] * physics.doubled_azimuth(normals, rays)
    return torch.cat([torch.ones_like(signed)[:, None], polarized], dim=1)


@pytest.mark.parametrize("kind", ["diffuse", "specular"])
def test_priors_hold_the_true_normal_up_to_the_half_turn(kind: str) -> None:
    rays = physics.pixel_rays(K, 24, 32)
    normals = _visible_normals(rays, seed=0)
    priors = physics.shape_priors(_stokes(normals, rays, 1.5, kind), 1.5, K)
    torch.testing.assert_close(
        priors.reshape(3, 3, 24, 32).norm(dim=1), torch.ones(3, 24, 32, dtype=torch.float64)
    )
    candidates = [priors[:, :3]] if kind == "diffuse" else [priors[:, 3:6], priors[:, 6:]]
    turned = []
    for prior in candidates:
        in_ray = physics.to_ray_frame(prior, rays)
        opposite = physics.from_ray_frame(in_ray * torch.tensor([-1.0, -1.0, 1.0]).view(1, 3, 1, 1), rays)
        turned += [(prior * normals).sum(1), (opposite * normals).sum(1)]
    angle = torch.rad2deg(torch.acos(torch.stack(turned).amax(dim=0).clamp(-1, 1)))
    away_from_axis = physics.cos_incidence(normals, rays) < 0.999
    assert angle[away_from_axis].max() < 0.01


def test_azimuths_are_counter_clockwise_as_displayed() -> None:
    axis = torch.tensor([0.0, 0.0, 1.0]).view(1, 3, 1, 1)
    upper_right = torch.tensor([0.5, -0.5, -math.sqrt(0.5)]).view(1, 3, 1, 1)  # y down: up in the image
    doubled = physics.doubled_azimuth(upper_right, axis)[0, :, 0, 0]
    torch.testing.assert_close(doubled, torch.tensor([0.0, 1.0]), atol=1e-5, rtol=0)  # phi = +45 deg
    at_45 = torch.tensor([1.0, 0.0, 0.3]).view(1, 3, 1, 1)
    wide = torch.tensor([[[1e6, 0, 0], [0, 1e6, 0], [0, 0, 1.0]]])
    diffuse, specular = physics.shape_priors(at_45, 1.5, wide)[0, :6, 0, 0].split(3)
    assert diffuse[0] > 0  # right and up
    assert diffuse[1] < 0
    assert specular[0] < 0  # 90 deg further: left and up
    assert specular[1] < 0


def test_turning_the_camera_about_its_axis_turns_the_angles() -> None:
    rays = physics.pixel_rays(K, 24, 32)
    normals = _visible_normals(rays, seed=1)
    angle = 0.4  # the picture turns by this, x towards y, which is clockwise as displayed
    turn = torch.tensor(
        [[math.cos(angle), -math.sin(angle), 0], [math.sin(angle), math.cos(angle), 0], [0, 0, 1]],
        dtype=torch.float64,
    )
    turned = [torch.einsum("ij,bjhw->bihw", turn, field) for field in (normals, rays)]
    before, after = physics.doubled_azimuth(normals, rays), physics.doubled_azimuth(turned[0], turned[1])
    cosine, sine = math.cos(2 * angle), math.sin(2 * angle)
    expected = torch.stack(
        [cosine * before[:, 0] + sine * before[:, 1], cosine * before[:, 1] - sine * before[:, 0]], dim=1
    )
    torch.testing.assert_close(after, expected)


def test_ray_frames_are_rotations_onto_the_optical_axis() -> None:
    rays = physics.pixel_rays(K, 24, 32)
    axis = physics.to_ray_frame(rays, rays)
    torch.testing.assert_close(axis[:, 2], torch.ones(1, 24, 32, dtype=torch.float64))
    normals = _visible_normals(rays, seed=2)
    again = physics.from_ray_frame(physics.to_ray_frame(normals, rays), rays)
    torch.testing.assert_close(again, normals)
    torch.testing.assert_close(physics.to_ray_frame(normals, rays).norm(dim=1), normals.norm(dim=1))


def test_the_inverse_model_passes_gradcheck() -> None:
    rays = physics.pixel_rays(K, 3, 4)
    normals = _visible_normals(rays, seed=3).requires_grad_()
    assert torch.autograd.gradcheck(lambda n: physics.analytic_dolp(n, rays, 1.5), (normals,))
    assert torch.autograd.gradcheck(lambda n: physics.doubled_azimuth(n, rays), (normals,))


@pytest.mark.parametrize("normal", [[0.0, 0, -1], [1.0, 0, 0], [0, -1.0, 0]])
def test_values_and_gradients_are_finite_at_0_and_90_degrees(normal: list[float]) -> None:
    axis = torch.tensor([0.0, 0, 1]).view(1, 3, 1, 1)
    normals = torch.tensor(normal).view(1, 3, 1, 1).requires_grad_()
    diffuse, specular = physics.analytic_dolp(normals, axis, 1.5)
    total = (diffuse + specular).sum() + physics.doubled_azimuth(normals, axis).sum()
    total.backward()
    assert torch.isfinite(total)
    assert normals.grad is not None
    assert torch.isfinite(normals.grad).all()


def test_priors_without_light_or_beyond_full_polarization_are_finite_unit_normals() -> None:
    stokes = torch.tensor([[0.0, 0, 0], [1.0, 0, 0], [0.5, -2.0, 0], [1.0, 1.0, -0.0], [0.0, 0.1, 0.1]])
    priors = physics.shape_priors(stokes.T.reshape(1, 3, 1, 5), 1.5, torch.eye(3)[None] + 1.0)
    assert torch.isfinite(priors).all()
    torch.testing.assert_close(priors.reshape(3, 3, 5).norm(dim=1), torch.ones(3, 5))


def _measured(kind: str, dtype: torch.dtype) -> Tensor:
    """(2, 3, 24, 37) Stokes: pictures that occur, and ones that should not."""
    generator = torch.Generator().manual_seed(4)
    s0, dolp, angle = torch.rand(3, 2, 24, 37, generator=generator, dtype=torch.float64)
    if kind == "nearly unpolarized":
        dolp = 10 ** (-6 * dolp)
    elif kind == "nearly fully polarized":
        dolp = 1 - 10 ** (-6 * dolp)
    elif kind == "beyond full polarization":
        dolp = 1 + dolp
    elif kind == "on the axes":
        angle = (4 * angle).floor() / 4
    angle = 2 * math.pi * angle
    return torch.stack([s0, s0 * dolp * angle.cos(), s0 * dolp * angle.sin()], dim=1).to(dtype)


@pytest.mark.parametrize("n", INDICES)
@pytest.mark.parametrize(
    "kind",
    ["any", "nearly unpolarized", "nearly fully polarized", "beyond full polarization", "on the axes"],
)
def test_the_compiled_priors_are_those_of_the_reference(kind: str, n: float) -> None:
    stokes = _measured(kind, torch.float32)
    cameras = torch.cat([K, K + torch.tensor([[0.0, 0, 7], [0, 3, -4], [0, 0, 0]])])
    fast = physics.shape_priors(stokes, n, cameras.float())
    exact = physics.shape_priors_reference(stokes.double(), n, cameras)
    plain = physics.shape_priors_reference(stokes, n, cameras.float())
    assert torch.isfinite(fast).all()
    torch.testing.assert_close(fast.reshape(2, 3, 3, 24, 37).norm(dim=2), torch.ones(2, 3, 24, 37))
    worst, worst_plain = (torch.quantile((maps.double() - exact).abs(), 0.999) for maps in (fast, plain))
    assert worst <= max(2e-6, 1.5 * float(worst_plain))


def test_compiled_priors_of_strided_and_dark_images() -> None:
    stokes = _measured("any", torch.float32)
    stokes[:, :, :4] = 0
    strided = stokes.permute(0, 1, 3, 2).contiguous().permute(0, 1, 3, 2)
    fast = physics.shape_priors(strided, 1.5, K.float().expand(2, 3, 3))
    exact = physics.shape_priors_reference(stokes.double(), 1.5, K.expand(2, 3, 3))
    torch.testing.assert_close(fast, exact.float(), atol=2e-6, rtol=0)


def test_priors_of_no_images_are_none_and_of_other_shapes_an_error() -> None:
    assert physics.shape_priors(torch.zeros(0, 3, 4, 5), 1.5, torch.zeros(0, 3, 3)).shape == (0, 9, 4, 5)
    half = torch.rand(1, 3, 4, 5).bfloat16()
    assert torch.isfinite(physics.shape_priors(half, 1.5, K.bfloat16())).all()
    for stokes, cameras in ((torch.zeros(2, 3, 4, 5), K), (torch.zeros(1, 4, 4, 5), K)):
        with pytest.raises(ToolkitError, match=r"\(B, 3, H, W\)"):
            physics.shape_priors(stokes, 1.5, cameras)
    with pytest.raises(ToolkitError, match="refractive index"):
        physics.shape_priors(torch.zeros(1, 3, 4, 5), 1.0, K)
