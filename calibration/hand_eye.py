"""Where the camera sits on the arm's tool, and where the board lies in the arm's base frame (eye in hand).

A X = X B by OpenCV's closed forms, then one joint refinement on reprojection in which the arm is allowed to
have been a little off in every view. How far off, against how noisy the corners are, is not assumed: both
are estimated with the unknowns (variance components, Förstner 1979), since the arm's noise usually dwarfs
that of the corners.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from calibration.board import BoardSpec
from calibration.bundle import (
    Bools,
    Floats,
    Linearization,
    Observations,
    Solution,
    cross_matrix,
    project_with_derivatives,
    solve,
)
from calibration.closed_forms import closed_forms
from calibration.detection import Detection
from calibration.intrinsics import board_pose
from calibration.observability import MIN_POSES, RotationSpread, require_observable
from dataset.errors import CalibrationError
from dataset.intrinsics import Intrinsics
from dataset.transforms import SE3, rotation_error_deg, translation_error_mm

_LOOSE_ARM = np.array([1e-3] * 3 + [2e-3] * 3)  # m, rad: before the arm's noise is known
_ARM_FLOOR = np.array(
    [2e-6] * 3 + [5e-6] * 3
)  # no arm repeats better; keeps the variance components positive
_PIXEL_FLOOR = 5e-3
_MAX_ERROR = 5.0  # of the views' median error: farther off is an outlier
_NO_ARM_M = 10e-3  # a typical arm is never this wrong: the poses are not what they are taken for
_NO_ARM_RAD = np.radians(2.0)
_FOLDS = 5
_TRANSFORMS = 12  # shared parameters before the board's scale and the camera's own
_SCALE = 12
_WRONG_SCALE = 0.02


@dataclass(frozen=True, eq=False)
class HandEyeResult:
    """What N views from N arm poses say.

    Attributes:
        T_tcp_cam, T_base_board: the two transforms.
        covariance: (12, 12) of the twists [rho, phi] dX, dZ (m, rad) in T_tcp_cam @ exp(dX), T_base_board @
            exp(dZ), the uncertainty of the intrinsics included when it was given.
        rms_px: distance between seen and predicted corners when every view may be off by the arm's noise.
        rigid_rms_px: the same when the arm's poses are taken at their word.
        arm_sigma_m, arm_sigma_rad, pixel_sigma: the noise estimated, a coordinate.
        used: (N,) False for views rejected as outliers.
        view_rms_px: (N,) like rigid_rms_px, a view.
        held_out_mm, held_out_deg: median error of the board's pose predicted in views left out (5-fold).
        spread: of the tool's rotation.
        candidates_px: the closed forms' median corner error, by name.
        board_scale, board_scale_sigma: the board's size against its description, as the arm's motion
            measures it.
        T_base_cam: N camera poses.
        board_size_m: width and height of the board, for drawing it.
        view, pixels, residual_px: (P,), (P, 2), (P, 2) every corner: its view, where seen, rigid predicted -
            seen.
    """

    T_tcp_cam: SE3
    T_base_board: SE3
    covariance: Floats
    rms_px: float
    rigid_rms_px: float
    arm_sigma_m: float
    arm_sigma_rad: float
    pixel_sigma: float
    used: Bools
    view_rms_px: Floats
    held_out_mm: float
    held_out_deg: float
    spread: RotationSpread
    candidates_px: dict[str, float]
    board_scale: float
    board_scale_sigma: float
    T_base_cam: SE3
    board_size_m: tuple[float, float]
    view: NDArray[np.int64]
    pixels: Floats
    residual_px: Floats

    @property
    def sigma_m(self) -> float:
        """Standard deviation of T_tcp_cam's position (root sum of squares of the axes), metres."""
        return float(np.sqrt(np.trace(self.covariance[:3, :3])))

    @property
    def sigma_rad(self) -> float:
        """Standard deviation of T_tcp_cam's rotation (root sum of squares of the axes), radians."""
        return float(np.sqrt(np.trace(self.covariance[3:6, 3:6])))


