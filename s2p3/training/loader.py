"""How batches reach a training: by number, from worker processes, out of memory or off the disk.

A batch follows from the seed and its number alone, so that it does not matter who makes it, nor where a
training that was interrupted goes on. `CropDataset` makes labelled crops anew whenever they are asked for,
where the memory does not hold them: each process has its own file handles and reads the Stokes images from
the decoded cache beside each session, so that a crop costs a few disk pages, a resampling and a
rasterization.
"""

from __future__ import annotations

import os
import shutil
import signal
import threading
from collections.abc import Generator, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.utils.data import DataLoader, Dataset

from dataset.errors import ToolkitError
from dataset.session import Session
from dataset.stokes_cache import cached_stokes
from s2p3.config import InputConfig
from s2p3.objects import ObjectModel
from s2p3.training.crops import LabelledCrops, collate, labelled_crop, shown_rows
from s2p3.training.trees import named_tensors

_SHARED_MEMORY = Path("/dev/shm")  # where torch puts the tensors of several processes on Linux
_ROOM_FOR_BATCHES = 1 << 28

Row = dict[str, NDArray[np.generic]]


class Data(Protocol):
    """What a training draws its batches from. Is sent to worker processes."""

    def __len__(self) -> int:
        """How many rows an epoch has."""

    def __call__(self, rows: Tensor, generator: torch.Generator) -> Any:
        """The batch of some rows: a tree of tensors, see `trees`. Whatever is random about it comes from
        `generator`."""


class CropDataset(Dataset[Row]):
    """Random access to the rows that `labelled_crops` keeps in memory, in the same order; in any
    process it is sent to.

    Args:
        paths: sessions with poses of the object.
        model: the object.
        config: what the crops are like.

    Raises:
        ToolkitError: a session lacks the object, or no frame shows it.
    """

    def __init__(self, paths: Sequence[Path], model: ObjectModel, config: InputConfig) -> None:
        self.paths, self.model, self.config = list(paths), model, config
        self.rows = shown_rows(paths, model)
        for path in self.paths:
            cached_stokes(path)  # made here, once, and not by every worker
        self._forget()

    def __len__(self) -> int:
        return len(self.rows)

    def __getitem__(self, row: int) -> Row:
        number, index = self.rows[row]
        session, stokes = self._opened(number)
        poses = session.object_poses(self.model.name)
        return labelled_crop(session, poses, index, stokes[index], self.model, self.config)

    def take(self, rows: Tensor) -> LabelledCrops:
        """Some rows as one batch."""
        return collate([self[int(row)] for row in rows])

    def __getstate__(self) -> dict[str, Any]:
        return self.__dict__ | {"_open": {}, "_process": 0}

    def _forget(self) -> None:
        self._open: dict[int, tuple[Session, NDArray[np.float16]]] = {}
        self._process = os.getpid()

    def _opened(self, number: int) -> tuple[Session, NDArray[np.float16]]:
        if self._process != os.getpid():  # handles of the process we were forked from are not ours
            self._forget()
        if number not in self._open:
            path = self.paths[number]
            self._open[number] = Session.open(path), cached_stokes(path)
        return self._open[number]


@dataclass(frozen=True)
class Share:
    """What one of several training processes has to make of every batch: every `world`-th row from `rank`
    on."""

    rank: int = 0
    world: int = 1

    def __post_init__(self) -> None:
        if not 0 <= self.rank < self.world:
            raise ToolkitError(
                f"rank {self.rank} of {self.world} processes does not exist; ranks go from 0 to "
                f"{self.world - 1}"
            )


