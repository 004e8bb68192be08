"""Hand-eye and robot-world transforms from pairs of poses: what to use when there are poses but no corners.

The equation is T_fixture_mount @ T_mount_cam @ T_cam_board = T_fixture_board (`calibration.closed_forms`).
Both unknowns are refined together by maximum likelihood. The camera's pose of the board errs in the camera's
frame (across and along the view) and in the board's rotation, the arm errs in the tool's frame; how much each
is estimated with the unknowns (`calibration.variance_components`), views with heavy errors count less.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from calibration.bundle import project_with_derivatives, solve_scaled
from calibration.closed_forms import Mount, arm_reading, closed_forms, disagreement, ransac
from calibration.observability import RotationSpread, require_observable
from calibration.variance_components import NoiseSource, covariances, estimate_sigmas, student_weights
from dataset.errors import CalibrationError
from dataset.intrinsics import Intrinsics
from dataset.transforms import SE3, adjoint, cross_matrix, matrix_to_rotvec

Floats = NDArray[np.float64]

_OUTLIER_SQUARE = 33.1  # 99.999 % of chi square with 6 degrees of freedom
_ROUNDS = 12
_STEPS = 20
_TRANSFORMS = 12
_SCALE, _OFFSET = 12, 13
_UNKNOWNS = 14
_START_VIEWS = 60  # the closed forms' cost grows with the square of the views


@dataclass(frozen=True, eq=False)
class RobotWorldResult:
    """What N pairs of poses say.

    Attributes:
        mount: who carries the camera.
        T_mount_cam: the camera on the tool (eye in hand) or in the base (eye to hand).
        T_fixture_board: the board in the base (eye in hand) or on the tool (eye to hand).
        covariance: (12, 12) of the twists [rho, phi] of both, on the right.
        scale, scale_sigma: of the camera's translations against the arm's; exactly 1 and 0 unless asked for.
        offset_s, offset_sigma_s: to add to the camera's times; 0 unless asked for.
        sigmas: standard deviation of every source of error, by name (m, rad, s, or 1 for given covariances).
        used: (N,) False for views beyond any likely error.
        spread: of the arm's rotation.
    """

    mount: Mount
    T_mount_cam: SE3
    T_fixture_board: SE3
    covariance: Floats
    scale: float
    scale_sigma: float
    offset_s: float
    offset_sigma_s: float
    sigmas: dict[str, float]
    used: NDArray[np.bool_]
    spread: RotationSpread


def solve_robot_world(
    T_base_tcp: SE3,
    T_cam_board: SE3,
    mount: Mount = "eye_in_hand",
    camera_covariance: Floats | None = None,
    scale_known: bool = True,
) -> RobotWorldResult:
    """Both unknown transforms from N pairs of poses.

    Args:
        T_base_tcp: N arm poses.
        T_cam_board: N poses of the board in the camera.
        mount: who carries the camera.
        camera_covariance: (N, 6, 6) of T_cam_board's translation in the camera's frame and rotation vector on
            the right, up to a common factor, where it is known (`pose_covariance`).
        scale_known: False when the camera's translations are in an unknown unit (monocular odometry).

    Raises:
        CalibrationError: sizes that differ, or poses that do not determine the transforms.
    """
    if len(T_base_tcp) != len(T_cam_board):
        raise CalibrationError(
            f"robot-world: {len(T_base_tcp)} arm poses for {len(T_cam_board)} board poses; give one of each a"
            " view"
        )
    bad = np.flatnonzero(~T_cam_board.finite)
    if len(bad):
        raise CalibrationError(
            f"robot-world: the board's pose is NaN or infinite in view {', '.join(map(str, bad[:8]))};"
            " drop these views"
        )
    spread = require_observable(T_base_tcp, mount)
    reading = arm_reading(T_base_tcp, mount)
    start = start_from(reading, T_cam_board, scale_known)
    pairs = PosePairs(T_base_tcp, T_cam_board, mount, camera_covariance)
    free = unknown_names("transforms") if scale_known else unknown_names("transforms", "scale")
    return refine(pairs, start, free, spread)


def unknown_names(*names: Literal["transforms", "scale", "offset"]) -> NDArray[np.bool_]:
    """(14,) which of the unknowns these are."""
    first = {"transforms": (0, _TRANSFORMS), "scale": (_SCALE, _OFFSET), "offset": (_OFFSET, _UNKNOWNS)}
    chosen = np.zeros(_UNKNOWNS, bool)
    for name in names:
        chosen[slice(*first[name])] = True
    return chosen


@dataclass(frozen=True, eq=False)
class Unknowns:
    """T_mount_cam, T_fixture_board, the scale of the camera's translations, and the offset
    to add to the camera's times, seconds."""

    T_mount_cam: SE3
    T_fixture_board: SE3
    scale: float = 1.0
    offset_s: float = 0.0

    def moved(self, step: Floats) -> Unknowns:
        """After a step (14,): two twists on the right, log scale, offset."""
        return Unknowns(
            self.T_mount_cam @ SE3.exp(step[:6]),
            self.T_fixture_board @ SE3.exp(step[6:12]),
            self.scale * float(np.exp(step[_SCALE])),
            self.offset_s + float(step[_OFFSET]),
        )


