"""The simulated lab obeys the physics and the geometry that the toolkit will recover from it."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from calibration.detection import detect_in_mosaic
from dataset.polarimetry import decode
from dataset.polarizer_response import PolarizerResponse, nominal_orientation
from dataset.transforms import SE3
from s2p3 import objects, physics
from s2p3.board import board_spec
from s2p3.lab.rig import BOARD
from s2p3.lab.scene import LabScene
from s2p3.lab.sensor import Sensor
from s2p3.lab.truth import LabTruth, sample_truth
from s2p3.rendering.rasterizer import rasterize


@pytest.fixture(scope="module")
def truth() -> LabTruth:
    model = objects.build("cup")
    return sample_truth(5, "cup", model.refractive_index, board_spec(BOARD).size_m, model.resting)


@pytest.fixture(scope="module")
def scene(truth: LabTruth) -> LabScene:
    return LabScene(truth)


@pytest.fixture(scope="module")
def sensor(truth: LabTruth) -> Sensor:
    return truth.sensor


def looking_at(target: np.ndarray, eye: np.ndarray) -> SE3:
    """T_base_cam of a camera at `eye`."""
    forward = (target - eye) / np.linalg.norm(target - eye)
    right = np.cross(forward, [0.0, 0.0, 1.0])
    right /= np.linalg.norm(right)
    return SE3(np.stack([right, np.cross(forward, right), forward], axis=1), eye)


@pytest.mark.parametrize("above", [(0.02, -0.05, 0.45), (-0.2, 0.15, 0.35)])
def test_board_corners_are_seen_where_the_truth_projects_them(
    truth: LabTruth, scene: LabScene, sensor: Sensor, above: tuple[float, float, float]
) -> None:
    spec = board_spec(BOARD)
    centre = truth.T_base_board.apply([spec.size_m[0] / 2, spec.size_m[1] / 2, 0.0])
    view = looking_at(centre, centre + above)
    raw = sensor.expose(scene.render(view), 1.0, 8, True, np.random.default_rng(0)).astype(np.uint8)
    found = detect_in_mosaic(raw, "colour", spec)
    assert found is not None
    assert len(found) > 40
    expected = truth.intrinsics.project(
        (view.inverse() @ truth.T_base_board).apply(spec.object_points(found.ids))
    )
    error = found.pixels - expected
    # A half-pixel mistake of grids or of the print would move every corner alike.
    assert np.abs(error.mean(axis=0)).max() < 0.05
    assert np.sqrt((error**2).sum(axis=1).mean()) < 0.12


def test_polished_steel_polarizes_as_fresnel_says_at_the_labs_own_index(sensor: Sensor) -> None:
    model = objects.build("knife")
    truth = sample_truth(6, "knife", model.refractive_index, board_spec(BOARD).size_m, model.resting)
    view, normals, rays, window, mask = object_view(truth, [0.05, -0.3, 0.2])
    _, mirror, phase = fresnel(normals, rays, truth.refractive_index)
    _, nominal, _ = fresnel(normals, rays, model.refractive_index)

    raw = sensor.expose(LabScene(truth).render(view), 0.5, 12, False, np.random.default_rng(1))
    stokes = decode(raw, "mono", 12, sensor.response)
    s0, s1, s2 = stokes.stack()[:, window[0], window[1]]
    seen = mask & stokes.valid[window] & (mirror > 0.1) & (mirror < 0.9)
    assert seen.sum() > 3000
    across = -(s1 * phase[0] + s2 * phase[1])[seen] / s0[seen]  # light off a mirror is turned by 90 degrees
    diagonal = (s2 * phase[0] - s1 * phase[1])[seen] / s0[seen]
    assert np.median(across / mirror[seen]) == pytest.approx(1.0, rel=5e-3)
    assert np.median(diagonal) == pytest.approx(0.0, abs=2e-3)
    # So precise that the index of the model file, a few percent off, would show.
    assert np.median(across / nominal[seen]) != pytest.approx(1.0, rel=1e-2)


def test_plastic_stays_between_body_and_mirror(truth: LabTruth, scene: LabScene) -> None:
    view, normals, rays, window, mask = object_view(truth, [0.2, 0.2, 0.15])
    body, mirror, phase = fresnel(normals, rays, truth.refractive_index)
    s0, s1, s2 = scene.render(view)[:, window[0], window[1]]
    seen = mask & (np.einsum("hwc,hwc->hw", normals, rays) < -0.05)
    along = ((s1 * phase[0] + s2 * phase[1]) / s0)[seen]
    assert (along <= body[seen] + 1e-3).all()
    assert (along >= -mirror[seen] - 1e-3).all()
    assert along.min() < -0.1
    assert (along > -mirror[seen] + 1e-4).any()


View = tuple[SE3, np.ndarray, np.ndarray, tuple[slice, slice], np.ndarray]


def object_view(truth: LabTruth, offset: list[float]) -> View:
    """T_base_cam of a camera `offset` from the object; the object's normals, rays, window and mask in it."""
    target = truth.T_base_object.apply(np.zeros(3)) + np.array([0.0, 0.0, 0.02])
    view = looking_at(target, target + np.array(offset))
    camera = truth.intrinsics.at(2)
    raster = rasterize(objects.build(truth.object_name).mesh, view.inverse() @ truth.T_base_object, camera)
    rays = camera.rays()[raster.window]
    normals = np.where(raster.mask[..., None], raster.normals, -rays)
    return view, normals, rays, raster.window, raster.mask


