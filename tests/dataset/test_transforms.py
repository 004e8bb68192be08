"""SE(3): the group axioms, both ends of the rotation vector, and interpolation."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from scipy.linalg import expm
from scipy.spatial.transform import Rotation, Slerp

from dataset import SE3, ToolkitError, interpolate_poses, rotation_error_deg, translation_error_mm

checked = settings(derandomize=True, deadline=None, max_examples=60)

unit = arrays(np.float64, 3, elements=st.floats(-1, 1)).filter(lambda v: np.linalg.norm(v) > 0.1)
angle = st.one_of(
    st.floats(0, np.pi),
    st.floats(0, 1e-3),
    st.sampled_from([0.0, 1e-300, 1e-12, 1e-8, 1e-5, 0.99e-4, 1.01e-4]),
    st.floats(0, 1e-3).map(lambda gap: np.pi - gap),
    st.sampled_from([np.pi, np.pi - 1e-9, np.pi - 1e-6]),
)
translation = arrays(np.float64, 3, elements=st.floats(-10, 10))


@st.composite
def transforms(draw: st.DrawFn) -> SE3:
    axis = draw(unit)
    return SE3.from_rotvec(draw(angle) * axis / np.linalg.norm(axis), draw(translation))


def assert_same(a: SE3, b: SE3, atol: float = 1e-9) -> None:
    np.testing.assert_allclose(a.as_matrix(), b.as_matrix(), rtol=0, atol=atol)


@checked
@given(transforms(), transforms(), transforms())
def test_composition_is_associative(a: SE3, b: SE3, c: SE3) -> None:
    assert_same((a @ b) @ c, a @ (b @ c))


@checked
@given(transforms())
def test_identity_and_inverse(a: SE3) -> None:
    assert_same(a @ SE3.identity(), a)
    assert_same(SE3.identity() @ a, a)
    assert_same(a @ a.inverse(), SE3.identity())
    assert_same(a.inverse() @ a, SE3.identity())


@checked
@given(transforms(), transforms(), translation)
def test_composition_maps_points_in_turn(a: SE3, b: SE3, point: np.ndarray) -> None:
    np.testing.assert_allclose((a @ b).apply(point), a.apply(b.apply(point)), atol=1e-9)


@checked
@given(transforms())
def test_every_parametrisation_round_trips(a: SE3) -> None:
    assert_same(SE3.from_matrix(a.as_matrix()), a)
    assert_same(SE3.from_quaternion(a.as_quaternion(), a.translation), a)
    assert_same(SE3.from_rotvec(a.as_rotvec(), a.translation), a)
    assert_same(SE3.from_pose6(a.as_pose6()), a)
    assert_same(SE3.exp(a.log()), a)


@checked
@given(transforms())
def test_rotation_vector_agrees_with_an_independent_implementation(a: SE3) -> None:
    ours = a.as_rotvec()
    assert np.linalg.norm(ours) <= np.pi + 1e-12
    theirs = Rotation.from_rotvec(ours).as_matrix()
    np.testing.assert_allclose(theirs, a.rotation, atol=1e-12)


@pytest.mark.parametrize("size", [1e-300, 1e-16, 1e-12, 1e-9, 1e-6, 1e-4, 1e-2])
def test_small_rotations_keep_their_relative_precision(size: float) -> None:
    rotvec = size * np.array([0.36, -0.48, 0.8])
    np.testing.assert_allclose(SE3.from_rotvec(rotvec, np.zeros(3)).as_rotvec(), rotvec, rtol=1e-9)


@pytest.mark.parametrize("gap", [1e-3, 1e-6, 1e-9, 1e-12])
def test_rotations_near_pi_keep_their_axis(gap: float) -> None:
    rotvec = (np.pi - gap) * np.array([0.6, 0.0, -0.8])
    np.testing.assert_allclose(SE3.from_rotvec(rotvec, np.zeros(3)).as_rotvec(), rotvec, atol=1e-9)


@checked
@given(transforms())
def test_exponential_agrees_with_the_matrix_exponential(a: SE3) -> None:
    rho, phi = a.log()[:3], a.log()[3:]
    twist = np.zeros((4, 4))
    twist[:3, :3] = np.cross(np.eye(3), phi)
    twist[:3, 3] = rho
    np.testing.assert_allclose(expm(twist), a.as_matrix(), atol=1e-8)


@checked
@given(transforms(), transforms(), st.floats(0, 1))
def test_interpolation_moves_at_constant_speed(a: SE3, b: SE3, alpha: float) -> None:
    assert_same(a.interpolate(b, 0.0), a)
    assert_same(a.interpolate(b, 1.0), b, atol=1e-8)
    between = a.interpolate(b, alpha)
    whole = rotation_error_deg(a, b)
    np.testing.assert_allclose(rotation_error_deg(a, between), alpha * whole, atol=1e-5)
    np.testing.assert_allclose(between.translation, (1 - alpha) * a.translation + alpha * b.translation)


def test_trajectory_agrees_with_slerp() -> None:
    rng = np.random.default_rng(0)
    times = np.cumsum(rng.uniform(0.01, 0.1, 40))
    poses = SE3.exp(rng.normal(size=(40, 6)))
    query = np.append(rng.uniform(times[0], times[-1], 200), [times[0], times[7], times[-1]])
    found = interpolate_poses(times, poses, query)
    expected = Slerp(times, Rotation.from_matrix(poses.rotation))(query).as_matrix()
    np.testing.assert_allclose(found.rotation, expected, atol=1e-9)
    for axis in range(3):
        np.testing.assert_allclose(
            found.translation[:, axis], np.interp(query, times, poses.translation[:, axis]), atol=1e-12
        )


@pytest.mark.parametrize("query", [-0.001, 1.001, np.nan])
def test_a_trajectory_is_not_read_outside_its_span(query: float) -> None:
    with pytest.raises(ToolkitError, match="outside the recorded span"):
        interpolate_poses([0.0, 1.0], SE3.identity((2,)), [0.5, query])


@pytest.mark.parametrize(
    ("times", "count", "message"),
    [([0.0, 0.0, 1.0], 3, "do not increase at sample 1"), ([0.0], 1, "M >= 2"), ([0.0, 1.0], 3, "M >= 2")],
)
def test_a_trajectory_needs_increasing_times(times: list[float], count: int, message: str) -> None:
    with pytest.raises(ToolkitError, match=message):
        interpolate_poses(times, SE3.identity((count,)), [0.0])


def test_batches_broadcast_index_and_iterate() -> None:
    rng = np.random.default_rng(1)
    batch, single, points = (
        SE3.exp(rng.normal(size=(5, 6))),
        SE3.exp(rng.normal(size=6)),
        rng.normal(size=(7, 3)),
    )
    composed = batch @ single
    assert composed.batch == (5,)
    assert len(composed) == 5
    for one, expected in zip(composed, batch, strict=True):
        assert_same(one, expected @ single)
    assert batch[:, None].apply(points).shape == (5, 7, 3)
    np.testing.assert_allclose(batch[:, None].apply(points)[2], batch[2].apply(points))
    assert_same(SE3.stack(list(batch)), batch)
    assert SE3.stack([]).batch == (0,)
    assert batch[np.array([True, False, True, False, False])].batch == (2,)


def test_values_cannot_be_changed() -> None:
    rotation = np.eye(3)
    pose = SE3(rotation, np.zeros(3))
    rotation[0, 0] = 5
    assert pose.rotation[0, 0] == 1
    with pytest.raises(ValueError, match="read-only"):
        pose.translation[0] = 1


def test_unknown_poses_are_told_apart() -> None:
    matrices = np.tile(np.eye(4), (3, 1, 1))
    matrices[1] = np.nan
    assert SE3.from_matrix(matrices).finite.tolist() == [True, False, True]


@pytest.mark.parametrize(
    ("matrix", "message"),
    [
        (np.eye(3), r"\(\.\.\., 4, 4\)"),
        (np.diag([2.0, 2, 2, 1]), "not orthonormal"),
        (np.diag([1.0, 1, -1, 1]), "reflection"),
        (np.array([[1.0, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0], [0.5, 0, 0, 1]]), "transposed"),
    ],
)
def test_matrices_that_are_no_pose_are_refused(matrix: np.ndarray, message: str) -> None:
    with pytest.raises(ToolkitError, match=message):
        SE3.from_matrix(matrix)


def test_errors_are_measured_in_degrees_and_millimetres() -> None:
    a = SE3.from_rotvec([0, 0, 0.1], [1, 2, 3])
    b = SE3.from_rotvec([0, 0, 0.1 + np.deg2rad(30)], [1, 2.003, 3.004])
    np.testing.assert_allclose(rotation_error_deg(a, b), 30)
    np.testing.assert_allclose(translation_error_mm(a, b), 5)


def test_pose6_is_what_universal_robots_writes() -> None:
    pose = SE3.from_pose6([0.1, 0.2, 0.3, 0, np.pi / 2, 0])
    np.testing.assert_allclose(pose.apply([1, 0, 0]), [0.1, 0.2, -0.7], atol=1e-12)


def test_arrays_do_not_compose_with_poses() -> None:
    with pytest.raises(TypeError):
        np.eye(4) @ SE3.identity()  # type: ignore[operator]
