"""A session with some of another's frames."""

from __future__ import annotations

import re
import uuid
from pathlib import Path

import h5py
import numpy as np
from numpy.typing import ArrayLike, NDArray

from dataset.errors import SessionError
from dataset.schema import declared_at
from dataset.session import Session
from dataset.session.files import check_new, create_whole, open_for_reading
from dataset.session.seals import leave_open
from dataset.validate.salvage import copy_content

_SLICE = re.compile(r"((?:-?\d+)?):((?:-?\d+)?)(?::(\d+))?")


def subset(path: str | Path, out: str | Path, indices: ArrayLike) -> int:
    """Writes a session that holds only some frames of another, with their poses, masks and splits.

    The frames left out are in the ledger of the new file, which names the old one as its origin; the arm's
    trace and the clocks stay whole. What the schema does not know is not copied.

    Args:
        path: of a complete session.
        out: of the new file.
        indices: of the frames to keep; order and repetition do not matter.

    Returns:
        The number of frames kept.

    Raises:
        SessionError: the session is incomplete or damaged, the file exists, an index is out of range, or no
            frame is left.
    """
    path, out = Path(path), Path(out)
    check_new(out)
    with Session.open(path) as session:
        require_complete(session)
        count = len(session)
        keep = np.unique(np.asarray(indices, dtype=np.int64))
        if len(keep) == 0 or keep[0] < 0 or keep[-1] >= count:
            known = f"its frames are 0 to {count - 1}" if count else "it holds none"
            raise SessionError(f"{path}: a subset needs at least one frame of the session; {known}")
        for index in keep:
            session.raw(int(index))  # a damaged frame must not be copied as a good one
        origin = f"{len(keep)} of {count} frames of session {session.session_id}"
    gone = np.setdiff1d(np.arange(count), keep)
    size = path.stat().st_size * len(keep) // count
    with open_for_reading(path)[0] as file, create_whole(out, size) as target:
        lost = copy_content(file, target, keep, gone, b"left out of the subset")
        if lost:
            raise SessionError(f"{path}: {lost[0]} is damaged; run first: s2p3 dataset repair {path}")
        _drop_unknown(target)
        target.attrs.update({"session_id": uuid.uuid4().hex, "origin": origin})
        leave_open(target)
    return len(keep)


def chosen_frames(session: Session, frames: str | None, split: str | None) -> NDArray[np.int64]:
    """Frame indices that a user names: a slice such as "0:100:2", a list such as "3,5,8", or a split.

    Raises:
        SessionError: neither or both are given, the split does not exist, or the text is no such thing.
    """
    if (frames is None) == (split is None):
        raise SessionError(f"{session.path}: name the frames either by --frames or by --split")
    if split is not None:
        return session.frames_in(split)
    text = str(frames).replace(" ", "")
    if found := _SLICE.fullmatch(text):
        start, stop, step = (int(part) if part else None for part in found.groups())
        if step != 0:
            return np.arange(len(session))[start:stop:step]
    elif re.fullmatch(r"\d{1,18}(,\d{1,18})*", text):
        return np.array([int(part) for part in text.split(",")], dtype=np.int64)
    raise SessionError(f"--frames {text}: give a slice such as 0:100:2, or a list such as 3,5,8")


def require_complete(session: Session) -> None:
    """Raises SessionError where the recording is incomplete."""
    if not session.complete:
        raise SessionError(f"{session.path} is incomplete; run first: s2p3 dataset repair {session.path}")


def _drop_unknown(file: h5py.File) -> None:
    unknown: list[str] = []

    def visit(path: str, node: h5py.Group | h5py.Dataset) -> None:
        if isinstance(node, h5py.Dataset) and declared_at(path) is None:
            unknown.append(path)

    file.visititems(visit)
    for path in unknown:
        del file[path]
