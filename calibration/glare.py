"""The same view of a board through different polarizers: glare that hides a corner in one spares it in
another.

Light that a glossy print reflects like a mirror is polarized, most of all near Brewster's angle; the board's
own diffuse light is hardly so. Behind a polarizer across it the glare is gone: that is one of the four angle
images, or nearly, and everywhere the smallest intensity over all angles, S0 (1 - DoLP) / 2.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from dataset.polarimetry import ANGLES_DEG, POLARIZER_CELL, Raw, split_angles

GLARE_DOLP = 0.2
"""Degree of polarization from which a board's light counts as glare (our choice: print is below 0.1)."""

_SMOOTH_PX = 9  # glare is smooth; the board's own edges, seen by four shifted sites, pass for polarization
_REGION_PX = 33  # over which glare is judged: a few squares, whose edges cancel


@dataclass(frozen=True, eq=False)
class Channel:
    """One picture (H/2, W/2) f32 of the board; its pixel (u, v) lies at (2u + x, 2v + y) of the mosaic."""

    name: str
    image: NDArray[np.float32]
    x: float
    y: float

    def to_mosaic(self, pixels: NDArray[np.float64]) -> NDArray[np.float64]:
        """Pixels (n, 2) of this picture in mosaic pixels."""
        return 2.0 * pixels + [self.x, self.y]

    def from_mosaic(self, pixels: NDArray[np.float64]) -> NDArray[np.float64]:
        """Mosaic pixels (n, 2) in this picture."""
        return (pixels - [self.x, self.y]) / 2.0


def intensity(raw: Raw) -> Channel:
    """S0 / 2: the mean of each 2x2 polarizer cell, centred between its four pixels."""
    return Channel("S0", split_angles(raw).astype(np.float32).mean(axis=0), 0.5, 0.5)


def without_glare(raw: Raw) -> list[Channel]:
    """The smallest intensity over all polarizer angles, and the four angle images."""
    angles = split_angles(raw).astype(np.float32)
    mean, polarized = angles.mean(axis=0), _polarized(angles)
    found = [Channel("least", mean - 0.5 * polarized, 0.5, 0.5)]
    for image, angle in zip(angles, ANGLES_DEG, strict=True):
        row, column = next(
            (row, column) for row, column in np.ndindex(2, 2) if POLARIZER_CELL[row][column] == angle
        )
        found.append(Channel(f"{angle} degrees", image, float(column), float(row)))
    return found


def glare(raw: Raw, where: NDArray[np.bool_]) -> float:
    """The 95th percentile of the smooth degree of polarization over a region (H/2, W/2) of the cells."""
    angles = split_angles(raw).astype(np.float32)
    mean = cv2.blur(angles.mean(axis=0), (_REGION_PX, _REGION_PX))
    ratio = _polarized(angles, _REGION_PX) / np.maximum(2.0 * mean, 1e-6)
    return float(np.percentile(ratio[where], 95.0)) if where.any() else 0.0


def _polarized(angles: NDArray[np.float32], smooth_px: int = _SMOOTH_PX) -> NDArray[np.float32]:
    """(H/2, W/2) sqrt(S1^2 + S2^2), of smoothed S1 and S2."""
    box = (smooth_px, smooth_px)
    s1, s2 = cv2.blur(angles[0] - angles[2], box), cv2.blur(angles[1] - angles[3], box)
    return np.asarray(np.hypot(s1, s2), np.float32)
