"""Calibration as a lab does it, a step at a time: read a session, add the result to calibration.json, write
its report.

The report of a step lies beside the calibration: calibration.json gets calibration-intrinsics.html and so on.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from calibration import html, remarks
from calibration.board import BoardSpec
from calibration.closed_forms import Mount
from calibration.hand_eye import HandEyeResult
from calibration.next_pose import NextPose, Reachable, next_pose
from calibration.records import (
    FixedCameraRecord,
    HandEyeRecord,
    IntrinsicsRecord,
    Source,
    TimeOffsetRecord,
)
from calibration.report import ViewPicture, hand_eye_section, intrinsics_section, time_offset_section
from calibration.resampling import Intervals, bootstrap
from calibration.result import Calibration
from calibration.sessions import (
    Detections,
    detect_session,
    hand_eye_from_session,
    intrinsics_from_session,
    time_offset_from_session,
    views_at_rest,
)
from calibration.view_selection import select_views
from dataset.errors import CalibrationError
from dataset.progress import Progress, silent
from dataset.session import Session

_PICTURES = 3
_NO_PRIOR = 1e6
"""Times a covariance: as good as no knowledge, and still invertible."""


def add_intrinsics(
    session: Path, spec: BoardSpec, calibration: Path, on_progress: Progress = silent
) -> IntrinsicsRecord:
    """Estimates K and distortion from stills of the board. What was estimated with other intrinsics goes:
    hand-eye, the fixed camera's place and the time offset, and another camera's polarizers; tool tip and
    objects stay.

    Raises:
        CalibrationError: as `intrinsics_from_session`.
        SessionError: the session cannot be read.
    """
    known = Calibration.load_or_new(calibration)
    with Session.open(session) as opened:
        found = detect_session(opened, spec, on_progress)
        found = [found[i] for i in select_views([d for _, d in found], spec)]
        result = intrinsics_from_session(opened, spec, found)
        pictures, camera = _pictures(opened, found), opened.camera
    frames = [index for index, _ in found]
    warnings = remarks.of_intrinsics(result, frames)
    record = IntrinsicsRecord.of(result, camera, (Source.of(session),), warnings)
    kept = replace(known, hand_eye=None, fixed_camera=None, time_offset=None)
    if known.polarizer is not None and known.polarizer.camera_serial not in (None, camera.serial):
        kept = replace(kept, polarizer=None)
    kept.merged(Calibration(board=spec, intrinsics=record)).save(calibration)
    section = intrinsics_section(result, frames, pictures, warnings)
    write_report(calibration, "intrinsics", str(session), [section], spec)
    return record


@dataclass(frozen=True, eq=False)
class HandEyeStep:
    """What was added, the intrinsics if they were refined, 95 % bootstrap intervals, and the view to take
    next; None where no further view of the board is within reach."""

    record: HandEyeRecord | FixedCameraRecord
    refined: IntrinsicsRecord | None
    intervals: Intervals
    advice: NextPose | None


def add_hand_eye(
    session: Path,
    spec: BoardSpec,
    calibration: Path,
    on_progress: Progress = silent,
    mount: Mount = "eye_in_hand",
    refine_camera: bool = False,
    reachable: Reachable | None = None,
) -> HandEyeStep:
    """Estimates T_tcp_cam and T_base_board from stills of the board; of a fixed camera (eye to hand),
    T_base_cam and T_tcp_board. Either takes the place of both: there is one camera.

    Args:
        session: stills of the board, the arm at rest.
        spec: the board.
        calibration: file with the intrinsics, to add the result to.
        on_progress: told of every frame searched for the board.
        mount: who carries the camera.
        refine_camera: refine the intrinsics with the transforms, and keep them.
        reachable: tells of K arm poses with the session's tool which (K,) the arm reaches; all by default.

    Raises:
        CalibrationError: no intrinsics yet; as `hand_eye_from_session`.
        SessionError: the session cannot be read.
    """
    known = Calibration.load(calibration)
    known.require("intrinsics")
    assert known.intrinsics is not None
    source = Source.of(session)
    prior = known.intrinsics
    if refine_camera and source in prior.sources:
        # The same pictures must not count twice.
        prior = replace(prior, covariance=_NO_PRIOR * prior.covariance)
    with Session.open(session) as opened:
        prior.require_camera(opened.camera, str(session))
        found = detect_session(opened, spec, on_progress)
        views, _ = views_at_rest(opened, found)  # the result counts these, not all that show the board
        views = [views[i] for i in select_views([d for _, d in views], spec)]
        result = hand_eye_from_session(opened, spec, prior, views, mount, refine_camera)
        pictures, tcp_offset = _pictures(opened, views), opened.tcp_offset
    frames = [index for index, _ in views]
    warnings = remarks.of_hand_eye(result, frames)
    refined = _refined(known.intrinsics, result, source)
    changed = Calibration(board=spec, intrinsics=refined)
    known = replace(known, hand_eye=None, fixed_camera=None)
    record: HandEyeRecord | FixedCameraRecord
    if mount == "eye_in_hand":
        record = HandEyeRecord.of(result, tcp_offset, (source,), warnings)
        known.merged(replace(changed, hand_eye=record)).save(calibration)
    else:
        record = FixedCameraRecord.of(result, (source,), warnings)
        known.merged(replace(changed, fixed_camera=record)).save(calibration)
    step = HandEyeStep(record, refined, bootstrap(result), _advice(result, spec, reachable))
    section = hand_eye_section(result, frames, pictures, step.intervals, step.advice, warnings)
    write_report(calibration, "hand-eye", str(session), [section], spec)
    return step


def _refined(before: IntrinsicsRecord, result: HandEyeResult, source: Source) -> IntrinsicsRecord | None:
    """The intrinsics that were refined with the transforms; None when they were not."""
    if result.intrinsics_covariance is None:
        return None
    return replace(
        before,
        intrinsics=result.intrinsics,
        covariance=result.intrinsics_covariance,
        rms_px=result.rms_px,
        held_out_px=float("nan"),
        sources=tuple(dict.fromkeys((*before.sources, source))),
    )


def _advice(result: HandEyeResult, spec: BoardSpec, reachable: Reachable | None) -> NextPose | None:
    try:
        return next_pose(result, spec, reachable)
    except CalibrationError:  # nothing to advise is no reason to lose the result
        return None


def add_time_offset(
    session: Path, spec: BoardSpec, calibration: Path, on_progress: Progress = silent
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
    if known.board is not None and known.board != spec:
        raise CalibrationError(
            f"{calibration}: hand-eye was calibrated with another board ({known.board}; this is {spec}); give"
            " the rig file it was calibrated with, or run `s2p3 calibrate hand-eye` again"
        )
    with Session.open(session) as opened:
        known.intrinsics.require_camera(opened.camera, str(session))
        found = detect_session(opened, spec, on_progress)
        result = time_offset_from_session(opened, spec, known.intrinsics, known.hand_eye, found)
    record = TimeOffsetRecord.of(result, (Source.of(session),))
    known.merged(Calibration(time_offset=record)).save(calibration)
    write_report(calibration, "time-offset", str(session), [time_offset_section(result)], spec)
    return record


def report_path(calibration: Path, step: str) -> Path:
    """Where the report of a step lies."""
    return calibration.with_name(f"{calibration.stem}-{step}.html")


def write_report(
    calibration: Path, step: str, source: str, sections: Sequence[str], board: BoardSpec | None = None
) -> None:
    """Writes the report of a step: what it came from, its HTML sections, and the board, if one was seen."""
    footer = "" if board is None else f"Board: {board}."
    page = html.page("Calibration report", source, sections, footer)
    report_path(calibration, step).write_text(page, encoding="utf-8")


def _pictures(session: Session, views: Detections) -> list[ViewPicture]:
    """A few of a result's views, spread over the session, to draw their corners on."""
    chosen = np.unique(np.linspace(0, len(views) - 1, _PICTURES).astype(int))
    return [ViewPicture(session.mosaic(views[view][0]), session.camera.mosaic, int(view)) for view in chosen]