def calibrate_hand_eye(
    T_base_tcp: SE3,
    detections: list[Detection],
    spec: BoardSpec,
    intrinsics: Intrinsics,
    intrinsics_covariance: Floats | None = None,
) -> HandEyeResult:
    """Estimate T_tcp_cam and T_base_board from N views of a fixed board.

    Args:
        T_base_tcp: N arm poses at the exposures.
        detections: N, one a view, corners in mosaic pixels.
        spec: the board.
        intrinsics: at the mosaic's pixel grid; held fixed.
        intrinsics_covariance: (4 + n, 4 + n); widens the result's covariance.

    Raises:
        CalibrationError: poses that do not determine the transform (see `require_observable`), a board whose
            size contradicts the arm's motion, or views that fit no common transform.
    """
    if len(T_base_tcp) != len(detections):
        raise CalibrationError(
            f"hand-eye: {len(T_base_tcp)} arm poses for {len(detections)} detections; give one pose a view"
        )
    spread = require_observable(T_base_tcp)
    observations = Observations.collect(detections, spec)
    T_cam_board = SE3.stack([board_pose(d, spec, intrinsics) for d in detections])
    state, candidates = _best_closed_form(T_base_tcp, T_cam_board, intrinsics, observations)
    used, state = _reject_outlier_views(state, observations)
    require_observable(T_base_tcp[used])
    kept = observations.of_views(used)
    state_used, solution, sigmas = _refine(state.of_views(used), kept)
    scale, scale_sigma = _board_scale(state_used, kept, sigmas)
    if abs(scale - 1) > max(_WRONG_SCALE, 6 * scale_sigma):
        raise CalibrationError(
            f"hand-eye: measured by the arm's motion the board is {scale:.3f} times the size described;"
            " square_m is"
            f" {spec.square_m:g}, it should be about {spec.square_m * scale:.4f} m (measure it), or the"
            " arm's poses"
            " are not in metres"
        )
    rigid = replace(state_used, T_base_tcp=T_base_tcp, offset=np.zeros((len(T_base_tcp), 6)))
    residual = rigid.linearize(observations).residual
    corner_used = used[observations.view]
    held_out_mm, held_out_deg = _held_out(state_used, kept, sigmas, T_cam_board[used])
    return HandEyeResult(
        T_tcp_cam=state_used.T_tcp_cam,
        T_base_board=state_used.T_base_board,
        covariance=_with_intrinsics(solution, intrinsics_covariance),
        rms_px=_rms(solution.residual),
        rigid_rms_px=_rms(residual[corner_used]),
        arm_sigma_m=float(sigmas.arm[0]),
        arm_sigma_rad=float(sigmas.arm[3]),
        pixel_sigma=sigmas.pixel,
        used=used,
        view_rms_px=observations.view_rms(residual),
        held_out_mm=held_out_mm,
        held_out_deg=held_out_deg,
        spread=spread,
        candidates_px=candidates,
        board_scale=scale,
        board_scale_sigma=scale_sigma,
        T_base_cam=T_base_tcp @ state_used.T_tcp_cam,
        board_size_m=spec.size_m,
        view=observations.view,
        pixels=observations.pixels,
        residual_px=residual,
    )


@dataclass(frozen=True, eq=False)
class _Sigmas:
    """Noise of a corner's coordinate (px) and of the arm's pose (6,) m, rad."""

    pixel: float
    arm: Floats


