"""What the report shows of the camera, of the hand-eye transform and of the time offset: pictures before
numbers."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from calibration import html, plots, view_plots
from calibration.bundle import camera_parameters
from calibration.detection import intensity_image
from calibration.hand_eye import HandEyeResult
from calibration.intrinsics import IntrinsicsResult
from calibration.next_pose import NextPose
from calibration.resampling import Intervals
from calibration.time_offset import TimeOffsetResult
from dataset.frames import Mosaic
from dataset.polarimetry import Raw


@dataclass(frozen=True, eq=False)
class ViewPicture:
    """A raw mosaic (H, W) to draw corners on, its layout, and which of the results' views it is."""

    raw: Raw
    layout: Mosaic
    view: int


def intrinsics_section(
    result: IntrinsicsResult,
    frames: Sequence[int],
    pictures: Sequence[ViewPicture] = (),
    warnings: Sequence[str] = (),
) -> str:
    """How well a lens model explains the corners, and the camera's parameters.

    Args:
        result: of N views.
        frames: (N,) the session's frame of every view, which names it.
        pictures: of some views, to draw the corners on.
        warnings: in words, to be shown first.
    """
    camera, sigma = result.intrinsics, result.sigma
    size = camera.height, camera.width
    outlier = ~result.used[result.view]
    field, magnify = plots.residual_field(result.pixels, result.residual_px, outlier, size)
    names = ["fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6"]
    values = camera_parameters(camera.K, camera.distortion)
    rows = [
        [
            name,
            f"{v:.3f}" if i < 4 else f"{v:.6f}",
            f"{s:.3f}" if i < 4 else f"{s:.6f}",
            "px" if i < 4 else "1",
        ]
        for i, (name, v, s) in enumerate(zip(names, values, sigma, strict=False))
    ]
    relative = 100 * sigma[0] / camera.K[0, 0]
    labels = [str(frame) for frame in frames]
    return html.section(
        "Intrinsics",
        "Each dot is a board corner. A good calibration leaves a small round cloud without a pattern over the"
        " image; arrows that agree with their neighbours mean that the lens model or the board is wrong."
        " Views are named by their frame in the session.",
        *_notes(warnings),
        html.grid(
            html.figure(
                field, f"Corners over the image and their residuals, {magnify:g} times magnified.", 7
            ),
            html.figure(
                plots.residual_scatter(result.residual_px, outlier), "Predicted minus seen corners.", 5
            ),
            html.figure(
                view_plots.coverage_map(result.pixels[~outlier], size),
                "Corners seen in each part of the image; where there are none the lens is extrapolated.",
                5,
            ),
            html.figure(
                plots.bars(result.view_rms_px, ~result.used, labels, "px", 620),
                "Residual of every view (rms); views in the second colour were left out.",
                7,
            ),
            html.figure(
                view_plots.view_residuals(
                    result.view,
                    result.pixels,
                    result.residual_px,
                    result.view_rms_px,
                    result.used,
                    labels,
                    size,
                ),
                "Residuals of every view, magnified alike, with their rms.",
                12,
            ),
            *_overlays(pictures, labels, result.view, result.pixels, result.residual_px),
        ),
        html.tiles(
            html.Tile("Reprojection", f"{result.rms_px:.3f} px", "rms, at mosaic resolution"),
            html.Tile("Held-out reprojection", f"{result.held_out_px:.3f} px", "views not used for the fit"),
            html.Tile(
                "Focal length", f"{camera.K[0, 0]:.2f} px", f"sigma {sigma[0]:.2f} px, {relative:.3f} %"
            ),
            html.Tile(
                "Coverage",
                f"{100 * result.coverage:.0f} %",
                "of an 8 x 6 grid over the image",
                "plain" if result.coverage > 0.6 else "warn",
            ),
            html.Tile(
                "Board's squares",
                f"{100 * (result.board_aspect - 1):+.3f} %",
                f"higher than wide, ± {100 * result.board_aspect_sigma:.3f} %",
            ),
            html.Tile("Views", f"{result.used.sum()} of {len(result.used)}", _left_out(result.used, labels)),
        ),
        html.table(["Parameter", "Value", "Standard deviation", "Unit"], rows),
    )


