"""How every pixel's polarizer responds, from pictures of an even light behind a polarizer that is turned.

A pixel sees the states S_k = level_k (1, P cos 2 phi_k, P sin 2 phi_k) of K frames through its analysis
vector a; with the states known that is linear least squares a pixel (Powell and Gruev, Optics Express 2013).
The states are found first, from the mean of the mosaic's four kinds of pixels (`polarizer_states`). What is a
pixel's gain and what an uneven light is told apart by scale: the light changes over many cells only.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray

from calibration.polarizer_states import States, angle_states, cell_means, orientation_deg
from dataset.errors import CalibrationError
from dataset.frames import Mosaic
from dataset.polarimetry import Raw, superpixel, white_level
from dataset.polarizer_response import POLARIZER_CELL, PolarizerResponse
from dataset.progress import Progress, silent

Floats = NDArray[np.float64]
Image = NDArray[np.float32]

MIN_FRAMES = 6
_MIN_CONDITION = 0.2
"""Of the states' smallest singular value to the largest, 0.71 for angles spread evenly (our choice)."""
_LIGHT_CELLS = 33
"""Over so many cells the light is taken to be even (our choice)."""
_PLAUSIBLE_GAIN = (0.5, 1.6)
_DEGREE = 4  # of the polynomial that the fall of the light over the image resembles (our choice)
_CROP = 128


@dataclass(frozen=True, eq=False)
class PolarizerResult:
    """What K frames say about the sensor.

    Attributes:
        response: of every pixel; defective ones carry a zero vector.
        states: the light of every frame.
        sigma: standard deviation of a component of an analysis vector (0.5 is the ideal pixel's first), from
            the frames' noise.
        cell_deg: ((2, 2)) mean orientation of the four kinds of pixels, degrees.
        cell_residual: (K,) rms by which a frame's means miss the model, relative.
        defective: pixels whose gain is out of all proportion, share of all.
        warnings: what is odd about the mosaic or the light, in words.
    """

    response: PolarizerResponse
    states: States
    sigma: float
    cell_deg: Floats
    cell_residual: Floats
    defective: float
    warnings: tuple[str, ...]


def calibrate_polarizer(
    frames: Sequence[Raw],
    layout: Mosaic,
    bits: int,
    angles: ArrayLike | None = None,
    extinction_ratio: float = np.inf,
    on_progress: Progress = silent,
) -> PolarizerResult:
    """The response of every pixel from frames of an even, unpolarized light behind a turned polarizer.

    Args:
        frames: K mosaics (H, W), read one at a time, twice each.
        layout, bits: of the sensor.
        angles: (K,) the polarizer's dial, radians counter-clockwise as the image shows it; NaN or None where
            nobody read it: then the pictures say it, and the mosaic is taken to be laid out as expected.
        extinction_ratio: of the turned polarizer, so that it is not blamed on the sensor.

    Raises:
        CalibrationError: too few frames, pictures that are saturated or dark, angles that are not those of
            the pictures, or a polarizer that was not turned far enough.
    """
    means = cell_means(frames, superpixel(layout), white_level(bits), MIN_FRAMES, on_progress)
    states = angle_states(means, angles)
    return fit_response(frames, states, layout, bits, extinction_ratio, on_progress)


