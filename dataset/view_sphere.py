"""From how many sides something was seen: the sphere of viewing directions, cut into cells of equal width."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

Floats = NDArray[np.float64]

OUTSIDE = -1
"""The cell of a direction below the lowest elevation."""


class ViewSphere:
    """Rings of cells, each about as wide as it is high (our choice: a grid of longitude and latitude would
    crowd at the pole).

    Args:
        cell_deg: height of a cell.
        lowest_deg: elevation of the lower edge of the lowest ring; 0 is the upper hemisphere.

    Attributes:
        directions: (C, 3) unit vectors to the cells' centres, z up.
        sizes: (C, 2) width and height, radians.
    """

    def __init__(self, cell_deg: float = 10.0, lowest_deg: float = 0.0) -> None:
        self.lowest = np.deg2rad(lowest_deg)
        rings = max(1, round((90.0 - lowest_deg) / cell_deg))
        self._height = (np.pi / 2 - self.lowest) / rings
        elevations = self.lowest + self._height * (np.arange(rings) + 0.5)
        self._sectors = np.maximum(1, np.rint(2 * np.pi * np.cos(elevations) / self._height)).astype(np.int64)
        self._first = np.concatenate([[0], np.cumsum(self._sectors)])
        ring = np.repeat(np.arange(rings), self._sectors)
        width = 2 * np.pi / self._sectors[ring]
        azimuth = (np.arange(len(ring)) - self._first[ring] + 0.5) * width
        level = np.cos(elevations[ring])
        self.directions = np.stack(
            [level * np.cos(azimuth), level * np.sin(azimuth), np.sin(elevations[ring])], axis=1
        )
        self.sizes = np.stack([width * level, np.full(len(ring), self._height)], axis=1)

    def __len__(self) -> int:
        return len(self.directions)

    def cells(self, directions: ArrayLike) -> NDArray[np.int64]:
        """(...) the cell of each direction (..., 3), of any length but 0; OUTSIDE below the lowest ring."""
        vectors = np.asarray(directions, dtype=np.float64)
        elevation = np.arcsin(np.clip(vectors[..., 2] / np.linalg.norm(vectors, axis=-1), -1, 1))
        ring = np.floor((elevation - self.lowest) / self._height).astype(np.int64)
        inside = ring >= 0
        ring = np.clip(ring, 0, len(self._sectors) - 1)
        turn = np.mod(np.arctan2(vectors[..., 1], vectors[..., 0]) / (2 * np.pi), 1.0)
        sector = np.minimum((turn * self._sectors[ring]).astype(np.int64), self._sectors[ring] - 1)
        return np.where(inside, self._first[ring] + sector, OUTSIDE)

    def count(self, directions: ArrayLike) -> NDArray[np.int64]:
        """(C,) how many of the directions (N, 3) fall into each cell."""
        cells = self.cells(np.asarray(directions, dtype=np.float64).reshape(-1, 3))
        return np.bincount(cells[cells != OUTSIDE], minlength=len(self))
