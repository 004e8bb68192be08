"""Summaries count every target; intervals cover what they should; runs are compared target by target."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from dataset.errors import ToolkitError
from s2p3.evaluation.bootstrap import interval, mean, median, resamples
from s2p3.evaluation.summary import FIGURES, grouped, summarize
from s2p3.objects import ObjectModel
from tests.s2p3.evaluations import evaluation, missed, record, subject


def test_a_missed_target_counts_as_failed(cup: ObjectModel) -> None:
    hit = record(0, 0.04 * cup.diameter, rotation_deg=2.0, translation_mm=3.0, depth_mm=-1.0)
    near = record(1, 0.08 * cup.diameter, rotation_deg=4.0, translation_mm=5.0, depth_mm=2.0)
    summary = summarize([hit, near, missed(2), missed(3)], subject(cup))
    assert (summary.targets, summary.missed) == (4, 2)
    assert (summary.recall_10, summary.recall_5) == (50, 25)
    assert summary.auc == pytest.approx(100 * (2 - 10 * 0.12 * cup.diameter) / 4)
    assert (summary.mssd_recall, summary.mspd_recall) == (pytest.approx((100 + 90) / 4), 50)
    assert (summary.rotation_deg, summary.translation_mm, summary.depth_mm) == (3, 4, 0.5)
    assert str(summary).startswith("ADD recall at 10 % 50.0")


def test_nothing_found_has_recall_zero_and_no_medians(cup: ObjectModel) -> None:
    summary = summarize([missed(0), missed(1)], subject(cup))
    assert summary.recall_10 == summary.auc == 0
    assert np.isnan([summary.rotation_deg, *summary.intervals["rotation_deg"]]).all()


def test_medians_leave_out_what_is_missing() -> None:
    rows = np.array([[3.0, np.nan, 1.0, np.nan], [np.nan] * 4, [4.0, 1.0, 2.0, 9.0], [7.0, np.nan, 1.0, 2.0]])
    np.testing.assert_array_equal(median(rows), [2, np.nan, 3, 2])


def test_an_interval_covers_the_truth_as_often_as_it_says() -> None:
    rng, covered = np.random.default_rng(0), 0
    for seed in range(200):
        values = 100.0 * (rng.random(150) < 0.7)
        low, high = interval(lambda rows, v=values: mean(v[rows]), resamples(150, 300, block=1, seed=seed))
        covered += low <= 70 <= high
    assert 180 <= covered <= 198


def test_blocks_widen_the_interval_of_a_film() -> None:
    """Runs of ten equal values: there are only thirty independent ones."""
    values = np.repeat(np.random.default_rng(1).random(30), 10)
    width = {}
    for block in (1, 10):
        low, high = interval(lambda rows: mean(values[rows]), resamples(300, block=block))
        width[block] = high - low
    assert width[10] > 2 * width[1]


@pytest.mark.parametrize("count", [1, 7, 1000])
def test_draws_are_targets_and_repeat(count: int) -> None:
    rows = resamples(count, 50)
    assert rows.shape == (50, count)
    assert rows.min() >= 0
    assert rows.max() < count
    np.testing.assert_array_equal(rows, resamples(count, 50))


def test_paired_runs_differ_surely_where_single_intervals_overlap(cup: ObjectModel) -> None:
    """Every target a little better: within the spread of the targets, but without exception."""
    errors = np.random.default_rng(2).uniform(0.001, 0.06, 200)
    before = evaluation([record(i, error) for i, error in enumerate(errors)], cup)
    after = evaluation([record(i, 0.9 * error) for i, error in enumerate(errors)], cup)
    (_, high), (low, _) = before.summary.intervals["auc"], after.summary.intervals["auc"]
    assert high > low
    above = after.above(before)
    assert set(above) == set(FIGURES)
    assert above["auc"].value == pytest.approx(after.summary.auc - before.summary.auc)
    assert above["auc"].interval[0] > 0
    assert after.above(after)["recall_10"].interval == (0, 0)


def test_runs_over_other_targets_are_not_paired(cup: ObjectModel) -> None:
    one, two = evaluation([record(0, 0.1)], cup), evaluation([record(1, 0.1)], cup)
    with pytest.raises(ToolkitError, match="not of the same targets"):
        one.above(two)
    elsewhere = replace(one, subject=replace(one.subject, session_id="another"))
    with pytest.raises(ToolkitError, match="same session and split"):
        one.above(elsewhere)


def test_groups_hold_every_target_once(cup: ObjectModel) -> None:
    rng = np.random.default_rng(4)
    records = [
        record(i, 0.01, visible_fraction=v, distance_m=d, elevation_deg=e)
        for i, (v, d, e) in enumerate(rng.uniform((0.1, 0.1, -90), (1, 2, 90), (50, 3)).tolist())
    ]
    groups = grouped(records, subject(cup))
    assert set(groups) == {"visible", "distance", "elevation"}
    assert all(sum(summary.targets for summary in group.values()) == 50 for group in groups.values())
    assert "from 1.5 m" in groups["distance"]
    known = [replace(r, unseen_deg=float(i)) for i, r in enumerate(records)]
    assert grouped(known, subject(cup))["from the nearest known view"]["5 to 10°"].targets == 5
