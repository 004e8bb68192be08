"""Points touched with the arm's tip: from recorded sessions and text files to an object's pose."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike, NDArray

from calibration.object_pose import ObjectPoseResult, register_points
from calibration.sessions import arm_trace, rest_pose
from dataset.errors import CalibrationError
from dataset.rests import find_rests
from dataset.session import Session
from dataset.transforms import SE3

Floats = NDArray[np.float64]


def object_from_touches(
    touches: Session | str | Path,
    vertices: ArrayLike,
    faces: ArrayLike,
    tip_in_tcp: ArrayLike = (0.0, 0.0, 0.0),
    init: SE3 | None = None,
    symmetry_axis: ArrayLike | None = None,
) -> ObjectPoseResult:
    """The pose of an object in the base frame from touched points.

    Args:
        touches: a session of kind "tool_tip" (the arm at rest with the tip on the surface, see
            `touched_points`), or a text file of points: x y z a line, metres in the base frame, '#' starts a
            comment.
        vertices, faces: (V, 3) metres, (F, 3): the object.
        tip_in_tcp: (3,) the tip in the tool's frame, metres; only used with a session.
        init, symmetry_axis: as in `register_points`.

    Raises:
        CalibrationError: as `register_points`, or no readable points.
    """
    if isinstance(touches, Session):
        points = touched_points(touches, tip_in_tcp)
    else:
        points = read_points(touches)
    return register_points(points, vertices, faces, init, symmetry_axis)


def touched_points(session: Session, tip_in_tcp: ArrayLike) -> Floats:
    """(n, 3) where the tool's tip was, in the base frame, at each rest of a hand-guided session, or in each
    frame of a session that has frames; the arm at rest.

    Raises:
        CalibrationError: no robot trace, or the arm moved at a touch.
    """
    times, trace = arm_trace(session)
    points: list[Floats] = []
    if len(session) == 0 and session.robot is not None:
        points = [rest.T_base_tcp.apply(tip_in_tcp) for rest in find_rests(session.robot)]
    for index in range(len(session)):
        pose = rest_pose(times, trace, int(session.mid_exposure_host_ns[index]))
        if pose is None:
            raise CalibrationError(
                f"{session.path}: the arm was moving at touch {index}; hold the tip still for half a second"
                " a touch"
            )
        points.append(pose.apply(np.asarray(tip_in_tcp, np.float64)))
    return np.array(points).reshape(-1, 3)


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
