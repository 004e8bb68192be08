"""Analytic shading against the physical model it must obey."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from dataset import SE3, Intrinsics
from s2p3 import object_meshes, physics
from s2p3.rendering import Mesh, Raster, rasterize
from s2p3.synthesis.analytic import shade
from s2p3.synthesis.lighting import Light, Surface

CAMERA = Intrinsics(np.array([[60.0, 0, 31.5], [0, 60.0, 30.0], [0, 0, 1]]), np.zeros(0), 62, 64)
RAYS = CAMERA.rays().astype(np.float32)


def _light(ambient: float = 0.5, sky: float = 0.8, lamps: float = 0.0) -> Light:
    return Light(
        up=np.array([0.0, -1.0, 0.0]),
        ambient=ambient,
        sky=sky,
        ground=sky,
        directions=np.array([[0.3, -0.8, -0.52]]),
        irradiance=np.array([lamps]),
        glare=np.array([lamps]),
        sharpness=np.array([20.0]),
        environment=np.ones((8, 16), np.float32),
        R_world_here=np.array([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]]),
    )


@pytest.fixture(scope="module")
def ball() -> Raster:
    mesh = Mesh.from_arrays(*object_meshes.ellipsoid((0.3, 0.3, 0.3)), crease_deg=60)
    return rasterize(mesh, SE3.from_rotvec(np.zeros(3), [0.05, 0.03, 0.45]), CAMERA)


def _model(ball: Raster, index: float) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    normals = torch.from_numpy(ball.normals).permute(2, 0, 1)[None].double()
    rays = torch.from_numpy(RAYS).permute(2, 0, 1)[None].double()
    diffuse, specular = physics.analytic_dolp(normals, rays, index)
    direction = physics.doubled_azimuth(normals, rays)[0]
    facing = ball.mask & (physics.cos_incidence(normals, rays)[0].numpy() > 0.05)
    return diffuse[0].numpy(), specular[0].numpy(), direction.numpy(), facing


@pytest.mark.parametrize("index", [1.5, 2.75])
@pytest.mark.parametrize("kind", ["diffuse", "specular"])
def test_pure_light_shows_the_models_degree_and_angle(ball: Raster, kind: str, index: float) -> None:
    surface = Surface(index, albedo=0.5 if kind == "diffuse" else 0.0, gloss=float(kind == "specular"))
    s0, s1, s2 = shade(ball.normals, RAYS, ball.mask, surface, _light())
    diffuse, specular, direction, seen = _model(ball, index)
    expected = diffuse * direction if kind == "diffuse" else -specular * direction
    np.testing.assert_allclose((s1 / np.maximum(s0, 1e-9))[seen], expected[0][seen], atol=1e-3)
    np.testing.assert_allclose((s2 / np.maximum(s0, 1e-9))[seen], expected[1][seen], atol=1e-3)


def test_energy_of_a_mirror_is_fresnels_mean(ball: Raster) -> None:
    s0, _, _ = shade(ball.normals, RAYS, ball.mask, Surface(1.5, 0.7), _light(sky=0.8))
    cosine = -(ball.normals * RAYS).sum(axis=-1)
    seen = ball.mask & (cosine > 0.05)
    r_s, r_p = physics.fresnel(cosine[seen].astype(np.float64), 1.5, 0.7)
    np.testing.assert_allclose(s0[seen], 0.4 * (r_s + r_p), rtol=1e-4)


def test_diffuse_and_specular_light_cancel(ball: Raster) -> None:
    mixed = shade(ball.normals, RAYS, ball.mask, Surface(1.5, albedo=0.5), _light(ambient=1.6, sky=0.8))
    assert np.abs(mixed[1:]).max() < 1e-6  # body and mirrored radiance equal


def test_light_turns_with_the_frame(ball: Raster) -> None:
    light, pose = _light(lamps=2.0), SE3.from_rotvec([0.2, 0.5, -0.9], [3.0, 2.0, 1.0])
    camera_light = light.turned(pose)
    np.testing.assert_allclose(camera_light.turned(pose.inverse()).directions, light.directions, atol=1e-12)
    np.testing.assert_allclose(camera_light.R_world_here @ camera_light.up, [0, 0, 1], atol=1e-12)
    surface = Surface(1.5, albedo=0.2)
    plain = shade(ball.normals, RAYS, ball.mask, surface, light)
    turn = pose.rotation.astype(np.float32)
    turned = shade(ball.normals @ turn.T, RAYS @ turn.T, ball.mask, surface, camera_light)
    np.testing.assert_allclose(turned[0], plain[0], atol=1e-4)
    np.testing.assert_allclose(light.scaled(2.0).glare, 2 * light.glare)
    doubled = shade(ball.normals, RAYS, ball.mask, surface, light.scaled(2.0))
    np.testing.assert_allclose(doubled, 2 * plain, atol=1e-5)


def test_lamps_shine_and_blunt_surfaces_spread_them(ball: Raster) -> None:
    lit = _light(sky=0.0, ambient=0.0, lamps=3.0)
    sharp = shade(ball.normals, RAYS, ball.mask, Surface(1.5), lit)[0]
    blunt = shade(ball.normals, RAYS, ball.mask, Surface(1.5, sharpness=5.0), lit)[0]
    assert sharp.max() > 2 * blunt.max() > 0


def test_a_painted_albedo_replaces_the_surfaces(ball: Raster) -> None:
    paint = np.linspace(0, 1, ball.mask.size, dtype=np.float32).reshape(ball.mask.shape)
    surface = Surface(1.5, albedo=1.0, gloss=0.0)
    plain = shade(ball.normals, RAYS, ball.mask, surface, _light())
    painted = shade(ball.normals, RAYS, ball.mask, surface, _light(), albedo=paint)
    np.testing.assert_allclose(painted, plain * paint, rtol=1e-4, atol=1e-7)
    assert not painted[:, ~ball.mask].any()
