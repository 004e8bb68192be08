"""Charts as SVG text: crisp at any size, coloured by the page's own style."""

from __future__ import annotations

from collections.abc import Sequence
from html import escape

import numpy as np
from numpy.typing import ArrayLike, NDArray

from calibration.html import data_uri
from dataset.transforms import SE3

Floats = NDArray[np.float64]


def residual_scatter(residual_px: Floats, outlier: NDArray[np.bool_]) -> str:
    """Where predicted corners fall around seen ones: (P, 2) px, outliers (P,) in the second colour."""
    size, centre = 420, 210
    inliers = residual_px[~outlier] if (~outlier).any() else residual_px
    span = _nice_ceiling(3.2 * float(np.sqrt(np.mean(inliers**2))) + 1e-6)
    scale = (centre - 26) / span
    ring = 'fill="none" stroke="var(--line)"'
    parts = [f'<circle cx="{centre}" cy="{centre}" r="{f * span * scale:.1f}" {ring}/>' for f in (0.5, 1.0)]
    parts += [
        _line(centre - span * scale, centre, centre + span * scale, centre, "var(--line)"),
        _line(centre, centre - span * scale, centre, centre + span * scale, "var(--line)"),
    ]
    for colour, chosen in (("var(--accent)", ~outlier), ("var(--second)", outlier)):
        shown = residual_px[chosen][:: max(1, len(residual_px) // 3000)]
        shown = centre + scale * shown[np.abs(shown).max(axis=1, initial=0.0) < span]
        dots = "".join(f'<circle cx="{x:.1f}" cy="{y:.1f}" r="1.9"/>' for x, y in shown)
        parts.append(f'<g fill="{colour}" fill-opacity=".5">{dots}</g>')
    for fraction in (0.5, 1.0):
        parts.append(
            _text(centre + 4, centre - fraction * span * scale + 13, f"{fraction * span:g} px", "start")
        )
    return svg(size, size, parts, "residual scatter")


def residual_field(
    pixels: Floats, residual_px: Floats, outlier: NDArray[np.bool_], image_size: tuple[int, int]
) -> tuple[str, float]:
    """Corners over the image (height, width), each with its residual magnified; returns the magnification."""
    height, width = image_size
    scale = 640 / width
    typical = float(np.median(np.linalg.norm(residual_px, axis=1))) + 1e-9
    magnify = _nice_ceiling(0.012 * width / typical)
    step = max(1, len(pixels) // 4000)
    parts = [_rectangle(0, 0, 640, height * scale)]
    parts += [_line(80 * k, 0, 80 * k, height * scale, "var(--line)") for k in range(1, 8)]
    parts += [
        _line(0, height * scale * k / 6, 640, height * scale * k / 6, "var(--line)") for k in range(1, 6)
    ]
    for colour, chosen in (("var(--accent)", ~outlier), ("var(--second)", outlier)):
        starts = (pixels[chosen][::step] + 0.5) * scale
        ends = starts + residual_px[chosen][::step] * magnify * scale
        # the marks of outliers may leave the image by far
        ends = (
            starts
            + (ends - starts) * np.minimum(1, 60 / (np.linalg.norm(ends - starts, axis=1) + 1e-9))[:, None]
        )
        path = "".join(
            f"M{a:.1f} {b:.1f}L{c:.1f} {d:.1f}" for (a, b), (c, d) in zip(starts, ends, strict=True)
        )
        parts.append(
            f'<path d="{path}" stroke="{colour}" stroke-width="1" stroke-opacity=".75" fill="none"/>'
        )
        dots = "".join(f'<circle cx="{a:.1f}" cy="{b:.1f}" r="1.3"/>' for a, b in starts)
        parts.append(f'<g fill="{colour}" fill-opacity=".8">{dots}</g>')
    return svg(640, height * scale, parts, "residual field"), magnify


def bars(
    values: Floats, highlighted: NDArray[np.bool_], labels: Sequence[str], unit: str, width: int = 520
) -> str:
    """A bar a value (N,), highlighted ones in the second colour. The scale is that of the others: what is
    far beyond it is cut off and labelled."""
    height, left, bottom = 250, 52, 30
    shown = values if highlighted.all() else values[~highlighted]
    top_value = _nice_ceiling(float(np.nanmax(shown, initial=1e-9)) * 1.15)
    slot = (width - left) / max(len(values), 1)
    parts = _horizontal_grid(left, width, 10, height - bottom, top_value, unit)
    every = max(1, int(np.ceil(34 * len(values) / (width - left))))
    for i, value in enumerate(values):
        part = 0.0 if np.isnan(value) else min(float(value) / top_value, 1.0)
        tall, middle = (height - bottom - 10) * part, left + (i + 0.5) * slot
        colour = "var(--second)" if highlighted[i] else "var(--accent)"
        parts.append(
            f'<rect x="{left + (i + 0.16) * slot:.1f}" y="{height - bottom - tall:.1f}"'
            f' width="{0.68 * slot:.1f}" height="{tall:.1f}" rx="{min(3, 0.2 * slot):.1f}" fill="{colour}"/>'
        )
        if value > top_value:
            parts.append(_text(middle, 26, f"{value:.2g}", "middle"))
        if i % every == 0:
            parts.append(_text(middle, height - 10, labels[i], "middle"))
    return svg(width, height, parts, "bars")


def curve(x: Floats, y: Floats, mark_x: float, x_label: str, y_label: str) -> str:
    """y over x on a logarithmic scale, with a mark at ``mark_x``."""
    positive = np.isfinite(y) & (y > 0)
    x, y = x[positive], y[positive]
    low, high = np.floor(np.log10(y.min())), np.ceil(np.log10(y.max()) + 1e-9)
    span = max(high - low, 1.0)
    ticks = {f"{10.0**decade:g}": (decade - low) / span for decade in np.arange(low, high + 1)}
    return _graph(x, (np.log10(y) - low) / span, ticks, mark_x, x_label, y_label)


def correlation_curve(x: Floats, y: Floats, mark_x: float, x_label: str) -> str:
    """A correlation y over x, from -1 to 1, with a mark at ``mark_x``."""
    told = np.isfinite(y)
    ticks = {f"{value:g}": 0.5 * (value + 1.0) for value in (-1.0, -0.5, 0.0, 0.5, 1.0)}
    return _graph(x[told], 0.5 * (y[told] + 1.0), ticks, mark_x, x_label, "correlation")


def _graph(
    x: Floats, tall: Floats, ticks: dict[str, float], mark_x: float, x_label: str, y_label: str
) -> str:
    """A line through points whose heights, and those of the ticks, are parts of the picture's."""
    width, height, left, bottom = 520, 290, 56, 38
    to_x = lambda v: left + (v - x[0]) / (x[-1] - x[0]) * (width - left - 14)  # noqa: E731
    to_y = lambda part: 10 + (1.0 - part) * (height - bottom - 10)  # noqa: E731
    parts: list[str] = []
    for text, part in ticks.items():
        parts.append(_line(left, to_y(part), width - 14, to_y(part), "var(--line)"))
        parts.append(_text(left - 8, to_y(part) + 4, text, "end"))
    parts.append(_text(left + 6, 26, y_label, "start"))
    step = _nice_ceiling((x[-1] - x[0]) / 6)
    for tick in step * np.arange(np.ceil(x[0] / step - 1e-9), np.floor(x[-1] / step + 1e-9) + 1):
        parts.append(_text(to_x(tick), height - bottom + 18, f"{np.round(tick, 9) + 0.0:g}", "middle"))
    parts.append(_text((left + width) / 2, height - 2, x_label, "middle"))
    path = "M" + "L".join(f"{to_x(a):.1f} {to_y(b):.1f}" for a, b in zip(x, tall, strict=True))
    parts.append(_line(to_x(mark_x), 10, to_x(mark_x), height - bottom, "var(--second)", 1.5))
    parts.append(
        f'<path d="{path}" fill="none" stroke="var(--accent)" stroke-width="2" stroke-linejoin="round"/>'
    )
    return svg(width, height, parts, y_label)


def overlay(image: NDArray[np.uint8], seen: Floats, predicted: Floats, level: int) -> str:
    """A picture (H, W) or (H, W, 3), cut out around its corners, with corners seen (rings) and predicted
    (crosses).

    Corners are (n, 2) in mosaic pixels, ``level`` of which make one of the picture's.
    """
    rings, crosses = (seen + 0.5) / level, (predicted + 0.5) / level  # pixel edges: where SVG counts from
    size = np.array(image.shape[1::-1])
    centre = 0.5 * (rings.min(axis=0) + rings.max(axis=0))
    extent = 1.25 * np.ptp(rings, axis=0) + 40
    extent = np.minimum(np.maximum(extent, extent[::-1] * [4 / 3, 3 / 4]), size).astype(int)
    corner = np.clip(centre - extent / 2, 0, size - extent).astype(int)
    cut = image[corner[1] : corner[1] + extent[1], corner[0] : corner[0] + extent[0]]
    unit = extent[0] / 520  # a pixel of the page
    circles = "".join(f'<circle cx="{x:.2f}" cy="{y:.2f}" r="{6 * unit:.2f}"/>' for x, y in rings - corner)
    path = "".join(
        f"M{x - 4 * unit:.2f} {y:.2f}h{8 * unit:.2f}M{x:.2f} {y - 4 * unit:.2f}v{8 * unit:.2f}"
        for x, y in crosses - corner
    )
    return svg(
        extent[0],
        extent[1],
        [
            f'<image href="{data_uri(np.ascontiguousarray(cut))}" width="{extent[0]}" height="{extent[1]}"/>',
            f'<g fill="none" stroke="#ffb000" stroke-width="{1.5 * unit:.2f}">{circles}</g>',
            f'<path d="{path}" stroke="#00c2ff" stroke-width="{1.5 * unit:.2f}" fill="none"/>',
        ],
        "reprojection overlay",
    )


def pose_sketch(T_ref_cam: SE3, board_corners: Floats, used: NDArray[np.bool_], origin: str) -> str:
    """Camera frusta (N) and the board (4, 3) in one frame, seen from the side and above, with that frame's
    axes."""
    reach = float(np.ptp(np.concatenate([T_ref_cam.translation, board_corners]), axis=0).max())
    size = 0.07 * reach
    half = np.array([[-0.6, -0.5, 1.0], [0.6, -0.5, 1.0], [0.6, 0.5, 1.0], [-0.6, 0.5, 1.0]]) * size
    view = _Isometric.around(
        np.concatenate([T_ref_cam.translation, board_corners, np.zeros((1, 3))]), 640, 470
    )
    board = view(board_corners)
    parts = [
        f'<polygon points="{_points(board)}" fill="var(--soft)" fill-opacity=".22" stroke="var(--soft)"/>',
        _text(board[:, 0].mean(), board[:, 1].mean(), "board", "middle"),
    ]
    zero = view(np.zeros((1, 3)))[0]
    for axis, colour in zip(0.2 * reach * np.eye(3), ("#d6455d", "#2e9e6b", "#4477dd"), strict=True):
        tip = view(axis[None])[0]
        parts.append(_line(zero[0], zero[1], tip[0], tip[1], colour, 2.5))
    parts.append(_text(zero[0], zero[1] + 16, origin, "middle"))
    depth = np.argsort(view.depth(T_ref_cam.translation))[::-1]
    for i in depth:
        apex = view(T_ref_cam.translation[i][None])[0]
        corners = view(T_ref_cam[i].apply(half))
        colour = "var(--accent)" if used[i] else "var(--second)"
        edges = "".join(f"M{apex[0]:.1f} {apex[1]:.1f}L{x:.1f} {y:.1f}" for x, y in corners)
        parts.append(
            f'<g stroke="{colour}" stroke-width="1.2" stroke-linejoin="round"><path d="{edges}" fill="none"/>'
            f'<polygon points="{_points(corners)}" fill="{colour}" fill-opacity=".16"/></g>'
        )
    return svg(640, 470, parts, "camera poses")


def mesh_sketch(vertices: Floats, faces: NDArray[np.integer], points: Floats, distance_m: Floats) -> str:
    """A mesh with touched points (n, 3) in its own frame, coloured by |distance| against 0.5 mm."""
    view = _Isometric.around(vertices, 560, 470)
    corners = vertices[faces]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    normals /= np.linalg.norm(normals, axis=1, keepdims=True) + 1e-12
    facing = normals @ view.toward_viewer
    visible = np.flatnonzero(facing > 0)
    order = visible[np.argsort(view.depth(corners[visible].mean(axis=1)))[::-1]]
    flat = view(corners.reshape(-1, 3)).reshape(-1, 3, 2)
    shade = np.round(2 + 10 * facing).astype(int)
    parts = [
        f'<polygon points="{_points(flat[i])}" fill="var(--soft)" fill-opacity=".{5 + 3 * shade[i]:02d}"/>'
        for i in order[:: max(1, len(order) // 6000)]
    ]
    for (x, y), gap in zip(view(points), np.abs(distance_m), strict=True):
        colour = "var(--good)" if gap < 5e-4 else "var(--warn)"
        parts.append(f'<circle cx="{x:.1f}" cy="{y:.1f}" r="5" fill="{colour}" stroke="var(--card)"/>')
    return svg(560, 470, parts, "touched points on the mesh")


def svg(width: float, height: float, parts: Sequence[str], label: str) -> str:
    """A picture of SVG elements, so many units wide and high; ``label`` describes it to a screen reader."""
    return (
        f'<svg viewBox="0 0 {width:.0f} {height:.0f}" role="img" aria-label="{escape(label)}"'
        f' xmlns="http://www.w3.org/2000/svg">{"".join(parts)}</svg>'
    )


class _Isometric:
    """An orthographic view from the front right and above, fitted to a picture; z of the frame points up."""

    def __init__(self, rows: Floats, scale: float, centre: Floats, size: tuple[int, int]) -> None:
        self._rows, self._scale, self._centre, self._size = rows, scale, centre, size
        self.toward_viewer = -rows[2]

    @staticmethod
    def around(points: ArrayLike, width: int, height: int) -> _Isometric:
        """The view that shows all points (n, 3) with a margin."""
        azimuth, elevation = np.radians(-58.0), np.radians(24.0)
        away = -np.array(
            [
                np.cos(elevation) * np.cos(azimuth),
                np.cos(elevation) * np.sin(azimuth),
                np.sin(elevation),
            ]
        )
        right = np.array([-np.sin(azimuth), np.cos(azimuth), 0.0])
        rows = np.stack([right, np.cross(away, right), away])
        flat = np.asarray(points) @ rows[:2].T
        low, high = flat.min(axis=0), flat.max(axis=0)
        scale = float(np.min((np.array([width, height]) - 70) / np.maximum(high - low, 1e-9)))
        return _Isometric(rows, scale, 0.5 * (low + high), (width, height))

    def __call__(self, points: Floats) -> Floats:
        flat = (points @ self._rows[:2].T - self._centre) * self._scale
        return np.asarray(flat + 0.5 * np.array(self._size))

    def depth(self, points: Floats) -> Floats:
        return np.asarray(points @ self._rows[2])


def _line(x0: float, y0: float, x1: float, y1: float, colour: str, width: float = 1.0) -> str:
    ends = f'x1="{x0:.1f}" y1="{y0:.1f}" x2="{x1:.1f}" y2="{y1:.1f}"'
    return f'<line {ends} stroke="{colour}" stroke-width="{width}"/>'


def _rectangle(x: float, y: float, width: float, height: float) -> str:
    return (
        f'<rect x="{x + 0.5:.1f}" y="{y + 0.5:.1f}" width="{width - 1:.1f}" height="{height - 1:.1f}" rx="4"'
        ' fill="none" stroke="var(--soft)"/>'
    )


def _text(x: float, y: float, text: str, anchor: str) -> str:
    return f'<text x="{x:.1f}" y="{y:.1f}" text-anchor="{anchor}">{escape(text)}</text>'


def _points(corners: Floats) -> str:
    return " ".join(f"{x:.1f},{y:.1f}" for x, y in corners)


def _horizontal_grid(
    left: float, right: float, top: float, bottom: float, top_value: float, unit: str
) -> list[str]:
    parts: list[str] = []
    for k in range(5):
        y = bottom - (bottom - top) * k / 4
        parts.append(_line(left, y, right, y, "var(--line)"))
        parts.append(_text(left - 6, y + 4, f"{top_value * k / 4:.3g}", "end"))
    parts.append(_text(left + 4, top + 12, unit, "start"))
    return parts


def _nice_ceiling(value: float) -> float:
    """The next of 1, 2, 3, 5 times a power of ten."""
    power = 10.0 ** np.floor(np.log10(value))
    return float(next(step * power for step in (1, 2, 3, 5, 10) if step * power >= value * (1 - 1e-9)))
