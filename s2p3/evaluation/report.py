"""The evaluation's part of an HTML report: the object's outline in truth and estimates, recall curves, and
the numbers."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from html import escape

import cv2
import numpy as np
from numpy.typing import NDArray

from calibration import html
from dataset import SE3, Intrinsics
from dataset.session import Session
from s2p3.evaluation.evaluate import Evaluation, Record
from s2p3.inputs import extract_crop, square_box
from s2p3.objects import ObjectModel
from s2p3.rendering import rasterize

Picture = NDArray[np.uint8]

COLOURS: Mapping[str, tuple[int, int, int]] = {
    "truth": (60, 200, 120),
    "before": (240, 150, 60),
    "after": (90, 140, 255),
}
"""RGB of the outlines; estimates of other names are drawn as `before`."""

_SIDE_PX = 360
_CONTEXT = 2.0
_AXIS_SHARE = 0.35  # of the diameter: length of the drawn axes
_CURVE_LIMIT = 0.3  # of the diameter: where the recall curve ends


def evaluation_section(
    session: Session, model: ObjectModel, runs: Mapping[str, Evaluation], pictures: int = 6
) -> str:
    """An HTML section (text for `calibration.html.page`).

    Args:
        session: the evaluated one, open.
        runs: evaluations of the same frames by name, such as teacher, before, after; the last one orders the
            pictures.
        pictures: how many overlays: the last run's best, median and worst targets.
    """
    drawn = {name: run for name, run in runs.items() if name in COLOURS} or dict(runs)
    last = list(runs.values())[-1]
    figures = [
        html.figure(
            html.picture(overlay(session, model, record.frame, drawn), f"frame {record.frame}"),
            f"{rank}: frame {record.frame}, {last.summary.metric} {_millimetres(record)}",
            columns=4,
        )
        for rank, record in chosen_records(last.records, pictures)
    ]
    tiles = [
        html.Tile(
            f"{name}: {run.summary.metric} recall at 10 %",
            f"{run.summary.recall_10:.1f} %",
            f"{run.summary.targets} targets, {run.summary.missed} missed",
        )
        for name, run in runs.items()
    ]
    head = (
        "run",
        "metric",
        "recall 10 %",
        "recall 5 %",
        "targets",
        "missed",
        "rotation",
        "translation",
        "depth",
    )
    rows = [_row(name, run) for name, run in runs.items()]
    lead = (
        f"Outlines of {model.name}: green as annotated, orange before and blue after self-supervision, "
        "in the detector's boxes. "
        "Every frame that shows the object is a target; one without an estimate counts as failed."
    )
    caption = f"Share of the targets within a given {last.summary.metric}, in percent of the diameter."
    return html.section(
        "Pose estimation",
        lead,
        html.grid(*figures, html.figure(recall_curves(runs, model.diameter), caption, columns=12)),
        html.tiles(*tiles),
        html.table(head, rows),
    )


def chosen_records(records: Sequence[Record], count: int) -> list[tuple[str, Record]]:
    """The best, the median and the worst targets, `count` in all, each with its rank in words."""
    ordered = sorted(records, key=lambda record: record.error_m)
    share = min(max(1, count // 3), len(ordered))
    middle = (len(ordered) - share) // 2
    groups = (
        ("best", ordered[:share]),
        ("median", ordered[middle : middle + share]),
        ("worst", ordered[-share:]),
    )
    return [(rank, record) for rank, group in groups for record in group]


def overlay(session: Session, model: ObjectModel, frame: int, runs: Mapping[str, Evaluation]) -> Picture:
    """(360, 360, 3) RGB picture of S0 around the object, with its outline and axes in truth and in each run's
    estimate."""
    poses = session.object_poses(model.name)
    region = square_box(poses.bbox_xywh[frame], _CONTEXT)
    intrinsics = session.working_intrinsics.crop(region, _SIDE_PX)
    s0 = extract_crop(session.stokes(frame).s0[None], region, _SIDE_PX)[0]
    bright = max(float(np.percentile(s0, 99)), 1e-6)
    grey = np.rint(255 * np.clip(s0 / bright, 0, 1) ** (1 / 2.2)).astype(np.uint8)
    picture: Picture = cv2.cvtColor(grey, cv2.COLOR_GRAY2RGB)
    draw_pose(picture, poses.T_cam_obj[frame], model, intrinsics, COLOURS["truth"])
    for name, run in runs.items():
        found = next((record.T_cam_obj for record in run.records if record.frame == frame), None)
        if found is not None:
            pose = SE3.from_matrix(np.array(found))
            draw_pose(picture, pose, model, intrinsics, COLOURS.get(name, COLOURS["before"]))
    return picture


def draw_pose(
    picture: Picture, pose: SE3, model: ObjectModel, intrinsics: Intrinsics, colour: tuple[int, int, int]
) -> None:
    """Draws the object's outline, in place, with a line from its centre along its x axis to show the turn
    about z."""
    mask = rasterize(model.mesh, pose, intrinsics).mask.astype(np.uint8)
    contours, _ = cv2.findContours(mask, cv2.RETR_LIST, cv2.CHAIN_APPROX_NONE)
    cv2.drawContours(picture, contours, -1, colour, 2, cv2.LINE_AA)
    ends = intrinsics.project(
        pose.apply(np.array([[0.0, 0.0, 0.0], [_AXIS_SHARE * model.diameter, 0.0, 0.0]]))
    )
    if np.isfinite(ends).all():
        start, end = (tuple(row) for row in np.rint(np.clip(ends, -9999, 9999)).astype(int).tolist())
        cv2.line(picture, start, end, colour, 2, cv2.LINE_AA)


def recall_curves(runs: Mapping[str, Evaluation], diameter_m: float) -> str:
    """An SVG chart: percent of the targets below each error, up to 30 % of the diameter."""
    width, height, left, bottom, right = 760, 280, 44, 40, 110
    thresholds = np.linspace(0, _CURVE_LIMIT, 121)
    x = left + thresholds / _CURVE_LIMIT * (width - left - right)
    parts = []
    for percent in (0, 25, 50, 75, 100):
        y = _height_at(percent, height, bottom)
        parts.append(
            f'<line x1="{left}" y1="{y:.1f}" x2="{width - right}" y2="{y:.1f}" stroke="var(--line)"/>'
        )
        parts.append(f'<text x="{left - 6}" y="{y + 4:.1f}" text-anchor="end">{percent}</text>')
    for share in (0.05, 0.1, 0.2, 0.3):
        at = left + share / _CURVE_LIMIT * (width - left - right)
        parts.append(
            f'<text x="{at:.1f}" y="{height - bottom + 18}" text-anchor="middle">{100 * share:.0f} %</text>'
        )
    label_y = 0.0
    for name, run in sorted(runs.items(), key=lambda item: -item[1].summary.recall_10):
        errors = np.array([record.error_m for record in run.records]) / diameter_m
        percent = 100 * (errors[None] < thresholds[:, None]).mean(axis=1)
        line = " ".join(
            f"{a:.1f},{_height_at(b, height, bottom):.1f}" for a, b in zip(x, percent, strict=True)
        )
        red, green, blue = COLOURS.get(name, (140, 140, 150))
        stroke = f"rgb({red},{green},{blue})"
        parts.append(f'<polyline points="{line}" fill="none" stroke="{stroke}" stroke-width="2"/>')
        label_y = max(_height_at(percent[-1], height, bottom) + 4, label_y + 16)
        parts.append(
            f'<text x="{width - right + 8}" y="{label_y:.1f}" style="fill:{stroke}">{escape(name)}</text>'
        )
    return f'<svg viewBox="0 0 {width} {height}" role="img" aria-label="recall curves">{"".join(parts)}</svg>'


def _height_at(percent: float, height: int, bottom: int) -> float:
    return 12 + (100 - percent) / 100 * (height - bottom - 12)


def _millimetres(record: Record) -> str:
    return f"{1e3 * record.error_m:.1f} mm" if np.isfinite(record.error_m) else "missed"


def _row(name: str, run: Evaluation) -> tuple[str, ...]:
    s = run.summary
    return (
        name,
        s.metric,
        f"{s.recall_10:.1f} %",
        f"{s.recall_5:.1f} %",
        str(s.targets),
        str(s.missed),
        f"{s.rotation_deg:.1f}°",
        f"{s.translation_mm:.1f} mm",
        f"{s.depth_mm:+.1f} mm",
    )
