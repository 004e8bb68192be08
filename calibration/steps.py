"""Calibration as a lab does it, a step at a time: read a session, add the result to calibration.json, write
its report.

The report of a step lies beside the calibration: calibration.json gets calibration-intrinsics.html and so on.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from calibration.board import BoardSpec
from calibration.closed_forms import Mount
from calibration.next_pose import NextPose, next_pose
from calibration.records import (
    FixedCameraRecord,
    HandEyeRecord,
    IntrinsicsRecord,
    Source,
    TimeOffsetRecord,
)
from calibration.report import ViewPicture, calibration_report
from calibration.resampling import Intervals, bootstrap
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
from calibration.view_selection import select_views
from dataset.session import Session

_PICTURES = 3


def add_intrinsics(
    session: Path, spec: BoardSpec, calibration: Path, on_progress: Progress | None = None
) -> IntrinsicsRecord:
    """Estimates K and distortion from stills of the board. What was estimated with other intrinsics goes:
    hand-eye and time offset; polarizers, tool tip and objects stay.

    Raises:
        CalibrationError: as `intrinsics_from_session`.
        SessionError: the session cannot be read.
    """
    with Session.open(session) as opened:
        found = detect_session(opened, spec, on_progress)
        found = [found[i] for i in select_views([d for _, d in found], spec)]
        result = intrinsics_from_session(opened, spec, found)
        pictures = _pictures(opened, found)
    record = IntrinsicsRecord.of(result, (Source.of(session),))
    known = Calibration.load(calibration) if calibration.exists() else Calibration()
    replace(known, board=spec, intrinsics=record, hand_eye=None, time_offset=None).save(calibration)
    html = calibration_report(spec, intrinsics=result, pictures=pictures, subtitle=str(session))
    report_path(calibration, "intrinsics").write_text(html, encoding="utf-8")
    return record


@dataclass(frozen=True, eq=False)
class HandEyeStep:
    """What was added, its 95 % bootstrap intervals, and the view to take next for a better one."""

    record: HandEyeRecord | FixedCameraRecord
    intervals: Intervals
    advice: NextPose


def add_hand_eye(
    session: Path,
    spec: BoardSpec,
    calibration: Path,
    on_progress: Progress | None = None,
    mount: Mount = "eye_in_hand",
) -> HandEyeStep:
    """Estimates T_tcp_cam and T_base_board from stills of the board; of a fixed camera (eye to hand),
    T_base_cam and T_tcp_board.

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
        result = hand_eye_from_session(opened, spec, known.intrinsics, views, mount)
        pictures = _pictures(opened, views)
    sources = (Source.of(session),)
    record: HandEyeRecord | FixedCameraRecord
    if mount == "eye_in_hand":
        record = HandEyeRecord.of(result, sources)
        known.merged(Calibration(board=spec, hand_eye=record)).save(calibration)
    else:
        record = FixedCameraRecord.of(result, sources)
        known.merged(Calibration(board=spec, fixed_camera=record)).save(calibration)
    step = HandEyeStep(record, bootstrap(result), next_pose(result, spec))
    html = calibration_report(
        spec, hand_eye=result, pictures=pictures, subtitle=str(session), intervals=step.intervals
    )
    report_path(calibration, "hand-eye").write_text(html, encoding="utf-8")
    return step


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


def report_path(calibration: Path, step: str) -> Path:
    """Where the report of a step lies."""
    return calibration.with_name(f"{calibration.stem}-{step}.html")


def _pictures(session: Session, views: Detections) -> list[ViewPicture]:
    """A few of a result's views, spread over the session, to draw their corners on."""
    chosen = np.unique(np.linspace(0, len(views) - 1, _PICTURES).astype(int))
    return [ViewPicture(session.mosaic(views[view][0]), session.camera.mosaic, int(view)) for view in chosen]
