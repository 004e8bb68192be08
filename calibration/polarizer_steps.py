"""The polarizers' calibration as a lab does it: read the session, add to calibration.json, report."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import overload

import numpy as np

from calibration.polarizer import PolarizerResult, calibrate_polarizer
from calibration.polarizer_report import polarizer_section
from calibration.records import PolarizerRecord, Source
from calibration.response_file import write_response
from calibration.result import Calibration
from calibration.steps import write_report
from dataset.polarimetry import Raw
from dataset.progress import Progress, silent
from dataset.session import Session


def add_polarizer(
    session: Path,
    calibration: Path,
    extinction_ratio: float = np.inf,
    on_progress: Progress = silent,
) -> PolarizerRecord:
    """Estimates the response of every pixel from a session of kind "polarizer".

    Args:
        session: frames of an even lamp behind a linear polarizer that was turned.
        calibration: file to add the result to; made when there is none. The analysis vectors are stored
            beside it.
        extinction_ratio: of the turned polarizer.

    Raises:
        CalibrationError: the intrinsics are of another camera; as `calibrate_polarizer`.
        SessionError: the session cannot be read.
    """
    known = Calibration.load_or_new(calibration)
    with Session.open(session) as opened:
        camera = opened.camera
        if known.intrinsics is not None:
            known.intrinsics.require_camera(camera, str(session))
        result = polarizer_from_session(opened, extinction_ratio, on_progress)
    file, digest = write_response(calibration, result.response)
    record = PolarizerRecord.of(result, camera, file, digest, (Source.of(session),))
    known.merged(Calibration(polarizer=record)).save(calibration)
    write_report(calibration, "polarizer", str(session), [polarizer_section(result)])
    return record


def polarizer_from_session(
    session: Session, extinction_ratio: float = np.inf, on_progress: Progress = silent
) -> PolarizerResult:
    """The response from a session's frames, at the dial's angles where they were recorded.

    Raises:
        CalibrationError: as `calibrate_polarizer`.
    """
    return calibrate_polarizer(
        _Frames(session),
        session.camera.mosaic,
        session.camera.bits,
        session.polarizer_angles,
        extinction_ratio,
        on_progress,
    )


class _Frames(Sequence[Raw]):
    """A session's raw mosaics, each read when asked for."""

    def __init__(self, session: Session) -> None:
        self._session = session

    def __len__(self) -> int:
        return len(self._session)

    @overload
    def __getitem__(self, index: int) -> Raw: ...

    @overload
    def __getitem__(self, index: slice) -> Sequence[Raw]: ...

    def __getitem__(self, index: int | slice) -> Raw | Sequence[Raw]:
        if isinstance(index, slice):
            return [self._session.mosaic(i) for i in range(len(self))[index]]
        return self._session.mosaic(index)
