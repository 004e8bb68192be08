"""Saving what a killed writer, a full disk or a bad copy left of a session."""

from __future__ import annotations

import os
import shutil
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from datetime import datetime, timezone
from pathlib import Path

import h5py
import numpy as np
from numpy.typing import NDArray

from dataset.compression import checksum
from dataset.errors import SessionError
from dataset.progress import Progress, silent
from dataset.schema import FRAME_COLUMNS
from dataset.session.clock_store import fit_stored
from dataset.session.files import (
    LIBVER,
    READ_ERRORS,
    attribute,
    changing,
    check_format,
    in_use,
    open_hdf5,
    open_healed,
)
from dataset.session.seals import seal
from dataset.validate.salvage import copy_content


@dataclass(frozen=True)
class RepairResult:
    """What a repair did.

    Attributes:
        path: of the file.
        changed: False when there was nothing to repair.
        frames: intact frames the file holds now.
        damaged_ids: frame ids whose pixels were lost; they are in the ledger now.
        lost: paths inside the file that could not be read and are gone.
    """

    path: Path
    changed: bool
    frames: int
    damaged_ids: tuple[int, ...]
    lost: tuple[str, ...]

    def __str__(self) -> str:
        if not self.changed:
            return f"{self.path}: nothing to repair, {self.frames} frames"
        text = f"{self.path}: repaired, {self.frames} frames"
        if self.damaged_ids:
            text += (
                f"; {len(self.damaged_ids)} damaged ones are in the ledger now: {_first(self.damaged_ids)}"
            )
        return text + (f"; lost: {_first(self.lost)}" if self.lost else "")


def repair(path: str | Path, on_progress: Progress = silent) -> RepairResult:
    """Restores every frame that had reached the disk and marks the session complete.

    The intact content goes to a new file that replaces the old one in a single step, so that an interrupted
    repair leaves the original as it was; a file that only lacks its mark of completeness gets that. Frames
    whose pixels do not match their checksum move to the ledger.

    Args:
        path: of the session.
        on_progress: called with (frames checked, frames in all).

    Raises:
        SessionError: in use by another program, beyond repair, or too little disk space for the copy.
    """
    path = Path(path)
    if not path.is_file():
        raise SessionError(f"{path} does not exist, or is no file; check the path")
    if in_use(path):
        raise SessionError(f"{path} is in use by another program; repair it when that has ended")
    copy = path.with_name(path.name + ".repairing")
    try:
        with _readable(path) as (file, clean):
            check_format(path, file)
            keep, damaged = _intact_frames(path, file, on_progress)
            ids = tuple(int(i) for i in file["camera/frame_id"][: len(keep) + len(damaged)][damaged])
            note = _note(len(keep), len(damaged))
            whole = clean and not ids and len(file["camera/raw"]) == len(keep) == _angles(file, len(keep))
            if whole and attribute(file, "complete"):
                return RepairResult(path, False, len(keep), (), ())
            ended = clean and bool(attribute(file, "complete"))
            lost = () if whole else _copy(path, file, copy, keep, damaged, note, ended)
        if whole:
            with changing(path) as file:
                fit_stored(file)
                seal(file)  # first: a file that is called complete is sealed
                file.attrs.update({"complete": True, "repaired": note})
        else:
            os.replace(copy, path)
    finally:
        copy.unlink(missing_ok=True)
    return RepairResult(path, True, len(keep), ids, lost)


def _first(names: Sequence[object]) -> str:
    shown = ", ".join(map(str, names[:8]))
    return shown if len(names) <= 8 else f"{shown} and {len(names) - 8} more"


@contextmanager
def _readable(path: Path) -> Iterator[tuple[h5py.File, bool]]:
    """The file opened by whatever means work, and whether it had been closed cleanly."""
    try:
        file, unfinished = open_hdf5(path)
    except SessionError:
        file, unfinished = open_healed(path), True
    with file:
        yield file, not unfinished


def _intact_frames(
    path: Path, file: h5py.File, on_progress: Progress
) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Indices of the frames whose pixels match their checksum, and of those that do not."""
    try:
        raw = file["camera/raw"]
        columns = {name: file[f"camera/{name}"][:] for name in ("crc32", *FRAME_COLUMNS)}
        count = min(len(raw), *(len(column) for column in columns.values()))
    except READ_ERRORS as error:
        raise SessionError(
            f"{path} is beyond repair: its list of frames is lost ({error}); use a copy"
        ) from error
    intact = np.zeros(count, dtype=bool)
    for index in range(count):
        try:
            intact[index] = checksum(raw[index]) == int(columns["crc32"][index])
        except READ_ERRORS:
            intact[index] = False
        on_progress(index + 1, count)
    return np.flatnonzero(intact), np.flatnonzero(~intact)


def _angles(file: h5py.File, frames: int) -> int:
    """Frames that have their polarizer angle, unknown ones included; all, where no polarizer was turned."""
    try:
        return len(file["polarizer/angle"]) if "polarizer" in file else frames
    except READ_ERRORS:
        return 0


def _copy(
    path: Path,
    file: h5py.File,
    copy: Path,
    keep: NDArray[np.int64],
    damaged: NDArray[np.int64],
    note: str,
    ended: bool,
) -> tuple[str, ...]:
    """Copies what can be read; where the recording had not `ended`, its clocks are fitted to all of it."""
    if shutil.disk_usage(path.parent).free < path.stat().st_size:
        raise SessionError(
            f"{path}: the repaired copy needs {path.stat().st_size / 1e9:.1f} GB of free disk space beside "
            "it; make room and repeat"
        )
    try:
        for node in (file, file["camera"]):
            dict(node.attrs)
    except READ_ERRORS as error:
        raise SessionError(
            f"{path} is beyond repair: the description of its frames is lost ({error}); use a copy"
        ) from error
    try:
        with h5py.File(copy, "w", libver=LIBVER) as out:
            lost = copy_content(file, out, keep, damaged)
            if not ended:
                fit_stored(out)
            seal(out)
            out.attrs.update({"complete": True, "repaired": note})
        with copy.open("rb") as stream:
            os.fsync(stream.fileno())
    except (OSError, RuntimeError) as error:
        raise SessionError(
            f"{path}: the repaired copy cannot be written ({error}); free disk space"
        ) from error
    return lost


def _note(kept: int, damaged: int) -> str:
    now = datetime.now(timezone.utc).isoformat(timespec="seconds")
    return f"{now}: {kept} frames kept, {damaged} damaged"
