"""The polarizers' calibration: what it gains, how the mosaic lies, and pictures that cannot tell."""

import numpy as np
import pytest

from calibration.polarizer import calibrate_polarizer, fit_response
from calibration.polarizer_states import States
from dataset.errors import CalibrationError
from dataset.polarimetry import decode, quantize
from dataset.polarizer_response import PolarizerResponse, nominal_orientation

SIZE = (96, 128)
WELL, READ_NOISE, BITS = 10_000.0, 2.5, 12
ANGLES = np.radians(np.arange(72) * 5.0)


@pytest.fixture(scope="module")
def sensor():
    """Extinction ratios 50-300, orientations off by 1 degree, gains by 2 %."""
    rng = np.random.default_rng(1)
    orientation = nominal_orientation(*SIZE) + rng.normal(0, np.radians(1), SIZE)
    return PolarizerResponse.of(rng.normal(1, 0.02, SIZE), rng.uniform(50, 300, SIZE), orientation)


def lamp(colour=False):
    """(H, W) level of a lamp that is darker in the corners, seen through the colour filters."""
    y, x = np.mgrid[-1 : 1 : SIZE[0] * 1j, -1 : 1 : SIZE[1] * 1j]
    level = 0.75 * (1 - 0.15 * (x**2 + 0.5 * y**2))
    if colour:
        row, column = np.indices(SIZE) // 2 % 2
        level = level * np.array([0.8, 1.0, 0.7])[row + column]
    return level


def expose(sensor, stokes, light, rng):
    """A picture of 12 bits with shot and read noise."""
    electrons = WELL * np.clip(light * (sensor.analysis @ np.asarray(stokes, float)), 0, None)
    noisy = rng.poisson(electrons) + rng.normal(0, READ_NOISE, SIZE)
    return quantize((noisy / WELL).astype(np.float32), BITS)


def turned(sensor, angles=ANGLES, light=None, seed=0, levels=None):
    rng = np.random.default_rng(seed)
    light = lamp() if light is None else light
    levels = np.ones(len(angles)) if levels is None else levels
    return [
        expose(sensor, level * np.array([1, np.cos(2 * a), np.sin(2 * a)]), light, rng)
        for a, level in zip(angles, levels, strict=True)
    ]


@pytest.fixture(scope="module")
def frames(sensor):
    return turned(sensor)


def dolp_error(sensor, response, layout, light, dolp, frames=64):
    """RMS error of the DoLP on the mean of several pictures: what stays when shot noise averages out."""
    rng = np.random.default_rng(9)
    stokes = [1.0, dolp * np.cos(0.7), dolp * np.sin(0.7)]
    mean = np.mean([expose(sensor, stokes, light, rng) for _ in range(frames)], axis=0)
    seen = decode(quantize((mean / (2**BITS - 1)).astype(np.float32), 16), layout, 16, response)
    true = np.full(SIZE, dolp)[: seen.shape[0], : seen.shape[1]]
    return float(np.sqrt(np.mean((seen.dolp - true) ** 2)))


@pytest.mark.parametrize("dolp", [0.2, 0.6])
def test_the_error_of_the_dolp_falls_fivefold(sensor, frames, dolp):
    response = calibrate_polarizer(frames, "mono", BITS).response
    before, after = (dolp_error(sensor, r, "mono", lamp(), dolp) for r in (None, response))
    assert before > 0.01
    assert after < before / 5


def test_behind_colour_filters_too(sensor):
    light = lamp(colour=True)
    response = calibrate_polarizer(turned(sensor, light=light), "colour", BITS).response
    assert response.gain.std() == pytest.approx(0.02, rel=0.15)  # the filters are no gain of the pixels
    before, after = (dolp_error(sensor, r, "colour", light, 0.5) for r in (None, response))
    assert after < before / 5


@pytest.mark.parametrize("angles", [None, ANGLES, ANGLES + 0.05, np.full(72, np.nan)])
def test_every_pixel_is_found_within_its_error_bar_with_and_without_a_dial(sensor, frames, angles):
    result = calibrate_polarizer(frames, "mono", BITS, angles)
    off = result.response.analysis - sensor.analysis
    assert 0.6 < off[..., 1:].std() / result.sigma < 1.3
    assert np.abs(off.mean(axis=(0, 1))).max() < 3e-4
    assert result.warnings == ()
    assert result.states.turn_deg == pytest.approx(5.0, abs=0.01)
    np.testing.assert_allclose(np.mod(result.states.angle - ANGLES + 0.1, np.pi) - 0.1, 0, atol=1e-3)


