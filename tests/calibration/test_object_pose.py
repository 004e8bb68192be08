"""An object's pose from touched points: accuracy, symmetry, refusals."""

import numpy as np
import pytest
import trimesh

from calibration.fusion import fuse_poses
from calibration.object_observability import Tip
from calibration.object_pose import register_points
from dataset.errors import CalibrationError
from dataset.transforms import SE3, rotation_error_deg, translation_error_mm

_PROFILE = [
    [0, 0], [0.026, 0], [0.030, 0.004], [0.038, 0.088], [0.0395, 0.09],
    [0.037, 0.09], [0.0355, 0.0875], [0.028, 0.006], [0, 0.006],
]  # fmt: skip
TRUTH = SE3.from_rotvec([0.05, -0.03, 2.1], [0.5, -0.1, 0.05])


def _cup(handle):
    cup = trimesh.creation.revolve(np.array(_PROFILE), sections=64)
    if handle:
        ring = trimesh.creation.torus(0.022, 0.004, major_sections=32, minor_sections=16)
        ring.apply_transform(trimesh.transformations.rotation_matrix(np.pi / 2, [1, 0, 0]))
        ring.apply_translation([0.047, 0, 0.048])
        cup = trimesh.util.concatenate([cup, ring])
    return cup


def _touch(mesh, count, seed, noise=1.5e-4):
    """Points spread over what a probe reaches from above and outside, in the base frame."""
    rng = np.random.default_rng(seed)
    points, face = trimesh.sample.sample_surface(mesh, 4000, seed=seed)
    inside = (np.linalg.norm(points[:, :2], axis=1) < 0.0365) & (points[:, 2] < 0.088)
    points = points[(mesh.face_normals[face][:, 2] > -0.5) & ~inside]
    chosen = [0]
    distance = np.linalg.norm(points - points[0], axis=1)
    while len(chosen) < count:
        chosen.append(int(np.argmax(distance)))
        distance = np.minimum(distance, np.linalg.norm(points - points[chosen[-1]], axis=1))
    return TRUTH.apply(points[chosen] + rng.normal(0, noise, (count, 3)))


@pytest.mark.parametrize("seed", [0, 1, 2])
def test_a_cup_is_found_without_a_guess(seed):
    cup = _cup(handle=True)
    result = register_points(_touch(cup, 24, seed), cup.vertices, cup.faces)
    assert rotation_error_deg(result.T_base_obj, TRUTH) < 0.5  # three axes together, sigma 0.1-0.15 each
    assert translation_error_mm(result.T_base_obj, TRUTH) < 1.0
    assert result.rms_m < 2e-4
    assert result.unobservable == ()
    assert result.runner_up_rms_m > 5 * result.rms_m


def test_the_error_bars_hold_the_truth():
    cup = _cup(handle=True)
    scores = []
    for seed in range(3):
        result = register_points(_touch(cup, 40, seed), cup.vertices, cup.faces, init=TRUTH)
        error = (result.T_base_obj.inverse() @ TRUTH).log()
        assert np.degrees(np.linalg.norm(error[3:])) < 0.3
        scores.append(error @ np.linalg.solve(result.covariance, error))
    assert 1 < np.mean(scores) < 18  # 6 expected


def test_a_cup_without_a_handle_leaves_its_turn_open_and_says_so():
    cup = _cup(handle=False)
    points = _touch(cup, 24, 0)
    result = register_points(points, cup.vertices, cup.faces)
    assert any("rotation about the object's z axis" in words for words in result.unobservable)
    assert np.sqrt(result.covariance[5, 5]) > 1.0
    tilt = np.degrees(np.arccos(min(1.0, result.T_base_obj.rotation[:, 2] @ TRUTH.rotation[:, 2])))
    assert tilt < 0.5
    assert translation_error_mm(result.T_base_obj, TRUTH) < 1.0


def test_a_known_symmetry_is_not_reported_as_a_defect():
    cup = _cup(handle=False)
    result = register_points(_touch(cup, 24, 0), cup.vertices, cup.faces, symmetry_axis=[0, 0, 1])
    assert result.unobservable == ()
    assert np.sqrt(result.covariance[5, 5]) > 1.0
    assert result.runner_up_rms_m > 2 * result.rms_m


