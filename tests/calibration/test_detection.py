"""Corners under polarized glare: found where the sum of all polarizer angles does not show them."""

import numpy as np
import pytest

from calibration import detection
from calibration.detection import detect_in_mosaic
from calibration.glare import GLARE_DOLP, glare, intensity, without_glare
from dataset.polarimetry import Stokes, quantize, sample_mosaic
from dataset.transforms import SE3


def _glossy(world, strength, angle_deg, seed=0):
    """A view of the board with a smooth blob of linearly polarized glare on it: mosaic and T_cam_board."""
    rng = np.random.default_rng(seed)
    centre = SE3(np.eye(3), -0.5 * np.array([*world.spec.size_m, 0.0]))
    T_cam_board = SE3.from_rotvec([0.25, -0.2, 0.1], [0.0, 0.0, 0.5]) @ centre
    plain = world.mosaic(T_cam_board, rng).astype(np.float32) / 255.0
    y, x = np.mgrid[: plain.shape[0], : plain.shape[1]].astype(np.float32)
    blob = strength * np.exp(-(((x - 1216) / 300) ** 2 + ((y - 1007) / 260) ** 2))
    angle = 2 * np.radians(angle_deg)
    stokes = Stokes(blob, 0.97 * blob * np.cos(angle), 0.97 * blob * np.sin(angle), np.ones(blob.shape, bool))
    glaring = sample_mosaic(stokes, "colour", blob.shape, colour_gains=(0.75, 1.0, 0.6))
    noise = rng.standard_normal(blob.shape, np.float32) * np.sqrt(1e-4 * glaring)
    return quantize(plain + glaring + noise, 8), T_cam_board


def _errors(world, found, T_cam_board):
    truth = world.intrinsics.project(T_cam_board.apply(world.spec.object_points(found.ids)))
    return np.linalg.norm(found.pixels - truth, axis=1)


def _on_s0_only(monkeypatch, raw, spec):
    with monkeypatch.context() as patched:
        patched.setattr(detection, "GLARE_DOLP", 2.0)
        return detect_in_mosaic(raw, "colour", spec)


@pytest.mark.parametrize("angle_deg", [30.0, 90.0])
def test_saturated_glare_costs_no_corner(world, monkeypatch, angle_deg):
    raw, T_cam_board = _glossy(world, 3.0, angle_deg)
    alone = _on_s0_only(monkeypatch, raw, world.spec)
    found = detect_in_mosaic(raw, "colour", world.spec)
    assert found is not None
    assert len(found) == world.spec.corner_count
    assert alone is None or len(alone) < world.spec.corner_count
    errors = _errors(world, found, T_cam_board)
    assert np.sqrt(np.mean(errors**2)) < 0.15
    assert errors.max() < 0.6


def test_without_glare_s0_is_used_alone_and_is_the_most_accurate(world):
    raw, T_cam_board = _glossy(world, 0.0, 0.0)
    found = detect_in_mosaic(raw, "colour", world.spec)
    assert glare(raw, np.ones((1024, 1224), bool)) < 0.7 * GLARE_DOLP  # its own edges are no glare
    assert np.sqrt(np.mean(_errors(world, found, T_cam_board) ** 2)) < 0.1


def test_every_channel_lies_where_its_pixels_are():
    """A ramp over the mosaic is the same ramp in each channel, half-pixel shifts included."""
    ramp = (np.arange(64)[None, :] + 2 * np.arange(48)[:, None]).astype(np.uint16)
    for channel in [intensity(ramp), *without_glare(ramp)[1:]]:
        rows, columns = np.mgrid[: channel.image.shape[0], : channel.image.shape[1]]
        xy = channel.to_mosaic(np.stack([columns, rows], -1).astype(float))
        np.testing.assert_allclose(channel.image, xy[..., 0] + 2 * xy[..., 1])
        np.testing.assert_allclose(channel.from_mosaic(xy), np.stack([columns, rows], -1))
