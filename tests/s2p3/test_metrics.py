"""ADD, ADD-S and recall on cases with known answers."""

from __future__ import annotations

import math

import numpy as np
import pytest

from dataset import SE3
from dataset.transforms import rotation_error_deg
from s2p3.evaluation import metrics
from s2p3.evaluation.evaluate import Record, metric_name, summarize
from s2p3.objects import ObjectModel, Symmetry, build

RNG = np.random.default_rng(0)
POINTS = RNG.normal(size=(200, 3)) * 0.05


def poses(count: int, seed: int = 1) -> SE3:
    rng = np.random.default_rng(seed)
    return SE3.from_rotvec(rng.normal(size=(count, 3)), rng.normal(size=(count, 3)))


def test_add_of_a_shift_is_its_length() -> None:
    true = poses(4)
    moved = SE3(true.rotation, true.translation + np.array([0.003, 0.0, 0.004]))
    np.testing.assert_allclose(metrics.add(moved, true, POINTS), 0.005)


def test_add_of_a_half_turn_by_hand() -> None:
    points = np.array([[0.1, 0.0, 0.0], [0.0, 0.0, 0.3]])
    turned = SE3.stack([SE3.from_rotvec(np.array([0, 0, math.pi]), np.zeros(3))])
    assert metrics.add(turned, SE3.identity((1,)), points)[0] == pytest.approx((0.2 + 0) / 2)


def test_add_s_forgives_a_symmetry_and_never_exceeds_add() -> None:
    ring = np.arange(360) * 2 * np.pi / 360
    points = 0.1 * np.stack([np.cos(ring), np.sin(ring), np.zeros(360)], axis=1)
    turned = SE3.stack([SE3.from_rotvec(np.array([0, 0, np.radians(42.0)]), np.zeros(3))])
    assert metrics.add_s(turned, SE3.identity((1,)), points)[0] == pytest.approx(0, abs=1e-9)
    assert metrics.add(turned, SE3.identity((1,)), points)[0] > 0.05
    a, b = poses(20), poses(20, seed=2)
    assert (metrics.add_s(a, b, POINTS) <= metrics.add(a, b, POINTS) + 1e-12).all()


def test_rotation_error_forgives_symmetries() -> None:
    turned = SE3.stack([SE3.from_rotvec(np.array([0, 0, np.radians(30.0)]), np.zeros(3))])
    plain, round_ = Symmetry(), Symmetry(axis=np.array([0.0, 0.0, 1.0]))
    assert metrics.rotation_error_deg(turned, SE3.identity((1,)), plain)[0] == pytest.approx(30)
    assert metrics.rotation_error_deg(turned, SE3.identity((1,)), round_)[0] == pytest.approx(0, abs=1e-5)


@pytest.mark.parametrize("around", [None, (0.0, 0.6, 0.8)])
def test_rotation_error_is_the_smallest_over_all_symmetries(around: tuple[float, ...] | None) -> None:
    half_turn = SE3.from_rotvec([np.pi, 0.0, 0.0], np.zeros(3)).as_matrix()
    symmetry = Symmetry(half_turn[None], None if around is None else np.array(around))
    estimated, true = poses(30), poses(30, seed=3)
    found = metrics.rotation_error_deg(estimated, true, symmetry)
    every = SE3.from_matrix(symmetry.sampled(3600))
    tried = np.stack([rotation_error_deg(estimated[i], true[i] @ every).min() for i in range(30)])
    np.testing.assert_allclose(found, tried, atol=0.06)
    assert (found <= tried + 1e-6).all()


def test_a_missed_target_counts_as_failed(cup: ObjectModel) -> None:
    nan, pose = float("nan"), tuple(map(tuple, np.eye(4).tolist()))
    hit = Record(0, 1.0, (0, 0, 1, 1), pose, 0.04 * cup.diameter, 2.0, 3.0, -1.0)
    near = Record(1, 1.0, (0, 0, 1, 1), pose, 0.08 * cup.diameter, 4.0, 5.0, 2.0)
    missed = Record(2, 1.0, None, None, float("inf"), nan, nan, nan)
    summary = summarize([hit, near, missed, missed], cup)
    assert (summary.targets, summary.missed) == (4, 2)
    assert (summary.recall_10, summary.recall_5) == (50, 25)
    assert (summary.rotation_deg, summary.translation_mm, summary.depth_mm) == (3, 4, 0.5)
    assert str(summary).startswith("ADD recall at 10 % 50.0")


def test_the_metric_is_named_by_the_objects_symmetry(cup: ObjectModel) -> None:
    assert metric_name(cup) == "ADD"
    assert metric_name(build("bottle")) == "ADD-S"


def test_recall_without_targets_is_not_a_number() -> None:
    assert math.isnan(metrics.recall(np.zeros(0), 0.1))
