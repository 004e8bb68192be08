"""Pivot calibration: the tip and its error bar, slips, and motions that cannot tell."""

import numpy as np
import pytest

from calibration.tool_tip import calibrate_tool_tip
from dataset.errors import CalibrationError
from dataset.transforms import SE3

TIP = np.array([0.004, -0.012, 0.183])
POINT = np.array([0.42, 0.1, 0.03])
NOISE_M, NOISE_RAD = 5e-5, 1e-4


def pivot(rotvecs, rng, noise_m=NOISE_M, noise_rad=NOISE_RAD):
    """Poses with the tip on the point, as a slightly wrong arm reports them."""
    down = SE3.from_rotvec([np.pi, 0, 0], np.zeros(3)).rotation
    rotation = down @ SE3.from_rotvec(rotvecs, np.zeros((len(rotvecs), 3))).rotation
    poses = SE3(rotation, POINT - rotation @ TIP)
    return poses @ SE3.exp(rng.normal(size=(len(rotvecs), 6)) * ([noise_m] * 3 + [noise_rad] * 3))


def cone(count, rng, tilt_deg=25.0):
    """Tool axes on a cone, turned at will about themselves."""
    azimuth = np.arange(count) * 2.4
    tilt = np.radians(tilt_deg) * np.column_stack([np.cos(azimuth), np.sin(azimuth), np.zeros(count)])
    return tilt + [0, 0, 1] * rng.uniform(-0.8, 0.8, (count, 1))


def test_the_tip_is_found_to_a_tenth_of_a_millimetre():
    rng = np.random.default_rng(0)
    result = calibrate_tool_tip(pivot(cone(16, rng), rng))
    assert np.linalg.norm(result.tip_in_tcp - TIP) < 1e-4
    assert np.linalg.norm(result.point_in_base - POINT) < 1e-4
    assert result.rms_m < 2e-4
    assert result.used.all()


def test_the_error_bars_hold_the_truth():
    scores = []
    for seed in range(60):
        rng = np.random.default_rng(seed)
        result = calibrate_tool_tip(pivot(cone(14, rng), rng))
        error = result.tip_in_tcp - TIP
        scores.append(error @ np.linalg.solve(result.covariance, error))
    assert 2.2 < np.mean(scores) < 4.2  # 3 expected
    assert 0.85 < np.mean(np.array(scores) < 7.81) < 1.0  # 95 % of chi-square, 3 degrees


def test_slipped_poses_are_left_out_and_named():
    rng = np.random.default_rng(1)
    poses = pivot(cone(14, rng), rng)
    moved = poses.translation.copy()
    moved[[3, 9]] += [[0.002, 0, 0.001], [0, -0.01, 0]]
    result = calibrate_tool_tip(SE3(poses.rotation, moved))
    assert np.flatnonzero(~result.used).tolist() == [3, 9]
    assert np.linalg.norm(result.tip_in_tcp - TIP) < 1.5e-4


def test_turning_about_one_axis_is_refused_by_its_name():
    rng = np.random.default_rng(2)
    about_z = np.array([[0.0, 0.0, a] for a in np.linspace(-1.5, 1.5, 12)])
    with pytest.raises(CalibrationError, match="the tool's z axis swung by 0"):
        calibrate_tool_tip(pivot(about_z, rng, noise_rad=1e-6))
    nodding = np.array([[a, 0.0, 0.0] for a in np.linspace(-0.6, 0.6, 12)])
    with pytest.raises(CalibrationError, match="the tool's x axis"):
        calibrate_tool_tip(pivot(nodding, rng))


@pytest.mark.parametrize(
    ("poses", "reason"),
    [
        (lambda good: good[:5], "5 poses; at least 6"),
        (lambda good: good[0], "1 poses"),
        (lambda good: SE3.stack([good[0]] * 20), "hardly turned"),
        (lambda good: SE3(good.rotation, good.translation * np.nan), "pose 0 is NaN"),
        (
            lambda good: SE3(
                good.rotation, good.translation + np.random.default_rng(0).normal(0, 0.05, (12, 3))
            ),
            "share no point",
        ),
    ],
)
def test_useless_poses_are_refused(poses, reason):
    rng = np.random.default_rng(3)
    with pytest.raises(CalibrationError, match=reason):
        calibrate_tool_tip(poses(pivot(cone(12, rng), rng)))
