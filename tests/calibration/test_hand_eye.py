"""Hand-eye from analytic corners, pixel noise and an arm that does not quite repeat."""

from dataclasses import replace

import numpy as np
import pytest

from calibration import remarks
from calibration.detection import Detection
from calibration.hand_eye import calibrate_hand_eye
from calibration.next_pose import next_pose
from calibration.resampling import bootstrap
from dataset.errors import CalibrationError
from dataset.transforms import SE3, rotation_error_deg, translation_error_mm

ARM_M, ARM_RAD = 3e-5, 5e-5


def _recording(world, seed, count=22, views=None):
    rng = np.random.default_rng(seed)
    views = world.views(count, rng) if views is None else views
    noise = rng.normal(0, 1, (len(views), 6)) * np.array([ARM_M] * 3 + [ARM_RAD] * 3)
    return world.arm(views) @ SE3.exp(noise), [world.detection(pose, rng) for pose in views]


def test_the_camera_on_the_tool_is_recovered_within_its_error_bars(world):
    chi_square = []
    for seed in range(6):
        result = calibrate_hand_eye(*_recording(world, seed), world.spec, world.intrinsics)
        assert rotation_error_deg(result.T_tcp_cam, world.T_tcp_cam) < 0.05
        assert translation_error_mm(result.T_tcp_cam, world.T_tcp_cam) < 0.2
        assert translation_error_mm(result.T_base_board, world.T_base_board) < 0.3
        assert result.used.all()
        assert len(result.candidates_px) == 8  # seven closed forms and RANSAC
        assert abs(result.board_scale - 1) < 5 * result.board_scale_sigma < 1e-3
        error = np.concatenate(
            [
                (result.T_tcp_cam.inverse() @ world.T_tcp_cam).log(),
                (result.T_base_board.inverse() @ world.T_base_board).log(),
            ]
        )
        chi_square.append(error @ np.linalg.solve(result.covariance, error))
    assert 6 < np.mean(chi_square) < 24  # 12 expected


def test_the_arms_noise_is_told_from_the_corners(world):
    result = calibrate_hand_eye(*_recording(world, 7, count=40), world.spec, world.intrinsics)
    assert result.arm_sigma_m == pytest.approx(ARM_M, rel=0.4)
    assert result.arm_sigma_rad == pytest.approx(ARM_RAD, rel=0.4)
    assert result.pixel_sigma == pytest.approx(0.1, rel=0.1)


def test_uncertain_intrinsics_widen_the_result(world):
    recording = _recording(world, 1)
    covariance = np.diag([1.0, 1.0, 1.0, 1.0, 1e-6, 1e-5, 1e-8, 1e-8, 1e-5])
    plain = calibrate_hand_eye(*recording, world.spec, world.intrinsics)
    widened = calibrate_hand_eye(*recording, world.spec, world.intrinsics, covariance)
    assert widened.sigma_m > 1.5 * plain.sigma_m


def test_views_with_a_wrong_arm_pose_are_left_out_and_named(world):
    arm, detections = _recording(world, 2)
    translation = arm.translation.copy()
    translation[[3, 10]] += [[0.02, 0, 0], [0, 0.005, 0]]
    result = calibrate_hand_eye(SE3(arm.rotation, translation), detections, world.spec, world.intrinsics)
    assert list(np.flatnonzero(~result.used)) == [3, 10]
    (words,) = remarks.of_hand_eye(result, range(22))
    assert "left out as outliers" in words
    assert translation_error_mm(result.T_tcp_cam, world.T_tcp_cam) < 0.2


@pytest.mark.parametrize(("axis", "name"), [([1, 0, 0], "x"), ([0, 1, 0], "y"), ([0, 0, 1], "z")])
def test_rotation_about_one_axis_is_refused_naming_the_axes(world, axis, name):
    first, _ = _recording(world, 3, count=1)
    turns = SE3.from_rotvec(np.linspace(-0.5, 0.5, 12)[:, None] * axis, np.zeros(3))
    arm = SE3(first.rotation @ turns.rotation, first.translation + 0.05 * np.arange(12)[:, None])
    _, detections = _recording(world, 3, count=12)
    with pytest.raises(CalibrationError, match=rf"one axis only \({name}, .*add views tilted"):
        calibrate_hand_eye(arm, detections, world.spec, world.intrinsics)