def fit_response(
    frames: Sequence[Raw],
    states: States,
    layout: Mosaic,
    bits: int,
    extinction_ratio: float = np.inf,
    on_progress: Progress = silent,
) -> PolarizerResult:
    """The response of every pixel from K frames of known states of light, however they were made.

    Args:
        frames, layout, bits, extinction_ratio: as in `calibrate_polarizer`.
        states: of the frames.

    Raises:
        CalibrationError: another number of states than frames, states that do not determine the three
            components, or frames of different sizes.
    """
    stokes = states.stokes * np.array([1.0, *[_contrast(extinction_ratio)] * 2])
    _require_determined(len(frames), stokes)
    weights = np.linalg.pinv(stokes).astype(np.float32) / np.float32(white_level(bits))
    vectors, crops = _accumulate(frames, weights, on_progress)
    noise = _noise(crops / white_level(bits), stokes)
    light = _light(vectors[..., 0], superpixel(layout) // 2)
    with np.errstate(divide="ignore", invalid="ignore"):
        analysis = 0.5 * vectors / light[..., None]
    gain = 2 * analysis[..., 0]
    bad = ~((gain > _PLAUSIBLE_GAIN[0]) & (gain < _PLAUSIBLE_GAIN[1]))
    analysis[bad] = 0
    sigma = noise * float(np.sqrt(np.diagonal(np.linalg.inv(stokes.T @ stokes)).max())) * 0.5
    kinds = _by_kind(analysis)
    cell = np.array([orientation_deg(k) for k in kinds]).reshape(2, 2)
    return PolarizerResult(
        response=PolarizerResponse(np.ascontiguousarray(analysis, np.float32)),
        states=states,
        sigma=sigma / float(np.median(light)),
        cell_deg=cell,
        cell_residual=states.residual,
        defective=float(bad.mean()),
        warnings=(*states.warnings, *_odd_mosaic(cell)),
    )


def _contrast(extinction_ratio: float) -> float:
    if not extinction_ratio > 1:
        raise CalibrationError(
            f"polarizer: an extinction ratio of {extinction_ratio:g}; it is T_max / T_min, more than 1: see"
            " the polarizer's data sheet"
        )
    return 1.0 if np.isinf(extinction_ratio) else (extinction_ratio - 1) / (extinction_ratio + 1)


def _require_determined(frames: int, stokes: Floats) -> None:
    if len(stokes) != frames:
        raise CalibrationError(f"polarizer: {len(stokes)} states for {frames} frames; give one a frame")
    if not np.isfinite(stokes).all():
        raise CalibrationError("polarizer: a state of light is NaN or infinite; give finite Stokes vectors")
    if frames < MIN_FRAMES:
        raise CalibrationError(
            f"polarizer: {frames} frames; at least {MIN_FRAMES} angles over 180 degrees are needed, 72 are"
            " good"
        )
    values = np.linalg.svd(stokes / stokes[:, :1], compute_uv=False)
    if values[2] < _MIN_CONDITION * values[0]:
        raise CalibrationError(
            "polarizer: the frames' light hardly changes; turn the polarizer through 180 degrees, in even"
            " steps"
        )


def _accumulate(
    frames: Sequence[Raw], weights: Image, on_progress: Progress
) -> tuple[Image, NDArray[np.float64]]:
    """Sum of weights (3, K) times frames: (H, W, 3); and a crop of every frame (K, c, c), for its noise."""
    total: Image | None = None
    crops = []
    for index in range(len(frames)):
        raw = frames[index]
        if total is None:
            total = np.zeros((3, *raw.shape), np.float32)
        for component in range(3):
            total[component] += weights[component, index] * raw
        crops.append(raw[:_CROP, :_CROP].astype(np.float64))
        on_progress(len(frames) + index + 1, 2 * len(frames))
    assert total is not None
    return np.moveaxis(total, 0, -1), np.stack(crops)


def _noise(crops: Floats, stokes: Floats) -> float:
    """Standard deviation of a reading against the best fit of its pixel, white = 1."""
    rows = crops.reshape(len(crops), -1)
    residual = rows - stokes @ (np.linalg.pinv(stokes) @ rows)
    return float(np.sqrt(np.sum(residual**2) / max(rows.shape[1] * (len(rows) - 3), 1)))


def _light(level: Image, colours: int) -> Image:
    """(H, W) how bright the light is that a pixel of average gain sees: the readings smoothed over many
    cells, each colour by itself."""
    height, width = level.shape
    cells = level.reshape(height // 2, 2, width // 2, 2)
    cell = np.median(cells.swapaxes(1, 2).reshape(height // 2, width // 2, 4), axis=-1)
    light = np.empty_like(cell)
    size = 2 * (_LIGHT_CELLS // colours // 2) + 1
    for row in range(colours):
        for column in range(colours):
            of_colour = np.ascontiguousarray(cell[row::colours, column::colours])
            # Against a polynomial, which a blur would bend at the image's borders.
            bowl = _polynomial(of_colour)
            smooth = cv2.blur(of_colour / bowl, (size, size), borderType=cv2.BORDER_REFLECT)
            light[row::colours, column::colours] = bowl * smooth
    return np.repeat(np.repeat(light, 2, axis=0), 2, axis=1)


def _polynomial(image: Image) -> Image:
    """The polynomial in x and y closest to an image (h, w)."""
    height, width = image.shape
    y, x = np.linspace(-1, 1, height), np.linspace(-1, 1, width)
    step = max(1, min(height, width) // 64)

    powers = [(i, j) for i in range(_DEGREE + 1) for j in range(_DEGREE + 1 - i)]
    coarse = np.stack([np.multiply.outer(y[::step] ** i, x[::step] ** j).ravel() for i, j in powers], axis=1)
    fit, *_ = np.linalg.lstsq(coarse, image[::step, ::step].ravel(), rcond=None)
    level = np.zeros((height, width), np.float32)
    for factor, (i, j) in zip(fit, powers, strict=True):
        level += np.multiply.outer((factor * y**i).astype(np.float32), (x**j).astype(np.float32))
    return np.maximum(level, 0.1 * image.mean())


def _by_kind(analysis: Image) -> list[Floats]:
    """Mean analysis vector (3,) of the four kinds of pixels, row by row of the cell."""
    return [
        np.asarray(analysis[row::2, column::2].mean(axis=(0, 1), dtype=np.float64), np.float64)
        for row in range(2)
        for column in range(2)
    ]


def _odd_mosaic(cell_deg: Floats) -> tuple[str, ...]:
    """What the orientations found say about how the image lies on the sensor."""
    expected = np.array(POLARIZER_CELL)
    found = (45 * np.rint(cell_deg / 45).astype(int)) % 180
    if np.array_equal(found, expected):
        return ()
    shown = " / ".join(" ".join(map(str, row)) for row in found)
    nominal = " / ".join(" ".join(map(str, row)) for row in expected)
    turned = (found - expected) % 180
    if np.all(turned == turned[0, 0]):
        why = (
            f"all are turned by {turned[0, 0]} degrees: the image is rotated or begins at another row or"
            " column of the sensor, or the dial's zero is not along image right"
        )
    else:
        why = (
            "45 and 135 degrees are swapped: the image is mirrored (ReverseX, ReverseY, an odd offset), or"
            " the dial was read clockwise"
        )
    return (f"the mosaic reads {shown} instead of {nominal}; {why}",)
