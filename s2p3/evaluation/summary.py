"""What lists of targets come to: figures with intervals, by group, and the difference between two runs."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial

import numpy as np
from numpy.typing import NDArray

from dataset.errors import ToolkitError
from s2p3 import metrics
from s2p3.evaluation.bootstrap import Interval, interval, mean, median, resamples
from s2p3.evaluation.records import Record, Subject
from s2p3.metrics import Floats

Statistic = Callable[[Floats], Floats]

FIGURES: Mapping[str, Statistic] = {
    "recall_10": mean,
    "recall_5": mean,
    "auc": mean,
    "mssd_recall": mean,
    "mspd_recall": mean,
    "rotation_deg": median,
    "translation_mm": median,
    "depth_mm": median,
}
"""The figures of a summary, and what each is of the targets' values."""

_VISIBILITY = (0.1, 0.3, 0.5, 0.7, 0.9)
_DISTANCE_M = (0.0, 0.2, 0.3, 0.4, 0.5, 0.6, 0.8, 1.0, 1.5)
_ELEVATION_DEG = (-90.0, -60.0, -30.0, 0.0, 30.0, 60.0)
_UNSEEN_DEG = (0.0, 5.0, 10.0, 20.0, 40.0)


@dataclass(frozen=True)
class Summary:
    """What a list of targets comes to.

    Attributes:
        metric: "ADD" or "ADD-S": what the recalls and the area are of.
        targets, missed: how many there were, and without any estimate.
        recall_10, recall_5: percent of all targets within 10 % and 5 % of the diameter.
        auc: area under the recall curve up to 0.1 m, percent.
        mssd_recall, mspd_recall: the BOP challenge's average recalls by MSSD and MSPD, percent.
        rotation_deg, translation_mm: medians over the targets with an estimate.
        depth_mm: median signed error of z, positive where the estimate is too far.
        intervals: of each figure by name, 95 % bootstrap.
    """

    metric: str
    targets: int
    missed: int
    recall_10: float
    recall_5: float
    auc: float
    mssd_recall: float
    mspd_recall: float
    rotation_deg: float
    translation_mm: float
    depth_mm: float
    intervals: Mapping[str, Interval]

    def __str__(self) -> str:
        low, high = self.intervals["recall_10"]
        return (
            f"{self.metric} recall at 10 % {self.recall_10:.1f} ({low:.1f} to {high:.1f}), "
            f"at 5 % {self.recall_5:.1f}, AUC {self.auc:.1f} ({self.targets} targets, {self.missed} missed); "
            f"medians: rotation {self.rotation_deg:.1f} deg, "
            f"translation {self.translation_mm:.1f} mm, depth {self.depth_mm:+.1f} mm"
        )


@dataclass(frozen=True)
class Difference:
    """How much one run is above another on the same targets, with the paired 95 % interval."""

    value: float
    interval: Interval


def summarize(records: Sequence[Record], subject: Subject) -> Summary:
    """What `records` come to; at least one."""
    values, rows = _values(records, subject), resamples(len(records))
    figures = {name: float(of(values[name][None])[0]) for name, of in FIGURES.items()}
    intervals = {name: interval(partial(_drawn, values[name], of), rows) for name, of in FIGURES.items()}
    missed = sum(record.T_cam_obj is None for record in records)
    return Summary(subject.metric, len(records), missed, **figures, intervals=intervals)


def grouped(records: Sequence[Record], subject: Subject) -> dict[str, dict[str, Summary]]:
    """Summaries by visible fraction, distance, elevation, and distance from known views; the last only where
    there are any, and none of groups without targets."""
    columns = {
        "visible": (_VISIBILITY, "", [record.visible_fraction for record in records]),
        "distance": (_DISTANCE_M, " m", [record.distance_m for record in records]),
        "elevation": (_ELEVATION_DEG, "°", [record.elevation_deg for record in records]),
        "from the nearest known view": (_UNSEEN_DEG, "°", [record.unseen_deg for record in records]),
    }
    groups = {}
    for title, (edges, unit, values) in columns.items():
        band = np.searchsorted(edges, values, side="right") - 1
        members = {
            _band(edges, index, unit): [r for r, b in zip(records, band, strict=True) if b == index]
            for index in range(len(edges))
        }
        if np.isfinite(values).all():
            groups[title] = {name: summarize(found, subject) for name, found in members.items() if found}
    return groups


def of_same_targets(
    run: Sequence[Record], other: Sequence[Record], subject: Subject, of_other: Subject
) -> bool:
    """Whether two runs can be compared target by target."""
    return subject == of_other and [record.frame for record in run] == [record.frame for record in other]


def differences(
    run: Sequence[Record], other: Sequence[Record], subject: Subject, of_other: Subject
) -> dict[str, Difference]:
    """Every figure of `run` minus that of `other`, with paired intervals: both are resampled alike.

    Raises ToolkitError: they are not of the same targets.
    """
    if not of_same_targets(run, other, subject, of_other):
        raise ToolkitError(
            f"two evaluations of {subject.object_name!r} and {of_other.object_name!r} are not of the same "
            "targets, so they cannot be paired; evaluate both on the same session and split"
        )
    ours, theirs = _values(run, subject), _values(other, of_other)
    rows, everything = resamples(len(run)), np.arange(len(run))[None]
    found = {}
    for name, of in FIGURES.items():
        above = partial(_apart, ours[name], theirs[name], of)
        found[name] = Difference(float(above(everything)[0]), interval(above, rows))
    return found


def _drawn(values: Floats, of: Statistic, rows: NDArray[np.int64]) -> Floats:
    return of(values[rows])


def _apart(ours: Floats, theirs: Floats, of: Statistic, rows: NDArray[np.int64]) -> Floats:
    return of(ours[rows]) - of(theirs[rows])


def _values(records: Sequence[Record], subject: Subject) -> dict[str, Floats]:
    """What each figure is the mean or median of, (N,) each."""

    def column(name: str) -> Floats:
        return np.array([getattr(record, name) for record in records], dtype=np.float64)

    errors: Floats = np.array([record.error_m(subject.metric) for record in records])
    within = [100 * (errors < share * subject.diameter_m).astype(np.float64) for share in (0.1, 0.05)]
    return {
        "recall_10": within[0],
        "recall_5": within[1],
        "auc": metrics.area_shares(errors),
        "mssd_recall": metrics.average_recalls(column("mssd_m"), metrics.MSSD_SHARES * subject.diameter_m),
        "mspd_recall": metrics.average_recalls(
            column("mspd_px"), metrics.mspd_thresholds_px(subject.image_width)
        ),
        "rotation_deg": column("rotation_deg"),
        "translation_mm": column("translation_mm"),
        "depth_mm": column("depth_mm"),
    }


def _band(edges: Sequence[float], index: int, unit: str) -> str:
    if index + 1 == len(edges):
        return f"from {edges[index]:g}{unit}"
    return f"{edges[index]:g} to {edges[index + 1]:g}{unit}"