def hand_eye_section(
    result: HandEyeResult,
    frames: Sequence[int],
    pictures: Sequence[ViewPicture] = (),
    intervals: Intervals | None = None,
    advice: NextPose | None = None,
    warnings: Sequence[str] = (),
) -> str:
    """Where the camera is on the tool or in the base, and how well the views agree on it.

    Args:
        result, frames, pictures, warnings: as in `intrinsics_section`.
        intervals: by the bootstrap.
        advice: the view to take next.
    """
    outlier = ~result.used[result.view]
    width, height = result.board_size_m
    corners = np.array([[0, 0, 0], [width, 0, 0], [width, height, 0], [0, height, 0]])
    board = result.T_base_board_seen[0].apply(corners)
    sketch = plots.pose_sketch(result.T_base_cam, board, result.used, "base")
    on_tool = result.mount == "eye_in_hand"
    labels = [str(frame) for frame in frames]
    pose = result.T_mount_cam.as_pose6()
    sigma = np.sqrt(np.diagonal(result.covariance)[:6])
    half = [""] * 6
    if intervals is not None:
        half = [f"± {v:.3f} mm" for v in intervals.half_mm] + [f"± {v:.4f} deg" for v in intervals.half_deg]
    rows = [
        [f"t {axis}", f"{1e3 * pose[i]:.3f} mm", f"{1e3 * sigma[i]:.3f} mm", half[i]]
        for i, axis in enumerate("xyz")
    ]
    rows += [
        [
            f"r {axis}",
            f"{np.degrees(pose[3 + i]):.4f} deg",
            f"{np.degrees(sigma[3 + i]):.4f} deg",
            half[3 + i],
        ]
        for i, axis in enumerate("xyz")
    ]
    methods = sorted(result.candidates_px.items(), key=lambda item: item[1])
    spread = result.spread.rms_deg
    return html.section(
        "Hand-eye",
        "The camera on the tool and the board in the arm's base frame, from stills. Residuals here take"
        " the arm's poses at their word, so they show the arm's repeatability as well as the camera's. Views"
        " are named by their frame in the session.",
        *_notes(warnings),
        html.grid(
            html.figure(sketch, "Where the camera was, and the board, in the arm's base frame.", 7),
            html.figure(
                plots.residual_scatter(result.residual_px, outlier), "Predicted minus seen corners.", 5
            ),
            html.figure(
                plots.bars(result.view_rms_px, ~result.used, labels, "px", 1070),
                "Residual of every view (rms); views in the second colour were left out.",
                12,
            ),
            *_overlays(pictures, labels, result.view, result.pixels, result.residual_px),
        ),
        html.tiles(
            html.Tile(
                "Camera on the tool" if on_tool else "Camera in the base",
                f"± {1e3 * result.sigma_m:.3f} mm",
                "one sigma, all axes",
            ),
            html.Tile("Its rotation", f"± {np.degrees(result.sigma_rad):.4f}°", "one sigma, all axes"),
            html.Tile(
                "Held-out error",
                f"{result.held_out_mm:.2f} mm",
                f"{result.held_out_deg:.3f}°, median, board's pose",
            ),
            html.Tile(
                "Arm's noise",
                f"{1e3 * result.arm_sigma_m:.3f} mm",
                f"{np.degrees(result.arm_sigma_rad):.4f}°, a coordinate; corners {result.pixel_sigma:.3f} px",
            ),
            html.Tile(
                "Rotation spread",
                f"{spread[0]:.0f}° / {spread[1]:.0f}° / {spread[2]:.0f}°",
                "rms about the principal axes; smallest singular value"
                f" {result.spread.smallest_singular:.2f}",
                "good" if spread[1] > 8 else "warn",
            ),
            html.Tile(
                "Board's size",
                f"{100 * (result.board_scale - 1):+.3f} %",
                f"against its description, ± {100 * result.board_scale_sigma:.3f} %",
            ),
            html.Tile(
                "Views",
                f"{result.used.sum()} of {len(result.used)}",
                _left_out(result.used, labels),
            ),
        ),
        *([] if advice is None else [html.lead(f"The view that would tell most next: {advice.reason}.")]),
        html.table(
            ["T_tcp_cam" if on_tool else "T_base_cam", "Value", "Standard deviation", "95 % (bootstrap)"],
            rows,
        ),
        html.table(
            ["Closed form", "Median corner error"], [[name, f"{error:.3f} px"] for name, error in methods]
        ),
    )


