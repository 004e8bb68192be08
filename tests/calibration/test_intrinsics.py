"""Intrinsics from analytic corners with noise: accuracy, honest error bars, outliers, refusals."""

import numpy as np
import pytest

from calibration import remarks
from calibration.board import BoardSpec
from calibration.detection import Detection
from calibration.intrinsics import calibrate_intrinsics
from calibration.view_selection import select_views
from dataset.errors import CalibrationError
from dataset.transforms import SE3

SIZE = (2048, 2448)


def _views(world, seed, count=15, noise=0.1, tilt=0.3):
    rng = np.random.default_rng(seed)
    return [world.detection(pose, rng, noise) for pose in world.views(count, rng, tilt)]


def test_the_camera_is_recovered_within_its_error_bars(world):
    truth = np.concatenate([world.intrinsics.K[[0, 1, 0, 1], [0, 1, 2, 2]], world.intrinsics.distortion])
    scores = []
    for seed in range(6):
        result = calibrate_intrinsics(_views(world, seed), world.spec, SIZE)
        found = np.concatenate(
            [result.intrinsics.K[[0, 1, 0, 1], [0, 1, 2, 2]], result.intrinsics.distortion]
        )
        assert abs(found[0] / truth[0] - 1) < 2e-3
        assert result.rms_px == pytest.approx(0.1 * np.sqrt(2), rel=0.1)
        assert result.rms_px <= result.held_out_px * 1.02 < 0.16
        scores.append((found - truth) / result.sigma)
    assert 0.5 < np.sqrt(np.mean(np.square(scores))) < 1.6


@pytest.mark.parametrize("count", [0, 4, 5, 8])
def test_every_distortion_model_of_opencv_can_be_estimated(world, count):
    result = calibrate_intrinsics(_views(world, 1), world.spec, SIZE, distortion_count=count)
    assert len(result.intrinsics.distortion) == count
    assert result.covariance.shape == (4 + count, 4 + count)


def test_a_blurred_view_is_left_out_and_named(world):
    detections = _views(world, 2)
    rng = np.random.default_rng(0)
    bad = detections[4]
    detections[4] = Detection(bad.ids, bad.pixels + rng.normal(0, 3.0, bad.pixels.shape))
    result = calibrate_intrinsics(detections, world.spec, SIZE)
    assert list(np.flatnonzero(~result.used)) == [4]
    words = remarks.of_intrinsics(result, range(100, 115))
    assert words[0].startswith("left out as outliers, against 0.14 px of the others: frame 104 (")
    assert abs(result.intrinsics.K[0, 0] / world.intrinsics.K[0, 0] - 1) < 2e-3


def test_a_few_misplaced_corners_do_not_pull(world):
    detections = _views(world, 3)
    for detection in detections[::3]:
        detection.pixels[7] += [6.0, -4.0]
    result = calibrate_intrinsics(detections, world.spec, SIZE)
    assert abs(result.intrinsics.K[0, 0] / world.intrinsics.K[0, 0] - 1) < 2e-3


def test_too_few_views_are_refused(world):
    with pytest.raises(CalibrationError, match="4 views show the board; at least 5"):
        calibrate_intrinsics(_views(world, 0, count=4), world.spec, SIZE)


def test_the_same_view_repeated_is_refused(world):
    rng = np.random.default_rng(0)
    pose = world.views(1, rng)[0]
    detections = [world.detection(pose, rng) for _ in range(20)]
    with pytest.raises(CalibrationError, match="only 1 of 20 views differ"):
        calibrate_intrinsics(detections, world.spec, SIZE)


def test_a_board_that_was_never_tilted_is_refused(world):
    rng = np.random.default_rng(0)
    centre = [-0.12, -0.165, 0.0]
    poses = [SE3.from_rotvec(np.zeros(3), np.add(centre, [0.01 * i, 0, 0.4 + 0.03 * i])) for i in range(9)]
    with pytest.raises(CalibrationError, match="tilt"):
        calibrate_intrinsics([world.detection(pose, rng) for pose in poses], world.spec, SIZE)


