"""Rigid transforms.

`T_a_b` maps points given in frame b to frame a: `p_a = T_a_b.apply(p_b)`, `T_a_c = T_a_b @ T_b_c`.
Metres, radians, scalar-last quaternions. Batches come first and broadcast as numpy arrays do.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from dataset.errors import ToolkitError

Floats = NDArray[np.float64]

_ORTHONORMAL_TOLERANCE = 1e-4  # a rotation stored as float32 and multiplied a few times stays well within
_SERIES_BELOW = 1e-4  # rad; under it the Taylor series is exact to double precision, the quotient is not


@dataclass(frozen=True, eq=False)
class SE3:
    """One rigid transform or a batch of them, immutable.

    Attributes:
        rotation: (..., 3, 3) float64 rotation matrices.
        translation: (..., 3) float64, metres.

    A pose that is not known is stored as NaN; `finite` tells which ones are known.

    Raises:
        ToolkitError: the shapes do not belong together.
    """

    rotation: Floats
    translation: Floats

    __array_ufunc__ = None  # makes `ndarray @ SE3` a TypeError instead of an object array

    def __post_init__(self) -> None:
        rotation = np.array(self.rotation, dtype=np.float64)
        translation = np.array(self.translation, dtype=np.float64)
        if rotation.shape[-2:] != (3, 3) or translation.shape != (*rotation.shape[:-2], 3):
            raise ToolkitError(
                f"SE3: rotation {rotation.shape} and translation {translation.shape} do not belong together; "
                "give (..., 3, 3) and (..., 3) with the same leading dimensions"
            )
        rotation.flags.writeable = False
        translation.flags.writeable = False
        object.__setattr__(self, "rotation", rotation)
        object.__setattr__(self, "translation", translation)

    @staticmethod
    def identity(batch: tuple[int, ...] = ()) -> SE3:
        """The transform that changes nothing, repeated over `batch`."""
        return SE3(np.broadcast_to(np.eye(3), (*batch, 3, 3)), np.zeros((*batch, 3)))

    @staticmethod
    def from_matrix(matrix: ArrayLike) -> SE3:
        """From homogeneous matrices (..., 4, 4), metres.

        Raises:
            ToolkitError: not (..., 4, 4), last row not [0 0 0 1], or the rotation part is not a rotation.
                Matrices holding NaN pass: they mark unknown poses.
        """
        matrix = np.asarray(matrix, dtype=np.float64)
        if matrix.shape[-2:] != (4, 4):
            raise ToolkitError(f"SE3.from_matrix: expected shape (..., 4, 4), got {matrix.shape}")
        known = matrix[np.isfinite(matrix).all(axis=(-2, -1))]
        if not np.allclose(known[..., 3, :], [0, 0, 0, 1], atol=_ORTHONORMAL_TOLERANCE):
            raise ToolkitError(
                "SE3.from_matrix: the last row is not [0 0 0 1]; is the matrix transposed (row-vector form)?"
            )
        _check_rotation(known[..., :3, :3])
        return SE3(matrix[..., :3, :3], matrix[..., :3, 3])

    @staticmethod
    def from_rotvec(rotvec: ArrayLike, translation: ArrayLike) -> SE3:
        """From rotation vectors (..., 3) in radians and translations (..., 3) in metres; they broadcast."""
        return _broadcast(rotvec_to_matrix(np.asarray(rotvec, dtype=np.float64)), translation)

    @staticmethod
    def from_quaternion(xyzw: ArrayLike, translation: ArrayLike) -> SE3:
        """From scalar-last quaternions (..., 4), normalised here, and translations (..., 3) in metres.

        Raises:
            ToolkitError: a quaternion of zero length.
        """
        xyzw = np.asarray(xyzw, dtype=np.float64)
        norm = np.linalg.norm(xyzw, axis=-1, keepdims=True)
        if np.any(norm < 1e-12):
            raise ToolkitError("SE3.from_quaternion: a quaternion has zero length and no direction")
        return _broadcast(_quaternion_to_matrix(xyzw / norm), translation)

    @staticmethod
    def from_pose6(pose: ArrayLike) -> SE3:
        """From (..., 6) [x y z rx ry rz]: metres and a rotation vector, as Universal Robots writes poses."""
        pose = np.asarray(pose, dtype=np.float64)
        if pose.ndim == 0 or pose.shape[-1] != 6:
            raise ToolkitError(f"SE3.from_pose6: expected shape (..., 6), got {pose.shape}")
        return SE3.from_rotvec(pose[..., 3:], pose[..., :3])

    @staticmethod
    def exp(twist: ArrayLike) -> SE3:
        """The exponential map of twists (..., 6) = [rho, phi], metres and radians.

        Solà, Deray, Atchuthan, "A micro Lie theory", 2018, eqs. 172-174.
        """
        twist = np.asarray(twist, dtype=np.float64)
        rho, phi = twist[..., :3], twist[..., 3:]
        return SE3(rotvec_to_matrix(phi), np.einsum("...ij,...j->...i", _left_jacobian(phi), rho))

    @staticmethod
    def stack(poses: Sequence[SE3]) -> SE3:
        """Equal-shaped transforms as one batch, along a new first axis."""
        if not poses:
            return SE3.identity((0,))
        return SE3(np.stack([p.rotation for p in poses]), np.stack([p.translation for p in poses]))

    def as_matrix(self) -> Floats:
        """Homogeneous matrices (..., 4, 4)."""
        matrix = np.zeros((*self.batch, 4, 4))
        matrix[..., :3, :3] = self.rotation
        matrix[..., :3, 3] = self.translation
        matrix[..., 3, 3] = 1.0
        return matrix

    def as_quaternion(self) -> Floats:
        """Unit quaternions (..., 4), scalar last, with w >= 0."""
        return _matrix_to_quaternion(self.rotation)

    def as_rotvec(self) -> Floats:
        """Rotation vectors (..., 3), radians, of length in [0, pi]; accurate at both ends."""
        return matrix_to_rotvec(self.rotation)

    def as_pose6(self) -> Floats:
        """(..., 6) [x y z rx ry rz], the inverse of `from_pose6`."""
        return np.concatenate([self.translation, self.as_rotvec()], axis=-1)

    def log(self) -> Floats:
        """Twists (..., 6) = [rho, phi] whose exponential this is; |phi| <= pi."""
        phi = self.as_rotvec()
        rho = np.linalg.solve(_left_jacobian(phi), self.translation[..., None])[..., 0]
        return np.concatenate([rho, phi], axis=-1)

    def inverse(self) -> SE3:
        """T_b_a of a T_a_b."""
        transposed = np.swapaxes(self.rotation, -1, -2)
        return SE3(transposed, -np.einsum("...ij,...j->...i", transposed, self.translation))

    def __matmul__(self, other: SE3) -> SE3:
        """Composition, T_a_c = T_a_b @ T_b_c; the batches broadcast."""
        if not isinstance(other, SE3):
            return NotImplemented
        return _broadcast(self.rotation @ other.rotation, self.apply(other.translation))

    def apply(self, points: ArrayLike) -> Floats:
        """Maps points (..., 3). The leading dimensions broadcast against the batch:
        N transforms of the same P points are `T[:, None].apply(points)`, shape (N, P, 3)."""
        points = np.asarray(points, dtype=np.float64)
        if not self.batch:
            return points @ self.rotation.T + self.translation
        return np.einsum("...ij,...j->...i", self.rotation, points) + self.translation

    def interpolate(self, other: SE3, alpha: ArrayLike) -> SE3:
        """The pose at `alpha` of the way to `other`: linear translation, constant-speed rotation (slerp).

        Args:
            other: where alpha = 1 arrives; its batch broadcasts with this one.
            alpha: (...) fractions, usually in [0, 1]; beyond it extrapolates.
        """
        alpha = np.asarray(alpha, dtype=np.float64)[..., None]
        step = alpha * matrix_to_rotvec(np.swapaxes(self.rotation, -1, -2) @ other.rotation)
        rotation = self.rotation @ rotvec_to_matrix(step)
        return _broadcast(rotation, (1 - alpha) * self.translation + alpha * other.translation)

    @property
    def batch(self) -> tuple[int, ...]:
        """The leading dimensions; () for a single transform."""
        return self.translation.shape[:-1]

    @property
    def finite(self) -> NDArray[np.bool_]:
        """(...) bool: which poses are known, i.e. hold no NaN."""
        known = np.isfinite(self.rotation).all(axis=(-2, -1)) & np.isfinite(self.translation).all(axis=-1)
        return np.asarray(known)

    def __len__(self) -> int:
        if not self.batch:
            raise TypeError("a single SE3 has no length; only a batch has")
        return self.batch[0]

    def __getitem__(self, index: Any) -> SE3:
        if not self.batch:
            raise TypeError("a single SE3 cannot be indexed; only a batch can")
        return SE3(self.rotation[index], self.translation[index])

    def __iter__(self) -> Iterator[SE3]:
        return (self[i] for i in range(len(self)))


def interpolate_poses(times_s: ArrayLike, poses: SE3, query_s: ArrayLike) -> SE3:
    """A trajectory read between its samples: linear translation, slerp rotation.

    Args:
        times_s: (M,) strictly increasing sample times, seconds, M >= 2.
        poses: the M poses at those times.
        query_s: (K,) times on the same clock, within the span.

    Returns:
        The K poses.

    Raises:
        ToolkitError: times not increasing, sizes that differ, or a query outside the span.
    """
    times, query = np.asarray(times_s, dtype=np.float64), np.asarray(query_s, dtype=np.float64)
    if times.ndim != 1 or poses.batch != times.shape or len(times) < 2:
        raise ToolkitError(
            f"interpolate_poses: {times.shape} times and {poses.batch} poses; give M >= 2 of each"
        )
    if not np.all(np.diff(times) > 0):
        raise ToolkitError(
            f"interpolate_poses: times do not increase at sample {int(np.argmin(np.diff(times) > 0)) + 1}; "
            "remove repeated samples first"
        )
    outside = ~((query >= times[0]) & (query <= times[-1]))
    if outside.any():
        raise ToolkitError(
            f"interpolate_poses: {int(outside.sum())} of {query.size} queries lie outside the recorded span "
            f"[{times[0]:.6f}, {times[-1]:.6f}] s, the first at {query[outside].flat[0]:.6f} s; "
            "record the trace from before the first to after the last frame"
        )
    left = np.clip(np.searchsorted(times, query, side="right") - 1, 0, len(times) - 2)
    alpha = (query - times[left]) / (times[left + 1] - times[left])
    return poses[left].interpolate(poses[left + 1], alpha)


def rotation_error_deg(a: SE3, b: SE3) -> Floats:
    """(...) angle of the rotation between a and b, degrees."""
    relative = np.swapaxes(a.rotation, -1, -2) @ b.rotation
    return np.rad2deg(np.linalg.norm(matrix_to_rotvec(relative), axis=-1))


def translation_error_mm(a: SE3, b: SE3) -> Floats:
    """(...) distance between the translations of a and b, millimetres."""
    return 1000.0 * np.linalg.norm(a.translation - b.translation, axis=-1)


def rotvec_to_matrix(rotvec: Floats) -> Floats:
    """Rodrigues' formula: rotation vectors (..., 3), radians, to matrices (..., 3, 3)."""
    first, second, _ = _exponential_coefficients(rotvec)
    skew = cross_matrix(rotvec)
    return np.eye(3) + first[..., None, None] * skew + second[..., None, None] * (skew @ skew)


