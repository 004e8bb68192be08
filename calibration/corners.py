"""Sub-pixel chessboard corners by fitting what a blurred corner looks like.

Around an inner corner the picture is the product of two blurred edges,

    I(p) = a + g . (p - c) + b erf(d1 / (sqrt2 s)) erf(d2 / (sqrt2 s)),

with d1, d2 the signed distances to the two edge lines through the corner c. Fitting the whole patch uses
every pixel that sees only the corner, the long arms between the neighbouring markers included, where
gradient-voting refinements need a window that is free of markers altogether. The model is our choice.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.special import erf

from calibration.board import BoardSpec

_PARAMETERS = 9  # cx, cy, angle 1, angle 2, blur, offset, contrast, gradient x, gradient y
_MAX_HALF_WINDOW_PX = 10
_MAX_SHIFT_PX = 3.0


def refine_corners(
    image: NDArray[np.float32],
    pixels: NDArray[np.float64],
    board_xy: NDArray[np.float64],
    homography: NDArray[np.float64],
    spec: BoardSpec,
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Refine corners ``pixels`` (n, 2) found in ``image`` (H, W).

    ``board_xy`` (n, 2) are the same corners on the board in metres and ``homography`` maps board to picture;
    they give the edges' directions and the place of the neighbouring markers. Returns the refined corners
    (n, 2) and how clearly (n,) each was seen: its contrast over the misfit, zero where it cannot be used.
    """
    frame = _local_frames(homography, board_xy)  # (n, 2, 2): board metres -> pixels, near each corner
    square_px = np.median(np.linalg.norm(frame, axis=1)) * spec.plain_m[0]
    half = int(np.clip(round(0.45 * square_px), 3, _MAX_HALF_WINDOW_PX))
    centre = np.round(pixels).astype(np.int64)
    height, width = image.shape
    inside = np.all((centre >= half) & (centre < np.array([width, height]) - half), axis=1)
    if not inside.any():
        return pixels, np.zeros(len(pixels))
    centre, frame = centre[inside], frame[inside]

    steps = np.arange(-half, half + 1)
    offsets = np.stack(np.meshgrid(steps, steps), axis=-1).reshape(-1, 2).astype(np.float64)  # (m, 2): x, y
    rows = centre[:, None, 1] + offsets[None, :, 1].astype(np.int64)
    columns = centre[:, None, 0] + offsets[None, :, 0].astype(np.int64)
    values = image[rows, columns].astype(np.float64)
    start = pixels[inside] - centre
    weights = _free_of_markers(offsets[None] - start[:, None], frame, spec)
    fitted, clarity = _fit(values, offsets, weights, start, frame)

    refined, seen = pixels.copy(), np.zeros(len(pixels))
    refined[inside] = centre + fitted
    seen[inside] = clarity
    refined[seen == 0] = pixels[seen == 0]
    return refined, seen


def _local_frames(H: NDArray[np.float64], xy: NDArray[np.float64]) -> NDArray[np.float64]:
    """Jacobian (n, 2, 2) of the homography at points xy (n, 2)."""
    p = xy @ H[:, :2].T + H[:, 2]
    uv = p[:, :2] / p[:, 2:]
    return (H[None, :2, :2] - uv[:, :, None] * H[None, 2:, :2]) / p[:, 2, None, None]


def _free_of_markers(
    offsets: NDArray[np.float64], frame: NDArray[np.float64], spec: BoardSpec
) -> NDArray[np.float64]:
    """1 where a pixel (n, m, 2), relative to the corner, sees only the corner's own four squares; else 0."""
    on_board = np.abs(offsets @ np.swapaxes(np.linalg.inv(frame), 1, 2))  # (n, m, 2) metres
    guard = 1.5 / np.linalg.norm(frame, axis=1).min(axis=1)[:, None]  # 1.5 px of blur, in metres
    square_m, marker_m = spec.plain_m
    margin = 0.5 * (square_m - marker_m)
    near_an_edge = on_board.min(axis=-1) < np.maximum(margin - guard, 0.5 * guard)
    within_squares = on_board.max(axis=-1) < square_m - np.minimum(guard, 0.5 * square_m)
    return (near_an_edge & within_squares).astype(np.float64)


