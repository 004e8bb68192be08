"""Views of boards and objects, and the arm's way to them, in the simulated lab's layout."""

from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest

from acquisition.clearance import CarriedCamera, is_clear
from acquisition.kinematics import JOINT_LIMIT, forward, link_transforms, unwrap_near
from acquisition.planning import VIA, configurations, most_diverse, plan_path, plan_stills, shorten
from acquisition.simulation.arm import HOME
from acquisition.trajectories import (
    board_visibility,
    hand_eye_views,
    hemisphere_path,
    hemisphere_views,
    look_at,
    rotation_spread_deg,
    seen_cells,
)
from dataset.errors import ToolkitError
from dataset.intrinsics import Intrinsics
from dataset.transforms import SE3, rotation_error_deg, translation_error_mm
from dataset.view_sphere import ViewSphere

INTRINSICS = Intrinsics(
    np.array([[1740.0, 0, 1223.5], [0, 1740, 1023.5], [0, 0, 1]]), np.zeros(0), 2048, 2448
)
CAMERA = CarriedCamera(SE3.identity(), SE3.from_rotvec([0, 0, 0.1], [0.0, -0.06, 0.03]))
BOARD_SIZE = (0.385, 0.28)
# On the table, its z axis into the table, centre at (0.45, -0.25).
T_BASE_BOARD = SE3(np.diag([1.0, -1.0, -1.0]), np.array([0.45 - 0.385 / 2, -0.25 + 0.14, 0.0]))
BOARD_CENTRE = np.array([0.45, -0.25, 0.0])
OBJECT = np.array([0.45, 0.2, 0.05])


def T_base_cam(q: np.ndarray) -> SE3:
    return forward(q) @ CAMERA.T_flange_tcp @ CAMERA.T_tcp_cam


def test_look_at_sees_the_target_in_the_middle_and_up_upwards() -> None:
    eye, target = np.array([0.2, 0.1, 0.6]), np.array([0.45, 0.2, 0.05])
    view = look_at(eye, target)
    in_camera = view.inverse().apply(np.stack([target, np.add(target, [0, 0, 0.1])]))
    np.testing.assert_allclose(in_camera[0, :2], 0, atol=1e-12)
    assert in_camera[0, 2] == pytest.approx(np.linalg.norm(target - eye))
    assert in_camera[1, 1] < 0  # higher in the world is higher in the image, where y points down
    assert in_camera[1, 0] == pytest.approx(0, abs=1e-12)


def test_look_at_straight_down_is_a_rotation() -> None:
    view = look_at([0.4, 0, 0.5], [0.4, 0, 0])
    np.testing.assert_allclose(view.rotation @ view.rotation.T, np.eye(3), atol=1e-12)
    assert np.linalg.det(view.rotation) == pytest.approx(1)
    np.testing.assert_allclose(view.rotation[:, 2], [0, 0, -1], atol=1e-12)


def test_roll_turns_the_image_only() -> None:
    level, rolled = look_at([0.1, 0, 0.5], [0.4, 0, 0]), look_at([0.1, 0, 0.5], [0.4, 0, 0], 0.5)
    np.testing.assert_allclose(level.rotation[:, 2], rolled.rotation[:, 2], atol=1e-12)
    assert rotation_error_deg(level, rolled) == pytest.approx(np.rad2deg(0.5))


@pytest.mark.parametrize("flip", [False, True], ids=["z into the table", "z out of the table"])
def test_hand_eye_views_show_the_board_from_above(flip: bool) -> None:
    board = SE3(np.eye(3), T_BASE_BOARD.translation - [0, 0.28, 0]) if flip else T_BASE_BOARD
    views = hand_eye_views(board, BOARD_SIZE, INTRINSICS, 40, seed=3)
    assert len(views) == 40
    assert (views.translation[:, 2] > 0.1).all()
    pixels = INTRINSICS.project(views.inverse().apply(BOARD_CENTRE))
    assert ((pixels > 0) & (pixels < [2448, 2048])).all()
    assert np.ptp(pixels, axis=0).min() > 400  # the board wanders over the image


