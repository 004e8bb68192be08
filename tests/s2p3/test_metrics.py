"""Errors, recalls and areas on cases with known answers."""

from __future__ import annotations

import json
import math

import numpy as np
import pytest
from scipy.spatial import ConvexHull

from dataset import SE3
from dataset.transforms import rotation_error_deg
from s2p3 import metrics
from s2p3.metrics import metric_name
from s2p3.objects import ObjectModel, Symmetry, build
from tests.s2p3.bop_pose_errors import CASES, STORED, cases, errors

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


def test_add_s_of_a_symmetric_pose_is_next_to_nothing() -> None:
    bottle = build("bottle")
    true = poses(5)
    turned = true @ SE3.from_rotvec(
        np.array([[0, 0, angle] for angle in (0.0, 0.7, 1.9, 2.8, 4.1)]), np.zeros((5, 3))
    )
    errors = metrics.surface_errors(bottle)
    assert errors["ADD-S"](turned, true)[0] == pytest.approx(0, abs=1e-12)
    assert errors["ADD-S"](turned, true).max() < 0.004 * bottle.diameter
    assert errors["ADD"](turned, true)[1:].min() > 0.1 * bottle.diameter
    moved = SE3(true.rotation, true.translation + np.array([0, 0, 0.02]))
    assert (errors["ADD-S"](moved, true) <= errors["ADD"](moved, true)).all()


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


def test_mssd_and_mspd_of_a_shift_by_hand() -> None:
    K = np.array([[500.0, 0, 320], [0, 500.0, 240], [0, 0, 1]])
    true = SE3(np.eye(3)[None], np.array([[0.0, 0.0, 0.5]]))
    moved = SE3(np.eye(3)[None], np.array([[0.003, 0.004, 0.5]]))
    points = np.array([[0.0, 0.0, 0.0], [0.1, 0.0, -0.1]])  # the second is nearer: more pixels a metre
    same = Symmetry().sampled()
    assert metrics.mssd(moved, true, points, same)[0] == pytest.approx(0.005)
    assert metrics.mspd(moved, true, points, same, K)[0] == pytest.approx(500 * 0.005 / 0.4)


def test_mssd_forgives_the_symmetries_only() -> None:
    half_turn = SE3.from_rotvec([0.0, 0.0, np.pi], np.zeros(3))
    symmetry = Symmetry(half_turn.as_matrix()[None])
    true = poses(3)
    turned = true @ half_turn
    assert metrics.mssd(turned, true, POINTS, symmetry.sampled()).max() < 1e-12
    assert metrics.mssd(turned, true, POINTS, Symmetry().sampled()).min() > 0.05


def test_mssd_by_the_hull_is_that_by_all_vertices() -> None:
    hull = POINTS[ConvexHull(POINTS).vertices]
    turns = Symmetry(axis=np.array([0.0, 0.6, 0.8])).sampled(60)
    a, b = poses(10), poses(10, seed=5)
    np.testing.assert_allclose(metrics.mssd(a, b, hull, turns), metrics.mssd(a, b, POINTS, turns), rtol=1e-12)


def test_the_area_under_the_curve_is_that_of_the_finely_drawn_curve() -> None:
    errors = np.append(np.random.default_rng(3).exponential(0.05, 200), [np.inf, 0.0])
    thresholds = (np.arange(20_000) + 0.5) / 20_000 * metrics.AUC_LIMIT_M
    drawn = metrics.recall_curve(errors, thresholds).mean()
    assert metrics.area_shares(errors).mean() == pytest.approx(drawn, abs=0.01)


def test_average_recalls_count_thresholds() -> None:
    shares = metrics.average_recalls([0.0, 0.049, 0.051, 0.3001, 0.6, np.inf], metrics.MSSD_SHARES)
    np.testing.assert_allclose(shares, [100, 100, 90, 40, 0, 0])
    np.testing.assert_allclose(metrics.mspd_thresholds_px(1280), np.arange(10, 101, 10))


def test_views_are_as_far_apart_as_the_camera_was_turned() -> None:
    looking = SE3.from_rotvec([np.pi, 0.0, 0.0], [0.0, 0.0, 0.4])  # from above
    turn = SE3.from_rotvec([0.0, np.radians(20.0), 0.0], np.zeros(3))
    seen = metrics.viewing_direction(SE3.stack([looking, looking @ turn]))
    np.testing.assert_allclose(seen[0], [0, 0, 1], atol=1e-12)
    assert metrics.view_distance_deg(seen[1:], seen[:1], Symmetry())[0] == pytest.approx(20)
    about_y = Symmetry(axis=np.array([0.0, 1.0, 0.0]))
    assert metrics.view_distance_deg(seen[1:], seen[:1], about_y)[0] == pytest.approx(0, abs=1e-6)
    about_z = Symmetry(axis=np.array([0.0, 0.0, 1.0]))
    assert metrics.view_distance_deg(seen[1:], seen[:1], about_z)[0] == pytest.approx(20)


def check_agreement(wanted: dict[str, list[float]]) -> None:
    for row, case in enumerate(cases()):
        found = SE3(case.R_estimated[None], case.t_estimated[None])
        true = SE3(case.R_true[None], case.t_true[None])
        measured = {
            "add": metrics.add(found, true, case.points),
            "adi": metrics.add_s(found, true, case.points),
            "mssd": metrics.mssd(found, true, case.points, case.symmetries),
            "mspd": metrics.mspd(found, true, case.points, case.symmetries, case.K),
        }
        for name, value in measured.items():
            assert abs(value[0] - wanted[name][row]) < 1e-6, (name, row)


def test_a_thousand_errors_agree_with_those_the_bop_toolkit_computed() -> None:
    stored = json.loads(STORED.read_text())
    assert all(len(stored[name]) == CASES for name in ("add", "adi", "mssd", "mspd"))
    check_agreement(stored)


def test_a_thousand_errors_agree_with_the_bop_toolkit_live() -> None:
    pytest.importorskip("bop_toolkit_lib.pose_error", reason="the BOP toolkit is not installed")
    check_agreement(errors())


def test_the_metric_is_named_by_the_objects_symmetry(cup: ObjectModel) -> None:
    assert metric_name(cup) == "ADD"
    assert metric_name(build("bottle")) == "ADD-S"


def test_recall_without_targets_is_not_a_number() -> None:
    assert math.isnan(metrics.recall(np.zeros(0), 0.1))
