"""Where the camera sits and where the board lies, from views of the board at known poses of the arm.

Eye in hand: T_tcp_cam and T_base_board. Eye to hand: T_base_cam and T_tcp_board. All closed forms and RANSAC
side by side, the best of them refined on reprojection with the arm's noise in the model
(`calibration.hand_eye_model`); on request the camera's parameters and the clocks' offset are refined, too.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from calibration.board import BoardSpec
from calibration.bundle import Bools, Floats, Observations, Solution, solve
from calibration.closed_forms import Mount, arm_reading, closed_forms, ransac
from calibration.detection import Detection
from calibration.hand_eye_model import (
    CAMERA,
    LOOSE_ARM,
    OFFSET,
    SCALE,
    TRANSFORMS,
    Fit,
    HandEyeState,
    TimedArm,
    fit,
)
from calibration.intrinsics import board_pose
from calibration.observability import MIN_POSES, RotationSpread, require_observable
from dataset.errors import CalibrationError
from dataset.intrinsics import Intrinsics
from dataset.transforms import SE3, rotation_error_deg, translation_error_mm

_MAX_ERROR = 5.0  # of the views' median error: farther off is an outlier
_NO_ARM_M = 10e-3  # a typical arm is never this wrong: the poses are not what they are taken for
_NO_ARM_RAD = np.radians(2.0)
_WRONG_SCALE = 0.02
_ODD_SCALE = 1e-3


@dataclass(frozen=True, eq=False)
class HandEyeResult:
    """What N views from N arm poses say.

    Attributes:
        mount: who carries the camera.
        T_mount_cam: the camera on the tool (eye in hand) or in the base (eye to hand).
        T_fixture_board: the board in the base (eye in hand) or on the tool (eye to hand).
        covariance: (12, 12) of the twists [rho, phi] dX, dZ (m, rad) in T_mount_cam @ exp(dX),
            T_fixture_board @ exp(dZ), the uncertainty of the intrinsics included when it was given.
        intrinsics: as given, or refined on request.
        intrinsics_covariance: (4 + n, 4 + n) of those refined; None when they were not.
        offset_s, offset_sigma_s: to add to the camera's times; zero when the arm was at rest.
        rms_px: distance between seen and predicted corners when every view may be off by the arm's noise.
        rigid_rms_px: the same when the arm's poses are taken at their word.
        arm_sigma_m, arm_sigma_rad, pixel_sigma: the noise estimated, a coordinate.
        used: (N,) False for views rejected as outliers.
        view_rms_px: (N,) like rigid_rms_px, a view.
        held_out_mm, held_out_deg: median error of the board's pose predicted in a view left out, each view in
            its turn.
        spread: of the tool's rotation.
        candidates_px: the closed forms' and RANSAC's median corner error, by name.
        board_scale, board_scale_sigma: the board's size against its description, as the arm's motion
            measures it.
        T_base_cam, T_base_board_seen: N camera poses, and N poses of the board by the arm and the result.
        board_size_m: width and height of the board, for drawing it.
        view, pixels, residual_px: (P,), (P, 2), (P, 2) every corner: its view, where seen, rigid predicted -
            seen.
        fit, observations: the minimum and the corners of the views used, for bootstrap and next pose.
    """

    mount: Mount
    T_mount_cam: SE3
    T_fixture_board: SE3
    covariance: Floats
    intrinsics: Intrinsics
    intrinsics_covariance: Floats | None
    offset_s: float
    offset_sigma_s: float
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
    T_base_board_seen: SE3
    board_size_m: tuple[float, float]
    view: NDArray[np.int64]
    pixels: Floats
    residual_px: Floats
    fit: Fit
    observations: Observations

    @property
    def T_tcp_cam(self) -> SE3:
        """The camera on the tool.

        Raises:
            CalibrationError: the camera stands still (eye to hand).
        """
        return self._of("eye_in_hand", self.T_mount_cam)

    @property
    def T_base_board(self) -> SE3:
        """The board in the base.

        Raises:
            CalibrationError: the board is on the tool (eye to hand).
        """
        return self._of("eye_in_hand", self.T_fixture_board)

    @property
    def T_tcp_board(self) -> SE3:
        """The board on the tool.

        Raises:
            CalibrationError: the board stands still (eye in hand).
        """
        return self._of("eye_to_hand", self.T_fixture_board)

    @property
    def sigma_m(self) -> float:
        """Standard deviation of T_mount_cam's position (root sum of squares of the axes), metres."""
        return float(np.sqrt(np.trace(self.covariance[:3, :3])))

    @property
    def sigma_rad(self) -> float:
        """Standard deviation of T_mount_cam's rotation (root sum of squares of the axes), radians."""
        return float(np.sqrt(np.trace(self.covariance[3:6, 3:6])))

    def _of(self, mount: Mount, pose: SE3) -> SE3:
        if self.mount != mount:
            raise CalibrationError(
                f"hand-eye: this is a calibration {self.mount.replace('_', ' ')}; it has no transform of a"
                f" calibration {mount.replace('_', ' ')}: use T_mount_cam and T_fixture_board"
            )
        return pose


