"""How the pixels of one polarization sensor really respond: their gain, extinction and orientation.

A pixel reads I = a . (S0, S1, S2) with its analysis vector a. Behind a polarizer of orientation theta,
transmission gain g and extinction ratio E it is a = g/2 (1, p cos 2 theta, p sin 2 theta), p = (E-1)/(E+1).
The ideal sensor has g = 1, infinite E and the orientations of `POLARIZER_CELL`; a real one is calibrated as
in Powell and Gruev, "Calibration methods for division-of-focal-plane polarimeters", Optics Express 2013.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import ArrayLike, NDArray

from dataset.errors import ToolkitError
from dataset.mosaic_kernels import demodulation_of

Image = NDArray[np.float32]

POLARIZER_CELL: tuple[tuple[int, int], tuple[int, int]] = ((90, 45), (135, 0))
"""Degrees of the 2x2 polarizer cell of Sony's Polarsens sensors, as displayed."""


@dataclass(frozen=True, eq=False)
class PolarizerResponse:
    """The analysis vector of every pixel of a mosaic.

    Attributes:
        analysis: (H, W, 3) float32. A pixel whose vector is zero (a dead one) is not used.

    Raises:
        ToolkitError: not (H, W, 3) of whole 2x2 cells, or not finite.
    """

    analysis: Image

    def __post_init__(self) -> None:
        shape = self.analysis.shape
        if len(shape) != 3 or shape[2] != 3 or shape[0] % 2 or shape[1] % 2 or 0 in shape:
            raise ToolkitError(
                f"polarizer response: analysis vectors of shape {shape}; give (H, W, 3), H and W even"
            )
        if not np.isfinite(self.analysis).all():
            raise ToolkitError(
                "polarizer response: an analysis vector is not finite; calibrate the polarizers again"
            )

    @staticmethod
    def of(gain: ArrayLike, extinction_ratio: ArrayLike, orientation: ArrayLike) -> PolarizerResponse:
        """From what polarizers are described by, each a number or (H, W): transmission against the ideal,
        T_max / T_min, and radians counter-clockwise from image right."""
        gain, ratio, theta = np.broadcast_arrays(
            *(np.asarray(v, np.float32) for v in (gain, extinction_ratio, orientation))
        )
        with np.errstate(invalid="ignore"):
            contrast = np.where(np.isinf(ratio), np.float32(1), (ratio - 1) / (ratio + 1))
        doubled = 2 * theta
        half = np.float32(0.5) * gain
        vectors = np.stack([half, half * contrast * np.cos(doubled), half * contrast * np.sin(doubled)], -1)
        return PolarizerResponse(vectors.astype(np.float32))

    @staticmethod
    def ideal(height: int, width: int) -> PolarizerResponse:
        """What a mosaic is taken for that was never calibrated."""
        return PolarizerResponse.of(1.0, np.inf, nominal_orientation(height, width))

    @property
    def shape(self) -> tuple[int, int]:
        """(H, W) of the mosaic."""
        height, width = self.analysis.shape[:2]
        return height, width

    @cached_property
    def gain(self) -> Image:
        """(H, W) transmission against the ideal; 0 for a dead pixel."""
        return np.asarray(2 * self.analysis[..., 0], np.float32)

    @cached_property
    def extinction_ratio(self) -> Image:
        """(H, W) T_max / T_min; inf where it is beyond what was measured, NaN for a dead pixel."""
        contrast = self._contrast
        with np.errstate(divide="ignore", invalid="ignore"):
            ratio = np.where(contrast < 1, (1 + contrast) / (1 - contrast), np.inf)
        return np.where(np.isnan(contrast), np.nan, ratio).astype(np.float32)

    @cached_property
    def orientation(self) -> Image:
        """(H, W) radians in [0, pi), counter-clockwise from image right."""
        doubled = np.arctan2(self.analysis[..., 2], self.analysis[..., 1])
        return np.asarray(np.mod(0.5 * doubled, np.pi), np.float32)

    @property
    def orientation_error(self) -> Image:
        """(H, W) radians in [-pi/2, pi/2): orientation against the nominal cell."""
        off = self.orientation - nominal_orientation(*self.shape)
        return np.asarray(np.mod(off + np.pi / 2, np.pi) - np.pi / 2, np.float32)

    @cached_property
    def demodulation(self) -> Image:
        """(H/2, W/2, 3, 4) float32 least squares from the 2x2 cell's four readings, row by row, to S0, S1,
        S2; zero where the cell's pixels do not determine them."""
        height, width = self.shape
        out = np.empty((height // 2, width // 2, 3, 4), np.float32)
        demodulation_of(np.ascontiguousarray(self.analysis), out)
        return out

    @property
    def _contrast(self) -> Image:
        level = np.where(self.analysis[..., 0] > 0, self.analysis[..., 0], np.float32(np.nan))
        return np.asarray(np.hypot(self.analysis[..., 1], self.analysis[..., 2]) / level, np.float32)


def nominal_orientation(height: int, width: int) -> Image:
    """(H, W) radians: the orientation of every pixel's polarizer as the sensor's maker states it."""
    cell = np.radians(np.array(POLARIZER_CELL, np.float32))
    return np.tile(cell, (height // 2, width // 2))
