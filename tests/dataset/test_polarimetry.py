"""Polarimetry: the mosaics' layout, Malus' law, round trips, and real sensor data."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from dataset import ToolkitError
from dataset.frames import Mosaic
from dataset.polarimetry import (
    ANGLES_DEG,
    Stokes,
    decode,
    encode,
    quantize,
    remap,
    sample_mosaic,
    split_angles,
    split_colours,
    superpixel,
)
from dataset.polarizer_response import POLARIZER_CELL

PICTURES = Path(__file__).parents[3] / "shared" / "data"

layouts = pytest.mark.parametrize("layout", ["mono", "colour"])


def uniform(dolp: float, aolp_deg: float, s0: float = 1.0, shape: tuple[int, int] = (3, 5)) -> Stokes:
    double = 2 * np.deg2rad(aolp_deg)
    values = [s0, s0 * dolp * np.cos(double), s0 * dolp * np.sin(double)]
    s0_, s1, s2 = (np.full(shape, value, np.float32) for value in values)
    return Stokes(s0_, s1, s2, np.ones(shape, dtype=bool))


def random_stokes(shape: tuple[int, int], seed: int = 0) -> Stokes:
    rng = np.random.default_rng(seed)
    s0 = rng.uniform(0.2, 0.9, shape).astype(np.float32)
    polarized, double = s0 * rng.uniform(0, 0.95, shape), 2 * rng.uniform(0, np.pi, shape)
    s1, s2 = (polarized * np.cos(double)).astype(np.float32), (polarized * np.sin(double)).astype(np.float32)
    return Stokes(s0, s1, s2, np.ones(shape, dtype=bool))


def test_the_colour_super_pixel_is_polarsens() -> None:
    """A mosaic that numbers its own sites comes apart as the data sheet draws it."""
    sheet = ["R90 R45 G90 G45", "R135 R0 G135 G0", "G90 G45 B90 B45", "G135 G0 B135 B0"]
    value = {"R": 100, "G": 200, "B": 300}
    raw = np.array([[value[s[0]] + int(s[1:]) for s in row.split()] for row in sheet], dtype=np.uint16)
    raw = np.tile(raw, (2, 3))
    colours = split_colours(raw)
    assert colours.shape == (4, 2, 3, 3)
    for i, angle in enumerate(ANGLES_DEG):
        np.testing.assert_array_equal(colours[i, 1, 2], [100 + angle, 200 + angle, 300 + angle])
    angles = split_angles(raw)
    assert angles.shape == (4, 4, 6)
    for i, angle in enumerate(ANGLES_DEG):
        np.testing.assert_array_equal(
            angles[i, :2, :2], [[100 + angle, 200 + angle], [200 + angle, 300 + angle]]
        )


def test_green_is_the_mean_of_both_green_pixels() -> None:
    raw = np.zeros((4, 4), np.uint8)
    raw[0, 2], raw[2, 0] = 10, 21  # G90 twice
    assert split_colours(raw)[2, 0, 0].tolist() == [0, 15.5, 0]


@layouts
@pytest.mark.parametrize("aolp_deg", [0, 30, 45, 90, 120, 135, 179])
def test_malus_law_reaches_every_polarizer(layout: Mosaic, aolp_deg: float) -> None:
    raw = sample_mosaic(uniform(0.6, aolp_deg), layout)
    for row in range(2):
        for column in range(2):
            angle = POLARIZER_CELL[row][column]
            expected = 0.5 * (1 + 0.6 * np.cos(2 * np.deg2rad(angle - aolp_deg)))
            np.testing.assert_allclose(raw[row::2, column::2], expected, atol=1e-6)


@settings(derandomize=True, deadline=None, max_examples=60)
@given(dolp=st.floats(0.01, 1), aolp_deg=st.floats(0, 179.9), s0=st.floats(0.05, 2))
def test_dolp_and_aolp_are_recovered(dolp: float, aolp_deg: float, s0: float) -> None:
    stokes = Stokes.from_angles(uniform(dolp, aolp_deg, s0).angles())
    np.testing.assert_allclose(stokes.s0, s0, rtol=1e-5)
    np.testing.assert_allclose(stokes.dolp, dolp, atol=1e-5)
    difference = np.rad2deg(stokes.aolp) - aolp_deg
    np.testing.assert_allclose((difference + 90) % 180 - 90, 0, atol=2e-2)


def test_aolp_is_within_its_interval_and_dark_is_unpolarized() -> None:
    s1, s2 = np.array([[1, -1, 1, 1, 0]], np.float32), np.array([[-1e-12, -1e-12, 0, 1e-12, 0]], np.float32)
    stokes = Stokes(np.array([[1, 1, 1, 0.5, 0]], np.float32), s1, s2, np.ones((1, 5), dtype=bool))
    assert np.all((stokes.aolp >= 0) & (stokes.aolp < np.pi))
    np.testing.assert_allclose(stokes.dolp, [[1, 1, 1, 1, 0]])


def test_stack_and_angles_are_consistent() -> None:
    stokes = random_stokes((6, 4))
    assert stokes.shape == (6, 4)
    assert stokes.stack().shape == (3, 6, 4)
    i0, i45, i90, i135 = stokes.angles()
    np.testing.assert_allclose(i0 + i90, i45 + i135, atol=1e-6)
    assert stokes.angles().dtype == np.float32


@layouts
@pytest.mark.parametrize("bits", [8, 10, 12, 16])
def test_a_mosaic_round_trips(layout: Mosaic, bits: int) -> None:
    stokes = random_stokes((8, 10))
    raw = encode(stokes, layout, bits)
    assert raw.shape == (8 * superpixel(layout), 10 * superpixel(layout))
    assert raw.dtype == (np.uint8 if bits == 8 else np.uint16)
    found = decode(raw, layout, bits)
    assert found.valid.all()
    step = 1.01 / ((1 << bits) - 1) + 1e-6  # each reading is rounded by up to half a count
    np.testing.assert_allclose(found.stack(), stokes.stack(), atol=step)


def least_squares(angles: np.ndarray) -> np.ndarray:
    """(4, h, w) intensities to (3, h, w) Stokes, as a matrix: Malus' law for the four angles, inverted."""
    double = 2 * np.deg2rad(ANGLES_DEG)
    malus = 0.5 * np.stack([np.ones(4), np.cos(double), np.sin(double)], axis=1)
    return np.tensordot(np.linalg.pinv(malus), angles, axes=1)


