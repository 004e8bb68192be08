"""The printed board: read back as a printer would, it has the described size and is detected."""

import re

import numpy as np
import pytest

from calibration.board import BoardSpec
from calibration.board_pdf import board_pdf
from calibration.detection import detect
from dataset.errors import CalibrationError

PX_PER_MM = 4.0
BOARDS = [
    BoardSpec(7, 5, 0.035, 0.026, "DICT_5X5_100"),
    BoardSpec(8, 5, 0.03, 0.0, "", "checkerboard"),
    BoardSpec(4, 3, 0.06, 0.045, "DICT_APRILTAG_36H11", "aprilgrid"),
]


def page(pdf: bytes) -> tuple[np.ndarray, list[tuple[float, ...]]]:
    """The page in grey at PX_PER_MM, and its rectangles: grey, x, y, width, height; millimetres, y down."""
    text = pdf.decode("ascii")
    width, height = (
        float(v) * 25.4 / 72 for v in re.search(r"/MediaBox \[0 0 ([\d.]+) ([\d.]+)\]", text).groups()
    )
    image = np.full((round(height * PX_PER_MM), round(width * PX_PER_MM)), 255, np.uint8)
    found = []
    for values in re.findall(r"([01]) g ([\d.]+) ([\d.]+) ([\d.]+) ([\d.]+) re f", text):
        grey, x, y, w, h = (float(v) * (25.4 / 72 if i else 1) for i, v in enumerate(values))
        found.append((grey, x, height - y - h, w, h))
        rows = np.round(PX_PER_MM * np.array([height - y - h, height - y])).astype(int)
        columns = np.round(PX_PER_MM * np.array([x, x + w])).astype(int)
        image[slice(*rows), slice(*columns)] = 255 * grey
    return image, found


@pytest.mark.parametrize("spec", BOARDS, ids=lambda spec: spec.kind)
def test_the_print_is_to_scale_and_detected(spec):
    image, _ = page(board_pdf(spec, "A4"))
    found = detect(image, spec)
    assert found is not None
    assert len(found) == spec.corner_count
    board_mm = 1e3 * spec.object_points(found.ids)[:, :2]
    apart = (found.pixels - found.pixels[0]) / PX_PER_MM - (board_mm - board_mm[0])
    assert np.abs(apart).max() < 0.15  # a pixel of this rendering is 0.25 mm


def test_the_ruler_is_100_mm_long_and_the_description_is_printed():
    pdf = board_pdf(BOARDS[0], "A4")
    _, rectangles = page(pdf)
    ruler = max(rectangles, key=lambda r: r[3])
    assert ruler[3] == pytest.approx(100.0, abs=1e-3)
    ticks = [r for r in rectangles if r[3] == pytest.approx(0.2, abs=1e-3)]
    assert len(ticks) == 11
    assert b"ChArUco board of 7 x 5 squares of 35 mm, markers of 26 mm, DICT_5X5_100" in pdf
    squares = [r for r in rectangles if r[3] == pytest.approx(35.0, abs=1e-3)]
    assert len(squares) == 18


def test_the_cross_reference_table_points_at_the_objects():
    pdf = board_pdf(BOARDS[1], "A3")
    start = int(re.search(rb"startxref\n(\d+)", pdf).group(1))
    assert pdf[start : start + 4] == b"xref"
    for number, offset in enumerate(re.findall(rb"(\d{10}) 00000 n", pdf), start=1):
        assert pdf[int(offset) :].startswith(b"%d 0 obj" % number)


@pytest.mark.parametrize("page_name", ["A4", "300x200"])
def test_a_board_larger_than_the_page_is_refused(page_name):
    with pytest.raises(CalibrationError, match="do not fit the page"):
        board_pdf(BoardSpec(11, 8, 0.035, 0.026, "DICT_5X5_100"), page_name)


def test_the_default_board_fits_a3_and_an_unknown_page_is_refused():
    assert board_pdf(BoardSpec(11, 8, 0.035, 0.026, "DICT_5X5_100"), "A3").startswith(b"%PDF-1.4")
    with pytest.raises(CalibrationError, match="WIDTHxHEIGHT"):
        board_pdf(BOARDS[0], "letter")
