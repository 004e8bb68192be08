"""Kinematics of the UR5e: forward, Jacobian, and the closed-form inverse.

Nominal Denavit-Hartenberg parameters as Universal Robots publishes them. A real arm is calibrated in the
factory and differs from them by millimetres: they serve simulation, planning and plausibility checks, never
as a measured pose. The flange frame is the controller's: its z axis points out of the flange.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from dataset.transforms import SE3

Floats = NDArray[np.float64]

DH_D = np.array([0.1625, 0.0, 0.0, 0.1333, 0.0997, 0.0996])
DH_A = np.array([0.0, -0.425, -0.3922, 0.0, 0.0, 0.0])
DH_ALPHA = np.array([np.pi / 2, 0.0, 0.0, np.pi / 2, -np.pi / 2, 0.0])

JOINT_LIMIT = 2 * np.pi  # rad, either way, every joint
JOINT_SPEED_LIMIT = np.pi  # rad/s

READY = (3.14, -1.57, 1.57, -1.57, -1.57, 0.0)
"""A bent arm above the table, its hand down: where a simulated arm stands, and a real one is taken to."""

_COS_ALPHA = np.round(np.cos(DH_ALPHA))
_SIN_ALPHA = np.round(np.sin(DH_ALPHA))
_SINGULAR = 1e-6  # |sin q5| under which joints 4 and 6 turn about one line and only their sum is determined


def link_transforms(q: ArrayLike) -> Floats:
    """Where each link's frame is, from the base to the flange.

    Args:
        q: (..., 6) joint angles, radians.

    Returns:
        (..., 7, 4, 4) homogeneous T_base_link, the base itself first, the flange last. The origins of links
        1 to 6 are the shoulder, the elbow, wrist 1, wrist 2, wrist 3 and the flange.
    """
    q = np.asarray(q, dtype=np.float64)
    cos, sin = np.cos(q), np.sin(q)
    step = np.zeros((*q.shape, 4, 4))
    step[..., 0, 0] = cos
    step[..., 0, 1] = -sin * _COS_ALPHA
    step[..., 0, 2] = sin * _SIN_ALPHA
    step[..., 0, 3] = DH_A * cos
    step[..., 1, 0] = sin
    step[..., 1, 1] = cos * _COS_ALPHA
    step[..., 1, 2] = -cos * _SIN_ALPHA
    step[..., 1, 3] = DH_A * sin
    step[..., 2, 1] = _SIN_ALPHA
    step[..., 2, 2] = _COS_ALPHA
    step[..., 2, 3] = DH_D
    step[..., 3, 3] = 1.0
    links = np.empty((*q.shape[:-1], 7, 4, 4))
    links[..., 0, :, :] = np.eye(4)
    for joint in range(6):
        links[..., joint + 1, :, :] = links[..., joint, :, :] @ step[..., joint, :, :]
    return links


def forward(q: ArrayLike) -> SE3:
    """T_base_flange of joint angles (..., 6), radians: a batch of the same leading shape."""
    flange = link_transforms(q)[..., 6, :, :]
    return SE3(flange[..., :3, :3], flange[..., :3, 3])


def jacobian(q: ArrayLike) -> Floats:
    """(..., 6, 6) geometric Jacobian at (..., 6) joints: joint rates to the flange's linear velocity (first
    three rows, m/s) and angular velocity (last three, rad/s), both in the base frame."""
    links = link_transforms(q)
    axes = links[..., :6, :3, 2]
    levers = links[..., 6:, :3, 3] - links[..., :6, :3, 3]
    return np.concatenate([np.swapaxes(np.cross(axes, levers), -1, -2), np.swapaxes(axes, -1, -2)], axis=-2)


def inverse_all(T_base_flange: SE3, free_wrist_3: float = 0.0) -> Floats:
    """Every joint configuration that reaches a flange pose.

    Hawkins, "Analytic inverse kinematics for the Universal Robots UR-5/UR-10 arms", 2013: two shoulder, two
    wrist and two elbow solutions.

    Args:
        T_base_flange: the pose, or a batch (...).
        free_wrist_3: joint 6, radians, where the wrist is singular and leaves it open.

    Returns:
        (..., 8, 6) joint angles in (-pi, pi]; rows of NaN where a solution does not exist.
    """
    rotation = T_base_flange.rotation[..., None, :, :]
    position = T_base_flange.translation[..., None, :]
    shoulder = np.array([1, 1, 1, 1, -1, -1, -1, -1])
    wrist = np.array([1, 1, -1, -1, 1, 1, -1, -1])
    elbow = np.array([1, -1, 1, -1, 1, -1, 1, -1])
    with np.errstate(invalid="ignore", divide="ignore"):
        centre = position - DH_D[5] * rotation[..., :, 2]
        reach = np.hypot(centre[..., 0], centre[..., 1])
        q1 = np.arctan2(centre[..., 1], centre[..., 0]) + shoulder * _arccos(DH_D[3] / reach) + np.pi / 2
        s1, c1 = np.sin(q1), np.cos(q1)
        q5 = wrist * _arccos((position[..., 0] * s1 - position[..., 1] * c1 - DH_D[3]) / DH_D[5])
        side = np.sign(np.sin(q5))
        q6 = np.arctan2(
            side * (rotation[..., 1, 1] * c1 - rotation[..., 0, 1] * s1),
            side * (rotation[..., 0, 0] * s1 - rotation[..., 1, 0] * c1),
        )
        q6 = np.where(np.abs(np.sin(q5)) < _SINGULAR, free_wrist_3, q6)
        # What remains is a planar arm of two links, seen in the frame of link 1.
        wrist_1 = _wrist_1_in_shoulder(q1, q5, q6, rotation, position)
        x, y, pitch = wrist_1
        a2, a3 = DH_A[1], DH_A[2]
        q3 = elbow * _arccos((x * x + y * y - a2 * a2 - a3 * a3) / (2 * a2 * a3))
        q2 = np.arctan2(y, x) - np.arctan2(a3 * np.sin(q3), a2 + a3 * np.cos(q3))
        q4 = pitch - q2 - q3
    joints = np.stack(np.broadcast_arrays(q1, q2, q3, q4, q5, q6), axis=-1)
    joints = np.pi - np.mod(np.pi - joints, 2 * np.pi)
    joints[~np.isfinite(joints).all(axis=-1)] = np.nan
    return joints


def inverse(T_base_flange: SE3, q_near: ArrayLike, limit: float = JOINT_LIMIT) -> Floats | None:
    """The joint configuration of one flange pose that is nearest to another configuration.

    Args:
        T_base_flange: a single pose.
        q_near: (6,) radians; each joint is also tried a turn further, so the result is the short way round.
        limit: largest |angle| of a joint, radians.

    Returns:
        (6,) radians, or None where the pose is out of reach.
    """
    near = np.asarray(q_near, dtype=np.float64)
    candidates = unwrap_near(inverse_all(T_base_flange, float(near[5])), near, limit)
    distance = np.abs(candidates - near).sum(axis=-1)
    if np.isnan(distance).all():
        return None
    return np.asarray(candidates[np.nanargmin(distance)])


def unwrap_near(q: Floats, q_near: Floats, limit: float = JOINT_LIMIT) -> Floats:
    """Adds whole turns to joints (..., 6) so that each is as near to q_near as the limit permits."""
    turned = q + 2 * np.pi * np.round((q_near - q) / (2 * np.pi))
    return np.asarray(np.where(np.abs(turned) <= limit, turned, turned - np.sign(turned) * 2 * np.pi))


def _wrist_1_in_shoulder(
    q1: Floats, q5: Floats, q6: Floats, rotation: Floats, position: Floats
) -> tuple[Floats, Floats, Floats]:
    """The wrist-1 origin (x, y) in link 1's plane and the angle q2 + q3 + q4 in that plane."""
    s1, c1, s5, c5, s6, c6 = np.sin(q1), np.cos(q1), np.sin(q5), np.cos(q5), np.sin(q6), np.cos(q6)
    # Link 4's x and z axes in the flange frame: undo joint 6, then joint 5.
    x4 = np.stack([c5 * c6, -c5 * s6, -s5], axis=-1)
    z4 = np.stack([-s6, -c6, np.zeros_like(c6)], axis=-1)
    x4, z4 = (np.einsum("...ij,...j->...i", rotation, axis) for axis in (x4, z4))
    wrist_2 = position - DH_D[5] * rotation[..., :, 2] - DH_D[4] * z4
    along = c1 * wrist_2[..., 0] + s1 * wrist_2[..., 1]
    up = wrist_2[..., 2] - DH_D[0]
    pitch = np.arctan2(x4[..., 2], c1 * x4[..., 0] + s1 * x4[..., 1])
    return along, up, pitch


def _arccos(value: Floats) -> Floats:
    """arccos that forgives rounding at the edge of the workspace; NaN beyond it."""
    return np.asarray(np.arccos(np.where(np.abs(value) > 1 + 1e-7, np.nan, np.clip(value, -1, 1))))
