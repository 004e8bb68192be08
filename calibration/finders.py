"""Find each kind of board in a picture, to half a pixel or so."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from calibration.board import BoardSpec, dictionary

MIN_CORNERS = 6
"""A view with fewer corners is not used (our choice): a pose needs 4, and two more let an error show."""

_OTHER_MARKER = 0.15
"""A marker whose side is that far off, relatively, is not the one described: blur makes up to half of it."""


@dataclass(frozen=True, eq=False)
class Detection:
    """Corners of one board in one picture: ``ids`` (n,) i64 and ``pixels`` (n, 2) f64, x then y."""

    ids: NDArray[np.int64]
    pixels: NDArray[np.float64]

    def __len__(self) -> int:
        return len(self.ids)


def find(image: NDArray[np.generic], spec: BoardSpec) -> Detection | None:
    """The corners OpenCV finds in a picture (H, W), if they are enough and lie as on the board."""
    found = {"charuco": _charuco, "checkerboard": _checkerboard, "aprilgrid": _aprilgrid}[spec.kind](
        to_u8(image), spec
    )
    if found is None or len(found) < MIN_CORNERS or board_homography(found, spec) is None:
        return None
    return found


def to_u8(image: NDArray[np.generic]) -> NDArray[np.uint8]:
    """Stretch to 8 bits for OpenCV's detectors; the refinement reads the original values."""
    if image.dtype == np.uint8:
        return np.ascontiguousarray(image)
    values = np.asarray(image, np.float32)
    low, high = np.percentile(values[::4, ::4], (0.5, 99.5))
    return np.clip((values - low) * (255.0 / max(float(high - low), 1e-6)), 0, 255).astype(np.uint8)


def board_homography(found: Detection, spec: BoardSpec) -> NDArray[np.float64] | None:
    """Board (m) to picture (px), or None when the corners do not look like one plane seen from its front
    through one lens."""
    extent = float(np.ptp(found.pixels, axis=0).max())
    # Lens distortion bends a board by a percent or so of its extent; a misread marker is off by a square.
    board_xy = spec.object_points(found.ids)[:, :2]
    H, inliers = cv2.findHomography(board_xy, found.pixels, cv2.RANSAC, max(2.0, 0.02 * extent))
    if H is None or np.mean(inliers) < 0.8 or np.linalg.det(H) <= 0:
        return None
    return np.asarray(H, np.float64)


def _charuco(grey: NDArray[np.uint8], spec: BoardSpec) -> Detection | None:
    corners, ids, markers, _ = cv2.aruco.CharucoDetector(spec.aruco).detectBoard(grey)
    if ids is None:
        return None
    found = Detection(
        np.asarray(ids).reshape(-1).astype(np.int64), np.asarray(corners).reshape(-1, 2).astype(np.float64)
    )
    H = board_homography(found, spec) if len(found) >= MIN_CORNERS else None
    if H is None or abs(_marker_side(markers, H) / spec.marker_m - 1) > _OTHER_MARKER:
        return None
    return found


def _marker_side(outlines: Sequence[NDArray[np.generic]], H: NDArray[np.float64]) -> float:
    """Median side of markers seen, on the board, metres."""
    pixels = np.asarray(outlines, np.float64).reshape(-1, 4, 2)
    on_board = cv2.perspectiveTransform(pixels, np.linalg.inv(H))
    return float(np.median(np.linalg.norm(on_board - np.roll(on_board, 1, axis=1), axis=2)))


def _aprilgrid(grey: NDArray[np.uint8], spec: BoardSpec) -> Detection | None:
    """The tags touch the small black squares, and blur may melt them together; so white is widened by a
    pixel, too, and the tags found there are made larger by as much."""
    widened = cv2.dilate(grey, np.ones((3, 3), np.uint8))
    best: Detection | None = None
    for picture, grown_px in ((grey, 0.0), (widened, 1.0)):
        corners, tags, _ = cv2.aruco.ArucoDetector(dictionary(spec.dictionary)).detectMarkers(picture)
        if (
            tags is None
            or tags.max() >= spec.marker_count
            or (best is not None and 4 * len(tags) <= len(best))
        ):
            continue
        ids = 4 * np.asarray(tags).reshape(-1, 1).astype(np.int64) + np.arange(4)
        outlines = np.asarray(corners, np.float64).reshape(-1, 4, 2)
        outward = outlines - outlines.mean(axis=1, keepdims=True)
        outward *= np.sqrt(2.0) / np.linalg.norm(outward, axis=2, keepdims=True)
        best = Detection(ids.reshape(-1), (outlines + grown_px * outward).reshape(-1, 2))
    return best


def _checkerboard(grey: NDArray[np.uint8], spec: BoardSpec) -> Detection | None:
    """The whole chessboard, numbered from the black corner square that the description calls the origin.

    A mirrored chessboard is a chessboard, so a mirrored picture cannot be told from a right one.
    """
    columns, rows = spec.squares_x - 1, spec.squares_y - 1
    ok, corners = cv2.findChessboardCornersSB(grey, (columns, rows), flags=cv2.CALIB_CB_NORMALIZE_IMAGE)
    if not ok:
        return None
    grid = np.asarray(corners, np.float64).reshape(rows, columns, 2)
    across, down = grid[0, -1] - grid[0, 0], grid[-1, 0] - grid[0, 0]
    if across[0] * down[1] - across[1] * down[0] < 0:
        grid = grid[:, ::-1]
    ids = np.arange(spec.corner_count, dtype=np.int64)
    # Upside down, the square before the first corner is white: one side of the board is odd, the other even.
    step = 0.5 * (grid[1, 1] - grid[0, 0])
    before, beside = (
        _at(grey, grid[0, 0] - step),
        _at(grey, 0.5 * (grid[0, 0] + grid[0, 1]) - 0.5 * (grid[1, 0] - grid[0, 0])),
    )
    if before > beside:
        grid = grid[::-1, ::-1]
    return Detection(ids, grid.reshape(-1, 2))


def _at(grey: NDArray[np.uint8], pixel: NDArray[np.float64]) -> float:
    """The mean of 3x3 pixels about a place, which is moved into the picture."""
    height, width = grey.shape
    x, y = np.clip(np.round(pixel).astype(int), 1, [width - 2, height - 2])
    return float(grey[y - 1 : y + 2, x - 1 : x + 2].mean())