def test_hand_eye_views_of_a_board_that_fits_no_image() -> None:
    far = SE3(np.eye(3), np.zeros(3))
    narrow = Intrinsics(np.array([[1740.0, 0, 1223.5], [0, 1740, -9000], [0, 0, 1]]), np.zeros(0), 2048, 2448)
    with pytest.raises(ToolkitError, match="found 0 of 2 views"):
        hand_eye_views(far, BOARD_SIZE, narrow, 2)


def test_hemisphere_views_cover_the_zone() -> None:
    views = hemisphere_views(OBJECT, (0.3, 0.5), (25, 80), 200)
    offset = views.translation - OBJECT
    distance = np.linalg.norm(offset, axis=1)
    elevation = np.rad2deg(np.arcsin(offset[:, 2] / distance))
    azimuth = np.rad2deg(np.arctan2(offset[:, 1], offset[:, 0]))
    assert 0.3 <= distance.min() < distance.max() <= 0.5
    assert 25 <= elevation.min() < 27
    assert 78 < elevation.max() <= 80
    assert (np.histogram(azimuth, 12, (-180, 180))[0] > 8).all()


def test_hemisphere_path_is_smooth_and_looks_at_the_object() -> None:
    path = hemisphere_path(OBJECT, (0.42, 0.32), (28, 78), rows=5, step_deg=8)
    middle = path.inverse().apply(OBJECT)
    np.testing.assert_allclose(middle[:, :2], 0, atol=1e-9)
    direction = (path.translation - OBJECT) / np.linalg.norm(path.translation - OBJECT, axis=1, keepdims=True)
    step = np.rad2deg(np.arccos(np.clip((direction[1:] * direction[:-1]).sum(axis=1), -1, 1)))
    assert step.max() < 13  # from row to row; 8 along a row
    assert np.median(step) < 8.5


def test_plan_of_hand_eye_stills_is_diverse_reachable_and_clear() -> None:
    views = hand_eye_views(T_BASE_BOARD, BOARD_SIZE, INTRINSICS, 80, seed=0)
    plan = plan_stills(views, CAMERA, HOME, count=30)
    assert len(plan.q) >= 25
    assert rotation_spread_deg(views[plan.index]) >= 25
    assert translation_error_mm(T_base_cam(plan.q), views[plan.index]).max() < 1e-3
    assert rotation_error_deg(T_base_cam(plan.q), views[plan.index]).max() < 1e-3
    assert np.abs(plan.q).max() <= JOINT_LIMIT
    assert set(plan.index) | set(plan.unreachable) == set(range(80))
    between = np.concatenate([np.linspace(a, b, 20) for a, b in zip(plan.q[:-1], plan.q[1:], strict=True)])
    assert link_transforms(between)[:, 2:, 2, 3].min() > 0.05


def travel(q: np.ndarray) -> float:
    """Of the fastest joint, radians, from HOME through configurations (K, 6)."""
    return float(np.abs(np.diff(np.vstack([HOME, q]), axis=0)).max(axis=1).sum())


@pytest.mark.parametrize("seed", range(3))
def test_order_of_stills_keeps_motions_short(seed: int) -> None:
    views = hand_eye_views(T_BASE_BOARD, BOARD_SIZE, INTRINSICS, 40, seed=seed)
    plan = plan_stills(views, CAMERA, HOME)
    here, as_wished = np.array(HOME), []
    for candidates in configurations(views, CAMERA)[
        np.sort(plan.index), 0
    ]:  # each the nearest to the one before
        near = unwrap_near(candidates, here)
        here = near[np.nanargmin(np.abs(near - here).max(axis=1))]
        as_wished.append(here)
    assert travel(plan.q) < 0.5 * travel(np.array(as_wished))
    between = [np.linspace(a, b, 30) for a, b in pairwise([np.array(HOME), *plan.q])]
    assert is_clear(np.concatenate(between)[1:], CAMERA).all()


