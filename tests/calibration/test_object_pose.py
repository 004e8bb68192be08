"""An object's pose from touched points: accuracy, symmetry, refusals."""

import numpy as np
import pytest
import trimesh

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
