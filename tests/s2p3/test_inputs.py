"""Crops keep their geometry, and what augmentation does to them is what a turned camera would have seen."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from dataset import SE3, Intrinsics
from s2p3 import inputs, physics
from s2p3.config import AugmentationConfig, InputConfig
from s2p3.inputs import View
from s2p3.objects import ObjectModel
from tests.s2p3.conftest import shade

CANONICAL, ZOOM = 96, 1.9
CAMERA = Intrinsics(np.array([[430.0, 0, 300], [0, 432.0, 250], [0, 0, 1]]), np.zeros(0), 512, 612)


@pytest.mark.parametrize(
    "box", [(100.0, 80.0, 96.0, 96.0), (201.3, 150.7, 130.0, 130.0), (-20.0, -15.0, 90.0, 90.0)]
)
def test_a_crop_lies_on_the_grid_its_intrinsics_say(box: tuple[float, ...]) -> None:
    x, y = np.meshgrid(np.arange(612.0), np.arange(512.0))
    crop = inputs.extract_crop(np.stack([x, y]).astype(np.float32), box, 48)
    K = inputs.crop_intrinsics(CAMERA, box, 48)
    pixels = np.stack(np.meshgrid(np.arange(48.0), np.arange(48.0)))
    expected = (
        (pixels - K[:2, 2, None, None]) / K[[0, 1], [0, 1], None, None] * CAMERA.K[[0, 1], [0, 1], None, None]
    )
    expected += CAMERA.K[:2, 2, None, None]
    inside = (expected > 1).all(0) & (expected[0] < 610) & (expected[1] < 510)
    np.testing.assert_allclose(crop[:, inside], expected[:, inside], atol=0.02)


@given(
    zoom=st.floats(1.1, 1.7),
    shift=st.tuples(st.floats(-0.2, 0.2), st.floats(-0.2, 0.2)),
    angle=st.floats(-math.pi, math.pi),
    offset=st.tuples(st.floats(-0.03, 0.03), st.floats(-0.03, 0.03)),
)
@settings(max_examples=50, deadline=None)
def test_a_view_is_the_image_of_a_turned_camera(
    zoom: float, shift: tuple[float, float], angle: float, offset: tuple[float, float]
) -> None:
    region = inputs.square_box((350.0, 120.0, 90.0, 70.0), ZOOM)
    K = torch.from_numpy(inputs.crop_intrinsics(CAMERA, region, CANONICAL)).double()[None]
    view = View(torch.tensor([zoom]).double(), torch.tensor([shift]).double(), torch.tensor([angle]).double())
    window = inputs.window(view, K, CANONICAL, ZOOM, 64)
    ray = CAMERA.rays(np.array([395.0, 155.0]))
    point = torch.from_numpy(0.5 * ray + np.array([*offset, 0.01]))
    before = (K[0] @ point)[:2] / point[2]
    turned = window.rotation[0] @ point
    after = ((window.K[0] @ turned)[:2] / turned[2]).numpy()
    x, y = np.clip(np.floor(after).astype(int), 0, 62)
    source = window.source[0, y, x] + (after[0] - x) * (window.source[0, y, x + 1] - window.source[0, y, x])
    source = source + (after[1] - y) * (window.source[0, y + 1, x] - window.source[0, y, x])
    torch.testing.assert_close(source, before, atol=1e-4, rtol=0)


@pytest.mark.parametrize("angle", [0.4, -1.1])
def test_a_turned_stokes_image_is_that_of_the_turned_object(cup: ObjectModel, angle: float) -> None:
    camera = Intrinsics(np.array([[330.0, 0, 63.5], [0, 330.0, 63.5], [0, 0, 1]]), np.zeros(0), 128, 128)
    rng = np.random.default_rng(0)
    pose = SE3.from_rotvec(np.array([1.9, 0.3, 0.2]), np.array([0.01, 0.0, 0.45]))
    turn = SE3.from_rotvec(np.array([0.0, 0.0, angle]), np.zeros(3))
    original, _ = shade(cup, pose, camera, rng)
    expected, mask = shade(cup, turn @ pose, camera, rng)
    K = torch.tensor(camera.K.tolist())[None]
    view = View(torch.tensor([ZOOM]), torch.zeros(1, 2), torch.tensor([angle]))
    window = inputs.window(view, K, 128, ZOOM, 128)
    seen = inputs.rotate_stokes(window.resample(torch.from_numpy(original)[None]), view.angle)[0].numpy()
    inner = mask[4:-4, 4:-4]
    error = np.abs(seen - expected)[:, 4:-4, 4:-4][:, inner]
    assert np.median(error[1:]) < 0.004
    wrong = inputs.rotate_stokes(torch.from_numpy(seen)[None], torch.tensor([-2 * angle]))[0].numpy()
    assert np.median(np.abs(wrong - expected)[1:, 4:-4, 4:-4][:, inner]) > 0.03


def test_normals_and_priors_turn_together() -> None:
    generator = torch.Generator().manual_seed(0)
    stokes = torch.cat([torch.ones(1, 1, 8, 8), 0.2 * torch.randn(1, 2, 8, 8, generator=generator)], dim=1)
    K = torch.tensor([[[1e5, 0, 3.5], [0, 1e5, 3.5], [0, 0, 1.0]]])
    angle = torch.tensor([0.7])
    turned = physics.shape_priors(inputs.rotate_stokes(stokes, angle), 1.5, K)[:, :3]
    rotation = View(torch.ones(1), torch.zeros(1, 2), angle).rotation
    expected = torch.einsum("bij,bjhw->bihw", rotation, physics.shape_priors(stokes, 1.5, K)[:, :3])
    azimuth_apart = (turned[:, :2] * expected[:, :2]).sum(1).abs() - expected[:, :2].norm(dim=1) ** 2
    assert azimuth_apart.abs().max() < 1e-3  # parallel up to the sign that polarization cannot tell


def test_photometric_augmentation_obeys_malus_law() -> None:
    generator = torch.Generator().manual_seed(1)
    stokes = inputs.stokes_from_intensities(torch.rand(4, 4, 16, 16, generator=generator) + 0.2)
    quiet = AugmentationConfig(noise=0.0)
    angles = inputs.intensities(inputs.augment_photometry(stokes, quiet, generator))
    torch.testing.assert_close(angles[:, 0] + angles[:, 2], angles[:, 1] + angles[:, 3])
    torch.testing.assert_close(inputs.stokes_from_intensities(inputs.intensities(stokes)), stokes)


def test_exposure_drops_out() -> None:
    stokes = torch.tensor([1.0, 0.2, -0.1]).view(1, 3, 1, 1) * torch.rand(1, 1, 8, 8)
    K = torch.tensor([[[100.0, 0, 3.5], [0, 100.0, 3.5], [0, 0, 1.0]]])
    dim, bright = (
        inputs.network_channels(inputs.normalize_exposure(stokes * gain), K, 1.5, InputConfig())
        for gain in (0.3, 2.0)
    )
    torch.testing.assert_close(dim[0], bright[0])
    torch.testing.assert_close(dim[1], bright[1], atol=1e-4, rtol=0)


@pytest.mark.parametrize(("aolp", "channels"), [("double_angle", 7), ("angle", 6)])
def test_channels_are_finite_and_as_many_as_said(aolp: str, channels: int) -> None:
    config = InputConfig(aolp=aolp)  # type: ignore[arg-type]
    stokes = torch.zeros(1, 3, 8, 8)
    stokes[0, 0, 4:] = 1
    stokes[0, 1, 6:] = 1
    seen = inputs.polarization_channels(stokes, config)
    assert (seen.shape[1], 9) == (channels, 9) == inputs.channel_counts(config)
    assert seen.isfinite().all()
    assert seen[0, 4, 7, 7] == 1


def test_a_masked_background_reaches_only_the_intensities() -> None:
    stokes = inputs.stokes_from_intensities(torch.rand(1, 4, 8, 8))
    K = torch.tensor([[[100.0, 0, 3.5], [0, 100.0, 3.5], [0, 0, 1.0]]])
    mask = torch.zeros(1, 1, 8, 8)
    mask[..., :4] = 1
    polarization, priors = inputs.network_channels(stokes, K, 1.5, InputConfig(background="mask"), mask)
    assert not priors[..., 4:].any()
    assert not polarization[:, 4:, :, 4:].any()
    assert polarization[:, :4, :, 4:].any()


def test_without_polarization_both_encoders_see_the_intensity() -> None:
    stokes = inputs.stokes_from_intensities(torch.rand(2, 4, 8, 8))
    K = torch.eye(3).expand(2, -1, -1)
    config = InputConfig(modality="rgb")
    first, second = inputs.network_channels(stokes, K, 1.5, config)
    assert (first.shape[1], second.shape[1]) == inputs.channel_counts(config)
    torch.testing.assert_close(first[:, 0], inputs.intensities(stokes).mean(1))
    assert torch.equal(first, second)
    unpolarized = torch.cat([stokes[:, :1], torch.zeros_like(stokes[:, 1:])], dim=1)
    assert torch.equal(first, inputs.network_channels(unpolarized, K, 1.5, config)[0])


def test_depth_reaches_the_second_encoder_as_relief_and_distance() -> None:
    stokes = inputs.stokes_from_intensities(torch.rand(1, 4, 8, 8))
    K = torch.tensor([[[100.0, 0, 3.5], [0, 100.0, 3.5], [0, 0, 1.0]]])
    depth = torch.full((1, 1, 8, 8), 0.5)
    depth[..., 0, 0], depth[..., 1, 1] = 0.0, 0.55
    config = InputConfig(modality="rgbd")
    first, second = inputs.network_channels(stokes, K, 1.5, config, depth=depth)
    assert (first.shape[1], second.shape[1]) == inputs.channel_counts(config)
    relief, distance, known = second[0]
    assert known.sum() == 63
    assert distance[0, 0] == pytest.approx(0.5 * 8 / 100)  # the crop is so wide there
    assert relief[1, 1] == pytest.approx(0.05 * 8 / 100)
    assert relief.count_nonzero() == 1
    assert not inputs.depth_channels(torch.zeros(1, 1, 8, 8), K).any()
    mask = torch.zeros(1, 1, 8, 8)
    config = InputConfig(modality="rgbd", background="mask")
    assert not inputs.network_channels(stokes, K, 1.5, config, mask, depth)[1].any()
