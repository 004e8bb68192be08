"""Find the board's corners in a picture, to a small fraction of a pixel, and say why when they are not
there."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from calibration.board import DICTIONARIES, BoardSpec, dictionary
from calibration.corners import refine_corners
from calibration.finders import MIN_CORNERS, Detection, board_homography, find, to_u8
from calibration.glare import GLARE_DOLP, Channel, glare, intensity, without_glare
from dataset.frames import Mosaic
from dataset.polarimetry import Raw

_CLEARER = 1.3
"""S0, which is the mean of four pixels, is left only for a picture that shows a corner so much better."""


def detect(image: NDArray[np.generic], spec: BoardSpec) -> Detection | None:
    """Corners of ``spec`` in a grey picture (H, W) of any real dtype, in that picture's own pixels.

    ``None`` when fewer than :data:`MIN_CORNERS` corners agree with the board's geometry.
    """
    found = find(image, spec)
    if found is None:
        return None
    pixels, clarity = _refine(image, found, spec)
    return _clear(found.ids, pixels, clarity, spec)


def detect_in_mosaic(raw: Raw, layout: Mosaic, spec: BoardSpec) -> Detection | None:
    """Corners of ``spec`` in a raw polarization mosaic (H, W), reported in mosaic pixels.

    The picture searched is S0 at half the mosaic's resolution: the mean of each 2x2 polarizer cell, which no
    polarization modulates. The centre of its pixel (u, v) lies at (2u + 0.5, 2v + 0.5) of the mosaic. Where
    the board's light is polarized by glare, or S0 does not show the board, the least intensity over all
    polarizer angles and the four angle images are searched, too, and every corner is taken from the picture
    that shows it most clearly.
    """
    channels = [intensity(raw)]
    found = [_find_in(channels[0], layout, spec)]
    if found[0] is None or glare(raw, _hull(found[0], channels[0].image.shape)) > GLARE_DOLP:
        channels += without_glare(raw)
        found += [_find_in(channel, layout, spec) for channel in channels[1:]]
    known = _merged([(c, f) for c, f in zip(channels, found, strict=True) if f is not None])
    if known is None:
        return None
    best, most = known.pixels.copy(), np.zeros(len(known))
    for channel in channels:
        here = Detection(known.ids, channel.from_mosaic(known.pixels))
        pixels, clarity = _refine(_balanced(channel.image, layout, here), here, spec)
        clearer = clarity > _CLEARER * most
        best[clearer], most[clearer] = channel.to_mosaic(pixels)[clearer], clarity[clearer]
    return _clear(known.ids, best, most, spec)


def _find_in(channel: Channel, layout: Mosaic, spec: BoardSpec) -> Detection | None:
    whole = np.ones(channel.image.shape, bool)
    return find(_balance_bayer(channel.image, whole) if layout == "colour" else channel.image, spec)


def _merged(found: list[tuple[Channel, Detection]]) -> Detection | None:
    """Every corner found in any picture, once, in mosaic pixels; None when there is none."""
    if not found:
        return None
    found = sorted(found, key=lambda pair: -len(pair[1]))
    ids, first = np.unique(np.concatenate([f.ids for _, f in found]), return_index=True)
    return Detection(ids, np.concatenate([c.to_mosaic(f.pixels) for c, f in found])[first])


def _balanced(image: NDArray[np.float32], layout: Mosaic, found: Detection) -> NDArray[np.float32]:
    """The Bayer sites balanced over the board: it is grey, whatever stands around it."""
    return _balance_bayer(image, _hull(found, image.shape)) if layout == "colour" else image


def _hull(found: Detection, shape: tuple[int, ...]) -> NDArray[np.bool_]:
    """The part of a picture that the corners surround."""
    hull = cv2.convexHull(found.pixels.astype(np.float32)).astype(np.int32)
    return cv2.fillConvexPoly(np.zeros(shape, np.uint8), hull, 1).astype(bool)


def intensity_image(raw: Raw, layout: Mosaic) -> NDArray[np.float32]:
    """Mean intensity of every 2x2 polarizer cell, (H/2, W/2) f32, with the Bayer sites of a colour sensor
    balanced."""
    image = intensity(raw).image
    return _balance_bayer(image, np.ones(image.shape, bool)) if layout == "colour" else image


def explain_missing_board(image: NDArray[np.generic], spec: BoardSpec) -> str:
    """Why ``spec`` is not found in ``image`` (H, W): another dictionary, another size, a mirrored picture,
    or nothing there."""
    grey = to_u8(image)
    if spec.kind == "checkerboard":
        return (
            f"no chessboard of {spec.squares_x}x{spec.squares_y} squares is visible as a whole: check the"
            " count of squares (not of inner corners), exposure, focus, and that no corner is hidden"
        )
    found = _marker_ids(grey, spec.dictionary)
    if len(found) >= 3:
        if found.max() >= spec.marker_count:
            return (
                f"markers up to id {found.max()} are visible but a {spec.squares_x}x{spec.squares_y} board"
                f" has only ids 0-{spec.marker_count - 1}: squares_x or squares_y is too small"
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


def _refine(
    image: NDArray[np.generic], found: Detection, spec: BoardSpec
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Refined pixels (n, 2), and how clearly each corner was seen."""
    homography = board_homography(found, spec)
    if homography is None:
        return found.pixels, np.zeros(len(found))
    board_xy = spec.object_points(found.ids)[:, :2]
    return refine_corners(np.asarray(image, np.float32), found.pixels, board_xy, homography, spec)


def _clear(
    ids: NDArray[np.int64], pixels: NDArray[np.float64], clarity: NDArray[np.float64], spec: BoardSpec
) -> Detection | None:
    """The corners that were seen clearly; None when they are too few or lie on one line."""
    good = clarity > 0
    board_xy = spec.object_points(ids[good])[:, :2]
    if len(board_xy) < MIN_CORNERS or np.linalg.matrix_rank(board_xy - board_xy[:1], tol=1e-9) < 2:
        return None
    return Detection(ids[good], pixels[good])


def _marker_ids(grey: NDArray[np.uint8], name: str) -> NDArray[np.int64]:
    _, ids, _ = cv2.aruco.ArucoDetector(dictionary(name)).detectMarkers(grey)
    return np.zeros(0, np.int64) if ids is None else ids.reshape(-1).astype(np.int64)


def _balance_bayer(intensity: NDArray[np.float32], where: NDArray[np.bool_]) -> NDArray[np.float32]:
    """Scale the four Bayer phases of a cell image to their common mean over ``where``, so grey things look
    grey."""
    balanced = intensity.copy()
    means = np.array([[intensity[r::2, c::2][where[r::2, c::2]].mean() for c in (0, 1)] for r in (0, 1)])
    for row, column in np.ndindex(2, 2):
        if means[row, column] > 0:
            balanced[row::2, column::2] *= means.mean() / means[row, column]
    return balanced
