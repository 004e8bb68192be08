"""The constant delay between camera and arm, from pictures of the board taken in motion.

First by correlation of how fast camera and arm turn, which needs no calibration (`calibration.streams`), and
by how far the board seems to move; then refined on reprojection together with the hand-eye transforms, within
their covariance, and with the arm's noise in the model.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from calibration.board import BoardSpec
from calibration.bundle import Floats, Observations
from calibration.detection import Detection
from calibration.hand_eye_model import SCALE, TRANSFORMS, HandEyeState, TimedArm, fit
from calibration.intrinsics import board_pose
from calibration.streams import RANGE_S, ArmTrace, Correlation, correlate_turning
from dataset.errors import CalibrationError
from dataset.intrinsics import Intrinsics
from dataset.transforms import SE3

MIN_FRAMES = 8
_SCAN_STEP_S = 0.01
_STRETCHES = 10  # of a film, in which the arm goes a way or two (our choice)
_SLOPE_SPAN_S = 0.02  # the arm's noise from one sample to the next must not pass for speed
_MAX_SIGMA_S = 2e-3
_EXACT = 1e-7
"""Radians and metres: no hand-eye transform is known better, also one that comes without uncertainty."""

_MIN_SPEED_PX_S = 30.0  # an arm at rest seems to move at a few px/s, by its own noise
_FAR = 1e3  # px: a corner behind the camera, or without an arm pose


@dataclass(frozen=True, eq=False)
class TimeOffsetResult:
    """What N pictures in motion say.

    Attributes:
        offset_s: the arm's pose at an exposure is trace(mid exposure on the host clock + offset_s).
        sigma_s: standard deviation, from the scatter of the frames.
        rms_px: distance between seen and predicted corners at that offset.
        rms_before_px: the same without an offset.
        frame_offset_s: (N,) what each frame alone says; NaN where the camera hardly moved.
        speed_px_s: (N,) how fast the corners moved.
        scan_s, scan_px: (K,) the median corner error over the range searched.
        used: (N,) frames that entered the estimate.
        correlation: of the angular speeds; None when too few frames lie close together, or nothing turns.
    """

    offset_s: float
    sigma_s: float
    rms_px: float
    rms_before_px: float
    frame_offset_s: Floats
    speed_px_s: Floats
    scan_s: Floats
    scan_px: Floats
    used: NDArray[np.bool_]
    correlation: Correlation | None


def estimate_time_offset(
    host_mid_ns: NDArray[np.int64],
    trace_ns: NDArray[np.int64],
    trace: SE3,
    detections: list[Detection],
    spec: BoardSpec,
    intrinsics: Intrinsics,
    T_tcp_cam: SE3,
    T_base_board: SE3,
    hand_eye_covariance: Floats | None = None,
) -> TimeOffsetResult:
    """The dt that makes the board stand still: minimises reprojection with the arm's pose at mid exposure +
    dt.

    Args:
        host_mid_ns: (N,) mid-exposure times on the host clock.
        trace_ns: (M,) times of the arm's samples on the host clock, increasing.
        trace: M poses T_base_tcp.
        detections: N, one a frame, corners in mosaic pixels.
        spec, intrinsics, T_tcp_cam, T_base_board: as calibrated at rest.
        hand_eye_covariance: (12, 12) of both transforms' twists; they are refined with the offset when given,
            and held fixed otherwise.

    Raises:
        CalibrationError: too few frames inside the trace, too little motion to tell, or no offset within
            +-1.7 s.
    """
    problem = _Problem.prepare(
        host_mid_ns, trace_ns, trace, detections, spec, intrinsics, T_tcp_cam, T_base_board
    )
    scan = np.arange(-RANGE_S, RANGE_S + 0.5 * _SCAN_STEP_S, _SCAN_STEP_S)
    errors = np.array([problem.median_error(dt) for dt in scan])
    if not np.isfinite(errors).any():
        raise CalibrationError(
            "time offset: most frames lie outside the arm's trace; record the trace from before the first to"
            " after the last frame"
        )
    offset = float(scan[np.argmin(errors)])
    correlation = _correlate(problem, detections, spec)
    if correlation is not None and problem.median_error(correlation.best_s) < errors.min():
        offset = correlation.best_s
    if abs(offset) > RANGE_S - 1.5 * _SCAN_STEP_S:
        raise CalibrationError(
            f"time offset: no offset within {RANGE_S:g} s explains the pictures; check that the clocks were"
            " fitted and that the hand-eye calibration belongs to this rig"
        )
    for _ in range(30):
        step = problem.gauss_newton_step(offset)
        offset += step
        if abs(step) < 1e-7:
            break
    frame = problem.frames(offset)
    if np.count_nonzero(frame.used) < MIN_FRAMES:
        raise CalibrationError(
            f"time offset: only {np.count_nonzero(frame.used)} frames lie within the arm's trace; record the"
            " trace from before the first to after the last frame"
        )
    # The frames' errors are not independent corner by corner (a hand-eye error moves all corners of a
    # frame), so the scatter of whole frames is what the uncertainty is taken from (a clustered, "sandwich"
    # estimate).
    information = float(frame.information.sum())
    score = frame.gradient[frame.used]
    sigma = np.inf if information == 0 else float(np.sqrt(np.sum(score**2)) / information)
    speed = float(np.median(frame.speed[frame.used]))
    if speed < _MIN_SPEED_PX_S or not sigma < _MAX_SIGMA_S:
        raise CalibrationError(
            f"time offset: the camera moved too little in {np.count_nonzero(frame.used)} frames to tell"
            f" (sigma {1e3 * sigma:.1f} ms; median corner speed {speed:.0f} px/s); record the board while the"
            " arm swings at 0.1-0.25 m/s, changing direction"
        )
    with np.errstate(divide="ignore", invalid="ignore"):
        alone = np.where(frame.speed > _MIN_SPEED_PX_S, offset - frame.gradient / frame.information, np.nan)
    if hand_eye_covariance is not None:
        offset, sigma = _refined(problem, offset, frame.used, T_base_board, hand_eye_covariance)
        frame = problem.frames(offset)
    before = problem.frames(0.0)
    return TimeOffsetResult(
        offset_s=offset,
        sigma_s=sigma,
        rms_px=_rms(frame.square_px[frame.used]),
        rms_before_px=_rms(before.square_px[before.used]) if before.used.any() else float("nan"),
        frame_offset_s=alone,
        speed_px_s=frame.speed,
        scan_s=scan,
        scan_px=errors,
        used=frame.used,
        correlation=correlation,
    )


def _correlate(problem: _Problem, detections: list[Detection], spec: BoardSpec) -> Correlation | None:
    order = np.argsort(problem.mid_s)
    seen = SE3.stack([board_pose(detections[i], spec, problem.intrinsics) for i in order])
    return correlate_turning(problem.mid_s[order], seen, problem.arm)


def _refined(
    problem: _Problem, offset: float, used: NDArray[np.bool_], T_base_board: SE3, covariance: Floats
) -> tuple[float, float]:
    """The offset and its standard deviation, refined with both transforms and the noise levels.

    How far off the arm is changes little from one frame to the next, and then the frames tell less than if
    they erred each for itself: the larger of both estimates of the uncertainty is taken.
    """
    state = HandEyeState(
        "eye_in_hand",
        problem.T_tcp_cam,
        T_base_board,
        problem.intrinsics,
        problem.arm.T_base_tcp[:1],
        np.zeros((int(used.sum()), 6)),
        moving=TimedArm(problem.arm, problem.mid_s[used]),
    ).at_offset(offset)
    free = state.free(offset=True)
    information = np.zeros((len(free), len(free)))
    information[TRANSFORMS, TRANSFORMS] = np.linalg.inv(covariance + _EXACT**2 * np.eye(len(covariance)))
    observations = problem.observations.take(used)
    found = fit(replace(state, expected=state), observations, free, information)
    place = int(np.count_nonzero(free[:SCALE]))  # after the transforms: the scale is not free
    stretches = found.jackknife_variance(observations, min(_STRETCHES, observations.view_count // 2))
    variance = max(float(found.solution.covariance[place, place]), float(stretches[place]))
    return found.state.offset_s, float(np.sqrt(variance))


@dataclass(frozen=True, eq=False)
class _Frames:
    """Per frame: gradient and information of dt, mean corner speed (px/s), mean square error, usable."""

    gradient: Floats
    information: Floats
    speed: Floats
    square_px: Floats
    used: NDArray[np.bool_]


@dataclass(frozen=True, eq=False)
class _Problem:
    observations: Observations
    board_in_base: Floats
    mid_s: Floats
    arm: ArmTrace
    intrinsics: Intrinsics
    T_tcp_cam: SE3

    @staticmethod
    def prepare(
        host_mid_ns: NDArray[np.int64],
        trace_ns: NDArray[np.int64],
        trace: SE3,
        detections: list[Detection],
        spec: BoardSpec,
        intrinsics: Intrinsics,
        T_tcp_cam: SE3,
        T_base_board: SE3,
    ) -> _Problem:
        if len(detections) != len(host_mid_ns):
            raise CalibrationError(
                f"time offset: {len(detections)} detections for {len(host_mid_ns)} frame times; give one of"
                " each a frame"
            )
        if len(detections) < MIN_FRAMES:
            raise CalibrationError(
                f"time offset: {len(detections)} frames show the board; at least {MIN_FRAMES} are needed,"
                " in motion"
            )
        if not trace.finite.all():
            raise CalibrationError("time offset: the arm's trace holds NaN poses; check the recording")
        # Seconds from a common origin: nanoseconds since boot do not fit a float64 to the microsecond for
        # ever.
        origin = int(trace_ns[0])
        observations = Observations.collect(detections, spec)
        return _Problem(
            observations,
            T_base_board.apply(observations.board),
            np.asarray((host_mid_ns - origin) * 1e-9, np.float64),
            ArmTrace(np.asarray((trace_ns - origin) * 1e-9, np.float64), trace),
            intrinsics,
            T_tcp_cam,
        )

    def covered(self, dt: float) -> NDArray[np.bool_]:
        """(N,) frames whose time, and a little either side of it, the trace covers."""
        return self.arm.covers(self.mid_s + dt, _SLOPE_SPAN_S)

    def residual(self, dt: float) -> Floats:
        """(P, 2) predicted - seen, `_FAR` where there is no prediction."""
        T_cam_base = (self.arm.at(self.mid_s + dt) @ self.T_tcp_cam).inverse()
        predicted = self.intrinsics.project(T_cam_base[self.observations.view].apply(self.board_in_base))
        residual = np.where(np.isfinite(predicted), predicted - self.observations.pixels, _FAR)
        return np.where(np.abs(residual) < _FAR, residual, _FAR)

    def median_error(self, dt: float) -> float:
        """Over the frames covered; infinite when they are fewer than half."""
        covered = self.covered(dt)
        if np.count_nonzero(covered) < max(MIN_FRAMES, len(covered) // 2):
            return np.inf
        return float(np.median(self.observations.view_rms(self.residual(dt))[covered]))

    def frames(self, dt: float) -> _Frames:
        residual = self.residual(dt)
        slope = (self.residual(dt + _SLOPE_SPAN_S) - self.residual(dt - _SLOPE_SPAN_S)) / (2 * _SLOPE_SPAN_S)
        sums = self.observations.sum_by_view
        covered = self.covered(dt)
        square = self.observations.view_rms(residual) ** 2
        typical = np.median(square[covered]) if covered.any() else 1.0
        weight = covered / np.sqrt(1.0 + square / (9.0 * typical + 1e-12))
        return _Frames(
            gradient=weight * sums(np.sum(slope * residual, axis=1)),
            information=weight * sums(np.sum(slope**2, axis=1)),
            speed=np.sqrt(sums(np.sum(slope**2, axis=1)) / sums(np.ones(len(slope)))),
            square_px=square,
            used=covered,
        )

    def gauss_newton_step(self, dt: float) -> float:
        frame = self.frames(dt)
        total = float(frame.information.sum())
        return 0.0 if total == 0 else float(np.clip(-frame.gradient.sum() / total, -0.05, 0.05))


def _rms(squares: Floats) -> float:
    return float(np.sqrt(np.mean(squares)))
