"""The board's description: what it refuses, where its corners are, and that drawing and detection agree."""

from dataclasses import replace

import cv2
import numpy as np
import pytest

from calibration.board import BoardSpec, draw
from calibration.detection import detect, explain_missing_board
from dataset.errors import CalibrationError

SPEC = BoardSpec(6, 5, 0.04, 0.03, "DICT_4X4_50")


@pytest.mark.parametrize(
    ("arguments", "reason"),
    [
        ((2, 5, 0.04, 0.03, "DICT_4X4_50"), "at least 3 squares"),
        ((6, 5, 0.04, 0.04, "DICT_4X4_50"), "smaller than square_m"),
        ((6, 5, 40.0, 30.0, "DICT_4X4_50"), "metres"),
        ((6, 5, 0.04, 0.03, "DICT_9X9"), "unknown dictionary"),
        ((20, 20, 0.04, 0.03, "DICT_4X4_50"), "larger dictionary"),
    ],
)
def test_an_impossible_board_is_refused_with_the_reason(arguments, reason):
    with pytest.raises(CalibrationError, match=reason):
        BoardSpec(*arguments)


def test_corners_are_numbered_row_by_row():
    points = SPEC.object_points(np.array([0, 1, 5]))
    np.testing.assert_allclose(points, [[0.04, 0.04, 0], [0.08, 0.04, 0], [0.04, 0.08, 0]])


def test_a_corner_of_another_board_is_refused():
    with pytest.raises(CalibrationError, match="squares_x"):
        SPEC.object_points(np.array([20]))


@pytest.mark.parametrize("dtype", [np.uint8, np.float32, np.uint16])
def test_the_drawn_board_is_detected_where_it_was_drawn(dtype):
    image = draw(SPEC, 60, margin_px=30)
    scale = 200 if dtype == np.uint16 else 1
    found = detect((image.astype(np.float64) * scale).astype(dtype), SPEC)
    assert found is not None
    assert len(found) == SPEC.corner_count
    expected = 30 + SPEC.object_points(found.ids)[:, :2] / SPEC.square_m * 60 - 0.5
    assert np.abs(found.pixels - expected).max() < 0.05


@pytest.mark.parametrize(
    ("spec", "flip", "reason"),
    [
        (BoardSpec(6, 5, 0.04, 0.03, "DICT_6X6_50"), False, "DICT_4X4_"),
        (BoardSpec(4, 5, 0.04, 0.03, "DICT_4X4_50"), False, "squares_x or squares_y is too small"),
        (BoardSpec(7, 6, 0.04, 0.03, "DICT_4X4_50"), False, "do not lie as on"),
        (replace(SPEC, marker_m=0.022), False, "marker_m / square_m"),
        (replace(SPEC, marker_m=0.037), False, "marker_m / square_m"),
        (SPEC, True, "mirrored"),
    ],
)
def test_a_wrong_description_is_explained(spec, flip, reason):
    image = draw(SPEC, 60, margin_px=30)
    image = np.ascontiguousarray(image[:, ::-1]) if flip else image
    assert detect(image, spec) is None
    assert reason in explain_missing_board(image, spec)


def test_an_empty_picture_has_no_board():
    image = np.full((300, 400), 120, np.uint8)
    assert detect(image, SPEC) is None
    assert "no marker" in explain_missing_board(image, SPEC)


CHESSBOARD = BoardSpec(8, 5, 0.03, 0.0, "", "checkerboard")
APRILGRID = BoardSpec(4, 3, 0.06, 0.045, "DICT_APRILTAG_36H11", "aprilgrid")


@pytest.mark.parametrize("spec", [SPEC, CHESSBOARD, APRILGRID], ids=["charuco", "checkerboard", "aprilgrid"])
@pytest.mark.parametrize("turns", [0, 2])
def test_every_kind_of_board_is_detected_where_it_was_drawn_either_way_up(spec, turns):
    image = draw(spec, 96, margin_px=48)
    turned = cv2.GaussianBlur(np.ascontiguousarray(np.rot90(image, turns)), (0, 0), 0.7)
    found = detect(turned, spec)
    assert found is not None
    assert len(found) == spec.corner_count
    expected = 48 + spec.object_points(found.ids)[:, :2] / spec.square_m * 96 - 0.5
    if turns == 2:
        expected = np.array(image.shape[::-1]) - 1 - expected
    assert np.abs(found.pixels - expected).max() < 0.05


@pytest.mark.parametrize(
    ("arguments", "reason"),
    [
        ((8, 6, 0.03, 0.0, "", "checkerboard"), "upside down"),
        ((4, 3, 0.06, 0.045, "DICT_5X5_100", "aprilgrid"), "APRILTAG_36H11"),
        ((4, 3, 0.06, 0.07, "DICT_APRILTAG_36H11", "aprilgrid"), "smaller than square_m"),
    ],
)
def test_an_impossible_board_of_another_kind_is_refused(arguments, reason):
    with pytest.raises(CalibrationError, match=reason):
        BoardSpec(*arguments)


def test_the_rectangles_of_a_charuco_board_are_those_that_opencv_prints():
    ours = draw(SPEC, 80, margin_px=20)
    theirs = SPEC.aruco.generateImage(ours.shape[::-1], marginSize=20, borderBits=1)
    assert np.mean(ours != theirs) < 0.01  # OpenCV rounds its modules to whole pixels


def test_a_mirrored_aprilgrid_is_explained():
    image = np.ascontiguousarray(draw(APRILGRID, 96, margin_px=48)[:, ::-1])
    assert detect(image, APRILGRID) is None
    assert "mirrored" in explain_missing_board(image, APRILGRID)


def test_a_miscounted_chessboard_is_explained():
    other = BoardSpec(7, 4, 0.03, 0.0, "", "checkerboard")
    image = draw(CHESSBOARD, 60, margin_px=60)
    assert detect(image, BoardSpec(10, 7, 0.03, 0.0, "", "checkerboard")) is None
    assert "7x4 squares" in explain_missing_board(image, other)
