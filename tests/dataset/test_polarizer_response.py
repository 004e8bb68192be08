"""Pixels that differ: analysis vectors, their demodulation, and Stokes images of a calibrated session."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from dataset import ToolkitError
from dataset.errors import SessionError
from dataset.frames import CameraInfo, Mosaic, RawFrame
from dataset.polarimetry import Stokes, decode, quantize, white_level
from dataset.polarizer_response import PolarizerResponse, nominal_orientation
from dataset.session import Session, SessionWriter, write_calibration
from dataset.validate import validate

SIZE = (32, 48)
BLOCK = {"mono": 2, "colour": 4}
layouts = pytest.mark.parametrize("layout", ["mono", "colour"])


@pytest.fixture
def response() -> PolarizerResponse:
    rng = np.random.default_rng(3)
    orientation = nominal_orientation(*SIZE) + rng.normal(0, np.radians(1), SIZE)
    return PolarizerResponse.of(rng.normal(1, 0.02, SIZE), rng.uniform(50, 300, SIZE), orientation)


def mosaic(response: PolarizerResponse, stokes: tuple[float, float, float]) -> np.ndarray:
    return quantize((response.analysis @ np.array(stokes, np.float32)).astype(np.float32), 16)


def reference(raw: np.ndarray, response: PolarizerResponse, block: int) -> np.ndarray:
    """(3, h, w) by numpy's pseudo-inverse of each cell, then the mean of the cells of a super-pixel."""

    def cells(image: np.ndarray) -> np.ndarray:
        height, width = image.shape[:2]
        split = image.reshape(height // 2, 2, width // 2, 2, *image.shape[2:])
        return split.swapaxes(1, 2).reshape(height // 2, width // 2, 4, *image.shape[2:])

    stokes = np.linalg.pinv(cells(response.analysis)) @ cells(raw / white_level(16))[..., None]
    n = block // 2
    height, width = stokes.shape[0] // n, stokes.shape[1] // n
    return stokes.reshape(height, n, width, n, 3).mean(axis=(1, 3)).transpose(2, 0, 1)


@layouts
def test_the_kernel_agrees_with_plain_least_squares(layout: Mosaic, response: PolarizerResponse) -> None:
    raw = np.random.default_rng(0).integers(1000, 40_000, SIZE).astype(np.uint16)
    found = decode(raw, layout, 16, response)
    np.testing.assert_allclose(found.stack(), reference(raw, response, BLOCK[layout]), atol=2e-6)
    assert found.valid.all()


@layouts
def test_light_is_measured_through_unequal_pixels_as_it_is(
    layout: Mosaic, response: PolarizerResponse
) -> None:
    raw = mosaic(response, (0.9, 0.3, -0.2))
    calibrated, assumed = decode(raw, layout, 16, response), decode(raw, layout, 16)
    dolp = np.hypot(0.3, 0.2) / 0.9
    assert np.abs(calibrated.dolp - dolp).max() < 1e-4
    assert np.abs(assumed.dolp - dolp).max() > 5e-3


@layouts
def test_the_ideal_response_changes_nothing(layout: Mosaic) -> None:
    raw = np.random.default_rng(1).integers(0, 65536, SIZE).astype(np.uint16)
    with_ideal, without = decode(raw, layout, 16, PolarizerResponse.ideal(*SIZE)), decode(raw, layout, 16)
    np.testing.assert_allclose(with_ideal.stack(), without.stack(), atol=1e-6)
    np.testing.assert_array_equal(with_ideal.valid, without.valid)


def test_what_describes_a_polarizer_survives_the_analysis_vector(response: PolarizerResponse) -> None:
    again = PolarizerResponse.of(response.gain, response.extinction_ratio, response.orientation)
    np.testing.assert_allclose(again.analysis, response.analysis, atol=2e-6)
    assert 49 < response.extinction_ratio.min() < response.extinction_ratio.max() < 310
    assert np.degrees(response.orientation_error).std() == pytest.approx(1.0, rel=0.1)


def test_one_dead_pixel_is_left_out_and_two_make_the_cell_invalid(response: PolarizerResponse) -> None:
    raw = mosaic(response, (0.9, 0.3, -0.2))
    analysis = response.analysis.copy()
    analysis[4, 6] = 0
    analysis[8:10, 10] = 0
    raw[4, 6] = raw[8, 10] = raw[9, 10] = 7
    found = decode(raw, "mono", 16, PolarizerResponse(analysis))
    np.testing.assert_allclose(found.stack()[:, 2, 3], (0.9, 0.3, -0.2), atol=1e-4)
    assert found.valid[2, 3]
    assert not found.valid[4, 5]
    assert np.isfinite(found.stack()).all()
    assert np.isnan(PolarizerResponse(analysis).extinction_ratio[4, 6])


@pytest.mark.parametrize(
    ("analysis", "reason"),
    [
        (np.zeros((3, 4, 3), np.float32), "H and W even"),
        (np.zeros((4, 4), np.float32), "give \\(H, W, 3\\)"),
        (np.full((4, 4, 3), np.nan, np.float32), "not finite"),
    ],
)
def test_what_is_no_response_is_refused(analysis: np.ndarray, reason: str) -> None:
    with pytest.raises(ToolkitError, match=reason):
        PolarizerResponse(analysis)


def test_a_response_of_another_size_is_refused(response: PolarizerResponse) -> None:
    with pytest.raises(ToolkitError, match="48x32"):
        decode(np.zeros((16, 16), np.uint16), "mono", 16, response)


@pytest.fixture
def recorded(response: PolarizerResponse, tmp_path: Path) -> Path:
    info = CameraInfo("LUCID", "PHX", "1", "1", "Mono16", "mono", SIZE[1], SIZE[0], 16, 1500)
    with SessionWriter(tmp_path / "polarizer.h5", "polarizer", info) as writer:
        for index, angle in enumerate((0.5, float("nan"))):
            pixels = mosaic(response, (0.9, 0.3, -0.2))
            writer.add_frame(RawFrame(pixels, "Mono16", index, index, index, 1000.0, 0.0, 0))
            writer.add_polarizer_angle(angle)
    return tmp_path / "polarizer.h5"


def test_a_session_applies_the_response_it_holds_and_knows_it(
    recorded: Path, response: PolarizerResponse
) -> None:
    with Session.open(recorded) as session:
        assert session.polarizer_response is None
        before = session.stokes(0, undistort=False)
        np.testing.assert_array_equal(session.polarizer_angles, [0.5, np.nan])
    write_calibration(recorded, "{}", None, response)
    with Session.open(recorded) as session:
        assert session.polarizer_response is not None
        np.testing.assert_array_equal(session.polarizer_response.analysis, response.analysis)
        after = session.stokes(0, undistort=False)
        assert session.intrinsics is None
    assert error(after) < 1e-4 < 5e-3 < error(before)
    assert [problem for problem in validate(recorded) if "polarizer" in problem.where] == []


def error(stokes: Stokes) -> float:
    return float(np.abs(stokes.dolp - np.hypot(0.3, 0.2) / 0.9).max())


def test_a_response_for_another_mosaic_is_not_stored(recorded: Path) -> None:
    with pytest.raises(SessionError, match="polarizer response is for 8x8"):
        write_calibration(recorded, "{}", None, PolarizerResponse.ideal(8, 8))