def time_offset_section(result: TimeOffsetResult) -> str:
    """How sharply the pictures tell the delay, and what each frame says."""
    order = np.argsort(result.speed_px_s)
    labels = [f"{result.speed_px_s[i]:.0f}" for i in order]
    apart = np.abs(1e3 * (result.frame_offset_s[order] - result.offset_s))
    correlation: list[str] = []
    if result.correlation is not None:
        tried, found = result.correlation.offset_s, result.correlation.correlation
        correlation = [
            html.figure(
                plots.correlation_curve(tried, found, result.offset_s, "offset tried, s"),
                "How alike camera and arm turn, before any calibration is used; the line marks the estimate.",
                4,
            )
        ]
    return html.section(
        "Time offset",
        "The board stands still, so the delay between camera and arm is the one that makes it stand still in"
        " the pictures. The curve must have one deep minimum.",
        html.grid(
            html.figure(
                plots.curve(
                    result.scan_s, result.scan_px, result.offset_s, "offset tried, s", "median error, px"
                ),
                "Corner error over the offset; the line marks the estimate.",
                4 if correlation else 6,
            ),
            *correlation,
            html.figure(
                plots.bars(apart, ~result.used[order], labels, "ms"),
                "How far each frame alone is from the estimate; frames by corner speed, px/s.",
                4 if correlation else 6,
            ),
        ),
        html.tiles(
            html.Tile(
                "Offset", f"{1e3 * result.offset_s:.2f} ms", f"sigma {1e3 * result.sigma_s:.3f} ms", "good"
            ),
            html.Tile("Corner error", f"{result.rms_px:.2f} px", f"{result.rms_before_px:.1f} px without it"),
            html.Tile(
                "Frames", str(int(result.used.sum())), f"{np.median(result.speed_px_s):.0f} px/s median"
            ),
        ),
    )


def _notes(warnings: Sequence[str]) -> list[str]:
    return [html.note(f"Look at this: {words}.") for words in warnings]


def _overlays(
    pictures: Sequence[ViewPicture],
    labels: Sequence[str],
    view: NDArray[np.int64],
    pixels: NDArray[np.float64],
    residual_px: NDArray[np.float64],
) -> list[str]:
    drawn: list[str] = []
    for shown in pictures:
        corners = view == shown.view
        intensity = intensity_image(shown.raw, shown.layout)
        white = max(float(np.percentile(intensity, 99.5)), 1e-6)
        grey = np.clip(255 * (intensity / white) ** (1 / 1.6), 0, 255).astype(np.uint8)
        seen = pixels[corners]
        drawn.append(
            html.figure(
                plots.overlay(grey, seen, seen + residual_px[corners], 2),
                f"Frame {labels[shown.view]}: corners seen (rings) and predicted (crosses), on S0.",
                4,
            )
        )
    return drawn


def _left_out(used: NDArray[np.bool_], labels: Sequence[str]) -> str:
    names = [label for label, kept in zip(labels, used, strict=True) if not kept]
    return f"left out: {', '.join(names[:12])}" if names else "none left out"