@dataclass(frozen=True, eq=False)
class PosePairs:
    """N measured pairs: what the arm and the camera said, and how the camera may have erred."""

    T_base_tcp: SE3
    T_cam_board: SE3
    mount: Mount
    camera_covariance: Floats | None = None

    def arm(self, offset_s: float) -> tuple[SE3, Floats]:
        """N arm poses, and their velocity (N, 6): twist a second, in the tool's frame."""
        return self.T_base_tcp, np.zeros((len(self.T_base_tcp), 6))

    def linearize(self, unknowns: Unknowns) -> tuple[Floats, Floats, Floats, Floats]:
        """Residual (N, 6) of T_cam_board: translation in the camera's frame, rotation vector on the right;
        its derivatives by the unknowns (N, 6, 14) and by the arm's twist (N, 6, 6); the velocity (N, 6)."""
        T_base_tcp, velocity = self.arm(unknowns.offset_s)
        T_cam_mount, Z = unknowns.T_mount_cam.inverse(), unknowns.T_fixture_board
        T_mount_fixture = arm_reading(T_base_tcp, self.mount).inverse()
        predicted = T_cam_mount @ T_mount_fixture @ Z
        t = unknowns.scale * predicted.translation
        rotation = np.swapaxes(predicted.rotation, 1, 2) @ self.T_cam_board.rotation
        residual = np.concatenate([self.T_cam_board.translation - t, matrix_to_rotvec(rotation)], axis=1)
        by_left, by_right = _by_left(predicted), _by_right(predicted)
        for matrix in (by_left, by_right):
            matrix[:, :3] *= unknowns.scale
        if self.mount == "eye_in_hand":
            by_arm = by_left @ -adjoint(T_cam_mount)
        else:
            by_arm = by_right @ adjoint(Z.inverse())
        by_unknowns = np.zeros((len(residual), 6, _UNKNOWNS))
        by_unknowns[:, :, :6] = by_left
        by_unknowns[:, :, 6:12] = -by_right
        by_unknowns[:, :3, _SCALE] = -t
        by_unknowns[:, :, _OFFSET] = -np.einsum("nij,nj->ni", by_arm, velocity)
        return residual, by_unknowns, -by_arm, velocity

    def noise(self, by_arm: Floats, velocity: Floats) -> list[NoiseSource]:
        """The sources of error of these pairs."""
        metres, radians = by_arm[:, :, :3], by_arm[:, :, 3:]
        sources = [
            NoiseSource("arm_m", metres @ np.swapaxes(metres, 1, 2), 1e-4),
            NoiseSource("arm_rad", radians @ np.swapaxes(radians, 1, 2), 2e-4),
        ]
        if self.camera_covariance is not None:
            sources.append(NoiseSource("camera", self.camera_covariance, 1.0))
        else:
            for name, axes, typical in _CAMERA:
                shape = np.diag(np.isin(np.arange(6), axes).astype(np.float64))
                sources.append(NoiseSource(name, np.broadcast_to(shape, (len(by_arm), 6, 6)), typical))
        if velocity.any():
            swept = np.einsum("nij,nj->ni", by_arm, velocity)
            sources.append(NoiseSource("jitter_s", swept[:, :, None] * swept[:, None, :], 3e-4))
        return sources


