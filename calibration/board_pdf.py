"""The board on paper, to scale: a PDF of vector rectangles, with a ruler to check the print against."""

from __future__ import annotations

import re

import numpy as np

from calibration.board import BoardSpec, patches
from dataset.errors import CalibrationError

PAGES_MM: dict[str, tuple[float, float]] = {"A4": (297.0, 210.0), "A3": (420.0, 297.0), "A2": (594.0, 420.0)}
"""Width and height, lying."""

RULER_MM = 100
_MARGIN_MM = 4.0
_FOOT_MM = 12.0  # the ruler and the description below the board
_POINTS_PER_MM = 72.0 / 25.4


def board_pdf(spec: BoardSpec, page: str = "A4") -> bytes:
    """A one-page PDF of the board.

    Args:
        spec: the board.
        page: A4, A3, A2, or WIDTHxHEIGHT in millimetres; named pages lie or stand as the board fits.

    Raises:
        CalibrationError: an unknown page, or a board that does not fit it.
    """
    width, height = _page_mm(page, spec)
    board_w, board_h = (1e3 * side for side in spec.size_m)
    left = 0.5 * (width - board_w)
    top = max(_outside_mm(spec), 0.5 * (height - _FOOT_MM - board_h))
    shapes = [
        _rectangle(left + 1e3 * p.x, top + 1e3 * p.y, 1e3 * p.width, 1e3 * p.height, height, p.black)
        for p in patches(spec)
    ]
    foot = height - _FOOT_MM + 3.0
    start = 0.5 * (width - RULER_MM)
    shapes.append(_rectangle(start, foot, RULER_MM, 0.2, height, True))
    shapes += [
        _rectangle(start + mm - 0.1, foot - (2.0 if mm % 50 == 0 else 1.2), 0.2, 2.0, height, True)
        for mm in range(0, RULER_MM + 1, 10)
    ]
    size = min(8.0, 1.7 * (width - 2 * _MARGIN_MM) * _POINTS_PER_MM / 110)
    text = f"{spec}. Print at 100 %, without fitting to the page: this ruler must measure {RULER_MM} mm."
    shapes.append(
        f"BT /F1 {size:.2f} Tf {_MARGIN_MM * _POINTS_PER_MM:.3f} {4.0 * _POINTS_PER_MM:.3f} Td"
        f" ({_escaped(text)}) Tj ET"
    )
    return _document("\n".join(shapes), width, height)


def _page_mm(page: str, spec: BoardSpec) -> tuple[float, float]:
    board_w, board_h = 1e3 * np.array(spec.size_m) + _outside_mm(spec) * np.array([2, 1])
    custom = re.fullmatch(r"(\d+(?:\.\d+)?)x(\d+(?:\.\d+)?)", page)
    if custom is None and page.upper() not in PAGES_MM:
        raise CalibrationError(
            f"board: unknown page {page!r}; give one of {', '.join(PAGES_MM)}, or WIDTHxHEIGHT in"
            " millimetres such as 400x300"
        )
    lying = (float(custom[1]), float(custom[2])) if custom else PAGES_MM[page.upper()]
    for width, height in [lying] if custom else [lying, lying[::-1]]:
        if board_w <= width + 1e-6 and board_h + _FOOT_MM <= height + 1e-6:
            return width, height
    raise CalibrationError(
        f"board: {board_w:.0f} x {board_h + _FOOT_MM:.0f} mm with its margin and ruler do not fit the page"
        f" {page} ({lying[0]:g} x {lying[1]:g} mm); choose a larger page or smaller squares"
    )


def _outside_mm(spec: BoardSpec) -> float:
    """The white border, which holds the outer black squares of an AprilGrid."""
    gap = 1e3 * (spec.square_m - spec.marker_m) / 2 if spec.kind == "aprilgrid" else 0.0
    return _MARGIN_MM + gap


def _rectangle(x: float, y: float, width: float, height: float, page_height: float, black: bool) -> str:
    """Millimetres from the page's top left, as PDF operators in points from its bottom left."""
    corner = (x * _POINTS_PER_MM, (page_height - y - height) * _POINTS_PER_MM)
    size = (width * _POINTS_PER_MM, height * _POINTS_PER_MM)
    return f"{0 if black else 1} g {corner[0]:.4f} {corner[1]:.4f} {size[0]:.4f} {size[1]:.4f} re f"


def _escaped(text: str) -> str:
    return re.sub(r"([()\\])", r"\\\1", text)


def _document(content: str, width_mm: float, height_mm: float) -> bytes:
    """A minimal PDF 1.4 file (ISO 32000-1, 7.5): catalogue, one page, one font, one content stream."""
    box = f"[0 0 {width_mm * _POINTS_PER_MM:.4f} {height_mm * _POINTS_PER_MM:.4f}]"
    objects = [
        "<< /Type /Catalog /Pages 2 0 R /ViewerPreferences << /PrintScaling /None >> >>",
        "<< /Type /Pages /Kids [3 0 R] /Count 1 >>",
        f"<< /Type /Page /Parent 2 0 R /MediaBox {box} /Contents 5 0 R"
        " /Resources << /Font << /F1 4 0 R >> >> >>",
        "<< /Type /Font /Subtype /Type1 /BaseFont /Helvetica >>",
        f"<< /Length {len(content)} >>\nstream\n{content}\nendstream",
    ]
    document = "%PDF-1.4\n"
    starts: list[int] = []
    for number, item in enumerate(objects, start=1):
        starts.append(len(document))
        document += f"{number} 0 obj\n{item}\nendobj\n"
    table = "".join(f"{start:010d} 00000 n \n" for start in starts)
    document += (
        f"xref\n0 {len(objects) + 1}\n0000000000 65535 f \n{table}"
        f"trailer\n<< /Size {len(objects) + 1} /Root 1 0 R >>\nstartxref\n{len(document)}\n%%EOF\n"
    )
    return document.encode("ascii")
