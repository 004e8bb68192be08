"""What the report shows of the tool's tip and of touched objects."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from calibration import html, plots
from calibration.object_pose import ObjectPoseResult
from calibration.tool_tip import ToolTipResult
from calibration.words import axis_name


@dataclass(frozen=True, eq=False)
class TouchedObject:
    """An object's result with what it was computed from: points (n, 3) in the base frame, and the mesh."""

    result: ObjectPoseResult
    points_base: NDArray[np.float64]
    vertices: ArrayLike
    faces: ArrayLike


def tool_tip_section(result: ToolTipResult) -> str:
    """How far the tip strayed from its point, and where it is."""
    count = len(result.used)
    sigma = np.sqrt(np.diagonal(result.covariance))
    slipped = np.flatnonzero(~result.used)
    rows = [
        [axis, f"{1e3 * result.tip_in_tcp[i]:.3f} mm", f"{1e3 * sigma[i]:.3f} mm"]
        for i, axis in enumerate("xyz")
    ]
    return html.section(
        "Tool tip",
        "The tip stayed on one point while the tool was tilted. Bars of one height are the arm's noise; a"
        " tall one is a tip that slipped.",
        html.grid(
            html.figure(
                plots.bars(1e3 * result.distance_m, ~result.used, [str(i) for i in range(count)], "mm", 1070),
                "Distance of the tip from its point, by pose; poses in the second colour were left out.",
                12,
            )
        ),
        html.tiles(
            html.Tile("Tip", f"± {1e3 * result.sigma_m:.3f} mm", "one sigma, all axes"),
            html.Tile("Fit", f"{1e3 * result.rms_m:.3f} mm", "rms distance from the point"),
            html.Tile(
                "Swing",
                f"{result.swing_deg[0]:.0f}°",
                f"rms of the axis that swung least, {axis_name(result.weak_axis)}",
                "good" if result.swing_deg[0] > 12 else "warn",
            ),
            html.Tile(
                "Poses",
                f"{result.used.sum()} of {count}",
                "none left out" if len(slipped) == 0 else f"slipped: {', '.join(map(str, slipped[:12]))}",
                "plain" if len(slipped) == 0 else "warn",
            ),
        ),
        html.table(["Tip in the tool's frame", "Value", "Standard deviation"], rows),
    )


def object_section(name: str, touched: TouchedObject) -> str:
    """The touched points on the mesh, and how well they hold it."""
    result = touched.result
    in_obj = result.T_base_obj.inverse().apply(touched.points_base)
    sketch = plots.mesh_sketch(
        np.asarray(touched.vertices, np.float64), np.asarray(touched.faces), in_obj, result.distance_m
    )
    count = len(result.distance_m)
    sigma = np.sqrt(np.maximum(np.diagonal(result.covariance), 0))
    angle = np.degrees(np.linalg.norm(sigma[3:]))
    return html.section(
        f"Object: {name}",
        "Touched points on the mesh in its fitted pose; green lies within half a millimetre of the surface.",
        *(
            html.note(f"The touched points leave open: {words}.")
            for words in (*result.unobservable, *result.rivals)
        ),
        html.grid(
            html.figure(sketch, "Touched points on the object.", 5),
            html.figure(
                plots.bars(
                    np.abs(1e3 * result.distance_m),
                    np.abs(result.distance_m) > 5e-4,
                    [str(i) for i in range(count)],
                    "mm",
                    620,
                ),
                "Distance of every point from the surface.",
                7,
            ),
        ),
        html.tiles(
            html.Tile("Fit", f"{1e3 * result.rms_m:.2f} mm", f"rms of {count} points"),
            html.Tile("Position", f"± {1e3 * np.linalg.norm(sigma[:3]):.2f} mm", "one sigma, all axes"),
            html.Tile("Rotation", f"± {angle:.2f}°", "one sigma, all axes", "warn" if angle > 3 else "plain"),
            html.Tile(
                "Next best pose",
                f"{1e3 * result.runner_up_rms_m:.2f} mm" if np.isfinite(result.runner_up_rms_m) else "none",
                "rms of the closest rival",
                "warn" if result.runner_up_rms_m < 2 * result.rms_m else "good",
            ),
        ),
    )
