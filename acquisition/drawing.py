"""A small SVG canvas for pictures of the arm: points in metres go in, seen along a direction."""

from __future__ import annotations

from html import escape

import numpy as np
from numpy.typing import ArrayLike, NDArray

Floats = NDArray[np.float64]


class Canvas:
    """A picture of the base frame, looked at in parallel projection.

    Args:
        size: width and height, pixels.
        right, up: (3,) unit vectors of the base frame that point right and up in the picture.
        centre: (3,) the point in the middle, metres.
        scale: pixels per metre.
    """

    def __init__(
        self, size: tuple[int, int], right: ArrayLike, up: ArrayLike, centre: ArrayLike, scale: float
    ) -> None:
        self._size = size
        self._axes = np.array([right, np.negative(up)], dtype=np.float64)
        self._centre = np.asarray(centre, dtype=np.float64)
        self._scale = scale
        self._parts: list[str] = []

    def line(self, points: ArrayLike, colour: str, width: float = 1.0, opacity: float = 1.0) -> None:
        """An open polyline through points (N, 3)."""
        self._add("polyline", points, f'fill="none" stroke="{colour}" stroke-width="{width}"', opacity)

    def area(self, points: ArrayLike, fill: str, stroke: str = "none", opacity: float = 1.0) -> None:
        """A filled polygon of points (N, 3)."""
        self._add("polygon", points, f'fill="{fill}" stroke="{stroke}" stroke-width="0.7"', opacity)

    def dot(self, point: ArrayLike, colour: str, radius: float = 2.0) -> None:
        """A point (3,), its radius in pixels."""
        ((x, y),) = self._pixels(np.reshape(point, (1, 3)))
        self._parts.append(f'<circle cx="{x:.1f}" cy="{y:.1f}" r="{radius}" fill="{colour}"/>')

    def label(self, point: ArrayLike, text: str) -> None:
        """Text at a point (3,)."""
        ((x, y),) = self._pixels(np.reshape(point, (1, 3)))
        self._parts.append(f'<text x="{x:.1f}" y="{y:.1f}">{escape(text)}</text>')

    def svg(self) -> str:
        """The picture as an <svg> element."""
        width, height = self._size
        return (
            f'<svg viewBox="0 0 {width} {height}" width="{width}" height="{height}" role="img">'
            f"{''.join(self._parts)}</svg>"
        )

    def _pixels(self, points: ArrayLike) -> Floats:
        flat = (np.asarray(points, dtype=np.float64) - self._centre) @ self._axes.T
        return np.asarray(flat * self._scale + 0.5 * np.array(self._size))

    def _add(self, element: str, points: ArrayLike, style: str, opacity: float) -> None:
        text = " ".join(f"{x:.1f},{y:.1f}" for x, y in self._pixels(points))
        self._parts.append(f'<{element} points="{text}" {style} opacity="{opacity:.2f}"/>')
