"""Pictures of a set of views: where the image was covered, and what every view leaves unexplained."""

from __future__ import annotations

from collections.abc import Sequence
from html import escape

import numpy as np
from numpy.typing import NDArray

from calibration.plots import svg

Floats = NDArray[np.float64]

_CELLS = (6, 8)
_WIDTH = 640.0
_PANEL = 150.0
_PANELS_A_ROW = 7
_MOST_PANELS = 42


def coverage_map(pixels: Floats, image_size: tuple[int, int]) -> str:
    """How many corners were seen in each cell of an 8x6 grid over the image (height, width), as SVG."""
    height, width = image_size
    counts, _, _ = np.histogram2d(pixels[:, 1], pixels[:, 0], _CELLS, ((0, height), (0, width)))
    rows, columns = _CELLS
    cell_w, cell_h = _WIDTH / columns, _WIDTH * height / width / rows
    most = max(counts.max(), 1.0)
    parts: list[str] = []
    for (row, column), count in np.ndenumerate(counts):
        x, y = column * cell_w, row * cell_h
        shade = 0.08 + 0.72 * np.sqrt(count / most) if count else 0.0
        colour = "var(--accent)" if count else "var(--warn)"
        parts.append(
            f'<rect x="{x + 1:.1f}" y="{y + 1:.1f}" width="{cell_w - 2:.1f}" height="{cell_h - 2:.1f}" rx="4"'
            f' fill="{colour}" fill-opacity="{shade:.2f}" stroke="{"none" if count else colour}"/>'
            f'<text x="{x + cell_w / 2:.1f}" y="{y + cell_h / 2 + 4:.1f}" text-anchor="middle">{count:.0f}'
            "</text>"
        )
    return svg(_WIDTH, cell_h * rows, parts, "corners seen in each part of the image")


def view_residuals(
    view: NDArray[np.int64],
    pixels: Floats,
    residual_px: Floats,
    view_rms_px: Floats,
    used: NDArray[np.bool_],
    labels: Sequence[str],
    image_size: tuple[int, int],
) -> str:
    """A small picture a view: its corners (P, 2) in the image, each with its residual, magnified alike in all
    views; views left out in the second colour. The first 42 views."""
    height, width = image_size
    count = min(len(used), _MOST_PANELS)
    panel_h = _PANEL * height / width
    scale = _PANEL / width
    typical = float(np.median(view_rms_px[used])) if used.any() else 1.0
    magnify = 6.0 / (scale * max(typical, 1e-6))
    parts: list[str] = []
    for index in range(count):
        row, column = divmod(index, _PANELS_A_ROW)
        left, top = column * (_PANEL + 10), row * (panel_h + 26)
        colour = "var(--accent)" if used[index] else "var(--second)"
        starts = pixels[view == index] * scale
        arrows = residual_px[view == index] * scale * magnify
        arrows *= np.minimum(1.0, 30.0 / (np.linalg.norm(arrows, axis=1, keepdims=True) + 1e-9))
        path = "".join(
            f"M{x:.1f} {y:.1f}l{dx:.1f} {dy:.1f}" for (x, y), (dx, dy) in zip(starts, arrows, strict=True)
        )
        label = f"{labels[index]}: {view_rms_px[index]:.2f} px" + ("" if used[index] else ", left out")
        parts.append(
            f'<g transform="translate({left:.0f} {top:.0f})"><rect width="{_PANEL:.0f}"'
            f' height="{panel_h:.0f}" rx="4" fill="none" stroke="var(--line)"/>'
            f'<path d="{path}" stroke="{colour}" fill="none"/>'
            f'<text x="2" y="{panel_h + 15:.0f}">{escape(label)}</text></g>'
        )
    rows = -(-count // _PANELS_A_ROW)
    return svg(_PANELS_A_ROW * (_PANEL + 10) - 10, rows * (panel_h + 26), parts, "residuals of every view")
