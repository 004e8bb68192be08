"""From recorded sessions to calibration results, and from a calibration back to camera poses."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from calibration.board import BoardSpec
from calibration.closed_forms import Mount, mean_pose
from calibration.detection import Detection, detect_in_mosaic, explain_missing_board, intensity_image
from calibration.hand_eye import HandEyeResult, calibrate_hand_eye
from calibration.intrinsics import IntrinsicsResult, calibrate_intrinsics
from calibration.records import FixedCameraRecord, HandEyeRecord, IntrinsicsRecord
from calibration.result import Calibration
from calibration.streams import ArmTrace
from calibration.time_offset import TimeOffsetResult, estimate_time_offset
from dataset.errors import CalibrationError
from dataset.progress import Progress, silent
from dataset.session import Session
from dataset.transforms import SE3

Floats = NDArray[np.float64]
Detections = list[tuple[int, Detection]]
"""Called with (frames done, frames in all)."""

_REST_WINDOW_S = 0.1
_REST_SEARCH_S = 0.5
_REST_M = 3e-4
_REST_RAD = np.radians(0.05)
_SLOPE_SPAN_S = 0.02
_LONGEST_HOLE_S, _LONGEST_HOLE_PERIODS = 0.04, 3.0
"""Our choice: at 0.5 m/s^2 a straight line over 40 ms is off by 0.1 mm."""


def detect_session(session: Session, spec: BoardSpec, on_progress: Progress = silent) -> Detections:
    """The board in every frame that shows it: (frame index, corners in mosaic pixels).

    Raises:
        CalibrationError: no frame shows the board; the message says what the middle frame shows instead.
    """
    found: Detections = []
    for index in range(len(session)):
        detection = detect_in_mosaic(session.mosaic(index), session.camera.mosaic, spec)
        if detection is not None:
            found.append((index, detection))
        on_progress(index + 1, len(session))
    if not found:
        raise CalibrationError(f"{session.path}: no frame shows the board; {_why_no_board(session, spec)}")
    return found


def intrinsics_from_session(
    session: Session, spec: BoardSpec, detections: Detections | None = None
) -> IntrinsicsResult:
    """Intrinsics at the mosaic's grid from a session that shows the board.

    Args:
        session: kind "intrinsics" or "hand_eye".
        spec: the board.
        detections: of `detect_session`, if it ran already.

    Raises:
        CalibrationError: as `detect_session` and `calibrate_intrinsics`.
    """
    detections = detect_session(session, spec) if detections is None else detections
    size = session.camera.height, session.camera.width
    return calibrate_intrinsics([d for _, d in detections], spec, size)


def hand_eye_from_session(
    session: Session,
    spec: BoardSpec,
    intrinsics: IntrinsicsRecord,
    detections: Detections | None = None,
    mount: Mount = "eye_in_hand",
    refine_camera: bool = False,
) -> HandEyeResult:
    """Where camera and board are, from stills of a fixed board, or by a fixed camera of a board on the tool;
    views in which the arm was not at rest are left out.

    Args:
        session: kind "hand_eye".
        spec: the board.
        intrinsics: of the same camera.
        detections: of `detect_session`, if it ran already.
        mount: who carries the camera.
        refine_camera: refine the intrinsics, too, starting from their covariance.

    Raises:
        CalibrationError: as `detect_session` and `calibrate_hand_eye`, no robot trace, or intrinsics of
            another camera.
    """
    intrinsics.require_camera(session.camera, str(session.path))
    detections = detect_session(session, spec) if detections is None else detections
    views, poses = views_at_rest(session, detections)
    corners, covariance = [d for _, d in views], intrinsics.covariance
    return calibrate_hand_eye(poses, corners, spec, intrinsics.intrinsics, covariance, mount, refine_camera)


def views_at_rest(session: Session, detections: Detections) -> tuple[Detections, SE3]:
    """The detections taken while the arm stood still, and T_base_tcp of each.

    Raises:
        CalibrationError: the arm never stood still, or there is no robot trace.
    """
    times, trace = arm_trace(session)
    found = [
        (index, detection, rest_pose(times, trace, int(session.mid_exposure_host_ns[index])))
        for index, detection in detections
    ]
    still = [(index, detection, pose) for index, detection, pose in found if pose is not None]
    if not still:
        raise CalibrationError(
            f"{session.path}: the arm was never at rest when a picture was taken; record stills with"
            " `s2p3 capture hand-eye`, which waits for the arm to settle"
        )
    return [(index, detection) for index, detection, _ in still], SE3.stack([pose for _, _, pose in still])


def time_offset_from_session(
    session: Session,
    spec: BoardSpec,
    intrinsics: IntrinsicsRecord,
    hand_eye: HandEyeRecord,
    detections: Detections | None = None,
) -> TimeOffsetResult:
    """The camera-to-arm delay from pictures of the same board taken in motion.

    Its uncertainty includes that of both clocks: what they are off here is taken for delay.

    Raises:
        CalibrationError: as `detect_session` and `estimate_time_offset`, no robot trace, or intrinsics of
            another camera.
    """
    intrinsics.require_camera(session.camera, str(session.path))
    detections = detect_session(session, spec) if detections is None else detections
    times, trace = arm_trace(session)
    chosen = [index for index, _ in detections]
    result = estimate_time_offset(
        session.mid_exposure_host_ns[chosen],
        times,
        trace,
        [d for _, d in detections],
        spec,
        intrinsics.intrinsics,
        hand_eye.camera_on(session.tcp_offset),
        hand_eye.T_base_board,
        hand_eye.covariance,
    )
    clocks_s = float(np.median(session.time_sigma_s[chosen]))
    return replace(result, sigma_s=float(np.hypot(result.sigma_s, clocks_s)))


def arm_trace(session: Session) -> tuple[NDArray[np.int64], SE3]:
    """Times (M,) i64 ns on the host clock, increasing, and poses T_base_tcp of the arm's samples.

    The controller's own clock, mapped by its fit, is used where there is one: it does not jitter.

    Raises:
        CalibrationError: the session has no robot trace, or one with poses that are NaN.
    """
    if session.robot is None or len(session.robot) < 2:
        raise CalibrationError(f"{session.path}: no robot trace; record it with the arm connected")
    bad = np.flatnonzero(~np.isfinite(session.robot.pose).all(axis=1))
    if len(bad):
        raise CalibrationError(
            f"{session.path}: the arm's pose is NaN or infinite in {len(bad)} of {len(session.robot)} samples"
            f" of its trace (the first is sample {bad[0]}); the trace is damaged: record it again"
        )
    fit = session.clocks.robot
    if fit is None:
        times = session.robot.host_time_ns
    else:
        times = fit.to_host(np.rint(session.robot.robot_time_s * 1e9).astype(np.int64))
    growing = np.flatnonzero(np.diff(np.maximum.accumulate(times), prepend=times[0] - 1) > 0)
    return times[growing], session.robot.poses[growing]


def rest_pose(times_ns: NDArray[np.int64], trace: SE3, at_ns: int) -> SE3 | None:
    """The arm's pose when it last stood still for 0.1 s, at or up to 0.5 s before ``at_ns``; None if it did
    not.

    A picture's time carries an unknown constant delay until that is calibrated, so a still is not looked up
    at one instant but in the rest before it.
    """
    for back_s in np.arange(0.0, _REST_SEARCH_S, 0.5 * _REST_WINDOW_S):
        end = at_ns - int(1e9 * back_s)
        first, last = np.searchsorted(times_ns, (end - int(1e9 * _REST_WINDOW_S), end))
        if last - first < 3:
            continue
        window = trace[first:last]
        mean = mean_pose(window)
        apart = mean.inverse() @ window
        still = np.linalg.norm(apart.translation, axis=1).max() < _REST_M
        if still and np.linalg.norm(apart.as_rotvec(), axis=1).max() < _REST_RAD:
            return mean
    return None


@dataclass(frozen=True, eq=False)
class CameraPoses:
    """T_base_cam (N) at mid exposure, NaN where the arm's trace does not reach; standard deviations (N,)."""

    T_base_cam: SE3
    sigma_m: Floats
    sigma_rad: Floats