def test_known_turns_are_no_defect_nor_a_rival():
    box = trimesh.creation.box([0.06, 0.08, 0.1])
    points = _touch(box, 30, 0)
    halves = SE3.from_rotvec(np.pi * np.eye(3), np.zeros(3))
    told = register_points(points, box.vertices, box.faces)
    known = register_points(points, box.vertices, box.faces, symmetry_turns=halves)
    (words,) = told.rivals
    assert "turned by 180 degrees" in words
    assert told.runner_up_rms_m < 2 * told.rms_m
    assert known.rivals == ()
    assert known.runner_up_rms_m > 2 * known.rms_m


def test_a_result_turned_towards_a_reference_is_the_same_object_with_its_uncertainty():
    bar = trimesh.creation.box([0.06, 0.06, 0.1])
    quarters = SE3.from_rotvec(np.pi / 2 * np.arange(1, 4)[:, None] * [0, 0, 1.0], np.zeros(3))
    found = register_points(_touch(bar, 30, 0), bar.vertices, bar.faces, TRUTH, symmetry_turns=quarters)
    other = found.T_base_obj @ quarters[0]
    turned = found.turned_towards(other, quarters)
    np.testing.assert_allclose(turned.T_base_obj.as_matrix(), other.as_matrix(), atol=1e-9)
    assert found.turned_towards(found.T_base_obj, quarters).T_base_obj.log() == pytest.approx(
        found.T_base_obj.log()
    )
    at = found.T_base_obj.apply([0.02, 0.01, 0.03])
    spreads = [_spread(result, result.T_base_obj.inverse().apply(at)) for result in (found, turned)]
    np.testing.assert_allclose(*spreads, rtol=1e-6, atol=1e-15)


def _spread(result, point):
    """Covariance (3, 3) in the base frame of a point (3,) of the object."""
    x, y, z = point
    cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    by_pose = result.T_base_obj.rotation @ np.hstack([np.eye(3), -cross])
    return by_pose @ result.covariance @ by_pose.T


def test_a_box_touched_on_two_sides_only_does_not_know_its_height():
    box = trimesh.creation.box([0.06, 0.08, 0.3])
    rng = np.random.default_rng(0)
    sides = [[0.03, y, z] for y in (-0.03, 0, 0.03) for z in (-0.05, 0.0, 0.05)]
    sides += [[x, 0.04, z] for x in (-0.02, 0.0, 0.02) for z in (-0.05, 0.0, 0.05)]
    points = TRUTH.apply(np.array(sides) + rng.normal(0, 1e-4, (len(sides), 3)))
    result = register_points(points, box.vertices, box.faces, init=TRUTH)
    assert any("position along the object's z axis" in words for words in result.unobservable)


@pytest.mark.parametrize(
    ("points", "reason"),
    [
        (np.zeros((4, 3)), "at least 6"),
        (np.full((8, 3), np.nan), "point 0 is NaN"),
        (np.zeros((8, 3)), "one spot or on one line"),
        (np.zeros((8, 2)), "give \\(n, 3\\)"),
    ],
)
def test_useless_points_are_refused(points, reason):
    cup = _cup(handle=False)
    with pytest.raises(CalibrationError, match=reason):
        register_points(points, cup.vertices, cup.faces)


def test_points_of_another_object_are_refused():
    cup = _cup(handle=True)
    points = np.random.default_rng(0).uniform(-0.05, 0.05, (24, 3))
    with pytest.raises(CalibrationError, match="mm from the surface"):
        register_points(points, cup.vertices, cup.faces)


def test_a_mesh_in_another_unit_is_refused_with_its_size():
    cup = _cup(handle=True)
    with pytest.raises(CalibrationError, match="mesh is only 0 mm across"):
        register_points(_touch(cup, 24, 0), 1e-3 * cup.vertices, cup.faces)


def test_a_mesh_in_millimetres_is_refused_with_its_size():
    cup = _cup(handle=True)
    with pytest.raises(CalibrationError, match="not millimetres"):
        register_points(_touch(cup, 24, 0), 1e3 * cup.vertices, cup.faces)


def _hand():
    """A block with three unequal arms along its axes: its mirror image is another object."""
    arms = [
        ((0.12, 0.02, 0.02), (0.05, 0, 0)),
        ((0.02, 0.08, 0.02), (0, 0.04, 0)),
        ((0.02, 0.02, 0.05), (0, 0, 0.03)),
    ]
    boxes = [trimesh.creation.box(size).apply_translation(place) for size, place in arms]
    return trimesh.boolean.union(boxes)