@layouts
@pytest.mark.parametrize("bits", [8, 12, 16])
@pytest.mark.parametrize("columns", [4, 48, 140])
def test_the_fast_decoder_equals_the_plain_one(layout: Mosaic, bits: int, columns: int) -> None:
    white = (1 << bits) - 1
    rng = np.random.default_rng(bits)
    raw = rng.integers(0, int(0.993 * white), (32, columns)).astype(np.uint8 if bits == 8 else np.uint16)
    near = rng.random(raw.shape) < 0.1  # the limit, one below it, and white
    raw[near] = rng.choice([int(np.ceil(0.995 * white)) - 1, int(np.ceil(0.995 * white)), white], near.sum())
    angles = split_angles(raw).astype(np.float64) / white
    if layout == "colour":
        angles = angles.reshape(4, 8, 2, columns // 4, 2).mean(axis=(2, 4))
    expected = least_squares(angles)
    found = decode(raw, layout, bits)
    np.testing.assert_allclose(found.stack(), expected, atol=2e-6)
    size = superpixel(layout)
    peak = raw.reshape(32 // size, size, columns // size, size).max(axis=(1, 3))
    np.testing.assert_array_equal(found.valid, (peak < 0.995 * white) & (expected[0] >= 0.01))
    np.testing.assert_allclose(Stokes.from_angles(angles).stack(), expected, atol=2e-6)


def test_eight_bits_that_count_as_twelve_are_never_saturated() -> None:
    assert decode(np.full((8, 8), 255, np.uint8), "colour", 12).valid.all()


@pytest.mark.parametrize("shape", [(3, 4, 4), (4, 4), (5, 4, 4)])
def test_angle_images_are_four(shape: tuple[int, ...]) -> None:
    with pytest.raises(ToolkitError, match=r"\(4, h, w\)"):
        Stokes.from_angles(np.zeros(shape))


def test_read_only_strided_and_unaligned_mosaics_decode() -> None:
    raw = np.random.default_rng(0).integers(0, 255, (16, 16)).astype(np.uint8)
    wide = np.repeat(raw, 2, axis=1)[:, ::2]
    wide.flags.writeable = False
    odd = np.zeros(raw.size + 1, np.uint8)[1:].reshape(raw.shape)  # as in a buffer behind a header
    odd[:] = raw
    for layout in ("mono", "colour"):
        expected = decode(raw, layout, 8).stack()
        for other in (wide, odd):
            np.testing.assert_array_equal(decode(other, layout, 8).stack(), expected)


@layouts
def test_saturated_and_dark_cells_are_not_valid(layout: Mosaic) -> None:
    raw = encode(uniform(0.2, 30, shape=(2, 3)), layout, 12)
    raw[0, 0] = 4095
    size = superpixel(layout)
    raw[size:, 2 * size :] = 3
    assert decode(raw, layout, 12).valid.tolist() == [[False, True, True], [True, True, False]]


def test_a_finer_stokes_image_lights_each_pixel_on_its_own() -> None:
    full = random_stokes((16, 24))
    raw = sample_mosaic(full, "mono", shape=(16, 24))
    np.testing.assert_allclose(raw[1, 1], 0.5 * (full.s0[1, 1] + full.s1[1, 1]), atol=1e-6)
    np.testing.assert_allclose(raw[0, 1], 0.5 * (full.s0[0, 1] + full.s2[0, 1]), atol=1e-6)
    cells = random_stokes((8, 12))
    colour = decode(encode(cells, "colour", 16, shape=(16, 24)), "colour", 16)
    np.testing.assert_allclose(colour.s0, cells.s0.reshape(4, 2, 6, 2).mean(axis=(1, 3)), atol=1e-4)


def test_colour_gains_scale_the_bayer_pixels() -> None:
    raw = encode(uniform(0, 0), "colour", 16, colour_gains=(0.5, 1.0, 0.25))
    np.testing.assert_allclose(split_colours(raw)[0, 0, 0] / 65535, [0.25, 0.5, 0.125], atol=1e-4)
    mono = encode(uniform(0, 0), "mono", 16, colour_gains=(0.5, 1.0, 0.25))
    assert np.ptp(mono) == 0


def test_quantization_clips() -> None:
    assert quantize(np.array([[-0.5, 0.5, 2.0]], np.float32), 8).tolist() == [[0, 128, 255]]


def test_remap_moves_pixels_and_spreads_invalidity() -> None:
    stokes = random_stokes((8, 10))
    stokes.valid[4, 5] = False
    columns, rows = np.meshgrid(np.arange(10, dtype=np.float32), np.arange(8, dtype=np.float32))
    same = remap(stokes, columns, rows)
    np.testing.assert_allclose(same.stack(), stokes.stack(), atol=1e-6)
    np.testing.assert_array_equal(same.valid, stokes.valid)
    half = remap(stokes, columns + 0.5, rows)
    np.testing.assert_allclose(half.s1[:, :-1], 0.5 * (stokes.s1[:, :-1] + stokes.s1[:, 1:]), atol=1e-6)
    assert not half.valid[4, 4]
    assert not half.valid[4, 5]
    assert not half.valid[:, -1].any()


@pytest.mark.parametrize(
    ("raw", "layout", "message"),
    [
        (np.zeros((6, 8), np.uint8), "colour", "whole 4x4 super-pixels"),
        (np.zeros((5, 8), np.uint8), "mono", "whole 2x2 super-pixels"),
        (np.zeros((4, 4, 3), np.uint8), "mono", "got shape"),
        (np.zeros((0, 4), np.uint8), "mono", "got shape"),
        (np.zeros((4, 4), np.float32), "mono", "float32"),
        (np.zeros((4, 4), np.uint8), "quad", "'quad' is unknown"),
    ],
)
def test_what_is_no_mosaic_is_refused(raw: np.ndarray, layout: Mosaic, message: str) -> None:
    with pytest.raises(ToolkitError, match=message):
        decode(raw, layout, 8)


def test_a_mosaic_that_is_no_multiple_is_refused() -> None:
    with pytest.raises(ToolkitError, match="no whole multiple"):
        sample_mosaic(uniform(0, 0, shape=(3, 3)), "mono", shape=(8, 8))


@pytest.mark.parametrize(("name", "residual"), [("camera", 4.53), ("fruits", 3.12)])
def test_real_sensor_pictures_decode(name: str, residual: float) -> None:
    """An IMX250MZR's raw pictures: the two orthogonal pairs measure the same light to a few counts."""
    path = PICTURES / f"{name}_IMX250MZR.png"
    if not path.exists():
        pytest.skip(f"the raw pictures are not at {PICTURES}")
    raw = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
    i0, i45, i90, i135 = split_angles(raw).astype(np.float64)
    assert np.abs(i0 + i90 - i45 - i135).mean() == pytest.approx(residual, abs=0.01)
    # any other assignment of the angles breaks that balance
    assert np.abs(i0 + i45 - i90 - i135).mean() > 2 * residual
    stokes = decode(raw, "mono", 8)
    assert stokes.shape == (1024, 1224)
    assert stokes.valid.mean() > 0.5
    assert 0.01 < np.median(stokes.dolp[stokes.valid]) < 0.5
