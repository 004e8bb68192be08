"""The path tracer against our own physics, geometry and light: two programs that share no formula."""

from __future__ import annotations

import os
import subprocess
import sys
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from numpy.typing import NDArray

from dataset import SE3, Intrinsics
from s2p3 import objects, physics
from s2p3.rendering import rasterize
from s2p3.synthesis import SYNTHETIC, Analytic, PathTraced, Recipe, Scene, Views, draw_scene, render
from s2p3.synthesis.analytic_scene import table_albedo
from s2p3.synthesis.lighting import Surface
from s2p3.synthesis.mitsuba_engine import FAST, SURE
from s2p3.synthesis.mitsuba_scene import bsdf, scene_dict, sensor_dict
from s2p3.synthesis.path_traced import in_ray_frames, render_stokes, to_rectangular

WIDE = Intrinsics(np.array([[140.0, 0, 120.3], [0, 140.0, 99.6], [0, 0, 1]]), np.zeros(0), 192, 224)
SMALL = Intrinsics(np.array([[120.0, 0, 70.0], [0, 121.5, 66.5], [0, 0, 1]]), np.zeros(0), 128, 160)
CUP = objects.build("cup")
BALL_M = 0.45
AXIS, ASIDE = np.array([0.0, 0.0, 1.0]), np.array([0.45, -0.35, 1.1])


@cache
def _mitsuba() -> Any:
    return PathTraced.here().engine.start()


def _ball(centre: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.bool_]]:
    """Normals (h, w, 3) of a ball where the rays of `WIDE` meet it, and where they do, not too steeply."""
    rays = WIDE.rays()
    along = rays @ centre
    gap = along**2 - centre @ centre + BALL_M**2
    hit = gap > 0
    points = (along - np.sqrt(np.maximum(gap, 0)))[..., None] * rays
    normals = (points - centre) / BALL_M
    cosine = -(normals * rays).sum(axis=-1)
    return normals, hit & (cosine > np.cos(np.radians(78))) & (cosine < np.cos(np.radians(8)))


@pytest.mark.parametrize(
    ("surface", "samples"),
    [
        (Surface(1.5, kind="metal", sharpness=1e6), 64),
        (Surface(2.75, kind="metal", sharpness=1e6), 64),
        (Surface(1.5, albedo=0.0, sharpness=1e6), 32),
        (Surface(1.5, albedo=0.9, gloss=0.0), 48),
    ],
    ids=["conductor 1.5", "conductor 2.75", "specular plastic", "diffuse plastic"],
)
@pytest.mark.parametrize(
    ("roll_deg", "centre"), [(0.0, AXIS), (30.0, ASIDE), (-75.0, ASIDE)], ids=["on axis", "30", "-75"]
)
def test_spheres_polarize_as_the_model_says(
    surface: Surface, samples: int, roll_deg: float, centre: NDArray[np.float64]
) -> None:
    mi = _mitsuba()
    T_world_cam = SE3.from_rotvec([0.4, -0.2, 0.0], [1.0, 2.0, 3.0]) @ SE3.from_rotvec(
        [0.0, 0.0, np.radians(roll_deg)], np.zeros(3)
    )
    scene = {
        "type": "scene",
        "integrator": {"type": "stokes", "nested": {"type": "path", "max_depth": 3}},
        "light": {"type": "constant"},
        "sensor": sensor_dict(mi, WIDE, T_world_cam, samples),
        "ball": {
            "type": "sphere",
            "center": T_world_cam.apply(centre).tolist(),
            "radius": BALL_M,
            "bsdf": bsdf(surface),
        },
    }
    s0, s1, s2 = in_ray_frames(render_stokes(mi, scene, 7), WIDE.rays().astype(np.float32))
    normals, seen = _ball(centre)
    maps = [torch.from_numpy(np.moveaxis(a, -1, 0))[None] for a in (normals, WIDE.rays())]
    diffuse, specular = physics.analytic_dolp(maps[0], maps[1], surface.refractive_index)
    direction = physics.doubled_azimuth(maps[0], maps[1])[0].numpy()
    body = surface.gloss == 0
    expected = (diffuse if body else specular)[0].numpy()[seen]
    dolp = (np.hypot(s1, s2) / s0)[seen]
    assert np.abs(dolp - expected).mean() < 0.002
    c, s = (direction if body else -direction)[:, seen]
    turned = 0.5 * np.arctan2(s2[seen] * c - s1[seen] * s, s1[seen] * c + s2[seen] * s)
    told = expected > 0.05
    assert np.degrees(np.abs(turned[told])).mean() < 0.2
    assert seen.sum() > 500


