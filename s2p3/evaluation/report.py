"""The evaluation's part of an HTML report: the object's outline in truth and estimates, recall curves, and
the numbers."""

from __future__ import annotations

from collections.abc import Mapping
from html import escape

import cv2
import numpy as np
from numpy.typing import NDArray

from calibration import html
from dataset import SE3, Intrinsics
from dataset.session import Session
from s2p3.evaluation.bootstrap import Interval
from s2p3.evaluation.evaluate import Evaluation
from s2p3.evaluation.summary import Summary
from s2p3.inputs import extract_crop, square_box
from s2p3.metrics import Floats, recall_curve
from s2p3.objects import ObjectModel
from s2p3.rendering import rasterize

Picture = NDArray[np.uint8]

TRUTH = (60, 200, 120)
"""RGB of what was annotated."""

_LATEST, _PREVIOUS, _EARLIER = (90, 140, 255), (240, 150, 60), (140, 140, 150)

_COLUMNS: Mapping[str, tuple[str, str]] = {
    "recall_10": ("recall 10 %", "{:.1f}"),
    "recall_5": ("recall 5 %", "{:.1f}"),
    "auc": ("AUC 0.1 m", "{:.1f}"),
    "mssd_recall": ("AR MSSD", "{:.1f}"),
    "mspd_recall": ("AR MSPD", "{:.1f}"),
    "rotation_deg": ("rotation °", "{:.1f}"),
    "translation_mm": ("translation mm", "{:.1f}"),
    "depth_mm": ("depth mm", "{:+.1f}"),
}
"""Title and format of each figure."""

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
    drawn = dict(list(runs.items())[-2:])
    last = list(runs.values())[-1]
    figures = []
    for rank, position in chosen_records(last.errors_m, pictures):
        frame, error = last.records[position].frame, _millimetres(last.errors_m[position])
        shown = html.picture(overlay(session, model, frame, drawn), f"frame {frame}")
        caption = f"{rank}: frame {frame}, {last.subject.metric} {error}"
        figures.append(html.figure(shown, caption, columns=4))
    tiles = [
        html.Tile(
            f"{name}: {run.summary.metric} recall at 10 %",
            f"{run.summary.recall_10:.1f} %",
            f"{run.summary.targets} targets, {run.summary.missed} missed",
        )
        for name, run in runs.items()
    ]
    previous = "".join(f", orange as estimated by {name}" for name in list(drawn)[:-1])
    lead = (
        f"Outlines of {model.name}: green as annotated{previous}, blue as estimated by {list(drawn)[-1]}, in "
        "the detector's boxes. "
        "Every frame that shows the object is a target; one without an estimate counts as failed. "
        "Medians are over the targets with an estimate; brackets are 95 % bootstrap intervals."
    )
    caption = f"Share of the targets within a given {last.summary.metric}, in percent of the diameter."
    return html.section(
        "Pose estimation",
        lead,
        html.grid(*figures, html.figure(recall_curves(runs, model.diameter), caption, columns=12)),
        html.tiles(*tiles),
        summary_table("run", {name: run.summary for name, run in runs.items()}),
    )


