"""What a supervised training learns from, and what it is scored on: frames of sessions, kept apart."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol

import torch
from torch import Tensor

from dataset.errors import ToolkitError
from dataset.schema import SUFFIXES
from dataset.session import Session
from s2p3.config import FrameSource, InputConfig, SupervisedConfig
from s2p3.objects import ObjectModel
from s2p3.progress import Report, quiet
from s2p3.training.crops import LabelledCrops, content_hashes, labelled_crops, shown_rows
from s2p3.training.loader import CropDataset

MOST_HELD_OUT = 256
"""Frames kept for scoring by default: more would cost time and tell no more."""


class CropSource(Protocol):
    """Labelled crops by row: in memory (`LabelledCrops`) or off the disk (`CropDataset`)."""

    def __len__(self) -> int:
        """How many rows there are."""

    def take(self, rows: Tensor) -> LabelledCrops:
        """Some rows as one batch."""


@dataclass(frozen=True)
class Examples:
    """Crops to learn from, and others to be scored on.

    Attributes:
        source: of the crops to learn from.
        rows: of these, those to learn from.
        held_out: the others; None where there are none.
        origin: of the others, in words.
        hashes: of all sessions, see `content_hashes`.
    """

    source: CropSource
    rows: Tensor
    held_out: LabelledCrops | None
    origin: str
    hashes: dict[str, str]

    @staticmethod
    def of(
        sessions: Sequence[Path],
        model: ObjectModel,
        config: InputConfig,
        settings: SupervisedConfig,
        frames: FrameSource,
        cache: Path | None = None,
        report: Report = quiet,
    ) -> Examples:
        """The crops of sessions, as `frames` says.

        Args:
            cache, report: see `labelled_crops`.

        Raises ToolkitError: a session lacks the object or the split, or is given twice; no frame shows it.
        """
        division = divide(sessions, model, settings, frames)
        scored_on = [] if division.session is None else [division.session]
        hashes = content_hashes([*sessions, *scored_on], model)
        source: CropSource
        if frames.storage == "memory":
            source = labelled_crops(sessions, model, config, cache, report)
        else:
            source = CropDataset(sessions, model, config)
        held_out = None
        if scored_on:
            held_out = labelled_crops(scored_on, model, config, cache, report)
        elif len(division.held_out):
            held_out = source.take(division.held_out)
        return Examples(source, division.rows, held_out, division.origin, hashes)


@dataclass(frozen=True)
class Division:
    """Rows of `shown_rows`: to learn from, and to be scored on; or the session to be scored on."""

    rows: Tensor
    held_out: Tensor
    session: Path | None
    origin: str


def divide(
    sessions: Sequence[Path], model: ObjectModel, settings: SupervisedConfig, frames: FrameSource
) -> Division:
    """Which frames are for learning and which for scoring.

    Raises ToolkitError: as `Examples.of`; or no frame is left to learn from.
    """
    shown = shown_rows(sessions, model)
    rows = torch.arange(len(shown)) if frames.split is None else _of_split(sessions, shown, frames.split)
    nothing = torch.arange(0)
    validation = frames.validation
    if not settings.validations:
        if validation is not None:
            raise ToolkitError(
                f"validations = 0 scores nothing on {validation!r}; raise it, or leave --validation out"
            )
        return Division(rows, nothing, None, "")
    if validation is None:
        count = min(int(settings.holdout * len(rows)), MOST_HELD_OUT)
        order = rows[torch.randperm(len(rows), generator=torch.Generator().manual_seed(settings.seed))]
        origin = f"{count} of {len(rows)} frames, drawn with seed {settings.seed}"
        return Division(order[count:].sort().values, order[:count].sort().values, None, origin)
    if Path(validation).suffix in SUFFIXES or Path(validation).is_file():
        return Division(rows, nothing, Path(validation), f"the session {validation}")
    held_out = _of_split(sessions, shown, validation)
    rows = rows[~torch.isin(rows, held_out)]
    if not len(rows):
        raise ToolkitError(f"the split {validation!r} leaves no frame to learn from; name another")
    return Division(rows, held_out, None, f"the split {validation!r}")


def _of_split(sessions: Sequence[Path], shown: Sequence[tuple[int, int]], split: str) -> Tensor:
    """Rows of the frames in a split."""
    allowed: set[tuple[int, int]] = set()
    for number, path in enumerate(sessions):
        with Session.open(path) as session:
            allowed |= {(number, int(index)) for index in session.frames_in(split)}
    rows = [row for row, place in enumerate(shown) if place in allowed]
    if not rows:
        raise ToolkitError(f"the split {split!r} holds no frame that shows the object; choose another")
    return torch.tensor(rows)
