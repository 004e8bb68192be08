"""Whole pictures: the priors of a mosaic in bands are those of its Stokes image."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from dataset import ToolkitError
from dataset.frames import Mosaic
from dataset.polarimetry import Stokes, decode, superpixel
from s2p3 import physics
from s2p3.image_priors import angle_priors, mosaic_priors

K = np.array([[90.0, 0, 15.3], [0, 88.0, 31.8], [0, 0, 1]])


def _whole(stokes: Stokes, index: float) -> np.ndarray:
    return physics.shape_priors(torch.from_numpy(stokes.stack())[None], index, torch.tensor(K)[None])[
        0
    ].numpy()


@pytest.mark.parametrize("height", [1, 32, 75])
@pytest.mark.parametrize(("layout", "bits"), [("mono", 12), ("colour", 8), ("colour", 12)])
def test_a_mosaic_has_the_priors_of_its_stokes_image(layout: Mosaic, bits: int, height: int) -> None:
    size = superpixel(layout)
    shape = (size * height, size * 37)
    raw = np.random.default_rng(0).integers(0, 1 << bits, shape).astype(np.uint8 if bits == 8 else np.uint16)
    raw[:size] = 0
    maps, valid = mosaic_priors(raw, layout, bits, 1.5, K)
    stokes = decode(raw, layout, bits)
    np.testing.assert_array_equal(maps, _whole(stokes, 1.5))
    np.testing.assert_array_equal(valid, stokes.valid)
    assert not valid[0].any()


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_angle_images_have_the_priors_of_their_stokes_image(dtype: type) -> None:
    angles = np.random.default_rng(1).random((4, 70, 37)).astype(dtype)
    out = np.empty((9, 70, 37), np.float32)
    assert angle_priors(angles, 2.75, K, out) is out
    np.testing.assert_array_equal(out, _whole(Stokes.from_angles(angles), 2.75))


def test_what_has_no_priors_is_refused() -> None:
    raw = np.zeros((8, 8), np.uint8)
    for out in (np.empty((9, 2, 3), np.float32), np.empty((9, 2, 2)), np.empty((2, 2, 9), np.float32).T):
        with pytest.raises(ToolkitError, match="contiguous float32"):
            mosaic_priors(raw, "colour", 8, 1.5, K, out)
    with pytest.raises(ToolkitError, match="whole 4x4"):
        mosaic_priors(raw[:7], "colour", 8, 1.5, K)
    with pytest.raises(ToolkitError, match=r"\(4, h, w\)"):
        angle_priors(np.zeros((3, 4, 4)), 1.5, K)
    with pytest.raises(ToolkitError, match="refractive index"):
        mosaic_priors(raw, "colour", 8, 0.9, K)