def test_turning_round_a_part_of_the_way_shortens_it() -> None:
    detour = [np.add(HOME, [turn, 0, 0, 0, 0, 0]) for turn in (0.1, 0.4, 0.3, 0.2, 0.5)]
    assert shorten(np.array(HOME), detour, CAMERA) == [0, 3, 2, 1, 4]


def test_stills_are_chosen_for_useful_rotations_and_for_what_they_show() -> None:
    views = hand_eye_views(T_BASE_BOARD, BOARD_SIZE, INTRINSICS, 80, seed=2)
    shown = board_visibility(views, T_BASE_BOARD, BOARD_SIZE, INTRINSICS)
    chosen = most_diverse(views, 15, shown)
    rng = np.random.default_rng(0)
    drawn = [rng.choice(80, 15, replace=False) for _ in range(20)]
    assert least_useful(views[chosen]) > 2 * np.median([least_useful(views[d]) for d in drawn])
    assert shown[chosen].mean() > shown.mean()  # the sides of a choice by rotation alone are left out
    assert len(set(chosen.tolist())) == 15


def least_useful(poses: SE3) -> float:
    """Of all pairs of poses, the smallest sine of the rotation between them."""
    angle = np.deg2rad(rotation_error_deg(poses[:, None], poses[None]))
    return float(np.sin(angle)[np.triu_indices(len(poses), 1)].min())


def test_visibility_is_the_share_of_the_board_in_the_image() -> None:
    above = look_at(np.add(BOARD_CENTRE, [0, 0, 0.5]), BOARD_CENTRE)
    aside = look_at(np.add(BOARD_CENTRE, [0.16, 0, 0.5]), np.add(BOARD_CENTRE, [0.35, 0, 0]))
    away = look_at(np.add(BOARD_CENTRE, [0, 0, 0.5]), np.add(BOARD_CENTRE, [0, 0, 1.0]))
    shown = board_visibility(SE3.stack([above, aside, away]), T_BASE_BOARD, BOARD_SIZE, INTRINSICS)
    assert shown[0] == 1.0
    assert 0.1 < shown[1] < 0.9
    assert shown[2] == 0.0
    assert board_visibility(above, T_BASE_BOARD, BOARD_SIZE, INTRINSICS) == 1.0


def test_coverage_counts_the_cells_that_were_looked_from() -> None:
    sphere = ViewSphere(15.0)
    zone = np.rad2deg(np.arcsin(sphere.directions[:, 2])) > 30
    seen = seen_cells(hemisphere_views(OBJECT, (0.3, 0.5), (30, 90), 600), OBJECT, sphere)
    assert seen[zone].all()
    assert not seen[np.rad2deg(np.arcsin(sphere.directions[:, 2])) < 20].any()
    one = seen_cells(look_at([np.add(OBJECT, [0, 0.1, 0.4])], OBJECT), OBJECT, sphere)
    assert one.sum() == 1


def test_path_over_the_hemisphere_is_dense_and_continuous() -> None:
    views = hemisphere_path(OBJECT, (0.42, 0.32), (28, 78), rows=4, step_deg=12)
    plan = plan_path(views, CAMERA, HOME)
    seen = plan.index >= 0
    assert seen.sum() >= 0.7 * len(views)
    at = T_base_cam(plan.q[seen])
    assert translation_error_mm(at, views[plan.index[seen]]).max() < 1e-3
    # The optical axis is the wished-for one; the roll is the plan's.
    np.testing.assert_allclose(at.rotation[..., 2], views[plan.index[seen]].rotation[..., 2], atol=1e-6)
    assert (np.diff(plan.index[seen]) > 0).all()
    steps = np.abs(np.diff(plan.q, axis=0)).max(axis=1)
    assert np.median(steps) < 0.5
    assert is_clear(plan.q, CAMERA).all()
    assert (plan.index[~seen] == VIA).all()