def rows_at(step: int, batch: int, count: int, seed: int) -> Tensor:
    """(batch,) the rows, out of `count`, of a batch: the next ones in an endless sequence of epochs, each of
    which goes through all rows once, in an order that follows from seed and epoch."""
    start = step * batch
    epochs = range(start // count, (start + batch - 1) // count + 1)
    orders = [
        torch.randperm(count, generator=torch.Generator().manual_seed(seed * 998_244_353 + epoch))
        for epoch in epochs
    ]
    return torch.cat(orders)[start - epochs[0] * count :][:batch]


WHOLE = Share()


class Steps(Dataset[Any]):
    """The batches of a training by their number: the same in whichever process, and in whichever order, they
    are made.

    Args:
        data: makes a batch of given rows, see `Data`.
        batch: rows of all processes together. Raises ToolkitError: it cannot be shared out evenly.
        seed: of the order and of the generators that `data` is given.
        share: of every batch that is made here.
    """

    def __init__(self, data: Data, batch: int, seed: int, share: Share = WHOLE) -> None:
        if batch % share.world:
            raise ToolkitError(
                f"a batch of {batch} cannot be shared out among {share.world} processes; choose a multiple"
            )
        self.data, self.batch, self.seed, self.share = data, batch, seed, share

    def __getitem__(self, step: int) -> Any:
        rank, world = self.share.rank, self.share.world
        rows = rows_at(step, self.batch, len(self.data), self.seed)[rank::world]
        generator = torch.Generator().manual_seed((self.seed * 1_000_003 + step) * world + rank)
        return self.data(rows, generator)


def stream(steps: Steps, first: int, last: int, workers: int = 0) -> Generator[Any, None, None]:
    """The batches from `first` to before `last`, made ahead by worker processes with one thread each.

    Workers share the tensors of `steps.data` and hand batches back through shared memory: nothing is copied.

    Args:
        workers: processes; 0 makes the batches here, when they are asked for.

    Raises ToolkitError: whatever kept a worker from making a batch; too little shared memory for them.
    """
    if workers:
        _insist_on_room(steps)
    loader = DataLoader(
        _Telling(steps),
        batch_size=None,
        sampler=range(first, last),
        num_workers=workers,
        collate_fn=_as_it_is,
        worker_init_fn=_alone,
        multiprocessing_context="spawn" if workers else None,
        generator=torch.Generator(),  # or the loader would draw from, and so change, the global one
    )
    with _deaf_to_interrupts():
        batches = iter(loader)
    for made in batches:
        if isinstance(made, _Failed):
            raise ToolkitError(made.why)
        yield made


def _insist_on_room(steps: Steps) -> None:
    """Raises ToolkitError: a process that fills shared memory up is killed without a word."""
    needed = sum(part.nbytes for part in named_tensors(steps.data, "").values() if not part.is_shared())
    if not _SHARED_MEMORY.is_dir():
        return
    free = shutil.disk_usage(_SHARED_MEMORY).free
    if free < needed + _ROOM_FOR_BATCHES:
        raise ToolkitError(
            f"workers share crops and batches through {_SHARED_MEMORY}, which has {free / 1e9:.2f} GB free "
            f"and needs {(needed + _ROOM_FOR_BATCHES) / 1e9:.2f}: enlarge it (docker: --shm-size), or give "
            "--workers 0, or --storage disk"
        )


@dataclass(frozen=True)
class _Failed:
    """Sent instead of a batch: an exception would arrive wrapped into its worker's traceback."""

    why: str


class _Telling(Dataset[Any]):
    def __init__(self, steps: Steps) -> None:
        self.steps = steps

    def __getitem__(self, step: int) -> Any:
        try:
            return self.steps[step]
        except ToolkitError as error:
            return _Failed(str(error))


@contextmanager
def _deaf_to_interrupts() -> Iterator[None]:
    """Processes that are started meanwhile leave Ctrl-C, which a terminal sends to all, to this one."""
    if threading.current_thread() is not threading.main_thread():  # which alone may change handlers
        yield
        return
    before = signal.signal(signal.SIGINT, signal.SIG_IGN)
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, before)


def _as_it_is(batch: Any) -> Any:
    return batch


def _alone(_: int) -> None:
    """A worker has one thread."""
    import cv2

    cv2.setNumThreads(1)
    torch.set_num_threads(1)