def calibrate_hand_eye(
    T_base_tcp: SE3,
    detections: list[Detection],
    spec: BoardSpec,
    intrinsics: Intrinsics,
    intrinsics_covariance: Floats | None = None,
    mount: Mount = "eye_in_hand",
    refine_camera: bool = False,
    moving: TimedArm | None = None,
) -> HandEyeResult:
    """Estimate where the camera and the board are from N views.

    Args:
        T_base_tcp: N arm poses at the exposures.
        detections: N, one a view, corners in mosaic pixels.
        spec: the board.
        intrinsics: at the mosaic's pixel grid.
        intrinsics_covariance: (4 + n, 4 + n); widens the result's covariance.
        mount: who carries the camera.
        refine_camera: refine the intrinsics, too, starting from ``intrinsics_covariance``.
        moving: when the views were taken in motion: the clocks' offset is refined, too.

    Raises:
        CalibrationError: poses that do not determine the transform (see `require_observable`), a board whose
            size contradicts the arm's motion, views that fit no common transform, or intrinsics to refine
            without their covariance.
    """
    if len(T_base_tcp) != len(detections):
        raise CalibrationError(
            f"hand-eye: {len(T_base_tcp)} arm poses for {len(detections)} detections; give one pose a view"
        )
    if refine_camera and intrinsics_covariance is None:
        raise CalibrationError(
            "hand-eye: intrinsics can only be refined from where their covariance expects them; give"
            " intrinsics_covariance, or run `s2p3 calibrate intrinsics`"
        )
    spread = require_observable(T_base_tcp, mount)
    observations = Observations.collect(detections, spec)
    T_cam_board = SE3.stack([board_pose(d, spec, intrinsics) for d in detections])
    start = HandEyeState(
        mount, SE3.identity(), SE3.identity(), intrinsics, T_base_tcp, np.zeros((len(T_base_tcp), 6))
    )
    start = replace(start, moving=moving).at_offset(0.0)
    state, candidates = _best_start(start, T_cam_board, observations)
    used, state = _reject_outlier_views(state, observations)
    require_observable(T_base_tcp[used], mount)
    kept = observations.take(used)
    free = state.free(offset=moving is not None, camera=refine_camera)
    state = replace(state.take(used), scale=1.0)
    information = None
    if refine_camera and intrinsics_covariance is not None:
        information = np.zeros((len(free), len(free)))
        information[CAMERA, CAMERA] = np.linalg.inv(intrinsics_covariance)
        state = replace(state, expected=state)
    found = fit(state, kept, free, information)
    scale, scale_sigma = _board_scale(found, kept)
    if abs(scale - 1) > max(_WRONG_SCALE, 6 * scale_sigma):
        raise CalibrationError(
            f"hand-eye: measured by the arm's motion the board is {scale:.3f} times the size described;"
            f" square_m is {spec.square_m:g}, it should be about {spec.square_m * scale:.4f} m"
            " (measure it), or the arm's poses are not in metres"
        )
    return _result(
        found,
        kept,
        start,
        used,
        observations,
        T_cam_board,
        spread,
        candidates,
        spec,
        (scale, scale_sigma),
        None if refine_camera else intrinsics_covariance,
    )