_CAMERA: list[tuple[str, list[int], float]] = [
    ("camera_across_m", [0, 1], 5e-4),
    ("camera_along_m", [2], 1.5e-3),
    ("camera_tilt_rad", [3, 4], 3e-3),  # a board's tilt is always seen worse than its turn in the plane
    ("camera_turn_rad", [5], 2e-3),
]


def refine(
    pairs: PosePairs, start: Unknowns, free: NDArray[np.bool_], spread: RotationSpread
) -> RobotWorldResult:
    """Unknowns, noise and weights in turn, until none of them moves."""
    unknowns = start
    residual, by_unknowns, by_arm, velocity = pairs.linearize(unknowns)
    # Which views start as outliers is judged by a scale the better half sets.
    apart = np.sum((residual / np.median(np.abs(residual), axis=0)) ** 2, axis=1)
    weight = np.minimum(1.0, 4.0 * np.median(apart) / np.maximum(apart, 1e-12))
    sources = pairs.noise(by_arm, velocity)
    sigmas = np.array([source.typical_sigma for source in sources])
    for _ in range(_ROUNDS):
        before = sigmas
        sources = pairs.noise(by_arm, velocity)
        sigmas = estimate_sigmas(residual, by_unknowns[:, :, free], weight, sources, sigmas)
        information = np.linalg.inv(covariances(sources, sigmas))
        for _ in range(_STEPS):
            J = by_unknowns[:, :, free]
            weighted = np.swapaxes(J, 1, 2) @ (information * weight[:, None, None])
            normal = np.sum(weighted @ J, axis=0)
            step = np.zeros(_UNKNOWNS)
            step[free] = -solve_scaled(normal, np.sum(weighted @ residual[..., None], axis=0)[:, 0])
            unknowns = unknowns.moved(step)
            residual, by_unknowns, by_arm, velocity = pairs.linearize(unknowns)
            if np.abs(step[:_TRANSFORMS]).max() < 1e-8:
                break
        square = np.einsum("ni,nij,nj->n", residual, information, residual)
        weight = student_weights(square, 6)
        if np.allclose(sigmas, before, rtol=0.01):
            break
    J = by_unknowns[:, :, free]
    normal = np.sum(np.swapaxes(J, 1, 2) @ (information * weight[:, None, None]) @ J, axis=0)
    covariance = np.zeros((_UNKNOWNS, _UNKNOWNS))
    covariance[np.ix_(free, free)] = np.linalg.pinv(normal, hermitian=True)
    return RobotWorldResult(
        mount=pairs.mount,
        T_mount_cam=unknowns.T_mount_cam,
        T_fixture_board=unknowns.T_fixture_board,
        covariance=covariance[:_TRANSFORMS, :_TRANSFORMS],
        scale=unknowns.scale,
        scale_sigma=unknowns.scale * float(np.sqrt(covariance[_SCALE, _SCALE])),
        offset_s=unknowns.offset_s,
        offset_sigma_s=float(np.sqrt(covariance[_OFFSET, _OFFSET])),
        sigmas={source.name: float(sigma) for source, sigma in zip(sources, sigmas, strict=True)},
        used=square < _OUTLIER_SQUARE,
        spread=spread,
    )