def fresnel(normals: np.ndarray, rays: np.ndarray, index: float) -> tuple[np.ndarray, ...]:
    """DoLP (h, w) of body and mirror reflection, and cos, sin of the doubled azimuth (2, h, w)."""
    n, r = (torch.from_numpy(np.moveaxis(field, -1, 0)).double()[None] for field in (normals, rays))
    body, mirror = physics.analytic_dolp(n, r, index)
    return body[0].numpy(), mirror[0].numpy(), physics.doubled_azimuth(n, r)[0].numpy()


def test_the_table_polarizes_across_the_plane_of_incidence(truth: LabTruth, scene: LabScene) -> None:
    bare = np.array([-0.4, 0.3, 0.0])
    view = looking_at(bare, bare + np.array([0.4, 0.0, 0.3]))
    s0, s1, s2 = scene.render(view)[:, 500:524, 600:624]
    # Looking along -x at a level table, the plane of incidence is upright: S1 is light along image right.
    assert (s1 / s0 > 0.02).all()
    assert np.abs(s2 / s0).max() < 0.02


def test_sensor_has_the_mean_and_the_variance_of_its_model() -> None:
    leaking = PolarizerResponse.of(1.0, 19.0, nominal_orientation(512, 640))  # efficiency 18/20
    sensor = Sensor(full_well=8000.0, read_noise=6.0, response=leaking)
    s0, s1, s2 = 0.8, 0.2, -0.1
    stokes = np.empty((3, 256, 320), np.float32)
    stokes[:] = np.array([s0, s1, s2])[:, None, None]
    raw = sensor.expose(stokes, 0.9, 12, False, np.random.default_rng(3)).astype(np.float64)
    for (row, column), degrees in {(0, 0): 90, (0, 1): 45, (1, 0): 135, (1, 1): 0}.items():
        angle = np.radians(degrees)
        light = 0.5 * 0.9 * (s0 + 0.9 * (s1 * np.cos(2 * angle) + s2 * np.sin(2 * angle)))
        variance = 4095**2 * (light / 8000 + (6 / 8000) ** 2) + 1 / 12
        seen = raw[row::2, column::2]
        assert seen.mean() == pytest.approx(4095 * light, abs=5 * np.sqrt(variance / seen.size))
        assert seen.var() == pytest.approx(variance, rel=0.03)


def test_sensor_clips_at_black_and_white_and_filters_colours() -> None:
    sensor = Sensor(1e9, 0.0, PolarizerResponse.ideal(8, 8), colour_gains=(0.5, 1.0, 0.25))
    stokes = np.zeros((3, 4, 4), np.float32)
    rng = np.random.default_rng(0)
    assert sensor.expose(stokes, 1.0, 8, True, rng).max() == 0
    stokes[0] = 0.8
    red, green, blue = sensor.expose(stokes, 1.0, 8, True, rng)[[0, 0, 2], [0, 2, 2]]
    assert (red, green, blue) == (51, 102, 26)
    stokes[0] = 10.0
    assert (sensor.expose(stokes, 1.0, 8, False, rng) == 255).all()


def test_noise_differs_from_frame_to_frame_and_row_to_row() -> None:
    sensor = Sensor(full_well=8000.0, read_noise=2.0, response=PolarizerResponse.ideal(256, 256))
    stokes = np.zeros((3, 128, 128), np.float32)
    stokes[0] = 1.0
    rng = np.random.default_rng(7)
    first, second = (sensor.expose(stokes, 0.8, 12, False, rng).astype(float) for _ in range(2))
    assert abs(np.corrcoef(first.ravel(), second.ravel())[0, 1]) < 0.05
    assert abs(np.corrcoef(first[:-2].ravel(), first[2:].ravel())[0, 1]) < 0.05