def _result(
    found: Fit,
    kept: Observations,
    start: HandEyeState,
    used: Bools,
    observations: Observations,
    T_cam_board: SE3,
    spread: RotationSpread,
    candidates: dict[str, float],
    spec: BoardSpec,
    scale: tuple[float, float],
    intrinsics_covariance: Floats | None,
) -> HandEyeResult:
    state, solution = found.state, found.solution
    whole = replace(
        start,
        T_mount_cam=state.T_mount_cam,
        T_fixture_board=state.T_fixture_board,
        camera=state.camera,
    ).at_offset(state.offset_s)
    residual = whole.linearize(observations).residual
    reading = arm_reading(whole.T_base_tcp, whole.mount)
    eye_in_hand = whole.mount == "eye_in_hand"
    count = len(whole.T_base_tcp)
    T_base_cam = reading @ state.T_mount_cam if eye_in_hand else _repeat(state.T_mount_cam, count)
    board = _repeat(state.T_fixture_board, count)
    covariance, names = _with_intrinsics(found, intrinsics_covariance), np.flatnonzero(found.free)
    offset_variance = covariance[names == OFFSET][:, names == OFFSET]
    lens = names >= CAMERA.start
    held_out_mm, held_out_deg = leave_one_out(found, kept, T_cam_board[used])
    return HandEyeResult(
        mount=state.mount,
        T_mount_cam=state.T_mount_cam,
        T_fixture_board=state.T_fixture_board,
        covariance=covariance[TRANSFORMS, TRANSFORMS],
        intrinsics=state.camera,
        intrinsics_covariance=covariance[lens][:, lens] if lens.any() else None,
        offset_s=state.offset_s,
        offset_sigma_s=float(np.sqrt(offset_variance.sum())),
        rms_px=_rms(solution.residual),
        rigid_rms_px=_rms(residual[used[observations.view]]),
        arm_sigma_m=float(found.sigmas.arm[0]),
        arm_sigma_rad=float(found.sigmas.arm[3]),
        pixel_sigma=found.sigmas.pixel,
        used=used,
        view_rms_px=observations.view_rms(residual),
        held_out_mm=held_out_mm,
        held_out_deg=held_out_deg,
        spread=spread,
        candidates_px=candidates,
        board_scale=scale[0],
        board_scale_sigma=scale[1],
        T_base_cam=T_base_cam,
        T_base_board_seen=board if eye_in_hand else whole.T_base_tcp @ board,
        board_size_m=spec.size_m,
        view=observations.view,
        pixels=observations.pixels,
        residual_px=residual,
        fit=found,
        observations=kept,
    )


def leave_one_out(found: Fit, observations: Observations, T_cam_board: SE3) -> tuple[float, float]:
    """Median error, mm and degrees, of the board's pose in a view that the estimate did not use, each view in
    its turn; NaN when too few are left."""
    count = observations.view_count
    if count <= MIN_POSES:
        return float("nan"), float("nan")
    millimetres, degrees = np.empty(count), np.empty(count)
    for left_out in range(count):
        others = np.arange(count) != left_out
        trained, _ = found.again(found.state.take(others), observations.take(others))
        reading = arm_reading(found.state.T_base_tcp[left_out], found.state.mount)
        predicted = (reading @ trained.T_mount_cam).inverse() @ trained.T_fixture_board
        millimetres[left_out] = translation_error_mm(predicted, T_cam_board[left_out])
        degrees[left_out] = rotation_error_deg(predicted, T_cam_board[left_out])
    return float(np.median(millimetres)), float(np.median(degrees))


