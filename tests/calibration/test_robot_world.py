"""Hand-eye from pairs of poses: both mounts, outliers, unknown scale, honest error bars, refusals."""

import numpy as np
import pytest

from calibration.robot_world import pose_covariance, solve_robot_world
from dataset.errors import CalibrationError
from dataset.intrinsics import Intrinsics
from dataset.transforms import SE3, rotation_error_deg, translation_error_mm

X = SE3.from_rotvec([0.02, -0.03, 1.55], [0.03, -0.06, 0.05])
Z = SE3.from_rotvec([0.01, 0.02, 0.3], [0.4, -0.2, 0.01])
CAMERA_SIGMA = np.array([1e-3, 1e-3, 3e-3, 2e-3, 2e-3, 2e-3])


def _pairs(seed, count=20, mount="eye_in_hand", noise=1.0):
    rng = np.random.default_rng(seed)
    place = rng.uniform([-0.1, -0.1, 0.4], [0.1, 0.1, 0.6], (count, 3))
    exact = SE3.from_rotvec(rng.normal(0, 0.4, (count, 3)), place)
    error = noise * rng.normal(size=(count, 6)) * CAMERA_SIGMA
    seen = SE3((exact @ SE3.from_rotvec(error[:, 3:], np.zeros(3))).rotation, place + error[:, :3])
    reading = Z @ (X @ exact).inverse()
    arm = reading if mount == "eye_in_hand" else reading.inverse()
    return arm @ SE3.exp(noise * rng.normal(size=(count, 6)) * 1e-4), seen


@pytest.mark.parametrize("mount", ["eye_in_hand", "eye_to_hand"])
def test_both_transforms_are_found_within_their_error_bars(mount):
    chi_square = []
    for seed in range(10):
        result = solve_robot_world(*_pairs(seed, mount=mount), mount)
        assert rotation_error_deg(result.T_mount_cam, X) < 0.3
        assert translation_error_mm(result.T_mount_cam, X) < 4.0
        error = np.concatenate(
            [(result.T_mount_cam.inverse() @ X).log(), (result.T_fixture_board.inverse() @ Z).log()]
        )
        chi_square.append(error @ np.linalg.solve(result.covariance, error))
    assert 7 < np.mean(chi_square) < 22  # 12 expected


def test_exact_pairs_give_the_exact_transforms():
    result = solve_robot_world(*_pairs(0, noise=0.0))
    assert rotation_error_deg(result.T_mount_cam, X) < 1e-4
    assert translation_error_mm(result.T_mount_cam, X) < 1e-3


def test_a_third_of_wrong_poses_does_not_pull():
    arm, seen = _pairs(1, count=21)
    wrong = np.arange(0, 21, 3)
    turned = seen.rotation.copy()
    turned[wrong] = SE3.from_rotvec([[0.5, -0.3, 0.1]] * len(wrong), np.zeros(3)).rotation @ turned[wrong]
    result = solve_robot_world(arm, SE3(turned, seen.translation))
    assert list(np.flatnonzero(~result.used)) == wrong.tolist()
    assert translation_error_mm(result.T_mount_cam, X) < 4.0


def test_an_unknown_scale_is_found_with_the_transforms():
    arm, seen = _pairs(2, count=30)
    result = solve_robot_world(arm, SE3(seen.rotation, 2.5 * seen.translation), scale_known=False)
    assert result.scale == pytest.approx(2.5, abs=5 * result.scale_sigma)
    assert result.scale_sigma < 0.05
    assert translation_error_mm(result.T_mount_cam, X) < 5.0


def test_poses_from_corners_are_weighed_by_what_their_corners_say():
    """A small far target: its rotation is seen badly, its position well."""
    rng = np.random.default_rng(3)
    camera = Intrinsics(np.array([[900.0, 0, 640], [0, 900, 360], [0, 0, 1]]), np.zeros(0), 720, 1280)
    points = 0.03 * np.array([[x, y, 0] for x in (-1, 0, 1) for y in (-1, 0, 1)])
    plain, weighed = [], []
    for _ in range(4):
        turns = rng.normal(0, 0.4, (14, 3))
        exact = SE3.from_rotvec(turns, rng.uniform([-0.3, -0.2, 0.8], [0.3, 0.2, 1.2], (14, 3)))
        covariance = pose_covariance(exact, points, camera, 0.4)
        error = np.einsum("nij,nj->ni", np.linalg.cholesky(covariance), rng.normal(size=(14, 6)))
        turned = exact @ SE3.from_rotvec(error[:, 3:], np.zeros(3))
        seen = SE3(turned.rotation, exact.translation + error[:, :3])
        arm = Z @ (X @ exact).inverse()
        given = pose_covariance(seen, points, camera)
        plain.append(translation_error_mm(solve_robot_world(arm, seen).T_mount_cam, X))
        weighed.append(
            translation_error_mm(solve_robot_world(arm, seen, "eye_in_hand", given).T_mount_cam, X)
        )
    assert np.mean(weighed) < 0.9 * np.mean(plain)


@pytest.mark.parametrize(
    ("spoil", "reason"),
    [
        (lambda arm, seen: (arm[:3], seen), "3 arm poses for 20 board poses"),
        (lambda arm, seen: (arm, SE3(seen.rotation, seen.translation * np.nan)), "NaN or infinite in view 0"),
        (lambda arm, seen: (arm[np.zeros(20, int)], seen), "only 1 of 20 arm poses differ"),
        (lambda arm, seen: (SE3(arm.rotation[:1].repeat(20, 0), arm.translation), seen), "hardly rotated"),
    ],
)
def test_pairs_that_determine_nothing_are_refused(spoil, reason):
    with pytest.raises(CalibrationError, match=reason):
        solve_robot_world(*spoil(*_pairs(4)))
