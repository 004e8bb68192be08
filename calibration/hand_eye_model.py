"""What hand-eye calibration predicts of every corner, and how it is fitted to what was seen.

The arm is allowed to have been a little off in every view. How far off, against how noisy the corners are, is
not assumed: both are estimated with the unknowns (variance components, Förstner 1979), since the arm's noise
usually dwarfs that of the corners.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from calibration.bundle import (
    Bools,
    Floats,
    Linearization,
    Observations,
    Solution,
    camera_moved,
    camera_parameters,
    jackknife_variance,
    project_with_derivatives,
    solve,
)
from calibration.closed_forms import Mount
from calibration.streams import ArmTrace
from dataset.intrinsics import Intrinsics
from dataset.transforms import SE3, cross_matrix

TRANSFORMS = slice(0, 12)
SCALE = 12
OFFSET = 13
CAMERA = slice(14, None)

LOOSE_ARM = np.array([1e-3] * 3 + [2e-3] * 3)
"""m, rad: before the arm's noise is known."""

_ARM_FLOOR = np.array([2e-6] * 3 + [5e-6] * 3)  # no arm repeats better; keeps the components positive
_PIXEL_FLOOR = 5e-3
_ROUNDS = 10


@dataclass(frozen=True, eq=False)
class TimedArm:
    """An arm in motion: its trace, and when (N,) the pictures were taken by the camera's clock, seconds."""

    trace: ArmTrace
    camera_s: Floats

    def at(self, offset_s: float) -> tuple[SE3, Floats]:
        """N arm poses and their velocity (N, 6) when the camera's clock is off by this much."""
        return self.trace.smoothed(self.camera_s + offset_s)

    def take(self, views: Bools | NDArray[np.intp]) -> TimedArm:
        """Some of the pictures."""
        return replace(self, camera_s=self.camera_s[views])


@dataclass(frozen=True, eq=False)
class HandEyeState:
    """Shared: T_mount_cam, T_fixture_board (twists on the right), the board's scale, the clocks' offset,
    fx fy cx cy distortion. Own: how far the arm was off, a twist in the tool's frame.

    Attributes:
        expected: the state that a prior on the shared parameters is about; none when None.
        moving: the arm's trace, when it was not at rest.
    """

    mount: Mount
    T_mount_cam: SE3
    T_fixture_board: SE3
    camera: Intrinsics
    T_base_tcp: SE3
    arm_error: Floats
    scale: float = 1.0
    offset_s: float = 0.0
    velocity: Floats | None = None
    moving: TimedArm | None = None
    expected: HandEyeState | None = None

    @property
    def deviation(self) -> Floats:
        return self.arm_error

    @property
    def shared_deviation(self) -> Floats:
        before = self.expected
        if before is None:
            return np.zeros(14 + 4 + len(self.camera.distortion))
        return np.concatenate(
            [
                (before.T_mount_cam.inverse() @ self.T_mount_cam).log(),
                (before.T_fixture_board.inverse() @ self.T_fixture_board).log(),
                [self.scale - before.scale, self.offset_s - before.offset_s],
                camera_parameters(self.camera.K, self.camera.distortion)
                - camera_parameters(before.camera.K, before.camera.distortion),
            ]
        )

    def free(self, scale: bool = False, offset: bool = False, camera: bool = False) -> Bools:
        """(S,) the two transforms, and what else is asked for."""
        free = np.zeros(14 + 4 + len(self.camera.distortion), bool)
        free[TRANSFORMS] = True
        free[SCALE], free[OFFSET], free[CAMERA] = scale, offset, camera
        return free

    def linearize(self, observations: Observations) -> Linearization:
        view = observations.view
        board = self.scale * observations.board
        error = SE3.exp(self.arm_error)
        Z = self.T_fixture_board
        if self.mount == "eye_in_hand":
            T_mount_fixture = error.inverse() @ self.T_base_tcp.inverse()
        else:
            T_mount_fixture = self.T_base_tcp @ error
        in_mount = (T_mount_fixture @ Z)[view].apply(board)
        cam_R_mount = self.T_mount_cam.rotation.T
        in_cam = self.T_mount_cam.inverse().apply(in_mount)
        predicted, by_point, by_camera = project_with_derivatives(
            in_cam, self.camera.K, self.camera.distortion
        )
        one = np.broadcast_to(np.eye(3), (len(view), 3, 3))
        cam_R_fixture = cam_R_mount @ T_mount_fixture.rotation[view]
        cam_R_board = cam_R_fixture @ Z.rotation
        by_mount_cam = np.concatenate([-one, cross_matrix(in_cam)], axis=2)
        by_board = cam_R_board @ np.concatenate([one, -cross_matrix(board)], axis=2)
        if self.mount == "eye_in_hand":
            by_arm = cam_R_mount @ np.concatenate([-one, cross_matrix(in_mount)], axis=2)
        else:
            in_fixture = Z.apply(board)
            by_arm = cam_R_fixture @ np.concatenate([one, -cross_matrix(in_fixture)], axis=2)
        by_scale = cam_R_board @ observations.board[..., None]
        velocity = np.zeros((len(self.arm_error), 6)) if self.velocity is None else self.velocity
        by_offset = by_arm @ velocity[view][..., None]
        by_shared = by_point @ np.concatenate([by_mount_cam, by_board, by_scale, by_offset], axis=2)
        return Linearization(
            predicted - observations.pixels,
            np.concatenate([by_shared, by_camera], axis=2),
            by_point @ by_arm,
        )

    def moved(self, shared: Floats, own: Floats) -> HandEyeState:
        step = replace(
            self,
            T_mount_cam=self.T_mount_cam @ SE3.exp(shared[:6]),
            T_fixture_board=self.T_fixture_board @ SE3.exp(shared[6:12]),
            scale=self.scale + float(shared[SCALE]),
            arm_error=self.arm_error + own,
        )
        if shared[CAMERA].any():
            K, distortion = camera_moved(self.camera.K, self.camera.distortion, shared[CAMERA])
            step = replace(step, camera=replace(self.camera, K=K, distortion=distortion))
        return step.at_offset(self.offset_s + float(shared[OFFSET])) if shared[OFFSET] else step

    def at_offset(self, offset_s: float) -> HandEyeState:
        """The arm looked up again for another offset of the clocks."""
        if self.moving is None:
            return self
        T_base_tcp, velocity = self.moving.at(offset_s)
        return replace(self, T_base_tcp=T_base_tcp, velocity=velocity, offset_s=offset_s)

    def take(self, views: Bools | NDArray[np.intp]) -> HandEyeState:
        """Some of the views: a mask (N,) or indices, one of which may come more than once."""
        return replace(
            self,
            T_base_tcp=self.T_base_tcp[views],
            arm_error=self.arm_error[views],
            velocity=None if self.velocity is None else self.velocity[views],
            moving=None if self.moving is None else self.moving.take(views),
        )

    def rigid(self) -> HandEyeState:
        """The arm taken at its word."""
        return replace(self, arm_error=np.zeros_like(self.arm_error))