def _best_start(
    state: HandEyeState, T_cam_board: SE3, observations: Observations
) -> tuple[HandEyeState, dict[str, float]]:
    """Start from the method with the smallest median corner error: the median, since a few views may be
    wrong."""
    reading = arm_reading(state.T_base_tcp, state.mount)
    pairs = closed_forms(reading, T_cam_board)
    sampled = ransac(reading, T_cam_board)
    if sampled is not None:
        pairs["ransac"] = sampled
    states = {name: replace(state, T_mount_cam=X, T_fixture_board=Z) for name, (X, Z) in pairs.items()}
    errors = {
        name: float(np.median(np.linalg.norm(tried.linearize(observations).residual, axis=1)))
        for name, tried in states.items()
    }
    if not errors:
        raise CalibrationError(
            "hand-eye: no closed-form method found a transform; check that arm poses and pictures belong"
            " together"
        )
    return states[min(errors, key=lambda name: errors[name])], errors


def _reject_outlier_views(state: HandEyeState, observations: Observations) -> tuple[Bools, HandEyeState]:
    """Views whose arm pose (or board) is far off the others': reweighted until the rest agree, then named."""
    count = observations.view_count
    spread = np.ones(count)
    for _ in range(8):
        state, _ = solve(
            state,
            observations,
            0.3,
            LOOSE_ARM * spread[:, None],
            state.free(scale=True, offset=state.moving is not None),
        )
        deviation = np.linalg.norm(state.arm_error / LOOSE_ARM, axis=1)
        typical = max(float(np.median(deviation)), 1e-3)
        # Student's t with 3 degrees of freedom: a view twice as far off as usual counts half, one far off
        # hardly.
        before, spread = spread, np.sqrt((3.0 + (deviation / typical) ** 2) / 4.0)
        if np.allclose(spread, before, rtol=0.05):
            break
    typical_m, typical_rad = np.median(np.linalg.norm(state.arm_error.reshape(count, 2, 3), axis=2), axis=0)
    if typical_m > _NO_ARM_M or typical_rad > _NO_ARM_RAD:
        raise CalibrationError(
            f"hand-eye: no common transform fits, the arm would have to be off by {1000 * typical_m:.0f} mm"
            f" and {np.degrees(typical_rad):.1f} degrees in a typical view; check that poses are base<-tcp"
            " (not inverted), in metres, and belong to the pictures"
        )
    # Judged by the picture, with the arm taken at its word: a view with few corners is not an outlier for
    # that.
    rigid = state.rigid().linearize(observations).residual
    error = observations.view_rms(rigid)
    used = error <= _MAX_ERROR * np.median(error) + 0.3
    if np.count_nonzero(used) < max(MIN_POSES, count // 2):
        raise CalibrationError(
            f"hand-eye: {count - np.count_nonzero(used)} of {count} views contradict the others; check that"
            " the board and the base did not move, and that arm poses are base<-tcp at the time of each"
            " picture"
        )
    return used, state


def _board_scale(found: Fit, observations: Observations) -> tuple[float, float]:
    """How large the board is against its description, and the standard deviation of that."""
    free = found.free.copy()
    free[SCALE] = True
    scaled, solution = replace(found, free=free).again(found.state, observations)
    if abs(scaled.scale - 1) > _ODD_SCALE:
        # A wrong size passes for noise of the arm, and would hide behind it.
        refit = fit(found.state, observations, free, found.information)
        scaled, solution = refit.state, refit.solution
    place = int(np.count_nonzero(free[:SCALE]))
    return scaled.scale, float(np.sqrt(solution.covariance[place, place]))


def _with_intrinsics(found: Fit, intrinsics_covariance: Floats | None) -> Floats:
    """Adds what the fixed intrinsics' own uncertainty does to the unknowns ("consider" covariance)."""
    solution: Solution = found.solution
    if intrinsics_covariance is None:
        return solution.covariance
    gain = solution.covariance @ solution.reduced_normal[found.free, CAMERA]
    return np.asarray(solution.covariance + gain @ intrinsics_covariance @ gain.T)


def _repeat(pose: SE3, count: int) -> SE3:
    return SE3(np.broadcast_to(pose.rotation, (count, 3, 3)), np.broadcast_to(pose.translation, (count, 3)))


def _rms(residual: Floats) -> float:
    return float(np.sqrt(np.mean(np.sum(residual**2, axis=1))))
