"""What light every frame of a polarizer's calibration saw: how the polarizer stood, how bright the lamp was.

Found from the means of the mosaic's four kinds of pixels, a few numbers a frame that carry no noise to speak
of: angles, levels and the four mean analysis vectors together, each held to what is known of it beforehand.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.optimize import least_squares

from dataset.errors import CalibrationError
from dataset.polarimetry import SATURATED, Raw
from dataset.polarizer_response import POLARIZER_CELL
from dataset.progress import Progress, silent

Floats = NDArray[np.float64]
"""Called with (frames done, frames in all)."""

# Our choices: what a mean over a million pixels, a lamp, a dial and a sensor are good to.
_MEAN_SIGMA = 2e-4
_LAMP_SIGMA = 0.01
_DIAL_SIGMA_RAD = np.radians(0.3)
_CELL_SIGMA = 0.02
_FLICKER = 0.03
_DARK = 0.02
_MAX_SATURATED = 1e-3
_SAME_TURN = 0.97
"""Mean resultant length of angles that agree up to a constant: 7 degrees rms."""
_CROOKED_DIAL_RAD = np.radians(10.0)
_MAX_RESIDUAL = 0.02
_MIN_POLARIZED = 0.5

NOMINAL = np.array(
    [
        [0.5, 0.5 * np.cos(2 * np.radians(angle)), 0.5 * np.sin(2 * np.radians(angle))]
        for row in POLARIZER_CELL
        for angle in row
    ]
)
"""(4, 3) analysis vectors of the ideal cell, row by row."""


@dataclass(frozen=True, eq=False)
class States:
    """The light of K frames.

    Attributes:
        stokes: (K, 3) relative to the mean level.
        angle: (K,) radians in [0, pi): the polarizer as the image shows it; NaN for other light.
        level: (K,) brightness against the mean.
        residual: (K,) relative rms by which the frames' means miss it; zeros where the states were given.
        turn_deg: how far the polarizer was turned from frame to frame (median), counter-clockwise positive;
            NaN for other light.
        warnings: what is odd, in words.
    """

    stokes: Floats
    angle: Floats
    level: Floats
    residual: Floats
    turn_deg: float
    warnings: tuple[str, ...] = ()

    @staticmethod
    def known(stokes: ArrayLike) -> States:
        """A set of states that somebody else made and measured: (K, 3)."""
        stokes = np.asarray(stokes, np.float64).reshape(-1, 3)
        unknown = np.full(len(stokes), np.nan)
        level = stokes[:, 0] / stokes[:, 0].mean()
        return States(stokes, unknown, level, np.zeros(len(stokes)), float("nan"))


def cell_means(
    frames: Sequence[Raw], block: int, white: int, fewest: int, on_progress: Progress = silent
) -> Floats:
    """(K, 4) mean reading of the four kinds of pixels in every frame, row by row of the cell, white = 1.

    Raises:
        CalibrationError: fewer than `fewest` frames, frames of different sizes, saturated or dark ones.
    """
    if len(frames) < fewest:
        raise CalibrationError(
            f"polarizer: {len(frames)} frames; at least {fewest} angles over 180 degrees are needed, 72 are"
            " good"
        )
    means = np.empty((len(frames), 4))
    shape = frames[0].shape
    for index in range(len(frames)):
        raw = frames[index]
        if raw.shape != shape or raw.ndim != 2 or raw.shape[0] % block or raw.shape[1] % block:
            raise CalibrationError(
                f"polarizer: frame {index} is {raw.shape}, the first {shape}; give mosaics of one size, of"
                f" whole {block}x{block} super-pixels"
            )
        if np.mean(raw >= SATURATED * white) > _MAX_SATURATED:
            raise CalibrationError(
                f"polarizer: frame {index} is saturated; lower the exposure so that the brightest pixels stay"
                " at 80 % of the white level"
            )
        means[index] = [raw[row::2, column::2].mean() / white for row in range(2) for column in range(2)]
        on_progress(index + 1, 2 * len(frames))
    dark = np.flatnonzero(means.mean(axis=1) < _DARK)
    if len(dark):
        raise CalibrationError(
            f"polarizer: frame {dark[0]} is dark ({100 * means[dark[0]].mean():.1f} % of white); light the"
            " whole image evenly and raise the exposure"
        )
    return means


def angle_states(means: Floats, angles: ArrayLike | None = None) -> States:
    """The states of light behind a linear polarizer, from the means (K, 4) of the four kinds of pixels.

    With the dial's angles known the mosaic may lie in the image any way; without them it is taken to lie as
    expected, and only its orientation as a whole goes unmeasured. The dial's zero is fitted.

    Raises:
        CalibrationError: light that is not polarized, angles that are not those of the pictures.
    """
    K = len(means)
    level = means.mean(axis=1) * 2
    decoded = (np.linalg.pinv(NOMINAL) @ means.T).T
    if np.median(np.hypot(decoded[:, 1], decoded[:, 2]) / decoded[:, 0]) < _MIN_POLARIZED:
        raise CalibrationError(
            "polarizer: the pictures show hardly any polarization; put a linear polarizer before the lens"
            " that covers the whole view"
        )
    seen = 0.5 * np.arctan2(decoded[:, 2], decoded[:, 1])
    dial = None if angles is None else np.asarray(angles, np.float64).reshape(-1)
    if dial is not None and len(dial) != K:
        raise CalibrationError(f"polarizer: {len(dial)} angles for {K} frames; give one a frame")
    warnings: tuple[str, ...] = ()
    if dial is None or not np.isfinite(dial).any():
        start, cells, held = seen, NOMINAL, False
    elif not np.isfinite(dial).all():
        raise CalibrationError(
            f"polarizer: the angle of frame {int(np.flatnonzero(~np.isfinite(dial))[0])} is missing; give all"
            " angles or none"
        )
    else:
        start, warnings = _on_the_dial(seen, dial)
        held = True
        polarized = np.column_stack([np.ones(K), np.cos(2 * start), np.sin(2 * start)])
        cells = (np.linalg.pinv(level[:, None] * polarized) @ means).T
    return _refined(means, start, level, cells, held, warnings)


def orientation_deg(vector: Floats) -> float:
    """Orientation of an analysis vector (3,), degrees in [0, 180)."""
    return float(np.degrees(0.5 * np.arctan2(vector[2], vector[1])) % 180)


def _on_the_dial(seen: Floats, dial: Floats) -> tuple[Floats, tuple[str, ...]]:
    """The dial's angles with its zero where the pictures put it, to the nearest eighth of a turn."""
    same, mirrored = (np.mean(np.exp(2j * (seen - sign * dial))) for sign in (1, -1))
    if max(abs(same), abs(mirrored)) < _SAME_TURN:
        raise CalibrationError(
            "polarizer: the angles given are not those of the pictures; check that they are in the frames'"
            " order and in the right unit, or leave them out"
        )
    # Mirrored pictures turn the other way round: seen = offset - dial, with the mosaic's own half turns.
    offset = 0.5 * float(np.angle(same if abs(same) >= abs(mirrored) else mirrored))
    crooked = offset - np.pi / 4 * np.rint(offset / (np.pi / 4))
    zero = crooked if abs(same) >= abs(mirrored) else -crooked
    warnings: tuple[str, ...] = ()
    if abs(crooked) > _CROOKED_DIAL_RAD:
        warnings = (
            f"the dial's zero is {np.degrees(crooked):.0f} degrees off image right, or the mosaic is: angles"
            " were shifted by it; align the dial, else the polarization angles carry that error",
        )
    return dial + zero, warnings