@dataclass(frozen=True, eq=False)
class _State:
    """Shared: T_tcp_cam, T_base_board, the board's scale, fx fy cx cy distortion. Own: how far the arm was
    off."""

    T_tcp_cam: SE3
    T_base_board: SE3
    scale: float
    camera: Intrinsics
    T_base_tcp: SE3
    offset: Floats

    @property
    def deviation(self) -> Floats:
        return self.offset

    def free(self, scale: bool) -> Bools:
        """(S,) the two transforms, and the board's scale if asked; never the camera."""
        free = np.zeros(_TRANSFORMS + 1 + 4 + len(self.camera.distortion), bool)
        free[:_TRANSFORMS] = True
        free[_SCALE] = scale
        return free

    def linearize(self, observations: Observations) -> Linearization:
        T_tcp_board = SE3.exp(-self.offset) @ self.T_base_tcp.inverse() @ self.T_base_board
        rotation_tcp_board = T_tcp_board.rotation[observations.view]
        board = self.scale * observations.board
        in_tcp = T_tcp_board[observations.view].apply(board)
        cam_R_tcp = self.T_tcp_cam.rotation.T
        in_cam = self.T_tcp_cam.inverse().apply(in_tcp)
        predicted, by_point, by_camera = project_with_derivatives(
            in_cam, self.camera.K, self.camera.distortion
        )
        cam_R_board = cam_R_tcp @ rotation_tcp_board
        minus_one = np.broadcast_to(-np.eye(3), (len(in_cam), 3, 3))
        by_tcp_cam = np.concatenate([minus_one, cross_matrix(in_cam)], axis=2)
        by_base_board = cam_R_board @ np.concatenate([-minus_one, -cross_matrix(board)], axis=2)
        by_offset = cam_R_tcp @ np.concatenate([minus_one, cross_matrix(in_tcp)], axis=2)
        by_scale = cam_R_board @ observations.board[..., None]
        by_shared = by_point @ np.concatenate([by_tcp_cam, by_base_board, by_scale], axis=2)
        return Linearization(
            predicted - observations.pixels,
            np.concatenate([by_shared, by_camera], axis=2),
            by_point @ by_offset,
        )

    def moved(self, shared: Floats, own: Floats) -> _State:
        return replace(
            self,
            T_tcp_cam=self.T_tcp_cam @ SE3.exp(shared[:6]),
            T_base_board=self.T_base_board @ SE3.exp(shared[6:12]),
            scale=self.scale + float(shared[_SCALE]),
            offset=self.offset + own,
        )

    def of_views(self, keep: Bools) -> _State:
        return replace(self, T_base_tcp=self.T_base_tcp[keep], offset=self.offset[keep])


def _best_closed_form(
    T_base_tcp: SE3, T_cam_board: SE3, intrinsics: Intrinsics, observations: Observations
) -> tuple[_State, dict[str, float]]:
    """Start from the method with the smallest median corner error: the median, since a few views may be
    wrong."""
    offset = np.zeros((len(T_base_tcp), 6))
    states = {
        name: _State(T_tcp_cam, T_base_board, 1.0, intrinsics, T_base_tcp, offset)
        for name, (T_tcp_cam, T_base_board) in closed_forms(T_base_tcp, T_cam_board).items()
    }
    errors = {
        name: float(np.median(np.linalg.norm(state.linearize(observations).residual, axis=1)))
        for name, state in states.items()
    }
    if not errors:
        raise CalibrationError(
            "hand-eye: no closed-form method found a transform; check that arm poses and pictures belong"
            " together"
        )
    return states[min(errors, key=lambda name: errors[name])], errors


