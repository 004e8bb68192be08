"""Find the board's corners in a picture, to a small fraction of a pixel, and say why when they are not
there."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from calibration.board import DICTIONARIES, BoardSpec, dictionary
from calibration.corners import refine_corners
from dataset.frames import Mosaic
from dataset.polarimetry import Raw, split_angles

MIN_CORNERS = 6
"""A view with fewer corners is not used (our choice): a pose needs 4, and two more let an error show."""


@dataclass(frozen=True, eq=False)
class Detection:
    """Corners of one board in one picture: ``ids`` (n,) i64 and ``pixels`` (n, 2) f64, x then y."""

    ids: NDArray[np.int64]
    pixels: NDArray[np.float64]

    def __len__(self) -> int:
        return len(self.ids)


def detect(image: NDArray[np.generic], spec: BoardSpec) -> Detection | None:
    """Corners of ``spec`` in a grey picture (H, W) of any real dtype, in that picture's own pixels.

    ``None`` when fewer than :data:`MIN_CORNERS` corners agree with the board's geometry.
    """
    found = _find(image, spec)
    return None if found is None else _refine(image, found, spec)


def detect_in_mosaic(raw: Raw, layout: Mosaic, spec: BoardSpec) -> Detection | None:
    """Corners of ``spec`` in a raw polarization mosaic (H, W), reported in mosaic pixels.

    The picture searched is S0 at half the mosaic's resolution: the mean of each 2x2 polarizer cell, which no
    polarized glare modulates. The centre of its pixel (u, v) lies at (2u + 0.5, 2v + 0.5) of the mosaic.
    """
    intensity = intensity_image(raw, layout)
    found = _find(intensity, spec)
    if found is None:
        return None
    if layout == "colour":
        # The first gains came from the whole picture. The board itself is grey, so it balances the Bayer
        # sites better than any coloured table around it does.
        hull = cv2.convexHull(found.pixels.astype(np.float32)).astype(np.int32)
        on_board = cv2.fillConvexPoly(np.zeros(intensity.shape, np.uint8), hull, 1).astype(bool)
        intensity = _balance_bayer(intensity, on_board)
    refined = _refine(intensity, found, spec)
    return None if refined is None else Detection(refined.ids, 2.0 * refined.pixels + 0.5)


def intensity_image(raw: Raw, layout: Mosaic) -> NDArray[np.float32]:
    """Mean intensity of every 2x2 polarizer cell, (H/2, W/2) f32, with the Bayer sites of a colour sensor
    balanced."""
    intensity = split_angles(raw).astype(np.float32).mean(axis=0)
    if layout == "colour":
        return _balance_bayer(intensity, np.ones(intensity.shape, bool))
    return intensity


def explain_missing_board(image: NDArray[np.generic], spec: BoardSpec) -> str:
    """Why ``spec`` is not found in ``image`` (H, W): another dictionary, another size, a mirrored picture,
    or nothing there."""
    grey = _to_u8(image)
    found = _marker_ids(grey, spec.dictionary)
    if len(found) >= 3:
        if found.max() >= spec.marker_count:
            return (
                f"markers up to id {found.max()} are visible but a {spec.squares_x}x{spec.squares_y} board"
                " has only"
                f" ids 0-{spec.marker_count - 1}: squares_x or squares_y is too small"
            )
        return (
            f"{len(found)} markers of {spec.dictionary} are visible but do not lie as on a"
            f" {spec.squares_x}x{spec.squares_y} board: check squares_x, squares_y and marker_m / square_m"
        )
    if len(_marker_ids(np.ascontiguousarray(grey[:, ::-1]), spec.dictionary)) >= 3:
        return "the markers are mirrored: switch off image flipping in the camera (ReverseX or ReverseY)"
    # Small dictionaries are prefixes of the larger ones: the smallest that explains the markers is tried
    # first.
    candidates = {name: _marker_ids(grey, name) for name in DICTIONARIES if name != spec.dictionary}
    best = max(candidates, key=lambda name: len(candidates[name]))
    if len(candidates[best]) >= 3:
        return f"markers of {best} are visible, the board is described with {spec.dictionary}: correct it"
    return "no marker of any dictionary is visible: check exposure, focus, and that the board is in view"


def _find(image: NDArray[np.generic], spec: BoardSpec) -> Detection | None:
    """OpenCV's corners, to half a pixel or so, if they are enough and lie as on the board."""
    corners, ids, _, _ = cv2.aruco.CharucoDetector(spec.aruco).detectBoard(_to_u8(image))
    if ids is None or len(ids) < MIN_CORNERS:
        return None
    found = Detection(
        np.asarray(ids).reshape(-1).astype(np.int64), np.asarray(corners).reshape(-1, 2).astype(np.float64)
    )
    return None if _homography(found, spec) is None else found


def _refine(image: NDArray[np.generic], found: Detection, spec: BoardSpec) -> Detection | None:
    homography = _homography(found, spec)
    if homography is None:
        return None
    board_xy = spec.object_points(found.ids)[:, :2]
    pixels, good = refine_corners(np.asarray(image, np.float32), found.pixels, board_xy, homography, spec)
    on_one_line = np.linalg.matrix_rank(board_xy[good] - board_xy[good][:1], tol=1e-9) < 2
    if np.count_nonzero(good) < MIN_CORNERS or on_one_line:
        return None
    return Detection(found.ids[good], pixels[good])


def _marker_ids(grey: NDArray[np.uint8], name: str) -> NDArray[np.int64]:
    _, ids, _ = cv2.aruco.ArucoDetector(dictionary(name)).detectMarkers(grey)
    return np.zeros(0, np.int64) if ids is None else ids.reshape(-1).astype(np.int64)


def _to_u8(image: NDArray[np.generic]) -> NDArray[np.uint8]:
    """Stretch to 8 bits for OpenCV's marker detector; the refinement reads the original values."""
    if image.dtype == np.uint8:
        return np.ascontiguousarray(image)
    values = np.asarray(image, np.float32)
    low, high = np.percentile(values[::4, ::4], (0.5, 99.5))
    return np.clip((values - low) * (255.0 / max(float(high - low), 1e-6)), 0, 255).astype(np.uint8)


def _balance_bayer(intensity: NDArray[np.float32], where: NDArray[np.bool_]) -> NDArray[np.float32]:
    """Scale the four Bayer phases of a cell image to their common mean over ``where``, so grey things look
    grey."""
    balanced = intensity.copy()
    means = np.array([[intensity[r::2, c::2][where[r::2, c::2]].mean() for c in (0, 1)] for r in (0, 1)])
    for row, column in np.ndindex(2, 2):
        if means[row, column] > 0:
            balanced[row::2, column::2] *= means.mean() / means[row, column]
    return balanced


def _homography(found: Detection, spec: BoardSpec) -> NDArray[np.float64] | None:
    """Board (m) to picture (px), or None when the corners do not look like one plane seen through one
    lens."""
    extent = float(np.ptp(found.pixels, axis=0).max())
    # Lens distortion bends a board by a percent or so of its extent; a misread marker is off by a square.
    board_xy = spec.object_points(found.ids)[:, :2]
    H, inliers = cv2.findHomography(board_xy, found.pixels, cv2.RANSAC, max(2.0, 0.02 * extent))
    if H is None or np.mean(inliers) < 0.8:
        return None
    return np.asarray(H, np.float64)