def _refined(
    means: Floats, angle: Floats, level: Floats, cells: Floats, held: bool, warnings: tuple[str, ...]
) -> States:
    """Angles, levels and mean analysis vectors together, by least squares."""
    K = len(means)
    mean_level = float(level.mean())
    nominal = _nearest_nominal(cells)
    flicker = float(level.std() / mean_level)
    if flicker > _FLICKER:
        warnings = (
            *warnings,
            f"the light changed by {100 * flicker:.0f} % (rms) from frame to frame: it flickers, or it is"
            " polarized before the polarizer, as a screen's is; an even lamp calibrates better",
        )

    def unpack(x: Floats) -> tuple[Floats, Floats, Floats]:
        turned = angle + x[:K] + x[-1] * held
        return turned, mean_level * np.exp(x[K : 2 * K]), nominal + x[2 * K : -1].reshape(4, 3)

    def predicted(phi: Floats, levels: Floats, vectors: Floats) -> Floats:
        return levels[:, None] * (np.column_stack([np.ones(K), np.cos(2 * phi), np.sin(2 * phi)]) @ vectors.T)

    def residual(x: Floats) -> Floats:
        phi, levels, vectors = unpack(x)
        off = (predicted(phi, levels, vectors) - means) / (_MEAN_SIGMA * mean_level)
        dial = x[:K] / _DIAL_SIGMA_RAD if held else np.zeros(0)
        lamp = x[K : 2 * K] / max(_LAMP_SIGMA, 2 * flicker)
        return np.concatenate([off.ravel(), dial, lamp, x[2 * K : -1] / (0.5 * _CELL_SIGMA), x[-1:] / np.pi])

    first = np.concatenate([np.zeros(K), np.log(level / mean_level), np.zeros(13)])
    fit = least_squares(residual, first, method="trf", x_scale="jac")
    phi, levels, vectors = unpack(fit.x)
    miss = np.sqrt(np.mean((predicted(phi, levels, vectors) - means) ** 2, axis=1)) / means.mean()
    if np.median(miss) > _MAX_RESIDUAL:
        raise CalibrationError(
            f"polarizer: the frames miss the model by {100 * np.median(miss):.1f} %; the light must be even,"
            " steady and unpolarized before the polarizer, and the dial read to half a degree"
        )
    relative = levels / levels.mean()
    stokes = relative[:, None] * np.column_stack([np.ones(K), np.cos(2 * phi), np.sin(2 * phi)])
    steps = np.mod(np.diff(phi) + np.pi / 2, np.pi) - np.pi / 2
    return States(stokes, np.mod(phi, np.pi), relative, miss, float(np.degrees(np.median(steps))), warnings)


def _nearest_nominal(cells: Floats) -> Floats:
    """(4, 3) ideal vectors with the orientations found, to the nearest eighth of a turn."""
    angles = np.radians(45 * np.rint(np.array([orientation_deg(cell) for cell in cells]) / 45))
    return 0.5 * np.column_stack([np.ones(4), np.cos(2 * angles), np.sin(2 * angles)])
