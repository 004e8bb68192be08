"""The undistorted Stokes images of a session, decoded once: a memory-mapped array beside the file.

The array `.NAME.stokes-HASH.npy` holds half-precision floats (N, h, w, 3) in the order S0, S1, S2: 11 bits of
mantissa, and finer near zero, where S1 and S2 live, than the 12 bits of the sensor. The hash covers all that
the images depend on, so that a session that was recalibrated or changed gets a new array and the old one
goes.
"""

from __future__ import annotations

import hashlib
import io
import math
import shutil
from dataclasses import astuple
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dataset.errors import SessionError
from dataset.progress import Progress, silent
from dataset.session import Session
from dataset.whole_files import replacing

_VERSION = 1
"""Of the decoding and of this layout: raise it when either changes."""


def cached_stokes(path: str | Path, on_progress: Progress = silent) -> NDArray[np.float16]:
    """(N, h, w, 3) read-only, memory-mapped Stokes images of a session; made on the first call.

    Two processes that call it at once both make it, and the second result replaces the first, which is the
    same. Reading from it needs no lock and works in any number of processes.

    Raises:
        SessionError: the session is not calibrated or damaged, or the array cannot be written beside it.
    """
    path = Path(path)
    with Session.open(path) as session:
        target = cache_path(session)
        if not target.exists() or target.stat().st_size != _size(session):  # a copy cut short, for one
            _make(session, target, on_progress)
    for stale in path.parent.glob(f".{path.name}.stokes-*.npy"):
        if stale != target:
            stale.unlink(missing_ok=True)
    found: NDArray[np.float16] = np.load(target, mmap_mode="r", allow_pickle=False)
    return found


def cache_path(session: Session) -> Path:
    """Where the array of a session is or would be."""
    return session.path.with_name(f".{session.path.name}.stokes-{images_hash(session)[:16]}.npy")


def images_hash(session: Session) -> str:
    """A hash of all that the undistorted Stokes images of a session depend on: its frames' checksums, its
    camera and that one's calibration, and how they are decoded."""
    digest = hashlib.sha256(f"{_VERSION} {session.session_id} {astuple(session.camera)}".encode())
    digest.update(session.contents.read("camera/crc32", slice(len(session))).tobytes())
    camera, response = session.intrinsics, session.polarizer_response
    parts: list[NDArray[Any]] = [] if camera is None else [camera.K, camera.distortion]
    for part in parts if response is None else [*parts, response.analysis]:
        digest.update(part.tobytes() + b"|")
    return digest.hexdigest()


def _shape(session: Session) -> tuple[int, int, int, int]:
    return (len(session), *session.camera.working_size, 3)


def _header(session: Session) -> bytes:
    stream = io.BytesIO()
    layout = {"descr": "<f2", "fortran_order": False, "shape": _shape(session)}
    np.lib.format.write_array_header_1_0(stream, layout)
    return stream.getvalue()


def _size(session: Session) -> int:
    """Bytes of the array's file."""
    return len(_header(session)) + 2 * math.prod(_shape(session))


def _make(session: Session, target: Path, on_progress: Progress) -> None:
    size = _size(session)
    if shutil.disk_usage(target.parent).free < size + (1 << 28):
        raise SessionError(
            f"{session.path}: its decoded images need {size / 1e9:.1f} GB beside it; make room, or copy the "
            "session to a larger disk"
        )
    try:
        # written, not mapped: a disk that fills up meanwhile is then an error, not a crash
        with replacing(target) as partial, partial.open("wb") as stream:
            stream.write(_header(session))
            for index in range(len(session)):
                image = np.moveaxis(session.stokes(index).stack(), 0, -1)
                stream.write(np.ascontiguousarray(image, "<f2").data)
                on_progress(index + 1, len(session))
    except OSError as error:
        raise SessionError(
            f"{session.path}: its decoded images cannot be written beside it ({error.strerror}); copy the "
            "session to a folder that may be written to, on a disk with room"
        ) from error