def chosen_records(errors_m: Floats, count: int) -> list[tuple[str, int]]:
    """Positions of the best, the median and the worst targets, `count` in all, with their ranks in words."""
    ordered = np.argsort(errors_m, kind="stable").tolist()
    share = min(max(1, count // 3), len(ordered))
    middle = (len(ordered) - share) // 2
    groups = (
        ("best", ordered[:share]),
        ("median", ordered[middle : middle + share]),
        ("worst", ordered[-share:]),
    )
    return [(rank, position) for rank, group in groups for position in group]


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
    draw_pose(picture, poses.T_cam_obj[frame], model, intrinsics, TRUTH)
    colours = _colours(runs)
    for name, run in runs.items():
        found = next((record.T_cam_obj for record in run.records if record.frame == frame), None)
        if found is not None:
            pose = SE3.from_matrix(np.array(found))
            draw_pose(picture, pose, model, intrinsics, colours[name])
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
    label_y, colours = 0.0, _colours(runs)
    for name, run in sorted(runs.items(), key=lambda item: -item[1].summary.recall_10):
        recalls = recall_curve(run.errors_m / diameter_m, thresholds)
        line = " ".join(
            f"{a:.1f},{_height_at(b, height, bottom):.1f}" for a, b in zip(x, recalls, strict=True)
        )
        red, green, blue = colours[name]
        stroke = f"rgb({red},{green},{blue})"
        parts.append(f'<polyline points="{line}" fill="none" stroke="{stroke}" stroke-width="2"/>')
        label_y = max(_height_at(recalls[-1], height, bottom) + 4, label_y + 16)
        parts.append(
            f'<text x="{width - right + 8}" y="{label_y:.1f}" style="fill:{stroke}">{escape(name)}</text>'
        )
    return f'<svg viewBox="0 0 {width} {height}" role="img" aria-label="recall curves">{"".join(parts)}</svg>'


def _colours(runs: Mapping[str, Evaluation]) -> dict[str, tuple[int, int, int]]:
    """RGB by name: the last run and the one before it stand out."""
    return dict.fromkeys(runs, _EARLIER) | dict(zip(list(runs)[::-1], (_LATEST, _PREVIOUS), strict=False))


def _height_at(percent: float, height: int, bottom: int) -> float:
    return 12 + (100 - percent) / 100 * (height - bottom - 12)


def groups_section(evaluation: Evaluation) -> str:
    """An HTML section: the figures by how the targets are seen."""
    tables = [summary_table(title, group) for title, group in evaluation.groups().items()]
    lead = (
        "The same targets by the visible share of the silhouette, by their distance from the camera, by the "
        "camera's elevation above the object's xy plane, and, where the session has a split to train on, by "
        "the angle to the nearest view in it."
    )
    return html.section("By visibility and view", lead, *tables)


def comparison_section(name: str, evaluation: Evaluation, others: Mapping[str, Evaluation]) -> str:
    """An HTML section: every run by object, and how far this one is above those of the same targets."""
    by_object = {
        f"{run.subject.object_name}: {run_name}": run.summary
        for run_name, run in sorted(
            {**others, name: evaluation}.items(), key=lambda item: item[1].subject.object_name
        )
    }
    blocks = [summary_table("object: run", by_object)]
    above = {other: evaluation.above(run) for other, run in others.items() if evaluation.paired_with(run)}
    if above:
        head = (f"{name} minus", *(title for title, _ in _COLUMNS.values()))
        rows = [
            (other, *(with_interval(found[f].value, found[f].interval, "{:+.1f}") for f in _COLUMNS))
            for other, found in above.items()
        ]
        blocks.append(html.table(head, rows))
    lead = (
        "Every run; and differences on the same targets, with paired 95 % bootstrap intervals: "
        "one that excludes zero is unlikely to be chance."
    )
    return html.section("Beside others", lead, *blocks)


def summary_table(head: str, summaries: Mapping[str, Summary]) -> str:
    """A table of figures with their intervals, a row each."""
    rows = [
        (
            name,
            summary.metric,
            f"{summary.targets} ({summary.missed} missed)",
            *(
                with_interval(getattr(summary, f), summary.intervals[f], form)
                for f, (_, form) in _COLUMNS.items()
            ),
        )
        for name, summary in summaries.items()
    ]
    return html.table((head, "metric", "targets", *(title for title, _ in _COLUMNS.values())), rows)


def with_interval(value: float, interval: Interval, form: str) -> str:
    """The value and, in brackets, its interval; a dash where there is no number."""
    if not np.isfinite(value):
        return "–"
    low, high = (form.format(end) for end in interval)
    return f"{form.format(value)} [{low}, {high}]"


def _millimetres(error_m: float) -> str:
    return f"{1e3 * error_m:.1f} mm" if np.isfinite(error_m) else "missed"