def _scene(seed: int, camera: Intrinsics = SMALL) -> Scene:
    rng = np.random.default_rng(seed)
    T_cam_obj = Views(distance_m=(0.2, 0.3)).draw(CUP, camera, rng)
    parameters = draw_scene(replace(SYNTHETIC, specular_share=1.0), CUP, T_cam_obj, rng)
    return Scene(CUP, T_cam_obj, camera, replace(parameters, clutter=()))


def test_the_object_stands_where_the_rasterizer_says() -> None:
    """A black cup before a white sky: off-centre principal point, and pixels that are not square."""
    mi, scene = _mitsuba(), _scene(1)
    black = replace(scene.parameters, surface=Surface(1.5, albedo=0.0, kind="matte"))
    described = scene_dict(mi, replace(scene, parameters=black)) | {"light": {"type": "constant"}}
    del described["table"]
    described["sensor"] = sensor_dict(mi, SMALL, scene.T_cam_table.inverse(), 64)
    cover = 1 - to_rectangular(render_stokes(mi, described, 3), SMALL)[0]
    mask = rasterize(CUP.mesh, scene.T_cam_obj, SMALL).mask
    assert (mask & (cover > 0.5)).sum() / (mask | (cover > 0.5)).sum() > 0.98
    y, x = np.mgrid[: SMALL.height, : SMALL.width]
    for axis in (x, y):
        assert abs((axis * cover).sum() / cover.sum() - axis[mask].mean()) < 0.06


def test_light_comes_from_where_the_scene_says() -> None:
    """Nothing but the surroundings, above the wall: each pixel shows the radiance along its ray."""
    mi, scene = _mitsuba(), _scene(2)
    light = replace(scene.parameters.light, sharpness=np.full(len(scene.parameters.light.glare), 8.0))
    parameters = replace(scene.parameters, light=light)
    T_world_cam = SE3.from_rotvec([0.3, 0.2, 0.5], np.zeros(3))  # looks up, along +z
    described = scene_dict(mi, replace(scene, parameters=parameters))
    only = {key: described[key] for key in ("type", "integrator", "light")}
    only["sensor"] = sensor_dict(mi, WIDE, T_world_cam, 16)
    seen = render_stokes(mi, only, 1)[0]
    directions = WIDE.rays() @ T_world_cam.rotation.T
    expected = light.radiance(directions)
    high = directions[..., 2] > np.sin(np.radians(45))
    assert high.mean() > 0.5
    assert np.corrcoef(seen[high], expected[high])[0, 1] > 0.99
    assert np.abs(seen[high] / expected[high] - 1).mean() < 0.03


def test_the_table_shows_its_texture_in_its_place() -> None:
    mi, scene = _mitsuba(), _scene(3)
    side = np.linspace(0.1, 0.9, 64, dtype=np.float32)
    lopsided = side[:, None] * (1 - 0.8 * side[None])
    cloth = replace(scene.parameters.table, kind="matte")
    matte = replace(scene.parameters, table=cloth, texture=lopsided, texture_m=0.7)
    scene = replace(scene, parameters=matte)
    described = scene_dict(mi, scene) | {"light": {"type": "constant"}}
    del described["object"]
    described["sensor"] = sensor_dict(mi, SMALL, scene.T_cam_table.inverse(), 64)
    s0, s1, s2 = render_stokes(mi, described, 1)
    albedo = table_albedo(scene)
    near = (albedo > 0) & (scene.rays @ scene.T_cam_table.rotation[:, 2] < -0.4)
    assert np.corrcoef(s0[near], albedo[near])[0, 1] > 0.99
    assert np.abs(s0[near] / albedo[near] - 1).mean() < 0.05
    assert max(np.abs(s1[near]).max(), np.abs(s2[near]).max()) < 1e-5  # cloth does not polarize