def matrix_to_rotvec(rotation: Floats) -> Floats:
    """The inverse of Rodrigues' formula, through the quaternion: accurate near 0 and near pi."""
    quaternion = _matrix_to_quaternion(rotation)
    vector, scalar = quaternion[..., :3], quaternion[..., 3]
    sine = np.linalg.norm(vector, axis=-1)
    small = sine < _SERIES_BELOW
    scale = np.where(small, 2.0 + sine**2 / 3.0, 2.0 * np.arctan2(sine, scalar) / np.where(small, 1.0, sine))
    return scale[..., None] * vector


def cross_matrix(v: Floats) -> Floats:
    """[v]x of vectors (..., 3): (..., 3, 3) with [v]x w = v x w."""
    zero = np.zeros_like(v[..., 0])
    x, y, z = v[..., 0], v[..., 1], v[..., 2]
    return np.stack([zero, -z, y, z, zero, -x, -y, x, zero], axis=-1).reshape(*v.shape[:-1], 3, 3)


def adjoint(pose: SE3) -> Floats:
    """(..., 6, 6) with T exp(x) = exp(Ad x) T for twists x = [rho, phi]. Solà et al. 2018, eq. 175."""
    matrix = np.zeros((*pose.batch, 6, 6))
    matrix[..., :3, :3] = matrix[..., 3:, 3:] = pose.rotation
    matrix[..., :3, 3:] = cross_matrix(pose.translation) @ pose.rotation
    return matrix