def _reject_outlier_views(state: _State, observations: Observations) -> tuple[Bools, _State]:
    """Views whose arm pose (or board) is far off the others': reweighted until the rest agree, then named."""
    count = observations.view_count
    spread = np.ones(count)
    for _ in range(8):
        state, _ = solve(state, observations, 0.3, _LOOSE_ARM * spread[:, None], state.free(scale=True))
        deviation = np.linalg.norm(state.offset / _LOOSE_ARM, axis=1)
        typical = max(float(np.median(deviation)), 1e-3)
        # Student's t with 3 degrees of freedom: a view twice as far off as usual counts half, one far off
        # hardly.
        before, spread = spread, np.sqrt((3.0 + (deviation / typical) ** 2) / 4.0)
        if np.allclose(spread, before, rtol=0.05):
            break
    typical_m, typical_rad = np.median(np.linalg.norm(state.offset.reshape(count, 2, 3), axis=2), axis=0)
    if typical_m > _NO_ARM_M or typical_rad > _NO_ARM_RAD:
        raise CalibrationError(
            f"hand-eye: no common transform fits, the arm would have to be off by {1000 * typical_m:.0f} mm"
            " and"
            f" {np.degrees(typical_rad):.1f} degrees in a typical view; check that poses are base<-tcp (not"
            " inverted), in"
            " metres, and belong to the pictures"
        )
    # Judged by the picture, with the arm taken at its word: a view with few corners is not an outlier for
    # that.
    rigid = replace(state, offset=np.zeros_like(state.offset)).linearize(observations).residual
    error = observations.view_rms(rigid)
    used = error <= _MAX_ERROR * np.median(error) + 0.3
    if np.count_nonzero(used) < max(MIN_POSES, count // 2):
        raise CalibrationError(
            f"hand-eye: {count - np.count_nonzero(used)} of {count} views contradict the others; check that"
            " the"
            " board and the base did not move, and that arm poses are base<-tcp at the time of each picture"
        )
    return used, state


def _refine(state: _State, observations: Observations) -> tuple[_State, Solution, _Sigmas]:
    """Alternate between the unknowns and the variance components until the noise levels settle."""
    sigmas = _Sigmas(0.3, _LOOSE_ARM)
    state = replace(state, scale=1.0, offset=np.zeros_like(state.offset))
    free = state.free(scale=False)
    for _ in range(10):
        state, solution = _solve(state, observations, sigmas, free)
        updated = _variance_components(state, solution, observations, sigmas)
        settled = np.allclose(updated.arm, sigmas.arm, rtol=0.02) and np.isclose(
            updated.pixel, sigmas.pixel, rtol=0.02
        )
        sigmas = updated
        if settled:
            break
    state, solution = _solve(state, observations, sigmas, free)
    return state, solution, sigmas


def _solve(
    state: _State, observations: Observations, sigmas: _Sigmas, free: Bools
) -> tuple[_State, Solution]:
    own_sigma = np.tile(sigmas.arm, (observations.view_count, 1))
    return solve(state, observations, sigmas.pixel, own_sigma, free)


def _variance_components(
    state: _State, solution: Solution, observations: Observations, sigmas: _Sigmas
) -> _Sigmas:
    """Each noise from its own residuals over its own redundancy (Förstner 1979)."""
    count = observations.view_count
    known = (
        np.einsum("vii->vi", solution.own_covariance) / sigmas.arm**2
    )  # 1: the views say nothing of the arm
    redundancy = np.maximum(count - known.sum(axis=0), 1e-6).reshape(2, 3).sum(axis=1)
    squares = np.sum(state.offset**2, axis=0).reshape(2, 3).sum(axis=1)
    arm = np.maximum(np.repeat(np.sqrt(squares / redundancy), 3), _ARM_FLOOR)
    freedom = 2 * len(observations.view) - _TRANSFORMS - redundancy.sum()
    return _Sigmas(max(solution.pixel_noise(freedom), _PIXEL_FLOOR), arm)


def _board_scale(state: _State, observations: Observations, sigmas: _Sigmas) -> tuple[float, float]:
    free = state.free(scale=True)
    scaled, solution = _solve(state, observations, sigmas, free)
    return scaled.scale, float(np.sqrt(solution.covariance[_SCALE, _SCALE]))


def _with_intrinsics(solution: Solution, intrinsics_covariance: Floats | None) -> Floats:
    """Adds what the fixed intrinsics' own uncertainty does to the transforms ("consider" covariance)."""
    if intrinsics_covariance is None:
        return solution.covariance
    camera = slice(_SCALE + 1, None)
    gain = solution.covariance @ solution.reduced_normal[:_TRANSFORMS, camera]
    return np.asarray(solution.covariance + gain @ intrinsics_covariance @ gain.T)


def _held_out(
    state: _State, observations: Observations, sigmas: _Sigmas, T_cam_board: SE3
) -> tuple[float, float]:
    """Median error, mm and degrees, of the board's pose in views that the estimate did not use."""
    millimetres: list[Floats] = []
    degrees: list[Floats] = []
    views = np.arange(observations.view_count)
    for fold in range(_FOLDS):
        test = views % _FOLDS == fold
        if np.count_nonzero(~test) < MIN_POSES - 1:
            continue
        trained, _ = _solve(
            state.of_views(~test), observations.of_views(~test), sigmas, state.free(scale=False)
        )
        T_base_cam = state.T_base_tcp[test] @ trained.T_tcp_cam
        predicted = T_base_cam.inverse() @ trained.T_base_board
        millimetres.append(translation_error_mm(predicted, T_cam_board[test]))
        degrees.append(rotation_error_deg(predicted, T_cam_board[test]))
    if not millimetres:
        return float("nan"), float("nan")
    return float(np.median(np.concatenate(millimetres))), float(np.median(np.concatenate(degrees)))


def _rms(residual: Floats) -> float:
    return float(np.sqrt(np.mean(np.sum(residual**2, axis=1))))
