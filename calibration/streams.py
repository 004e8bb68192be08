"""Two streams of poses on two clocks: the arm's and the camera's, and what brings them together.

How fast a rigid body turns does not depend on the frame it is seen in, so the angular speeds of both streams
are one function of time up to the clocks' offset. Their correlation finds it without any calibration (Furrer
et al. 2017); the transforms, the noise and the offset are then refined together.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from calibration.closed_forms import Mount, arm_reading
from calibration.observability import require_observable
from calibration.robot_world import PosePairs, RobotWorldResult, refine, start_from, unknown_names
from dataset.errors import CalibrationError
from dataset.transforms import SE3, interpolate_poses

Floats = NDArray[np.float64]

RANGE_S = 1.7
"""Offsets searched, either way (our choice: a trigger, a network and a buffer stay well below; a simulated
camera on a slow machine takes up to 1.5 s for a picture)."""

_STEP_S = 0.01
_TURN_S = 0.1  # a shorter interval turns the poses' noise into speed
_SMOOTH_S = 0.025  # half the window over which an arm's motion passes for a parabola
_LEAST_SAMPLES = 3
_LEAST_CORRELATION = 0.5
_LEAST_PAIRS = 8


@dataclass(frozen=True, eq=False)
class ArmTrace:
    """M poses T_base_tcp at increasing times, seconds on any clock."""

    times_s: Floats
    T_base_tcp: SE3

    def covers(self, at_s: Floats, margin_s: float = 0.0) -> NDArray[np.bool_]:
        """Which times, and a margin either side of them, lie within the trace."""
        return (at_s - margin_s >= self.times_s[0]) & (at_s + margin_s <= self.times_s[-1])

    def at(self, at_s: Floats) -> SE3:
        """Poses at K times, those outside the trace at its ends; interpolated between samples."""
        inside = np.clip(at_s, self.times_s[0], self.times_s[-1])
        return interpolate_poses(self.times_s, self.T_base_tcp, inside)

    def smoothed(self, at_s: Floats) -> tuple[SE3, Floats]:
        """Poses at K times, from a parabola through the samples 25 ms around each, which averages the arm's
        noise; and the velocity there (K, 6): twist a second, in the tool's frame."""
        nearest = np.clip(np.searchsorted(self.times_s, at_s), _LEAST_SAMPLES, len(self.times_s) - 1)
        spacing = float(np.median(np.diff(self.times_s)))
        half = max(_LEAST_SAMPLES, int(np.ceil(_SMOOTH_S / spacing)))
        index = nearest[:, None] + np.arange(-half, half + 1)
        inside = (index >= 0) & (index < len(self.times_s))
        index = np.clip(index, 0, len(self.times_s) - 1)
        reference = self.at(at_s)
        twist = (reference[:, None].inverse() @ self.T_base_tcp[index]).log()
        since = self.times_s[index] - at_s[:, None]
        width = (half + 1) * spacing
        weight = np.sqrt(inside * np.clip(1.0 - (since / width) ** 2, 1e-6, None))
        basis = np.stack([np.ones_like(since), since / width, (since / width) ** 2], axis=-1)
        fitted = np.linalg.pinv(basis * weight[..., None]) @ (twist * weight[..., None])
        return reference @ SE3.exp(fitted[:, 0]), fitted[:, 1] / width


@dataclass(frozen=True, eq=False)
class Correlation:
    """The correlation (K,) of the angular speeds over the offsets tried (K,), seconds; NaN where untold."""

    offset_s: Floats
    correlation: Floats

    @property
    def best_s(self) -> float:
        """The offset with the largest correlation."""
        return float(self.offset_s[np.nanargmax(self.correlation)])