def _check_rotation(rotation: Floats) -> None:
    error = np.abs(rotation @ np.swapaxes(rotation, -1, -2) - np.eye(3))
    if error.size and error.max() > _ORTHONORMAL_TOLERANCE:
        raise ToolkitError(
            f"SE3.from_matrix: the rotation part is not orthonormal (off by {error.max():.2g}); "
            "remove scale and shear, or check the units"
        )
    if rotation.size and np.linalg.det(rotation).min() < 0:
        raise ToolkitError(
            "SE3.from_matrix: the rotation part is a reflection (determinant -1); flip one axis"
        )


def _broadcast(rotation: Floats, translation: ArrayLike) -> SE3:
    translation = np.asarray(translation, dtype=np.float64)
    batch = np.broadcast_shapes(rotation.shape[:-2], translation.shape[:-1])
    return SE3(np.broadcast_to(rotation, (*batch, 3, 3)), np.broadcast_to(translation, (*batch, 3)))


def _exponential_coefficients(phi: Floats) -> tuple[Floats, Floats, Floats]:
    """sin(t)/t, (1 - cos t)/t^2 and (t - sin t)/t^3 for t = |phi|, without cancellation near zero."""
    angle = np.linalg.norm(phi, axis=-1)
    small = angle < _SERIES_BELOW
    safe = np.where(small, 1.0, angle)
    square = angle**2
    first = np.where(small, 1 - square / 6, np.sin(safe) / safe)
    second = np.where(small, 0.5 - square / 24, 2 * (np.sin(safe / 2) / safe) ** 2)
    third = np.where(small, 1 / 6 - square / 120, (safe - np.sin(safe)) / safe**3)
    return first, second, third


