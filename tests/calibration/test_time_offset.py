"""The camera-to-arm delay from a simulated swing past the board."""

import numpy as np
import pytest

from calibration.intrinsics import board_pose
from calibration.streams import solve_streams
from calibration.time_offset import estimate_time_offset
from dataset.errors import CalibrationError
from dataset.transforms import SE3, translation_error_mm

START_NS = 7_000_000_000_000


def _swing(world, seed, offset_s, amplitude=1.0, frames=60, seconds=8.0, wander=0.0):
    """Frames at random times of a smooth motion, an arm at 500 Hz, camera times early by the offset; the arm
    may err by so many mm and mrad, smoothly over its workspace."""
    rng = np.random.default_rng(seed)
    size = amplitude * np.array([0.10, 0.08, 0.05, 0.12, 0.12, 0.2])
    rate = 2 * np.pi * np.array([0.23, 0.31, 0.17, 0.11, 0.19, 0.13])
    phase = rng.uniform(0, 6, 6)
    centre = SE3(np.eye(3), -0.5 * np.array([*world.spec.size_m, 0.0]))

    def T_cam_board(times):
        swing = size * np.sin(rate * np.asarray(times)[:, None] + phase)
        return SE3.from_rotvec(swing[:, 3:], swing[:, :3] + [0, 0, 0.55]) @ centre

    times = np.arange(0, seconds, 0.002)
    noise = rng.normal(0, 1, (len(times), 6)) * np.array([3e-5] * 3 + [5e-5] * 3)
    real = world.arm(T_cam_board(times))
    wave = 1e-3 * wander * np.sin(2 * np.pi / 0.4 * real.translation)
    trace = real @ SE3.exp(np.concatenate([wave, wave[:, [1, 2, 0]]], axis=1)) @ SE3.exp(noise)
    exposed = np.sort(rng.uniform(0.7, seconds - 0.7, frames))
    detections = [world.detection(pose, rng) for pose in T_cam_board(exposed)]
    host_mid_ns = START_NS + np.round((exposed - offset_s) * 1e9).astype(np.int64)
    return host_mid_ns, START_NS + np.round(times * 1e9).astype(np.int64), trace, detections


def _estimate(world, recording, T_tcp_cam=None, covariance=None):
    T_tcp_cam = world.T_tcp_cam if T_tcp_cam is None else T_tcp_cam
    board = world.T_base_board
    return estimate_time_offset(*recording, world.spec, world.intrinsics, T_tcp_cam, board, covariance)


@pytest.mark.parametrize("offset_s", [0.033, -0.02, 0.45, 0.0])
def test_the_offset_is_found_within_its_error_bar(world, offset_s):
    result = _estimate(world, _swing(world, 1, offset_s))
    assert abs(result.offset_s - offset_s) < min(5 * result.sigma_s, 2e-4)
    assert result.rms_px < 0.5
    assert result.rms_px <= result.rms_before_px


def test_a_hand_eye_error_of_three_tenths_of_a_millimetre_costs_less_than_a_millisecond(world):
    off = world.T_tcp_cam @ SE3.exp([2e-4, -2e-4, 1e-4, 3e-4, 0, 2e-4])
    result = _estimate(world, _swing(world, 2, 0.025), off)
    assert abs(result.offset_s - 0.025) < 1e-3


def test_an_arm_at_rest_tells_nothing(world):
    with pytest.raises(CalibrationError, match="moved too little"):
        _estimate(world, _swing(world, 3, 0.03, amplitude=0.0))


def test_a_delay_out_of_range_is_refused(world):
    with pytest.raises(CalibrationError, match="no offset within"):
        _estimate(world, _swing(world, 4, 2.0))


def test_too_few_frames_are_refused(world):
    with pytest.raises(CalibrationError, match="5 frames show the board"):
        _estimate(world, _swing(world, 5, 0.03, frames=5))


def test_the_speeds_correlate_at_the_offset(world):
    result = _estimate(world, _swing(world, 6, 0.12))
    assert result.correlation is not None
    assert abs(result.correlation.best_s - 0.12) < 0.02
    assert np.nanmax(result.correlation.correlation) > 0.95


def test_refining_the_hand_eye_transform_with_the_offset_undoes_its_error(world):
    """A known uncertainty of the transforms: what they are off no longer passes for delay."""
    off = world.T_tcp_cam @ SE3.exp([6e-4, -5e-4, 3e-4, 1e-3, -5e-4, 6e-4])
    covariance = np.diag(([5e-4] * 3 + [1e-3] * 3) * 2) ** 2
    alone, joint, sigmas = [], [], []
    for seed in range(3):
        recording = _swing(world, 30 + seed, 0.025, frames=40)
        alone.append(_estimate(world, recording, off).offset_s - 0.025)
        result = _estimate(world, recording, off, covariance)
        joint.append(result.offset_s - 0.025)
        sigmas.append(result.sigma_s)
    assert np.abs(joint).max() < 2e-4
    assert np.abs(joint).mean() < 0.5 * np.abs(alone).mean()
    assert np.all(np.abs(joint) < 4 * np.array(sigmas))


def test_the_error_bar_holds_for_an_arm_that_errs_alike_from_frame_to_frame(world):
    covariance = np.diag(([5e-5] * 3 + [1e-4] * 3) * 2) ** 2
    scores = []
    for seed in range(6):
        recording = _swing(world, 60 + seed, 0.025, frames=40, wander=0.1)
        result = _estimate(world, recording, None, covariance)
        scores.append((result.offset_s - 0.025) / result.sigma_s)
    assert 0.3 < np.sqrt(np.mean(np.square(scores))) < 1.25


def test_two_streams_of_poses_give_offset_and_transforms_without_any_calibration(world):
    _, arm_ns, trace, _ = recording = _swing(world, 40, 0.07, frames=80)
    seen = SE3.stack([board_pose(d, world.spec, world.intrinsics) for d in recording[3]])
    camera_s, arm_s = (recording[0] - START_NS) * 1e-9, (arm_ns - START_NS) * 1e-9
    result = solve_streams(arm_s, trace, camera_s, seen)
    assert abs(result.offset_s - 0.07) < min(1e-3, 5 * result.offset_sigma_s)
    assert translation_error_mm(result.T_mount_cam, world.T_tcp_cam) < 1.0
    with pytest.raises(CalibrationError, match="do not turn alike"):
        solve_streams(arm_s + 30.0, trace, camera_s, seen)