def test_a_flickering_lamp_does_no_harm_and_is_told(sensor):
    levels = 1 + 0.06 * np.random.default_rng(2).standard_normal(72)
    result = calibrate_polarizer(turned(sensor, levels=0.8 * levels), "mono", BITS, ANGLES)
    assert "changed by 6 %" in result.warnings[0]
    assert (result.response.analysis - sensor.analysis)[..., 1:].std() < 1.4 * result.sigma


@pytest.mark.parametrize(
    ("change", "angles", "words"),
    [
        (
            lambda raw: raw[:, ::-1],
            ANGLES,
            "45 90 / 0 135 instead of 90 45 / 135 0; 45 and",
        ),
        (lambda raw: raw[::-1], ANGLES, "45 and 135 degrees are swapped"),
        (lambda raw: raw, -ANGLES, "90 135 / 45 0 instead .* the dial was read clockwise"),
        (lambda raw: raw[::-1, ::-1], ANGLES, "all are turned by 90 degrees: the image is rotated"),
        (lambda raw: raw, ANGLES + np.radians(20), "dial's zero is -20 degrees off"),
    ],
)
def test_a_mosaic_that_lies_otherwise_is_found_and_told(frames, change, angles, words):
    changed = [np.ascontiguousarray(change(raw)) for raw in frames]
    result = calibrate_polarizer(changed, "mono", BITS, angles)
    assert len(result.warnings) == 1
    with pytest.raises(AssertionError, match=words):
        raise AssertionError(result.warnings[0])


def test_known_states_do_as_well_as_a_turned_polarizer(sensor):
    states = np.array(
        [[1, 0, 0], [1, 0.9, 0], [1, -0.5, 0.7], [1, -0.5, -0.7], [0.8, 0.1, 0.6], [1, 0, -0.8]] * 6
    )
    rng = np.random.default_rng(4)
    pictures = [expose(sensor, state, lamp(), rng) for state in states]
    result = fit_response(pictures, States.known(states), "mono", BITS)
    assert 0.4 < (result.response.analysis - sensor.analysis)[..., 1:].std() / result.sigma < 1.3


def test_a_poor_polarizer_is_not_blamed_on_the_sensor(sensor):
    contrast = (20 - 1) / (20 + 1)
    rng = np.random.default_rng(5)
    pictures = [
        expose(sensor, [1, contrast * np.cos(2 * a), contrast * np.sin(2 * a)], lamp(), rng) for a in ANGLES
    ]
    result = calibrate_polarizer(pictures, "mono", BITS, extinction_ratio=20.0)
    assert np.abs((result.response.analysis - sensor.analysis).mean(axis=(0, 1))).max() < 3e-4


def test_dead_pixels_are_left_out(sensor, frames):
    broken = [raw.copy() for raw in frames]
    for raw in broken:
        raw[10, 20], raw[30, 41] = 5, 4000
    result = calibrate_polarizer(broken, "mono", BITS)
    assert result.defective == pytest.approx(2 / (SIZE[0] * SIZE[1]))
    assert np.all(result.response.analysis[[10, 30], [20, 41]] == 0)


@pytest.mark.parametrize(
    ("pictures", "angles", "reason"),
    [
        (lambda f: f[:5], None, "5 frames; at least 6"),
        (lambda f: [f[0]] * 20, None, "hardly changes; turn the polarizer"),
        (lambda f: f[:6], None, "hardly changes"),
        (lambda f: f, ANGLES[:-1], "71 angles for 72 frames"),
        (lambda f: f, ANGLES[::-1] ** 2, "not those of the pictures"),
        (lambda f: f, np.where(np.arange(72) == 3, np.nan, ANGLES), "angle of frame 3 is missing"),
        (lambda f: [np.full_like(raw, 4095) for raw in f], None, "frame 0 is saturated"),
        (lambda f: [raw // 64 for raw in f], None, "frame 0 is dark"),
        (lambda f: [raw // 2 + 900 for raw in (f[0],) * 9], None, "hardly any polarization"),
        (lambda f: [*f[:-1], f[-1][:-2]], None, "frame 71 is \\(94, 128\\)"),
    ],
)
def test_useless_pictures_are_refused(frames, pictures, angles, reason):
    with pytest.raises(CalibrationError, match=reason):
        calibrate_polarizer(pictures(frames), "mono", BITS, angles)


def test_an_impossible_extinction_ratio_is_refused(frames):
    with pytest.raises(CalibrationError, match="T_max / T_min"):
        calibrate_polarizer(frames, "mono", BITS, extinction_ratio=0.5)