def _left_jacobian(phi: Floats) -> Floats:
    _, second, third = _exponential_coefficients(phi)
    skew = cross_matrix(phi)
    return np.eye(3) + second[..., None, None] * skew + third[..., None, None] * (skew @ skew)


def _quaternion_to_matrix(q: Floats) -> Floats:
    skew = cross_matrix(q[..., :3])
    return np.eye(3) + 2 * q[..., 3, None, None] * skew + 2 * (skew @ skew)


def _matrix_to_quaternion(rotation: Floats) -> Floats:
    """Shepperd's method: of the four ways to divide, the one with the largest divisor."""
    r = rotation
    xx, yy, zz = r[..., 0, 0], r[..., 1, 1], r[..., 2, 2]
    sum_xy, sum_xz, sum_yz = (
        r[..., 0, 1] + r[..., 1, 0],
        r[..., 0, 2] + r[..., 2, 0],
        r[..., 1, 2] + r[..., 2, 1],
    )
    dif_x, dif_y, dif_z = (
        r[..., 2, 1] - r[..., 1, 2],
        r[..., 0, 2] - r[..., 2, 0],
        r[..., 1, 0] - r[..., 0, 1],
    )
    candidates = np.stack(
        [
            np.stack([1 + xx - yy - zz, sum_xy, sum_xz, dif_x], axis=-1),
            np.stack([sum_xy, 1 - xx + yy - zz, sum_yz, dif_y], axis=-1),
            np.stack([sum_xz, sum_yz, 1 - xx - yy + zz, dif_z], axis=-1),
            np.stack([dif_x, dif_y, dif_z, 1 + xx + yy + zz], axis=-1),
        ],
        axis=-2,
    )
    diagonal = np.stack([candidates[..., i, i] for i in range(4)], axis=-1)
    best = np.argmax(diagonal, axis=-1)
    chosen = np.take_along_axis(candidates, best[..., None, None], axis=-2)[..., 0, :]
    unit = chosen / np.linalg.norm(chosen, axis=-1, keepdims=True)
    return np.where(unit[..., 3:] < 0, -unit, unit)
