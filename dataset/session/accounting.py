"""What became of every frame of a recording, from the file alone."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from dataset.schema import PAUSE_DTYPE
from dataset.session.reader import Session


@dataclass(frozen=True)
class FrameAccount:
    """The frames that a camera took between the first and the last one that is known.

    Attributes:
        offered: all of them but those of a pause.
        stored, ledgered: in the file, and in its ledger of drops with a reason.
        paused: taken while the recording was paused, and not wanted.
        silent: neither; 0 in a file that can be trusted.
    """

    offered: int
    stored: int
    ledgered: int
    paused: int
    silent: int


def account(session: Session) -> FrameAccount:
    """Counts the frames of a recording by their ids: gaps against the ledger and the pauses."""
    ids, dropped = session.frame_ids, session.drops["frame_id"]
    silent = int(np.maximum(unexplained(ids, dropped, session.pauses), 0).sum())
    return FrameAccount(len(ids) + len(dropped) + silent, len(ids), len(dropped), paused(session), silent)


def paused(session: Session) -> int:
    """How many frames were taken while the recording was paused."""
    pauses = session.pauses
    return int((pauses["last_id"] - pauses["first_id"] + 1).sum())


def unexplained(
    ids: NDArray[np.int64], dropped: NDArray[np.int64], pauses: NDArray[np.void] | None
) -> NDArray[np.int64]:
    """(N-1,) frames missing between consecutive stored ids (N,) that neither ledger nor pause explains."""
    if pauses is None:
        pauses = np.empty(0, PAUSE_DTYPE)
    inside = np.searchsorted(np.unique(dropped), ids)
    gaps: NDArray[np.int64] = np.diff(ids) - 1 - np.diff(inside)
    for pause in pauses:
        before = int(np.searchsorted(ids, pause["first_id"])) - 1
        if 0 <= before < len(gaps):
            gaps[before] -= pause["last_id"] - pause["first_id"] + 1
    return gaps
