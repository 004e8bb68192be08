"""Going on with a session that was interrupted: what must fit, and where the new segment begins."""

from __future__ import annotations

from datetime import datetime, timezone
from pathlib import Path

import h5py
import numpy as np

from dataset.errors import SessionError
from dataset.frames import CameraInfo
from dataset.schema import CAMERA_ATTRIBUTES, FRAME_COLUMNS, ROBOT_COLUMNS, SEGMENT_DTYPE
from dataset.session.files import attribute, closed_on_failure, open_for_editing, open_to_write
from dataset.session.seals import reopen

GROWING: tuple[str, ...] = (
    "camera/crc32",
    "camera/drops",
    "camera/pauses",
    *(f"camera/{name}" for name in FRAME_COLUMNS),
    *(f"robot/{name}" for name in ROBOT_COLUMNS),
    "clocks/camera_pieces",
    "clocks/robot_pieces",
    "segments",
)
"""Datasets that grow while a session of any kind is recorded, beside the frames themselves."""

BEGINNING: tuple[tuple[str, int], ...] = (
    ("robot/tcp_offset", 6),
    ("robot/payload", 4),
    ("clocks/camera", 3),
    ("clocks/robot", 3),
)
"""Datasets of a fixed size that are filled while a session is recorded, and their sizes."""

_COMPUTED = ("poses", "splits", "depth")
_BOOT_ID = Path("/proc/sys/kernel/random/boot_id")


def growing(kind: str) -> tuple[str, ...]:
    """Datasets that grow while a session of this kind is recorded, beside the frames themselves."""
    return (*GROWING, "polarizer/angle") if kind == "polarizer" else GROWING


def host_boot_id() -> str:
    """Which start of this computer its monotonic clock counts from; empty where that cannot be told."""
    return _BOOT_ID.read_text().strip() if _BOOT_ID.exists() else ""


def open_to_continue(path: Path, kind: str, camera: CameraInfo) -> h5py.File:
    """Opens a complete session so that a recording can go on in it.

    Raises:
        SessionError: it is missing, in use or incomplete, or the recording does not fit it; says why.
    """
    with open_for_editing(path) as file:
        reason = _why_not(file, kind, camera)
    if reason is not None:
        raise SessionError(f"{path}: nothing can be appended, {reason}; record to a new file")
    file = open_to_write(path)
    with closed_on_failure(path, file):
        for name in (*growing(kind), *(name for name, _ in BEGINNING)):
            reopen(file[name])
        file.flush()
    return file


def begin_segment(file: h5py.File, first_frame: int, first_sample: int) -> None:
    """Enters into an open file that an uninterrupted recording begins with these rows."""
    begun = datetime.now(timezone.utc).isoformat(timespec="seconds").encode()
    segments = file["segments"]
    count = len(segments)
    segments.resize(count + 1, axis=0)
    segments[count:] = np.array([(first_frame, first_sample, begun)], SEGMENT_DTYPE)
    file.flush()


def _why_not(file: h5py.File, kind: str, camera: CameraInfo) -> str | None:
    if attribute(file, "kind") != kind:
        return f"it is of kind {attribute(file, 'kind')}, the new recording of kind {kind}"
    for name in (declared.name for declared in CAMERA_ATTRIBUTES if declared.name != "packet_size"):
        found, expected = attribute(file["camera"], name), getattr(camera, name)
        if found != expected:
            return f"its camera has {name} {found}, this one {expected}"
    if not host_boot_id() or attribute(file, "host_boot_id") != host_boot_id():
        return "it was recorded before this computer was restarted, on another one or by an older toolkit"
    if any(name not in file for name in (*growing(kind), *(name for name, _ in BEGINNING))):
        return "it was written by an older toolkit"
    computed = [name for name in _COMPUTED if name in file]
    if computed:
        return f"it holds {' and '.join(computed)} of the frames recorded so far"
    return None
