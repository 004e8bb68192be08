"""The file beside calibration.json that holds the analysis vector of every pixel: a plain .npz, no pickle."""

from __future__ import annotations

import hashlib
import zipfile
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from calibration.records import PolarizerRecord
from dataset.errors import CalibrationError
from dataset.polarizer_response import PolarizerResponse
from dataset.whole_files import replacing


def write_response(calibration: Path, response: PolarizerResponse) -> tuple[Path, str]:
    """Writes it for the calibration.json at a path: calibration-polarizer.npz, with the array `analysis`
    (H, W, 3) float32; returns the file and its digest.

    Raises:
        CalibrationError: the file cannot be written.
    """
    path = calibration.with_name(f"{calibration.stem}-polarizer.npz")
    try:
        with replacing(path) as partial, partial.open("wb") as stream:
            np.savez(stream, analysis=response.analysis)
    except OSError as error:
        raise CalibrationError(
            f"{path}: cannot be written ({error.strerror}); check the folder exists, is writable and has room"
        ) from error
    return path, _digest(response.analysis)


def read_response(record: PolarizerRecord) -> PolarizerResponse:
    """Reads what `write_response` wrote.

    Raises:
        CalibrationError: the file is missing, damaged, or another one.
    """
    if record.folder is None:
        raise CalibrationError(
            f"calibration: {record.file} cannot be found without the folder it lies in; load calibration.json"
            " from its file"
        )
    path = record.folder / record.file
    try:
        with np.load(path, allow_pickle=False) as content:
            analysis = np.asarray(content["analysis"], np.float32)
    except (OSError, KeyError, ValueError, zipfile.BadZipFile) as error:
        raise CalibrationError(
            f"{path}: cannot be read ({str(error).splitlines()[0]}); it belongs beside calibration.json: copy"
            " both, or run `s2p3 calibrate polarizer` again"
        ) from error
    if _digest(analysis) != record.sha256:
        raise CalibrationError(
            f"{path}: is not the file that calibration.json was written with; copy both together, or run"
            " `s2p3 calibrate polarizer` again"
        )
    return PolarizerResponse(analysis)


def _digest(analysis: NDArray[np.float32]) -> str:
    return hashlib.sha256(np.ascontiguousarray(analysis, "<f4").tobytes()).hexdigest()
