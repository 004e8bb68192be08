"""Tool tip and touched objects as a lab does it: read sessions, add to calibration.json, report."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike

from calibration.fusion import fuse_poses
from calibration.object_observability import Tip
from calibration.object_pose import ObjectPoseResult, register_points
from calibration.records import ObjectPoseRecord, Source, ToolTipRecord
from calibration.result import Calibration
from calibration.steps import write_report
from calibration.touch_report import TouchedObject, object_section, tool_tip_section
from calibration.touches import KnownTip, Touches, read_points, tool_tip_from_session, touched_points
from dataset.errors import CalibrationError
from dataset.schema import SUFFIXES
from dataset.session import Session
from dataset.transforms import SE3


def add_tool_tip(session: Path, calibration: Path) -> ToolTipRecord:
    """Estimates where the tip is in the tool's frame, from a session of kind "tool_tip".

    Args:
        session: in which the tip stayed on one point while the tool was tilted.
        calibration: file to add the result to; made when there is none.

    Raises:
        CalibrationError: as `tool_tip_from_session`.
        SessionError: the session cannot be read.
    """
    with Session.open(session) as opened:
        result = tool_tip_from_session(opened)
        record = ToolTipRecord.of(result, opened.tcp_offset, (Source.of(session),))
    Calibration.load_or_new(calibration).merged(Calibration(tool_tip=record)).save(calibration)
    write_report(calibration, "tool-tip", str(session), [tool_tip_section(result)])
    return record


def known_tip(calibration: Path, guess: ArrayLike | None, ball_m: float = 0.0) -> KnownTip:
    """The tip as calibrated, or else a guess taken at its word.

    Raises:
        CalibrationError: the tip was not calibrated, and there is no guess.
    """
    record = Calibration.load_or_new(calibration).tool_tip
    if record is not None:
        offset = record.tcp_offset if len(record.tcp_offset) else None
        return KnownTip(record.tip_in_tcp, record.covariance, ball_m, offset)
    if guess is None:
        raise CalibrationError(
            f"{calibration}: the tool tip is not calibrated; run `s2p3 calibrate tool-tip`, or give --rig,"
            " whose [frames] T_tcp_tip says where it is"
        )
    return KnownTip.exactly(guess, ball_m)


def add_object(
    touches: Path | Sequence[Path],
    name: str,
    vertices: ArrayLike,
    faces: ArrayLike,
    calibration: Path,
    symmetry_axis: ArrayLike | None = None,
    tip: KnownTip | None = None,
    symmetry_turns: SE3 | None = None,
) -> ObjectPoseRecord:
    """Estimates an object's pose in the base frame from points touched with the tip.

    Args:
        touches: sessions of kind "touches", or text files of points in the base frame; each gives a pose, and
            several are fused.
        name: of the object.
        vertices, faces: its mesh, (V, 3) metres and (F, 3).
        calibration: file to add the result to; made when there is none.
        symmetry_axis: (3,) of a body of revolution.
        tip: that touched; as calibrated when None. A file of points needs none.
        symmetry_turns: n other motions that leave the object looking the same.

    Raises:
        CalibrationError: as `register_points` and `fuse_poses`, or the tip is not known.
        SessionError: a session cannot be read.
    """
    paths = [touches] if isinstance(touches, Path) else list(touches)
    found = [_read(path, calibration, tip) for path in paths]
    results: list[ObjectPoseResult] = []
    for t in found:
        init = results[0].T_base_obj if results else None
        result = register_points(t.points, vertices, faces, init, symmetry_axis, t.tip, symmetry_turns)
        if init is not None and symmetry_turns is not None:
            result = result.turned_towards(init, symmetry_turns)
        results.append(result)
    sources = tuple(Source.of(path) for path in paths)
    record = _fused(results, sources, symmetry_axis)
    Calibration.load_or_new(calibration).merged(Calibration(objects={name: record})).save(calibration)
    sections = [
        object_section(name, TouchedObject(result, t.points, vertices, faces))
        for result, t in zip(results, found, strict=True)
    ]
    write_report(calibration, f"object-{name}", ", ".join(map(str, paths)), sections)
    return record


def _read(path: Path, calibration: Path, tip: KnownTip | None) -> Touches:
    if path.suffix not in SUFFIXES:
        return Touches(read_points(path), Tip(0.0 if tip is None else tip.ball_m))
    with Session.open(path) as opened:
        return touched_points(opened, known_tip(calibration, None) if tip is None else tip)


def _fused(
    results: Sequence[ObjectPoseResult], sources: tuple[Source, ...], symmetry_axis: ArrayLike | None
) -> ObjectPoseRecord:
    """One record from the results of one or more sessions. What one session leaves open another may not: only
    what all leave open stays. The tip's error is common to them and does not average out."""
    first = ObjectPoseRecord.of(results[0], sources)
    if len(results) == 1:
        return first
    tip = np.mean([r.tip_covariance for r in results], axis=0)
    fused = fuse_poses(
        SE3.stack([r.T_base_obj for r in results]),
        np.stack([r.covariance - r.tip_covariance for r in results]),
        symmetry_axis,
    )
    points = np.array([len(r.distance_m) for r in results])
    left_open = [w for w in results[0].unobservable if all(w in r.unobservable for r in results)]
    return replace(
        first,
        T_base_obj=fused.pose,
        covariance=fused.covariance + tip,
        rms_m=float(np.sqrt(np.average([r.rms_m**2 for r in results], weights=points))),
        points=int(points.sum()),
        unobservable=(*left_open, *results[0].rivals),  # the others were sought about the first
    )