def test_a_mirrored_mesh_is_refused_as_such():
    hand = _hand()
    points = TRUTH.apply(trimesh.sample.sample_surface(hand, 60, seed=1)[0])
    assert register_points(points, hand.vertices, hand.faces).rms_m < 1e-4
    with pytest.raises(CalibrationError, match="mirror image"):
        register_points(points, hand.vertices * [1, -1, 1], hand.faces[:, ::-1])


def test_points_on_one_flat_face_leave_three_directions_open_and_name_them():
    box = trimesh.creation.box([0.08, 0.06, 0.05])
    rng = np.random.default_rng(0)
    top = np.column_stack([rng.uniform(-0.03, 0.03, 20), rng.uniform(-0.02, 0.02, 20), np.full(20, 0.025)])
    result = register_points(TRUTH.apply(top), box.vertices, box.faces, init=TRUTH)
    words = " | ".join(result.unobservable)
    assert "position along the object's x axis" in words
    assert "position along the object's y axis" in words
    assert "rotation about the object's z axis" in words
    assert "position along the object's z axis" not in words


def test_a_balls_radius_is_taken_off():
    cup = _cup(handle=True)
    points, face = trimesh.sample.sample_surface(cup, 4000, seed=1)
    outside = (np.linalg.norm(points[:, :2], axis=1) > 0.0365) & (cup.face_normals[face][:, 2] > -0.5)
    chosen = np.flatnonzero(outside)[:60]
    centres = TRUTH.apply(points[chosen] + 0.003 * cup.face_normals[face[chosen]])
    with_ball = register_points(centres, cup.vertices, cup.faces, tip=Tip(ball_m=0.003))
    assert translation_error_mm(with_ball.T_base_obj, TRUTH) < 0.3
    with pytest.raises(CalibrationError, match="tip's offset and radius"):
        register_points(centres, cup.vertices, cup.faces)


def test_the_tips_own_error_ends_up_in_the_pose():
    cup = _cup(handle=True)
    points = _touch(cup, 30, 0)
    rng = np.random.default_rng(0)
    upright = SE3.from_rotvec(rng.normal(0, 0.05, (30, 3)), np.zeros((30, 3))).rotation
    exact = register_points(points, cup.vertices, cup.faces, init=TRUTH)
    known = Tip(covariance=1e-6 * np.eye(3), rotation=upright)
    found = register_points(points, cup.vertices, cup.faces, init=TRUTH, tip=known)
    added = found.covariance - exact.covariance
    np.testing.assert_allclose(added, found.tip_covariance, atol=1e-12)
    # Touched with the tool held one way, a tip that is 1 mm off puts the object 1 mm off.
    np.testing.assert_allclose(np.sqrt(np.diagonal(added)[:3]), 1e-3, rtol=0.25)


def test_poses_of_several_sessions_are_fused_and_a_moved_object_is_noticed():
    cup = _cup(handle=True)
    results = [
        register_points(_touch(cup, 24, seed), cup.vertices, cup.faces, init=TRUTH) for seed in (0, 1, 2)
    ]
    poses, covariances = SE3.stack([r.T_base_obj for r in results]), [r.covariance for r in results]
    fused = fuse_poses(poses, covariances)
    assert np.trace(fused.covariance) < 0.5 * min(np.trace(c) for c in covariances)
    error = (fused.pose.inverse() @ TRUTH).log()
    assert error @ np.linalg.solve(fused.covariance, error) < 20
    moved = SE3.stack([poses[0], poses[1], SE3.from_rotvec(np.zeros(3), [0.003, 0, 0]) @ poses[2]])
    with pytest.raises(CalibrationError, match="moved in between"):
        fuse_poses(moved, covariances)


def test_turns_of_a_round_body_do_not_count_when_poses_are_fused():
    axis = np.array([0.0, 0.0, 1.0])
    turned = SE3.stack([TRUTH @ SE3.from_rotvec([0, 0, angle], [0, 0, 0]) for angle in (0.0, 1.9, -2.8)])
    covariance = np.diag([1e-8] * 3 + [1e-5, 1e-5, np.pi**2 / 3])
    fused = fuse_poses(turned, [covariance] * 3, symmetry_axis=axis)
    assert translation_error_mm(fused.pose, TRUTH) < 1e-6
    np.testing.assert_allclose(fused.pose.rotation[:, 2], TRUTH.rotation[:, 2], atol=1e-9)
    with pytest.raises(CalibrationError, match="contradict"):
        fuse_poses(turned, [np.diag([1e-8] * 3 + [1e-5] * 3)] * 3)