def _fit(
    values: NDArray[np.float64],
    offsets: NDArray[np.float64],
    weights: NDArray[np.float64],
    start: NDArray[np.float64],
    frame: NDArray[np.float64],
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Levenberg-Marquardt on all corners at once; values, weights (n, m), offsets (m, 2), start (n, 2)."""
    n = len(values)
    p = np.zeros((n, _PARAMETERS))
    p[:, :2] = start
    p[:, 2] = np.arctan2(frame[:, 1, 0], frame[:, 0, 0])
    p[:, 3] = np.arctan2(frame[:, 1, 1], frame[:, 0, 1])
    p[:, 4] = 0.8
    p[:, 5] = np.sum(weights * values, axis=1) / np.maximum(weights.sum(axis=1), 1.0)
    # The sign of the contrast says which quadrants are white: start from the better of the two.
    shape, _ = _model(_with(p, 6, 1.0), offsets)
    shape = shape - p[:, 5:6]
    p[:, 6] = np.sum(weights * shape * (values - p[:, 5:6]), axis=1) / np.maximum(
        np.sum(weights * shape**2, axis=1), 1e-9
    )
    damping = np.full(n, 1e-3)
    model, J = _model(p, offsets)
    residual = weights * (values - model)
    cost = np.sum(residual**2, axis=1)
    for _ in range(25):
        JtJ = np.einsum("nmi,nm,nmj->nij", J, weights, J, optimize=True)
        scale = np.einsum("nii->ni", JtJ) + 1e-9
        A = JtJ + damping[:, None, None] * scale[:, :, None] * np.eye(_PARAMETERS)
        step = np.linalg.solve(A, np.einsum("nmi,nm->ni", J, residual)[..., None])[..., 0]
        trial = p + step
        trial[:, 4] = np.clip(trial[:, 4], 0.3, 4.0)
        model, J_trial = _model(trial, offsets)
        r_trial = weights * (values - model)
        cost_trial = np.sum(r_trial**2, axis=1)
        better = cost_trial <= cost
        p[better], J[better], residual[better] = trial[better], J_trial[better], r_trial[better]
        cost = np.where(better, cost_trial, cost)
        damping = np.clip(np.where(better, 0.3 * damping, 5.0 * damping), 1e-9, 1e6)
        if np.all(np.abs(step[:, :2]).max(axis=1)[better] < 1e-4) and better.all():
            break
    count = np.maximum(weights.sum(axis=1), 1.0)
    noise = np.sqrt(cost / count)
    good = (
        (np.linalg.norm(p[:, :2] - start, axis=1) < _MAX_SHIFT_PX)
        & (np.abs(p[:, 6]) > 2.0 * noise)
        & (p[:, 4] < 3.9)
        & (count > 2 * _PARAMETERS)
    )
    return p[:, :2], np.where(good, np.abs(p[:, 6]) / np.maximum(noise, 1e-9), 0.0)


def _with(p: NDArray[np.float64], column: int, value: float) -> NDArray[np.float64]:
    changed = p.copy()
    changed[:, column] = value
    return changed


def _model(
    p: NDArray[np.float64], offsets: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """The picture of a blurred corner (n, m) and its Jacobian (n, m, 9) for parameters p (n, 9)."""
    centre, angles, blur = p[:, None, :2], p[:, 2:4], p[:, 4, None]
    offset, contrast, gradient = p[:, 5, None], p[:, 6, None], p[:, 7:9]
    delta = offsets[None] - centre  # (n, m, 2)
    along = np.stack([np.cos(angles), np.sin(angles)], axis=-1)  # (n, 2, 2): edge, xy
    normal = np.stack([-along[..., 1], along[..., 0]], axis=-1)
    d = np.einsum("nmi,nei->nme", delta, normal)  # signed distances to both edges
    z = d / (np.sqrt(2.0) * blur[..., None])
    edge = erf(z)
    slope = np.sqrt(2.0 / np.pi) / blur[..., None] * np.exp(-(z**2))  # d edge / d distance
    product = edge[..., 0] * edge[..., 1]
    ramp = np.einsum("nmi,ni->nm", delta, gradient)
    by_distance = contrast[..., None] * slope * edge[..., ::-1]  # d I / d distance to each edge
    by_centre = -np.einsum("nme,nei->nmi", by_distance, normal) - gradient[:, None, :]
    by_angle = -by_distance * np.einsum("nmi,nei->nme", delta, along)
    by_blur = -np.sum(by_distance * d, axis=-1) / blur
    J = np.concatenate(
        [by_centre, by_angle, by_blur[..., None], np.ones((*product.shape, 1)), product[..., None], delta],
        axis=-1,
    )
    return offset + ramp + contrast * product, J