def test_motion_without_rotation_is_refused(world):
    arm, detections = _recording(world, 4, count=10)
    still = SE3(np.broadcast_to(arm.rotation[0], (10, 3, 3)), arm.translation)
    with pytest.raises(CalibrationError, match="hardly rotated"):
        calibrate_hand_eye(still, detections, world.spec, world.intrinsics)


def test_the_same_pose_repeated_is_refused(world):
    views = world.views(1, np.random.default_rng(0))[np.zeros(20, int)]
    with pytest.raises(CalibrationError, match="only 1 of 20 arm poses differ"):
        calibrate_hand_eye(*_recording(world, 5, views=views), world.spec, world.intrinsics)


def test_nan_poses_are_refused_by_number(world):
    arm, detections = _recording(world, 6, count=8)
    translation = arm.translation.copy()
    translation[5] = np.nan
    with pytest.raises(CalibrationError, match="NaN or infinite in view 5"):
        calibrate_hand_eye(SE3(arm.rotation, translation), detections, world.spec, world.intrinsics)


def test_too_few_views_are_refused(world):
    with pytest.raises(CalibrationError, match="4 views show the board"):
        calibrate_hand_eye(*_recording(world, 0, count=4), world.spec, world.intrinsics)


@pytest.mark.parametrize(("scale", "count"), [(0.5, 20), (1.25, 20), (0.952, 8)])
def test_a_board_of_another_size_is_refused_with_the_size_it_has(world, scale, count):
    """Few views, too: the size must not pass for noise of the arm."""
    rng = np.random.default_rng(8)
    views = world.views(count, rng)
    arm = world.arm(views)
    detections = []
    for pose in views:
        ids = np.arange(world.spec.corner_count)
        pixels = world.intrinsics.project(pose.apply(scale * world.spec.object_points(ids)))
        detections.append(Detection(ids, pixels + rng.normal(0, 0.1, pixels.shape)))
    with pytest.raises(CalibrationError, match=rf"{scale:.3f} times the size described"):
        calibrate_hand_eye(arm, detections, world.spec, world.intrinsics)


def test_an_inverted_transform_is_refused(world):
    arm, detections = _recording(world, 9)
    with pytest.raises(CalibrationError, match="hand-eye"):
        calibrate_hand_eye(arm.inverse(), detections, world.spec, world.intrinsics)


def test_a_fixed_camera_and_a_board_on_the_tool_are_recovered_within_their_error_bars(world):
    T_base_cam, T_tcp_board = world.T_base_board @ SE3.from_rotvec([2.0, 0.3, 0], [0, 0, 1]), world.T_tcp_cam
    chi_square = []
    for seed in range(3):
        rng = np.random.default_rng(seed)
        views = world.views(22, rng)
        noise = SE3.exp(rng.normal(0, 1, (len(views), 6)) * np.array([ARM_M] * 3 + [ARM_RAD] * 3))
        arm = T_base_cam @ views @ T_tcp_board.inverse() @ noise
        detections = [world.detection(pose, rng) for pose in views]
        result = calibrate_hand_eye(arm, detections, world.spec, world.intrinsics, mount="eye_to_hand")
        assert translation_error_mm(result.T_mount_cam, T_base_cam) < 1.0
        assert translation_error_mm(result.T_tcp_board, T_tcp_board) < 0.2
        assert translation_error_mm(result.T_base_board_seen, arm @ T_tcp_board).max() < 0.4
        error = np.concatenate(
            [
                (result.T_mount_cam.inverse() @ T_base_cam).log(),
                (result.T_tcp_board.inverse() @ T_tcp_board).log(),
            ]
        )
        chi_square.append(error @ np.linalg.solve(result.covariance, error))
    assert 5 < np.mean(chi_square) < 24  # 12 expected
    with pytest.raises(CalibrationError, match="calibration eye to hand"):
        _ = result.T_tcp_cam


