"""Calibration as a lab does it, a step at a time: read a session, add the result to calibration.json, write
its report.

The report of a step lies beside the calibration: calibration.json gets calibration-intrinsics.html and so on.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike

from calibration.board import BoardSpec
from calibration.object_pose import register_points
from calibration.records import (
    HandEyeRecord,
    IntrinsicsRecord,
    ObjectPoseRecord,
    Source,
    TimeOffsetRecord,
)
from calibration.report import TouchedObject, ViewPicture, calibration_report
from calibration.result import Calibration
from calibration.sessions import (
    Detections,
    Progress,
    detect_session,
    hand_eye_from_session,
    intrinsics_from_session,
    time_offset_from_session,
    views_at_rest,
)
from calibration.touches import read_points, touched_points
from dataset.session import Session

_PICTURES = 3


def add_intrinsics(
    session: Path, spec: BoardSpec, calibration: Path, on_progress: Progress | None = None
) -> IntrinsicsRecord:
    """Estimates K and distortion from stills of the board. A calibration made with other intrinsics starts
    over.

    Raises:
        CalibrationError: as `intrinsics_from_session`.
        SessionError: the session cannot be read.
    """
    with Session.open(session) as opened:
        found = detect_session(opened, spec, on_progress)
        result = intrinsics_from_session(opened, spec, found)
        pictures = _pictures(opened, found)
    record = IntrinsicsRecord.of(result, (Source.of(session),))
    Calibration(board=spec, intrinsics=record).save(calibration)
    html = calibration_report(spec, intrinsics=result, pictures=pictures, subtitle=str(session))
    report_path(calibration, "intrinsics").write_text(html, encoding="utf-8")
    return record


def add_hand_eye(
    session: Path, spec: BoardSpec, calibration: Path, on_progress: Progress | None = None
) -> HandEyeRecord:
    """Estimates T_tcp_cam and T_base_board from stills of the board.

    Raises:
        CalibrationError: no intrinsics yet; as `hand_eye_from_session`.
        SessionError: the session cannot be read.
    """
    known = Calibration.load(calibration)
    known.require("intrinsics")
    assert known.intrinsics is not None
    with Session.open(session) as opened:
        found = detect_session(opened, spec, on_progress)
        views, _ = views_at_rest(opened, found)  # the result counts these, not all that show the board
        result = hand_eye_from_session(opened, spec, known.intrinsics, views)
        pictures = _pictures(opened, views)
    record = HandEyeRecord.of(result, (Source.of(session),))
    known.merged(Calibration(board=spec, hand_eye=record)).save(calibration)
    html = calibration_report(spec, hand_eye=result, pictures=pictures, subtitle=str(session))
    report_path(calibration, "hand-eye").write_text(html, encoding="utf-8")
    return record


def add_time_offset(
    session: Path, spec: BoardSpec, calibration: Path, on_progress: Progress | None = None
) -> TimeOffsetRecord:
    """Estimates the delay between the camera's and the arm's time from the board filmed in motion.

    Raises:
        CalibrationError: no intrinsics or hand-eye yet; as `time_offset_from_session`.
        SessionError: the session cannot be read.
    """
    known = Calibration.load(calibration)
    known.require("intrinsics", "hand_eye")
    assert known.intrinsics is not None
    assert known.hand_eye is not None
    with Session.open(session) as opened:
        found = detect_session(opened, spec, on_progress)
        result = time_offset_from_session(opened, spec, known.intrinsics, known.hand_eye, found)
    record = TimeOffsetRecord.of(result, (Source.of(session),))
    known.merged(Calibration(time_offset=record)).save(calibration)
    html = calibration_report(spec, time_offset=result, subtitle=str(session))
    report_path(calibration, "time-offset").write_text(html, encoding="utf-8")
    return record


def add_object(
    touches: Path,
    tip_in_tcp: ArrayLike,
    name: str,
    vertices: ArrayLike,
    faces: ArrayLike,
    calibration: Path,
    symmetry_axis: ArrayLike | None = None,
) -> ObjectPoseRecord:
    """Estimates an object's pose in the base frame from points touched with the tip.

    Args:
        touches: a session of kind "tool_tip", or a text file of points in the base frame.
        tip_in_tcp: (3,) the tip in the tool's frame, metres; used with a session.
        name: of the object.
        vertices, faces: its mesh, (V, 3) metres and (F, 3).
        calibration: file to add the result to; made when there is none.
        symmetry_axis: (3,) of a body of revolution.

    Raises:
        CalibrationError: as `object_from_touches`.
        SessionError: the session cannot be read.
    """
    if touches.suffix in (".h5", ".hdf5"):
        with Session.open(touches) as opened:
            points = touched_points(opened, tip_in_tcp)
    else:
        points = read_points(touches)
    result = register_points(points, vertices, faces, symmetry_axis=symmetry_axis)
    record = ObjectPoseRecord.of(result, (Source.of(touches),))
    known = Calibration.load(calibration) if calibration.exists() else Calibration()
    known.merged(Calibration(objects={name: record})).save(calibration)
    touched = TouchedObject(result, points, vertices, faces)
    html = calibration_report(known.board, objects={name: touched}, subtitle=str(touches))
    report_path(calibration, f"object-{name}").write_text(html, encoding="utf-8")
    return record


def report_path(calibration: Path, step: str) -> Path:
    """Where the report of a step lies."""
    return calibration.with_name(f"{calibration.stem}-{step}.html")


def _pictures(session: Session, views: Detections) -> list[ViewPicture]:
    """A few of a result's views, spread over the session, to draw their corners on."""
    chosen = np.unique(np.linspace(0, len(views) - 1, _PICTURES).astype(int))
    return [ViewPicture(session.raw(views[view][0]), session.camera.mosaic, int(view)) for view in chosen]