def test_both_backends_see_the_same_cup() -> None:
    scene = _scene(4)
    traced, analytic = (render(scene, backend, 5).stokes for backend in (PathTraced.here(), Analytic()))
    seen = scene.mask
    assert np.corrcoef(traced.dolp[seen], analytic.dolp[seen])[0, 1] > 0.5
    told = seen & (analytic.dolp > 0.2) & (traced.dolp > 0.2)
    turned = np.angle(np.exp(2j * (traced.aolp - analytic.aolp)))[told] / 2
    assert np.degrees(np.median(np.abs(turned))) < 4
    assert (np.hypot(traced.s1, traced.s2) <= traced.s0 * (1 + 1e-4)).all()


def test_glass_shows_what_is_behind_it() -> None:
    bottle = objects.build("bottle")
    rng = np.random.default_rng(0)
    T_cam_obj = Views(distance_m=(0.2, 0.25), elevation_deg=(30, 50)).draw(bottle, SMALL, rng)
    parameters = replace(draw_scene(SYNTHETIC, bottle, T_cam_obj, rng), clutter=(), blur_px=0.0)
    scene = Scene(bottle, T_cam_obj, SMALL, parameters)
    bright = replace(parameters, texture=np.full_like(parameters.texture, 0.9))
    dark = replace(parameters, texture=np.full_like(parameters.texture, 0.05))
    through = [
        PathTraced.here().noisy(replace(scene, parameters=p), 1)[0][scene.mask] for p in (bright, dark)
    ]
    assert through[0].mean() > 2 * through[1].mean()
    opaque = [Analytic().radiance(replace(scene, parameters=p))[0][scene.mask] for p in (bright, dark)]
    np.testing.assert_allclose(opaque[0], opaque[1])


def test_the_same_seed_gives_the_same_bits_and_another_gives_others() -> None:
    scene, backend = _scene(6, WIDE), PathTraced(PathTraced.here().engine, 16)
    one, again, other = (backend.radiance(scene, seed) for seed in (1, 1, 2))
    np.testing.assert_array_equal(one, again)
    assert np.abs(one - other).max() > 0


_WITHOUT_LLVM = """
import numpy as np
from dataset import Intrinsics
from s2p3 import objects
from s2p3.synthesis import SYNTHETIC, PathTraced, Recipe
K = np.array([[30.0, 0, 20], [0, 30, 16], [0, 0, 1]])
backend = PathTraced.here(64)
drawn = Recipe(objects.build("cup"), Intrinsics(K, np.zeros(0), 32, 40), SYNTHETIC, backend, 0).draw(0)
print(backend.engine.variant, backend.engine.note)
np.save({out!r}, backend.noisy(drawn.scene, 1))
"""


def test_without_llvm_the_sure_variant_renders_the_same_light(tmp_path: Path) -> None:
    program = _WITHOUT_LLVM.format(out=str(tmp_path / "sure.npy"))
    environment = dict(os.environ) | {"DRJIT_LIBLLVM_PATH": str(tmp_path / "no-such-llvm.so")}
    done = subprocess.run(
        [sys.executable, "-c", program], env=environment, capture_output=True, text=True, check=True
    )
    variant, _, note = done.stdout.partition(" ")
    assert variant == SURE
    assert "libllvm19" in note
    backend = PathTraced.here(64)
    assert backend.engine.variant == FAST
    K = np.array([[30.0, 0, 20], [0, 30, 16], [0, 0, 1]])
    drawn = Recipe(CUP, Intrinsics(K, np.zeros(0), 32, 40), SYNTHETIC, backend, 0).draw(0)
    fast, sure = (
        image.reshape(3, 8, 4, 10, 4).mean(axis=(2, 4)) / image[0].mean()
        for image in (backend.noisy(drawn.scene, 1), np.load(tmp_path / "sure.npy"))
    )
    assert np.abs(fast[0] - sure[0]).mean() < 0.05
    assert np.abs(fast[1:] - sure[1:]).mean() < 0.02
