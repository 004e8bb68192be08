"""What the report shows of the pixels' polarizers."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from calibration import html, plots
from calibration.polarizer import PolarizerResult

_CROP = 48
_ZOOM = 8


def polarizer_section(result: PolarizerResult) -> str:
    """How unequal the pixels are, as pictures, and what that would have done to the polarization."""
    response = result.response
    alive = response.gain > 0
    orientation = np.degrees(response.orientation_error)
    ratio = response.extinction_ratio[alive]
    counts, edges = np.histogram(np.clip(ratio, 0, 500), bins=25, range=(0, 500))
    residual = result.cell_residual
    cell = " / ".join(" ".join(f"{angle:.1f}" for angle in row) for row in result.cell_deg)
    return html.section(
        "Polarizers",
        "Every pixel has a polarizer of its own. Patches without a pattern are pixels that differ by chance;"
        " a pattern over the whole image would be the light's, or the lens's.",
        *(html.note(f"Look at this: {words}.") for words in result.warnings),
        html.grid(
            html.figure(_patch(response.gain, 1.0, 0.05), "Gain, 0.95 (blue) to 1.05 (red), middle.", 4),
            html.figure(_patch(orientation, 0.0, 3.0), "Orientation error, -3° (blue) to 3° (red).", 4),
            html.figure(
                plots.bars(
                    100 * counts / max(counts.sum(), 1),
                    np.zeros(len(counts), bool),
                    [f"{edge:.0f}" for edge in edges[:-1]],
                    "%",
                ),
                "Extinction ratio of the pixels; the last bar holds all above 480.",
                4,
            ),
            html.figure(
                plots.bars(
                    100 * residual,
                    np.zeros(len(residual), bool),
                    [str(i) for i in range(len(residual))],
                    "%",
                    1070,
                ),
                "How far every frame misses the model: a tall bar is a flicker, or a dial misread.",
                12,
            ),
        ),
        html.tiles(
            html.Tile("Gain", f"± {100 * response.gain[alive].std():.2f} %", "spread of the pixels"),
            html.Tile("Orientation", f"± {orientation[alive].std():.2f}°", "spread of the pixels"),
            html.Tile("Extinction", f"{np.median(ratio):.0f}", "median of the pixels"),
            html.Tile("Error of a pixel", f"{200 * result.sigma:.2f} %", "one sigma, of a white reading"),
            html.Tile(
                "Left out",
                f"{1e6 * result.defective:.0f} ppm",
                "pixels",
                "good" if result.defective < 1e-3 else "warn",
            ),
        ),
        html.table(
            ["Mosaic, row / row", "Light, rms change", "Turn a frame"],
            [
                [
                    f"{cell} degrees",
                    f"{100 * result.states.level.std():.2f} %",
                    f"{result.states.turn_deg:.2f} degrees",
                ]
            ],
        ),
    )


def _patch(values: NDArray[np.floating], middle: float, reach: float) -> str:
    """The middle of an image (H, W) pixel by pixel, blue below and red above a value."""
    height, width = values.shape
    top, left = max(0, (height - _CROP) // 2), max(0, (width - _CROP) // 2)
    crop = values[top : top + _CROP, left : left + _CROP]
    grey = np.clip(127.5 + 127.5 * (crop - middle) / reach, 0, 255).astype(np.uint8)
    large = cv2.resize(grey, None, fx=_ZOOM, fy=_ZOOM, interpolation=cv2.INTER_NEAREST)
    coloured = cv2.cvtColor(cv2.applyColorMap(large, cv2.COLORMAP_JET), cv2.COLOR_BGR2RGB)
    return html.picture(np.asarray(coloured, np.uint8), "pixels")
