"""Depth images of synthetic scenes: exact where they should be, wrong where a real sensor would be."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from dataset import Intrinsics
from dataset.session import Session
from dataset.validate import validate
from s2p3.cli import main
from s2p3.objects import build
from s2p3.synthesis import SYNTHETIC, Analytic, Recipe
from s2p3.synthesis import depth as depth_module
from s2p3.synthesis.depth import scene_depth, sensed, table_depth
from s2p3.synthesis.scene import Scene

CAMERA = Intrinsics(np.array([[150.0, 0, 80], [0, 150.0, 60], [0, 0, 1]]), np.zeros(0), 120, 160)


def drawn(name: str) -> Scene:
    return Recipe(build(name), CAMERA, SYNTHETIC, Analytic(), 3).draw(0).scene


def test_every_surface_lies_where_its_depth_says() -> None:
    scene = drawn("cup")
    depth = scene_depth(scene)
    raster = scene.layers[0].raster
    visible = scene.mask[raster.window]
    np.testing.assert_array_equal(depth[raster.window][visible], raster.depth[visible])
    points = (scene.rays / scene.rays[..., 2:] * depth[..., None])[(depth > 0) & ~scene.covered]
    on_table = scene.T_cam_table.inverse().apply(points)
    assert len(points) > 1000
    np.testing.assert_allclose(on_table[:, 2], 0, atol=1e-5)
    assert ((table_depth(scene) >= depth - 1e-6) | (table_depth(scene) == 0)).all()  # nothing is below it


@pytest.mark.parametrize("name", ["cup", "fork", "bottle"])
def test_a_time_of_flight_camera_errs_on_metal_and_glass(name: str) -> None:
    scene = drawn(name)
    true = scene_depth(scene)
    measured = sensed(scene, "tof", np.random.default_rng(0))
    seen = scene.mask & (measured > 0)
    error = (measured - true)[seen]
    table = (true > 0) & ~scene.covered & (measured > 0)
    assert np.abs((measured - true)[table]).mean() < 0.005
    assert (measured[scene.mask] == 0).mean() > 0.05  # silhouettes, at least
    if name == "cup":
        assert abs(np.median(error)) < 0.002
    else:
        assert np.median(error) > 0.004
    np.testing.assert_array_equal(sensed(scene, "ideal", np.random.default_rng(0)), true)


@pytest.mark.parametrize("share", [0.1, depth_module._GLASS_SEEN, depth_module._METAL_LOST, 0.9])
def test_patches_take_the_share_that_is_asked_for(share: float) -> None:
    for seed in range(3):
        luck = depth_module._patches(np.random.default_rng(seed), (120, 160))
        assert luck.shape == (120, 160)
        assert (luck < share).mean() == pytest.approx(share, abs=1e-3)
        assert np.abs(np.diff(luck, axis=1)).mean() < 0.15  # neighbours err alike; unrelated ones: 1/3
        again = depth_module._patches(np.random.default_rng(seed), (120, 160))
        np.testing.assert_array_equal(luck, again)


def test_so_much_of_metal_is_not_measured() -> None:
    scene = drawn("fork")
    draws = map(np.random.default_rng, range(200))
    measured = np.stack([sensed(scene, "tof", rng)[scene.mask] for rng in draws])
    inside = (measured > 0).any(axis=0)  # a silhouette never is
    assert inside.sum() > 50
    lost = (measured[:, inside] == 0).mean()
    assert lost == pytest.approx(depth_module._METAL_LOST, abs=0.05)


def test_a_set_is_synthesized_with_depth(tmp_path: Path) -> None:
    path = tmp_path / "set.h5"
    words = ["synthesize", "--object", "cup", "--count", "2", "--workers", "1", "--depth", "ideal"]
    assert main([*words, "--out", str(path)]) == 0
    assert validate(path) == []
    with Session.open(path) as session:
        poses = session.object_poses("cup")
        for index in range(2):
            depth, mask = session.depth(index), poses.mask(index)
            centre = poses.T_cam_obj[index].translation[2]
            assert (np.abs(depth[mask] - centre) < 0.6 * build("cup").diameter).all()


def test_a_set_that_was_interrupted_while_its_depth_was_computed_goes_on(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "set.h5"
    words = ["synthesize", "--object", "fork", "--count", "2", "--workers", "1", "--depth", "tof", "--out"]
    calls = []

    def interrupted(scene: Scene) -> depth_module.Image:
        calls.append(scene)
        if len(calls) == 2:
            raise KeyboardInterrupt
        return scene_depth(scene)

    with monkeypatch.context() as patched:
        patched.setattr(depth_module, "scene_depth", interrupted)
        assert main([*words, str(path)]) == 130
    assert not path.exists()
    assert main([*words, str(path)]) == 0
    assert validate(path) == []
    assert main([*words, str(tmp_path / "whole.h5")]) == 0
    with Session.open(path) as found, Session.open(tmp_path / "whole.h5") as whole:
        for index in range(2):
            assert (found.depth(index) > 0).any()
            np.testing.assert_array_equal(found.depth(index), whole.depth(index))