def camera_poses(session: Session, calibration: Calibration) -> CameraPoses:
    """Where the camera was in every frame: the arm's trace at mid exposure plus the time offset, times
    T_tcp_cam; or, of a fixed camera, where it stands.

    The uncertainty adds those of the hand-eye transform, of the arm, and, times the speed, those of the time
    offset and of both clocks. Where samples of the arm are missing around an exposure, its pose is unknown.

    Raises:
        CalibrationError: the hand-eye transform is missing, or there is no robot trace.
    """
    if calibration.fixed_camera is not None:
        return _standing(calibration.fixed_camera, len(session))
    calibration.require("hand_eye")
    hand_eye = calibration.hand_eye
    assert hand_eye is not None
    T_tcp_cam = hand_eye.camera_on(session.tcp_offset)
    offset = calibration.time_offset
    offset_s, offset_sigma_s = (0.0, 0.0) if offset is None else (offset.offset_s, offset.sigma_s)
    times_ns, trace = arm_trace(session)
    origin = int(times_ns[0])
    arm = ArmTrace(np.asarray((times_ns - origin) * 1e-9, np.float64), trace)
    at = np.asarray((session.mid_exposure_host_ns - origin) * 1e-9 + offset_s, np.float64)
    known = arm.covers(at) & (_hole_around(arm.times_s, at) < _longest_hole_s(arm.times_s))
    T_base_cam = arm.at(at) @ T_tcp_cam
    before, after = arm.at(at - _SLOPE_SPAN_S) @ T_tcp_cam, arm.at(at + _SLOPE_SPAN_S) @ T_tcp_cam
    moved = before.inverse() @ after
    speed = np.linalg.norm(moved.translation, axis=1) / (2 * _SLOPE_SPAN_S)
    turning = np.linalg.norm(moved.as_rotvec(), axis=1) / (2 * _SLOPE_SPAN_S)
    time_variance = offset_sigma_s**2 + session.time_sigma_s**2
    variance_m = np.trace(hand_eye.covariance[:3, :3]) + 3 * hand_eye.arm_sigma_m**2
    variance_rad = np.trace(hand_eye.covariance[3:6, 3:6]) + 3 * hand_eye.arm_sigma_rad**2
    rotation, translation = T_base_cam.rotation.copy(), T_base_cam.translation.copy()
    rotation[~known], translation[~known] = np.nan, np.nan
    return CameraPoses(
        SE3(rotation, translation),
        np.sqrt(variance_m + speed**2 * time_variance),
        np.sqrt(variance_rad + turning**2 * time_variance),
    )


