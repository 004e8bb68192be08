"""Intrinsics: every derived grid sees the same world, to the half pixel."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from dataset import CalibrationError, Intrinsics

MATRIX = np.array([[1405.8, 0, 1216.4], [0, 1405.9, 1006.1], [0, 0, 1]])
DISTORTION = np.array([-0.21, 0.12, 0.0012, -0.0008, -0.03])


def sensor(distortion: np.ndarray = DISTORTION) -> Intrinsics:
    return Intrinsics(MATRIX, distortion, 2048, 2448)


def points_in_view(count: int = 200) -> np.ndarray:
    rng = np.random.default_rng(0)
    plane = rng.uniform([-0.7, -0.6], [0.7, 0.6], (count, 2))
    depth = rng.uniform(0.3, 2.0, (count, 1))
    return np.concatenate([plane * depth, depth], axis=1)


@pytest.mark.parametrize("level", [1, 2, 4, 8])
def test_levels_project_to_the_same_place(level: int) -> None:
    full = sensor().project(points_in_view())
    coarse = sensor().at(level)
    assert (coarse.height, coarse.width) == (2048 // level, 2448 // level)
    # block pixel j covers mosaic pixels level*j ... level*j + level - 1, whose centres average to this
    np.testing.assert_allclose(level * coarse.project(points_in_view()) + (level - 1) / 2, full, atol=1e-9)


def test_a_level_is_the_grid_of_block_means() -> None:
    """The centroid of a blob in the block-averaged image, carried to the mosaic, is the blob's."""
    centre = np.array([37.3, 22.8])
    columns, rows = np.meshgrid(np.arange(80), np.arange(60))
    blob = np.exp(-((columns - centre[0]) ** 2 + (rows - centre[1]) ** 2) / (2 * 5.0**2))
    camera = Intrinsics(np.array([[50.0, 0, 40], [0, 50, 30], [0, 0, 1]]), np.zeros(0), 60, 80)
    ray = camera.rays(centre)
    for level in (2, 4):
        mean = blob.reshape(60 // level, level, 80 // level, level).mean(axis=(1, 3))
        rows_c, columns_c = np.indices(mean.shape)
        found = [(mean * columns_c).sum() / mean.sum(), (mean * rows_c).sum() / mean.sum()]
        np.testing.assert_allclose(camera.at(level).project(ray), found, atol=1e-4)


def test_levels_compose() -> None:
    np.testing.assert_allclose(sensor().at(2).at(2).K, sensor().at(4).K)


def test_a_crop_projects_to_the_same_place() -> None:
    camera = sensor(np.zeros(0)).at(4)
    crop = camera.crop([100.5, 60.25, 200.0, 150.0], (96, 128))
    assert (crop.height, crop.width) == (96, 128)
    full, cropped = camera.project(points_in_view()), crop.project(points_in_view())
    expected = [100.5, 60.25] + (cropped + 0.5) * [200 / 128, 150 / 96] - 0.5
    np.testing.assert_allclose(expected, full, atol=1e-9)


def test_crop_pixel_zero_and_the_trivial_crop() -> None:
    camera = sensor(np.zeros(0))
    crop = camera.crop([10, 20, 64, 64], 128)
    ray = crop.rays(np.array([0.0, 0.0]))
    np.testing.assert_allclose(camera.project(ray), [10 + 64 / 256 - 0.5, 20 + 64 / 256 - 0.5])
    np.testing.assert_allclose(camera.crop([0, 0, 2448, 2048], (2048, 2448)).K, camera.K)
    np.testing.assert_allclose(camera.crop([0, 0, 2448, 2048], (512, 612)).K, camera.at(4).K)


@pytest.mark.parametrize("count", [0, 4, 5, 8])
def test_projection_agrees_with_opencv(count: int) -> None:
    distortion = np.array([-0.21, 0.12, 0.0012, -0.0008, -0.03, 0.02, -0.01, 0.004])[:count]
    points = points_in_view()
    expected, _ = cv2.projectPoints(points, np.zeros(3), np.zeros(3), MATRIX, distortion)
    np.testing.assert_allclose(sensor(distortion).project(points), expected[:, 0], atol=1e-8)


@pytest.mark.parametrize("count", [0, 4, 5, 8])
def test_rays_invert_projection(count: int) -> None:
    distortion = np.array([-0.21, 0.12, 0.0012, -0.0008, -0.03, 0.02, -0.01, 0.004])[:count]
    points = points_in_view()
    rays = sensor(distortion).rays(sensor(distortion).project(points))
    np.testing.assert_allclose(rays, points / np.linalg.norm(points, axis=1, keepdims=True), atol=1e-8)


def test_rays_of_the_whole_grid() -> None:
    camera = sensor().at(16)
    rays = camera.rays()
    assert rays.shape == (128, 153, 3)
    rows, columns = np.indices((128, 153))
    np.testing.assert_allclose(camera.project(rays), np.stack([columns, rows], axis=-1), atol=1e-6)


def test_undistort_map_agrees_with_opencv() -> None:
    camera = sensor().at(4)
    ours = camera.undistort_map()
    size = (camera.width, camera.height)
    theirs = cv2.initUndistortRectifyMap(camera.K, camera.distortion, np.eye(3), camera.K, size, cv2.CV_32FC1)
    np.testing.assert_allclose(ours[0], theirs[0], atol=1e-3)
    np.testing.assert_allclose(ours[1], theirs[1], atol=1e-3)


def test_points_behind_the_camera_have_no_pixel() -> None:
    pixels = sensor().project(np.array([[0.1, 0.1, -1.0], [0.1, 0.1, 0.0], [0.1, 0.1, 1.0]]))
    assert np.isnan(pixels).all(axis=1).tolist() == [True, True, False]


def test_a_distortion_that_folds_back_is_reported() -> None:
    camera = sensor(np.array([-3.0, 0.0, 0.0, 0.0]))
    with pytest.raises(CalibrationError, match="cannot be inverted"):
        camera.rays(np.array([[0.0, 0.0]]))


@pytest.mark.parametrize(
    ("matrix", "distortion", "size", "message"),
    [
        (np.eye(4), [], (10, 10), "shape"),
        (np.diag([-1.0, 1, 1]), [], (10, 10), "not a pinhole"),
        (np.diag([1.0, 1, 2]), [], (10, 10), "without skew"),
        (np.eye(3), [0.1] * 3, (10, 10), "3 distortion coefficients"),
        (np.eye(3), [np.nan] * 4, (10, 10), "finite"),
        (np.eye(3), [], (0, 10), "empty"),
    ],
)
def test_what_is_no_camera_is_refused(
    matrix: np.ndarray, distortion: list[float], size: tuple[int, int], message: str
) -> None:
    with pytest.raises(CalibrationError, match=message):
        Intrinsics(matrix, np.array(distortion), *size)


def test_impossible_levels_and_crops_are_refused() -> None:
    with pytest.raises(CalibrationError, match="level 0"):
        sensor().at(0)
    with pytest.raises(CalibrationError, match="empty"):
        sensor().crop([0, 0, 0, 10], 64)
