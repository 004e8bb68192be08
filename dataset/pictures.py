"""Pictures of polarization as a person can look at them: S0, DoLP, AoLP, and where the sensor was blinded."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from dataset.polarimetry import DARK, Stokes

Picture = NDArray[np.uint8]
"""(h, w) grey or (h, w, 3) BGR, as OpenCV writes it."""

SATURATED_BGR = (60, 60, 255)

_NOMINAL_FIELD_OF_VIEW = 0.7
"""Focal length in image widths where no calibration is at hand (our choice: the paper's lens)."""


def intensity(stokes: Stokes) -> Picture:
    """(h, w) grey picture of S0, stretched to its brightest percent, gamma 2.2."""
    bright = max(float(np.percentile(stokes.s0, 99)), 1e-6)
    return to_bytes(np.clip(stokes.s0 / bright, 0, 1) ** (1 / 2.2))


def degree(stokes: Stokes, full_scale: float = 1.0) -> Picture:
    """(h, w, 3) BGR picture of the DoLP, dark blue 0 to yellow `full_scale`."""
    levels = to_bytes(np.clip(stokes.dolp / full_scale, 0, 1))
    return np.asarray(cv2.applyColorMap(levels, cv2.COLORMAP_VIRIDIS), np.uint8)


def angle(stokes: Stokes) -> Picture:
    """(h, w, 3) BGR picture of the AoLP: hue is the angle (0 and 180 degrees alike), brightness the DoLP's
    root.
    """
    hue = np.mod(stokes.aolp * (180 / np.pi), 180).astype(np.uint8)
    value = to_bytes(np.sqrt(np.clip(stokes.dolp, 0, 1)))
    picture = np.dstack([hue, np.full_like(hue, 220), value])
    return np.asarray(cv2.cvtColor(picture, cv2.COLOR_HSV2BGR), np.uint8)


def saturated(stokes: Stokes) -> NDArray[np.bool_]:
    """(h, w) bool: lit, and yet not valid, which leaves that one of its pixels reached the white level."""
    return ~stokes.valid & (stokes.s0 >= DARK)


def in_colour(picture: Picture) -> Picture:
    """(h, w, 3) BGR of a grey or coloured picture."""
    return np.dstack([picture] * 3) if picture.ndim == 2 else picture


def to_bytes(values: NDArray[np.floating]) -> Picture:
    """Values in [0, 1] as 0 to 255."""
    return np.rint(255 * values).astype(np.uint8)


def nominal_camera_matrix(height: int, width: int) -> NDArray[np.float64]:
    """(3, 3) pinhole matrix of a plausible lens, for pictures of uncalibrated frames."""
    focal = _NOMINAL_FIELD_OF_VIEW * width
    return np.array([[focal, 0, (width - 1) / 2], [0, focal, (height - 1) / 2], [0, 0, 1]])