def correlate_turning(camera_s: Floats, T_cam_board: SE3, arm: ArmTrace) -> Correlation | None:
    """Correlation of how fast camera and arm turn, for offsets to add to the camera's times (N,).

    Whole intervals between pictures are compared, so pictures may be sparse and irregular. None when too few
    pictures lie close together, or neither turns.
    """
    later = np.searchsorted(camera_s, camera_s + _TURN_S)
    first = np.flatnonzero(later < len(camera_s))
    second = later[first]
    interval = camera_s[second] - camera_s[first]
    close = interval < 5 * _TURN_S
    first, second, interval = first[close], second[close], interval[close]
    if len(first) < _LEAST_PAIRS:
        return None
    seen = _angles(T_cam_board[first], T_cam_board[second]) / interval
    offsets = np.arange(-RANGE_S, RANGE_S + 0.5 * _STEP_S, _STEP_S)
    found = np.full(len(offsets), np.nan)
    for k, offset in enumerate(offsets):
        known = arm.covers(camera_s[first] + offset) & arm.covers(camera_s[second] + offset)
        if np.count_nonzero(known) < max(_LEAST_PAIRS, len(first) // 3):
            continue
        moved = _angles(arm.at(camera_s[first][known] + offset), arm.at(camera_s[second][known] + offset))
        speeds = np.stack([moved / interval[known], seen[known]])
        if speeds.std(axis=1).min() > 1e-6:
            found[k] = float(np.corrcoef(speeds[0], speeds[1]).ravel()[1])
    return Correlation(offsets, found) if np.isfinite(found).any() else None


def solve_streams(
    arm_s: Floats,
    T_base_tcp: SE3,
    camera_s: Floats,
    T_cam_board: SE3,
    mount: Mount = "eye_in_hand",
) -> RobotWorldResult:
    """Both unknown transforms and the clocks' offset from two streams of poses in motion.

    Args:
        arm_s: (M,) times of the arm's poses, seconds, increasing.
        T_base_tcp: M arm poses.
        camera_s: (N,) times of the pictures on the camera's clock, seconds, increasing.
        T_cam_board: N poses of the board.
        mount: who carries the camera.

    Raises:
        CalibrationError: sizes that differ, NaN, speeds that do not correlate, poses that do not determine
            the transforms.
    """
    if len(arm_s) != len(T_base_tcp) or len(camera_s) != len(T_cam_board):
        raise CalibrationError(
            f"streams: {len(arm_s)} times for {len(T_base_tcp)} arm poses and {len(camera_s)} times for"
            f" {len(T_cam_board)} board poses; give one time a pose"
        )
    if not (T_base_tcp.finite.all() and T_cam_board.finite.all()):
        raise CalibrationError("streams: some poses are NaN or infinite; drop them with their times")
    arm = ArmTrace(np.asarray(arm_s, np.float64), T_base_tcp)
    correlation = correlate_turning(camera_s, T_cam_board, arm)
    if correlation is None or np.nanmax(correlation.correlation) < _LEAST_CORRELATION:
        raise CalibrationError(
            "streams: the camera and the arm do not turn alike at any offset within"
            f" {RANGE_S:g} s; check the clocks, and that the arm turned back and forth while filming"
        )
    offset = correlation.best_s
    known = arm.covers(camera_s + offset, _STEP_S)
    pairs = TimedPairs(
        arm.at(camera_s + offset)[known], T_cam_board[known], mount, trace=arm, camera_s=camera_s[known]
    )
    spread = require_observable(pairs.T_base_tcp, mount)
    start = start_from(arm_reading(pairs.T_base_tcp, mount), pairs.T_cam_board, scale_known=True)
    start = replace(start, offset_s=offset)
    return refine(pairs, start, unknown_names("transforms", "offset"), spread)


@dataclass(frozen=True, eq=False)
class TimedPairs(PosePairs):
    """Pairs whose arm pose is looked up in a trace at the camera's time plus the offset."""

    trace: ArmTrace = field(kw_only=True)
    camera_s: Floats = field(kw_only=True)

    def arm(self, offset_s: float) -> tuple[SE3, Floats]:
        return self.trace.smoothed(self.camera_s + offset_s)


def _angles(a: SE3, b: SE3) -> Floats:
    return np.linalg.norm((a.inverse() @ b).as_rotvec(), axis=1)
