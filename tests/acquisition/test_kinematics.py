"""The UR5e's kinematics, against published numbers, itself, and finite differences."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from acquisition.kinematics import forward, inverse, inverse_all, jacobian, link_transforms
from dataset.transforms import SE3, rotation_error_deg, translation_error_mm

TRANSLATION = [-0.567723093, -0.379956175, 0.430607992]
ROTATION = [
    [-0.729677879, 0.493771643, -0.473032512],
    [0.115503238, -0.592835772, -0.796997333],
    [-0.673965277, -0.636188111, 0.375546926],
]

joints = st.lists(st.floats(-3.1, 3.1), min_size=6, max_size=6).map(np.array)


def test_flange_pose_of_ur_analytic_ik() -> None:
    """Numbers computed with the independent package ur-analytic-ik 0.1.0.post3."""
    pose = forward([0.3, -1.2, 1.4, -0.7, 0.9, -2.0])
    np.testing.assert_allclose(pose.translation, TRANSLATION, atol=1e-8)
    np.testing.assert_allclose(pose.rotation, ROTATION, atol=1e-8)


def test_arm_stretched_upwards() -> None:
    """At [0 -90 0 -90 0 0] deg every link stands on the one before: heights add up."""
    links = link_transforms(np.deg2rad([0, -90, 0, -90, 0, 0]))
    np.testing.assert_allclose(links[2, 2, 3], 0.1625 + 0.425, atol=1e-12)
    np.testing.assert_allclose(
        links[6, :3, 3], [0, -0.1333 - 0.0996, 0.1625 + 0.425 + 0.3922 + 0.0997], atol=1e-12
    )


def test_batches_agree_with_single_calls() -> None:
    q = np.random.default_rng(0).uniform(-3, 3, (2, 3, 6))
    assert forward(q).batch == (2, 3)
    np.testing.assert_allclose(forward(q).translation[1, 2], forward(q[1, 2]).translation, atol=1e-15)
    np.testing.assert_allclose(jacobian(q)[1, 2], jacobian(q[1, 2]), atol=1e-15)
    assert inverse_all(forward(q)).shape == (2, 3, 8, 6)


@given(joints)
@settings(max_examples=60, deadline=None)
def test_every_inverse_solution_reaches_the_pose(q: np.ndarray) -> None:
    target = forward(q)
    solutions = inverse_all(target, free_wrist_3=q[5])
    solutions = solutions[np.isfinite(solutions).all(axis=-1)]
    assert len(solutions) >= 1
    reached = forward(solutions)
    assert translation_error_mm(reached, target).max() < 1e-3
    assert rotation_error_deg(reached, target).max() < 1e-3


@given(joints)
@settings(max_examples=60, deadline=None)
def test_inverse_returns_to_where_it_started(q: np.ndarray) -> None:
    q[4] = np.sign(q[4]) * max(abs(q[4]), 0.05) or 0.05  # away from the wrist's singularity
    q[2] = np.sign(q[2]) * max(abs(q[2]), 0.05) or 0.05  # and from the stretched elbow
    found = inverse(forward(q), q)
    assert found is not None
    assert np.abs(found - q).sum() < 1e-5 or translation_error_mm(forward(found), forward(q)) < 1e-6


def test_inverse_at_the_wrist_singularity_keeps_the_last_joint() -> None:
    q = np.array([0.3, -1.2, 1.4, -0.7, 0.0, 0.8])
    found = inverse(forward(q), q)
    assert found is not None
    np.testing.assert_allclose(found, q, atol=1e-6)


def test_out_of_reach_is_none() -> None:
    assert inverse(SE3.from_rotvec([0, 0, 0], [1.5, 0, 0.3]), np.zeros(6)) is None


def test_inverse_goes_the_short_way_round() -> None:
    q = np.array([3.5, -1.2, 1.4, -0.7, 0.9, -5.0])
    found = inverse(forward(q), q)
    assert found is not None
    np.testing.assert_allclose(found, q, atol=1e-7)


@pytest.mark.parametrize("seed", range(3))
def test_jacobian_is_the_derivative_of_the_flange(seed: int) -> None:
    q = np.random.default_rng(seed).uniform(-2, 2, 6)
    step = 1e-6
    for joint in range(6):
        plus, minus = forward(q + step * np.eye(6)[joint]), forward(q - step * np.eye(6)[joint])
        linear = (plus.translation - minus.translation) / (2 * step)
        angular = SE3(plus.rotation @ minus.rotation.T, np.zeros(3)).as_rotvec() / (2 * step)
        np.testing.assert_allclose(jacobian(q)[:, joint], [*linear, *angular], atol=1e-7)