def test_intrinsics_that_are_off_are_refined_with_the_arm(world):
    off = replace(world.intrinsics, K=world.intrinsics.K * np.array([[1.003], [1.003], [1.0]]))
    covariance = np.diag([20.0, 20.0, 20.0, 20.0, 1e-5, 1e-5, 1e-8, 1e-8, 1e-5])
    recording = _recording(world, 8)
    fixed = calibrate_hand_eye(*recording, world.spec, off, covariance)
    refined = calibrate_hand_eye(*recording, world.spec, off, covariance, refine_camera=True)
    assert abs(refined.intrinsics.K[0, 0] / world.intrinsics.K[0, 0] - 1) < 5e-4
    assert translation_error_mm(refined.T_tcp_cam, world.T_tcp_cam) < 0.3
    assert refined.rms_px < fixed.rms_px
    assert fixed.intrinsics_covariance is None
    assert refined.intrinsics_covariance.shape == covariance.shape
    fx_sigma = float(np.sqrt(refined.intrinsics_covariance[0, 0]))
    assert abs(refined.intrinsics.K[0, 0] - world.intrinsics.K[0, 0]) < 4 * fx_sigma < 2.0
    with pytest.raises(CalibrationError, match="intrinsics_covariance"):
        calibrate_hand_eye(*recording, world.spec, off, refine_camera=True)


def test_a_view_left_out_is_predicted_as_well_as_arm_and_corners_allow(world):
    result = calibrate_hand_eye(*_recording(world, 9), world.spec, world.intrinsics)
    assert 0.02 < result.held_out_mm < 0.3
    assert 0.002 < result.held_out_deg < 0.05


def test_bootstrap_intervals_hold_the_truth_and_agree_with_the_covariance(world):
    held = []
    for seed in range(2):
        result = calibrate_hand_eye(*_recording(world, 20 + seed), world.spec, world.intrinsics)
        intervals = bootstrap(result, draws=30)
        error = (result.T_mount_cam.inverse() @ world.T_tcp_cam).log()
        held.append((intervals.low < error) & (error < intervals.high))
        half = 0.5 * (intervals.high - intervals.low)
        assert np.all(half > 0.8 * np.sqrt(np.diagonal(result.covariance))[:6])
        assert np.all(half < 4.0 * np.sqrt(np.diagonal(result.covariance))[:6])
    assert np.mean(held) >= 0.7


def test_the_next_pose_taken_is_worth_what_it_promised(world):
    arm, detections = _recording(world, 10, count=8)
    before = calibrate_hand_eye(arm, detections, world.spec, world.intrinsics)
    advice = next_pose(before, world.spec)
    rng = np.random.default_rng(0)
    seen = (advice.T_base_tcp @ world.T_tcp_cam).inverse() @ world.T_base_board
    assert len(world.detection(seen, rng)) >= 30
    assert "degrees" in advice.reason
    grown = SE3.stack([*arm, advice.T_base_tcp])
    after = calibrate_hand_eye(grown, [*detections, world.detection(seen, rng)], world.spec, world.intrinsics)
    assert advice.sigma_m < before.sigma_m
    # The noise levels are estimated anew with the view added: the promise holds for those assumed before it.
    assert after.sigma_m / after.arm_sigma_m < 1.05 * before.sigma_m / before.arm_sigma_m


def test_next_pose_is_refused_where_nothing_is_reachable(world):
    result = calibrate_hand_eye(*_recording(world, 11, count=8), world.spec, world.intrinsics)
    with pytest.raises(CalibrationError, match="none of"):
        next_pose(result, world.spec, reachable=lambda poses: np.zeros(len(poses), bool))