def test_views_of_another_resolution_are_refused(world):
    with pytest.raises(CalibrationError, match="outside a 1224x1024 image"):
        calibrate_intrinsics(_views(world, 0), world.spec, (1024, 1224))


@pytest.mark.parametrize("level", [1, 2, 4, 8])
def test_every_level_projects_to_the_centre_of_its_blocks_exactly(world, level):
    """A level x level block of mosaic pixels is one pixel of the level, and their centres agree: a point seen
    there must project to integer coordinates, half pixels included."""
    camera = world.intrinsics
    blocks = np.array([[0, 0], [3, 5], [100, 40], [2048 // level - 1, 1024 // level]], float)
    centres = level * blocks + (level - 1) / 2
    points = camera.rays(centres) * np.array([[0.4], [0.5], [0.6], [1.3]])
    np.testing.assert_allclose(camera.at(level).project(points), blocks, atol=1e-6)
    np.testing.assert_allclose(camera.at(2).at(2).K, camera.at(4).K, atol=1e-9)


def test_the_views_selected_cover_more_than_as_many_in_a_row(world):
    rng = np.random.default_rng(4)
    poses = world.views(8, rng)
    jitter = SE3.exp(rng.normal(0, 1e-3, (72, 6)))
    crowded = [world.detection(pose, rng) for pose in poses[np.repeat(np.arange(8), 9)] @ jitter]
    chosen = select_views(crowded, world.spec, 8)
    assert sorted(np.unique(chosen // 9)) == list(range(8))
    assert list(select_views(crowded[:5], world.spec, 8)) == list(range(5))


def test_a_board_of_other_counts_is_refused(world):
    wrong = BoardSpec(12, 8, world.spec.square_m, world.spec.marker_m, "DICT_5X5_100")
    with pytest.raises(CalibrationError, match="squares_x"):
        calibrate_intrinsics(_views(world, 5), wrong, SIZE)


def _stretched(world, aspect, turned):
    """Views of a board whose squares are that much higher than wide, turned in the picture or upright."""
    rng = np.random.default_rng(5)
    views = world.views(10, rng)
    if not turned:
        centre = SE3(np.eye(3), -0.5 * np.array([*world.spec.size_m, 0.0]))
        tilts = np.column_stack([rng.normal(0, 0.3, (10, 2)), np.zeros(10)])
        views = SE3.from_rotvec(tilts, rng.uniform([-0.1, -0.08, 0.4], [0.1, 0.08, 0.65], (10, 3))) @ centre
    corners = world.spec.object_points(np.arange(world.spec.corner_count)) * [1.0, aspect, 1.0]
    found = []
    for pose in views:
        pixels = world.intrinsics.project(pose.apply(corners))
        inside = np.flatnonzero(np.all((pixels > 5) & (pixels < np.array(SIZE[::-1]) - 6), axis=1))
        found.append(Detection(inside, pixels[inside] + rng.normal(0, 0.1, (len(inside), 2))))
    return found


@pytest.mark.parametrize("turned", [True, False])
def test_squares_that_are_not_square_are_refused(world, turned):
    """As a printer's fit to the page makes them: no lens does that, nor do a sensor's pixels."""
    with pytest.raises(CalibrationError, match=r"1\.020 times as high as wide; it was stretched"):
        calibrate_intrinsics(_stretched(world, 1.02, turned), world.spec, SIZE)


def test_squares_that_are_nearly_square_are_told(world):
    result = calibrate_intrinsics(_stretched(world, 1.004, True), world.spec, SIZE)
    assert result.board_aspect == pytest.approx(1.004, abs=5 * result.board_aspect_sigma)
    assert result.board_aspect_sigma < 5e-4
    words = remarks.of_intrinsics(result, range(10))
    assert f"{result.board_aspect:.4f} times as high as wide" in words[0]


def test_corners_that_are_nan_are_refused_by_view(world):
    detections = _views(world, 6)
    detections[3].pixels[2] = np.nan
    with pytest.raises(CalibrationError, match="view 3 has fewer than 6 finite corners"):
        calibrate_intrinsics(detections, world.spec, SIZE)