@dataclass(frozen=True, eq=False)
class Sigmas:
    """Noise of a corner's coordinate (px) and of the arm's pose (6,) m, rad."""

    pixel: float
    arm: Floats


@dataclass(frozen=True, eq=False)
class Fit:
    """A minimum: the state there, what the solver says of it, the noise levels, and what was free."""

    state: HandEyeState
    solution: Solution
    sigmas: Sigmas
    free: Bools
    information: Floats | None

    def again(self, state: HandEyeState, observations: Observations) -> tuple[HandEyeState, Solution]:
        """The same fit to other views, with the noise levels found before."""
        return solve_with(state, observations, self.sigmas, self.free, self.information)

    def jackknife_variance(self, observations: Observations, groups: int) -> Floats:
        """(F,) variances of the free parameters when neighbouring views err alike."""
        free = self.free
        information = np.zeros((len(free), len(free))) if self.information is None else self.information
        own_sigma = np.tile(self.sigmas.arm, (observations.view_count, 1))
        return jackknife_variance(
            self.state, observations, self.sigmas.pixel, own_sigma, free, information, groups
        )


def fit(
    state: HandEyeState, observations: Observations, free: Bools, information: Floats | None = None
) -> Fit:
    """Alternate between the unknowns and the variance components until the noise levels settle.

    Args:
        state: where to start.
        observations: the corners.
        free: (S,) which shared parameters may move.
        information: (S, S) of a prior on them, about ``state.expected``.
    """
    sigmas = Sigmas(0.3, LOOSE_ARM)
    state = replace(state.rigid(), scale=1.0)
    for _ in range(_ROUNDS):
        state, solution = solve_with(state, observations, sigmas, free, information)
        updated = _variance_components(state, solution, observations, sigmas)
        settled = np.allclose(updated.arm, sigmas.arm, rtol=0.02) and np.isclose(
            updated.pixel, sigmas.pixel, rtol=0.02
        )
        sigmas = updated
        if settled:
            break
    state, solution = solve_with(state, observations, sigmas, free, information)
    return Fit(state, solution, sigmas, free, information)


def solve_with(
    state: HandEyeState,
    observations: Observations,
    sigmas: Sigmas,
    free: Bools,
    information: Floats | None = None,
) -> tuple[HandEyeState, Solution]:
    """The minimum for given noise levels."""
    own_sigma = np.tile(sigmas.arm, (observations.view_count, 1))
    return solve(state, observations, sigmas.pixel, own_sigma, free, information)


def _variance_components(
    state: HandEyeState, solution: Solution, observations: Observations, sigmas: Sigmas
) -> Sigmas:
    """Each noise from its own residuals over its own redundancy (Förstner 1979)."""
    count = observations.view_count
    known = (
        np.einsum("vii->vi", solution.own_covariance) / sigmas.arm**2
    )  # 1: the views say nothing of the arm
    redundancy = np.maximum(count - known.sum(axis=0), 1e-6).reshape(2, 3).sum(axis=1)
    squares = np.sum(state.arm_error**2, axis=0).reshape(2, 3).sum(axis=1)
    arm = np.maximum(np.repeat(np.sqrt(squares / redundancy), 3), _ARM_FLOOR)
    freedom = 2 * len(observations.view) - 12 - redundancy.sum()
    return Sigmas(max(solution.pixel_noise(freedom), _PIXEL_FLOOR), arm)