def _standing(camera: FixedCameraRecord, frames: int) -> CameraPoses:
    """The same pose in all frames."""
    ones = np.ones(frames)
    T_base_cam = SE3.stack([camera.T_base_cam] * frames) if frames else SE3.identity((0,))
    sigma_m, sigma_rad = (
        np.sqrt(np.trace(camera.covariance[part, part])) for part in (slice(3), slice(3, 6))
    )
    return CameraPoses(T_base_cam, sigma_m * ones, sigma_rad * ones)


def _hole_around(times_s: Floats, at_s: Floats) -> Floats:
    """(N,) how far the samples on either side of each instant are apart, seconds."""
    after = np.clip(np.searchsorted(times_s, at_s), 1, len(times_s) - 1)
    hole: Floats = times_s[after] - times_s[after - 1]
    return hole


def _longest_hole_s(times_s: Floats) -> float:
    """Of a few periods of the trace, over which the arm hardly accelerates; where a recording was interrupted
    the hole is longer."""
    return max(_LONGEST_HOLE_S, _LONGEST_HOLE_PERIODS * float(np.median(np.diff(times_s))))


def _why_no_board(session: Session, spec: BoardSpec) -> str:
    if len(session) == 0:
        return "the session holds no frame"
    middle = len(session) // 2
    return explain_missing_board(intensity_image(session.mosaic(middle), session.camera.mosaic), spec)