def pose_covariance(
    T_cam_board: SE3, points: Floats, intrinsics: Intrinsics, pixel_sigma: float = 1.0
) -> Floats:
    """(N, 6, 6) covariance of board poses fitted to corners, for `solve_robot_world`.

    Args:
        T_cam_board: N poses.
        points: (P, 3) the corners seen, in the board's frame.
        intrinsics: of the camera.
        pixel_sigma: standard deviation of a corner's coordinate, pixels.
    """
    covariance = np.empty((len(T_cam_board), 6, 6))
    for view, pose in enumerate(T_cam_board):
        _, by_point, _ = project_with_derivatives(pose.apply(points), intrinsics.K, intrinsics.distortion)
        by_turn = -pose.rotation @ cross_matrix(points)
        J = np.concatenate([by_point, by_point @ by_turn], axis=2).reshape(-1, 6)
        covariance[view] = pixel_sigma**2 * np.linalg.inv(J.T @ J)
    return covariance


def _by_left(pose: SE3) -> Floats:
    """Derivative (N, 6, 6) of (translation, rotation vector on the right) by a twist on the left."""
    matrix = np.zeros((len(pose), 6, 6))
    matrix[:, :3, :3] = np.eye(3)
    matrix[:, :3, 3:] = -cross_matrix(pose.translation)
    matrix[:, 3:, 3:] = np.swapaxes(pose.rotation, 1, 2)
    return matrix


def _by_right(pose: SE3) -> Floats:
    """Likewise by a twist on the right."""
    matrix = np.zeros((len(pose), 6, 6))
    matrix[:, :3, :3] = pose.rotation
    matrix[:, 3:, 3:] = np.eye(3)
    return matrix


def start_from(reading: SE3, T_cam_board: SE3, scale_known: bool) -> Unknowns:
    """Where to start: of the closed forms and RANSAC, the one most views agree with.

    Args:
        reading: T_fixture_mount of N views.
        T_cam_board: N.
        scale_known: False when the camera's translations are in an unknown unit.

    Raises:
        CalibrationError: no method finds a transform.
    """
    if not scale_known:
        return _start_without_scale(reading, T_cam_board)
    few = np.unique(np.linspace(0, len(reading) - 1, _START_VIEWS).astype(int))
    candidates = list(closed_forms(reading[few], T_cam_board[few]).values())
    sampled = ransac(reading, T_cam_board)
    candidates += [] if sampled is None else [sampled]
    if not candidates:
        raise CalibrationError(
            "robot-world: no closed-form method found a transform; check that arm poses and board poses"
            " belong together"
        )

    def score(pair: tuple[SE3, SE3]) -> float:
        return float(np.minimum(disagreement(reading @ pair[0] @ T_cam_board, pair[1]), 9.0).sum())

    return Unknowns(*min(candidates, key=score))


def _start_without_scale(reading: SE3, T_cam_board: SE3) -> Unknowns:
    """Rotations do not depend on the scale; with them known, both translations and 1 / scale are linear."""
    rotations = SE3(T_cam_board.rotation, np.zeros((len(T_cam_board), 3)))
    candidates = closed_forms(SE3(reading.rotation, np.zeros((len(reading), 3))), rotations)
    name = "shah" if "shah" in candidates else next(iter(candidates), None)
    if name is None:
        raise CalibrationError(
            "robot-world: no closed-form method found a rotation; check that arm poses and board poses belong"
            " together"
        )
    R_mount_cam, R_board = candidates[name][0].rotation, candidates[name][1].rotation
    minus_one = np.broadcast_to(-np.eye(3), reading.rotation.shape)
    along = reading.rotation @ (R_mount_cam @ T_cam_board.translation[..., None])
    system = np.concatenate([reading.rotation, minus_one, along], axis=2).reshape(-1, 7)
    found = np.linalg.lstsq(system, -reading.translation.ravel(), None)[0]
    if found[6] <= 0:
        raise CalibrationError(
            "robot-world: the camera's translations have a negative scale against the arm's; the poses may"
            " be inverted"
        )
    return Unknowns(SE3(R_mount_cam, found[:3]), SE3(R_board, found[3:6]), scale=1.0 / float(found[6]))
