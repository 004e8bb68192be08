"""What the arm's tip told: from recorded sessions and text files to touched points, pivots and poses."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike, NDArray

from calibration.object_observability import Tip
from calibration.sessions import arm_trace, rest_pose
from calibration.tool_tip import MIN_POSES, ToolTipResult, calibrate_tool_tip
from dataset.errors import CalibrationError
from dataset.rests import find_rests
from dataset.session import Session
from dataset.transforms import SE3

Floats = NDArray[np.float64]

_PIVOT_STEP_RAD = np.radians(2.0)
_SAME_TOOL_M = 1e-6


@dataclass(frozen=True, eq=False)
class KnownTip:
    """The tip in the tool's frame.

    Attributes:
        in_tcp: (3,) metres.
        covariance: (3, 3).
        ball_m: radius of a ball at its end, whose centre `in_tcp` is then; 0 for a point.
        tcp_offset: (6,) the arm's tool setting it holds for; None where that is not known.
    """

    in_tcp: Floats
    covariance: Floats
    ball_m: float = 0.0
    tcp_offset: Floats | None = None

    @staticmethod
    def exactly(in_tcp: ArrayLike, ball_m: float = 0.0) -> KnownTip:
        """A tip that is taken at its word."""
        return KnownTip(np.asarray(in_tcp, np.float64), np.zeros((3, 3)), ball_m)


@dataclass(frozen=True, eq=False)
class Touches:
    """Touched points: (n, 3) in the base frame, metres, and what touched."""

    points: Floats
    tip: Tip


def touched_points(session: Session, tip: KnownTip) -> Touches:
    """Where the tip was at each rest of a hand-guided session, or in each frame of a session that has
    frames; the arm at rest.

    Args:
        session: kind "touches".
        tip: that touched.

    Raises:
        CalibrationError: no robot trace, the arm moved at a touch, no touches at all, or the arm's tool
            setting is not the one that the tip was calibrated with.
    """
    _require_same_tool(session, tip)
    times, trace = arm_trace(session)
    poses: list[SE3] = []
    if len(session) == 0 and session.robot is not None:
        poses = [rest.T_base_tcp for rest in find_rests(session.robot)]
    for index in range(len(session)):
        pose = rest_pose(times, trace, int(session.mid_exposure_host_ns[index]))
        if pose is None:
            raise CalibrationError(
                f"{session.path}: the arm was moving at touch {index}; hold the tip still for half a second"
                " a touch"
            )
        poses.append(pose)
    if not poses:
        raise CalibrationError(
            f"{session.path}: the arm was never held still, so nothing was touched; rest for a second on"
            " every point"
        )
    at = SE3.stack(poses)
    return Touches(at.apply(tip.in_tcp), Tip(tip.ball_m, tip.covariance, at.rotation))


def tool_tip_from_session(session: Session) -> ToolTipResult:
    """The tip from a session in which it stayed on one point while the arm was tilted.

    The rests of the arm count; where it was swung without a rest, poses two degrees apart.

    Raises:
        CalibrationError: touched points instead of a pivot, no robot trace, or as `calibrate_tool_tip`.
    """
    if session.kind == "touches":
        raise CalibrationError(
            f"{session.path} holds points touched on an object; record the tip on one fixed point with"
            " `s2p3 capture tool-tip`"
        )
    _, trace = arm_trace(session)
    assert session.robot is not None
    rests = [rest.T_base_tcp for rest in find_rests(session.robot)]
    if len(rests) >= MIN_POSES:
        return calibrate_tool_tip(SE3.stack(rests))
    try:
        return calibrate_tool_tip(_thinned(trace))
    except CalibrationError as error:
        raise CalibrationError(
            f"{error} (the arm was held still {len(rests)} times, fewer than {MIN_POSES}, so the whole way"
            " was taken)"
        ) from error


def _thinned(trace: SE3) -> SE3:
    """Poses of a trace that lie two degrees apart at least."""
    kept = [0]
    for index in range(1, len(trace)):
        cosine = (np.vdot(trace.rotation[index], trace.rotation[kept[-1]]) - 1) / 2
        if cosine < np.cos(_PIVOT_STEP_RAD):
            kept.append(index)
    return trace[np.array(kept)]


def _require_same_tool(session: Session, tip: KnownTip) -> None:
    if tip.tcp_offset is None or session.tcp_offset is None:
        return
    if np.abs(tip.tcp_offset - session.tcp_offset).max() > _SAME_TOOL_M:
        raise CalibrationError(
            f"{session.path}: recorded with another tool setting of the arm ({_six(session.tcp_offset)}) than"
            f" the tip was calibrated with ({_six(tip.tcp_offset)}); set [robot] tcp_offset alike and record"
            " again"
        )


def _six(pose: Floats) -> str:
    return " ".join(f"{value:g}" for value in pose)


def read_points(path: str | Path) -> Floats:
    """(n, 3) points of a text file: x y z a line (spaces or commas), metres, '#' starts a comment.

    Raises:
        CalibrationError: missing, not numbers, or not three a line.
    """
    try:
        text = Path(path).read_text(encoding="utf-8").replace(",", " ")
        rows = [line.split("#")[0].split() for line in text.splitlines()]
        points = np.array([[float(value) for value in row] for row in rows if row])
    except (OSError, ValueError) as error:
        raise CalibrationError(
            f"{path}: cannot be read as points ({str(error).splitlines()[0]}); give x y z a line, in metres"
        ) from error
    if points.ndim != 2 or points.shape[1] != 3:
        raise CalibrationError(f"{path}: not three numbers a line; give x y z in metres, base frame")
    return points