def test_configurations_are_of_the_view_asked_for() -> None:
    views = hemisphere_views(OBJECT, (0.35, 0.35), (40, 60), 5)
    q = configurations(views, CAMERA)
    assert q.shape == (5, 1, 8, 6)
    for view, solutions in zip(views, q[:, 0], strict=True):
        reached = T_base_cam(solutions[np.isfinite(solutions).all(axis=-1)])
        assert (translation_error_mm(reached, view) < 1e-3).all()
    assert np.isfinite(q).all(axis=-1).any(axis=(1, 2)).sum() >= 3


def test_a_long_tool_must_stay_clear_too() -> None:
    low = np.deg2rad([180, -62, 100, -128, -90, 0])
    short = CarriedCamera(SE3.identity(), SE3.identity())
    long = CarriedCamera(SE3.from_rotvec([0, 0, 0], [0, 0, 0.3]), SE3.from_rotvec([0, 0, 0], [0, 0, -0.3]))
    assert is_clear(low, short)
    assert forward(low).translation[2] < 0.35
    assert not is_clear(low, long)


def test_a_plan_stays_in_the_workspace() -> None:
    boxed = replace(CAMERA, workspace=((0.2, -0.6, 0.1), (0.9, 0.6, 0.55)))
    views = hemisphere_path(OBJECT, (0.38, 0.38), (30, 80), rows=2, step_deg=15)
    free, plan = plan_path(views, CAMERA, HOME), plan_path(views, boxed, HOME)
    way = np.concatenate([np.linspace(a, b, 10) for a, b in pairwise(plan.q)])
    tool = forward(way).translation
    assert (tool >= np.array(boxed.workspace[0]) - 5e-3).all()  # between the points that were looked at
    assert (tool <= np.array(boxed.workspace[1]) + 5e-3).all()
    assert len(plan.unreachable) > len(free.unreachable)


@pytest.mark.parametrize(
    ("q_deg", "clear"),
    [
        ([180, -90, 90, -90, -90, 0], True),
        ([0, -30, 0, -90, -90, 0], True),  # stretched out, rising
        ([0, 0, 0, -90, -90, 0], False),  # stretched out level: the camera under the hand meets the table
        ([180, 20, 20, -90, -90, 0], False),  # elbow through the table
        ([180, -90, 150, -60, -90, 0], False),  # folded: the flange 96 mm from the axis of the upper arm
    ],
)
def test_collisions(q_deg: list[float], clear: bool) -> None:
    assert bool(is_clear(np.deg2rad(q_deg), CAMERA)) is clear


def test_nothing_reachable_says_what_to_check() -> None:
    with pytest.raises(ToolkitError, match="reaches none of 10 views; check T_tcp_cam_guess"):
        plan_stills(hemisphere_views([3, 0, 0], (0.3, 0.3), (30, 60), 10), CAMERA, HOME)
    with pytest.raises(ToolkitError, match="reaches none"):
        plan_path(hemisphere_views([3, 0, 0], (0.3, 0.3), (30, 60), 10), CAMERA, HOME)


def test_an_arm_that_stands_outside_is_told_to_be_moved() -> None:
    boxed = replace(CAMERA, workspace=((-0.8, -0.8, 0.05), (0.8, 0.8, 0.9)))
    upright = np.deg2rad([180, -90, 0, -90, 0, 0])
    views = hemisphere_views(OBJECT, (0.3, 0.5), (25, 80), 20)
    for plan in (plan_stills, plan_path):
        with pytest.raises(
            ToolkitError, match=r"where the arm stands, .* outside the workspace .* at the pendant"
        ):
            plan(views, boxed, upright)
