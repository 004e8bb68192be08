"""Sizes the paper states, geometry of the pose heads, and the quick depthwise convolution against torch's."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Literal

import numpy as np
import pytest
import torch
import torch.nn.functional as F
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import nn

from s2p3 import presets
from s2p3.config import ExperimentConfig
from s2p3.inputs import channel_counts
from s2p3.networks import Teacher, build_student, build_teacher, detector, pose_head, pose_of
from s2p3.networks.depthwise import DepthwiseConv
from s2p3.networks.detector import Detector
from s2p3.networks.lite0 import Lite0, load_imagenet

IMAGE = np.random.default_rng(0).random((3, 128, 160), dtype=np.float32)
SIZES = [(64, 16), (128, 32), (128, 16), (256, 32)]


def parameters(network: nn.Module) -> int:
    return sum(parameter.numel() for parameter in network.parameters())


def sized(size: int, stride: Literal[16, 32]) -> ExperimentConfig:
    base = presets.fast()
    seen = replace(base.input, size=size, canonical_size=2 * size)
    return replace(base, input=seen, network=replace(base.network, total_stride=stride))


def test_the_networks_weigh_what_the_paper_says() -> None:
    assert parameters(build_teacher(presets.paper())) == pytest.approx(5.5e6, rel=0.01)
    assert parameters(build_student(presets.paper())) == pytest.approx(5.0e6, rel=0.01)


@pytest.mark.parametrize(("size", "stride"), SIZES)
def test_the_networks_predict_at_every_size(size: int, stride: Literal[16, 32]) -> None:
    polarization, priors = torch.randn(2, 7, size, size), torch.randn(2, 9, size, size)
    with torch.no_grad():
        output = build_teacher(sized(size, stride)).eval()(polarization, priors)
        pose = build_student(sized(size, stride)).eval()(polarization, priors)
    assert output.pose.shape == pose.shape == (2, 9)
    assert output.mask_logits.shape == (2, 1, size // 4, size // 4)
    assert output.coordinates.shape == output.normals.shape == (2, 3, size // 4, size // 4)
    torch.testing.assert_close(output.normals.norm(dim=1), torch.ones(2, size // 4, size // 4))


@pytest.mark.parametrize("modality", ["polarization", "rgb", "rgbd"])
def test_the_same_networks_run_as_baselines(modality: Literal["polarization", "rgb", "rgbd"]) -> None:
    base = presets.fast()
    config = replace(base, input=replace(base.input, modality=modality))
    images = [torch.randn(2, channels, 64, 64) for channels in channel_counts(config.input)]
    networks = (build_teacher(config), build_student(config))
    with torch.no_grad():
        assert all(pose_of(network.eval()(*images)).shape == (2, 9) for network in networks)
    weights = [parameters(network) for network in (build_teacher(base), build_student(base))]
    assert [parameters(network) for network in networks] == pytest.approx(weights, rel=0.01)


def test_the_large_student_is_the_teachers_network() -> None:
    base = presets.fast()
    large = build_student(replace(base, network=replace(base.network, student="large")))
    assert isinstance(large, Teacher)
    assert parameters(large) == parameters(build_teacher(base)) > parameters(build_student(base))


def test_every_packaged_weight_of_the_trunk_is_used() -> None:
    plain, loaded = Lite0(3), load_imagenet(Lite0(3))
    untouched = [
        name
        for (name, a), b in zip(plain.named_parameters(), loaded.parameters(), strict=True)
        if torch.equal(a, b)
    ]
    assert untouched == []
    assert parameters(loaded) == 2_958_848


def test_a_stem_of_many_channels_sees_a_grey_image_as_the_original_does() -> None:
    grey = torch.rand(1, 1, 32, 32)
    three, seven = load_imagenet(Lite0(3, 1)).eval(), load_imagenet(Lite0(7, 1)).eval()
    with torch.no_grad():
        expected = three(grey.expand(-1, 3, -1, -1))[0]
        torch.testing.assert_close(seven(grey.expand(-1, 7, -1, -1))[0], expected, atol=1e-4, rtol=1e-4)


@pytest.mark.parametrize("side", [2, 3, 4])
def test_the_quick_depthwise_convolution_is_the_ordinary_one(side: int) -> None:
    layer = DepthwiseConv(6, 5, 1).double()
    x = torch.randn(3, 6, side, side, dtype=torch.float64, requires_grad=True)
    expected = F.conv2d(x, layer.weight, padding=2, groups=6)
    torch.testing.assert_close(layer(x), expected)
    gradient = torch.randn_like(expected)
    wanted = torch.autograd.grad(expected, (x, layer.weight), gradient)
    found = torch.autograd.grad(layer(x), (x, layer.weight), gradient)
    torch.testing.assert_close(found, wanted)


@given(st.lists(st.floats(-2, 2), min_size=6, max_size=6))
@settings(max_examples=50, deadline=None)
def test_six_numbers_make_a_rotation(values: list[float]) -> None:
    columns = torch.tensor([values], dtype=torch.float64) + torch.tensor([3.0, 0, 0, 0, 3.0, 0])
    rotation = pose_head.rotation_from_6d(columns)[0]
    torch.testing.assert_close(rotation @ rotation.T, torch.eye(3, dtype=torch.float64))
    assert torch.linalg.det(rotation) == pytest.approx(1)


def test_the_allocentric_turn_takes_the_axis_onto_the_ray() -> None:
    translation = torch.tensor([[0.1, -0.2, 0.5], [0.0, 0.0, 1.0]], dtype=torch.float64)
    turn = pose_head.ray_rotation(translation)
    torch.testing.assert_close(turn[:, :, 2], F.normalize(translation, dim=1))
    torch.testing.assert_close(turn[1], torch.eye(3, dtype=torch.float64))
    trace = turn.diagonal(dim1=1, dim2=2).sum(1)
    angle = math.acos(0.5 / math.sqrt(0.3))
    assert trace[0] == pytest.approx(1 + 2 * math.cos(angle))  # the smallest such rotation


@given(st.floats(-0.1, 0.1), st.floats(-0.1, 0.1), st.floats(0.3, 1.5))
@settings(max_examples=50, deadline=None)
def test_scale_invariant_translation_is_inverted(x: float, y: float, z: float) -> None:
    K = torch.tensor([[[220.0, 0, 15], [0, 221.0, 40], [0, 0, 1]]], dtype=torch.float64)
    translation = torch.tensor([[x, y, z]], dtype=torch.float64)
    site = pose_head.site_from_translation(translation, K, 64, 0.14)
    back = pose_head.translation_from_site(site, K, 64, 0.14)
    torch.testing.assert_close(back, translation)


def test_zeros_decode_to_the_crops_centre_and_nominal_size() -> None:
    K = torch.tensor([[[200.0, 0, 31.5], [0, 200.0, 31.5], [0, 0, 1]]])
    rotation, translation, _ = pose_head.decode_pose(torch.zeros(1, 9), K, 64, 0.1)
    torch.testing.assert_close(rotation[0], torch.eye(3))
    depth = translation[0, 2]
    assert 200 * 0.1 / depth * pose_head.NOMINAL_ZOOM == pytest.approx(64)
    torch.testing.assert_close(translation[0, :2], torch.zeros(2))


class _Oracle(Detector):
    """Stands in for trained weights: answers with a given mask and the distances to its box."""

    def __init__(self, probability: torch.Tensor, box: tuple[float, float, float, float]) -> None:
        super().__init__(1, imagenet=False)
        self._probability, self._box = probability, box

    def forward(self, image: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        height, width = image.shape[2] // detector.CELL, image.shape[3] // detector.CELL
        logits = torch.full((1, 1, height, width), -9.0)
        logits[..., : self._probability.shape[0], : self._probability.shape[1]] = torch.logit(
            self._probability
        )
        y, x = torch.meshgrid(torch.arange(height) + 0.5, torch.arange(width) + 0.5, indexing="ij")
        left, top, right, bottom = self._box
        sides = torch.stack([2 * x - left, 2 * y - top, right - 2 * x, bottom - 2 * y])
        return logits, sides[None]


def test_a_detection_is_placed_in_the_full_image() -> None:
    probability = torch.full((16, 20), 0.01)
    probability[4:9, 6:13] = 0.95
    probability[14, 18] = 0.99  # a stray cell, smaller than the object
    network = _Oracle(probability, (12.0, 8.0, 26.0, 18.0))
    found = detector.detect(network, IMAGE, 4, 0.5, 0.5)
    assert found is not None
    np.testing.assert_allclose(found.box_xywh, [48, 32, 56, 40])
    assert found.mask.shape == (128, 160)
    assert found.mask[36:68, 52:100].all()
    assert not found.mask[100:].any()
    assert found.score == pytest.approx(0.95, abs=1e-3)


def test_nothing_is_detected_where_nothing_is() -> None:
    network = _Oracle(torch.full((16, 20), 0.01), (0.0, 0.0, 1.0, 1.0))
    assert detector.detect(network, IMAGE, 4, 0.5, 0.5) is None
