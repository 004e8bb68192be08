"""Labelled crops made anew for every epoch, by worker processes, for data that does not fit into memory.

Every worker has its own file handles and reads the Stokes images from the decoded cache beside each session,
so that a crop costs a few disk pages, a resampling and a rasterization. The order of an epoch depends on the
seed and the epoch alone; several ranks share it out among themselves.
"""

from __future__ import annotations

import os
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch.utils.data import DataLoader, Dataset, Sampler

from dataset.errors import ToolkitError
from dataset.session import Session
from dataset.stokes_cache import cached_stokes
from s2p3.config import InputConfig
from s2p3.objects import ObjectModel
from s2p3.training.crops import LabelledCrops, collate, labelled_crop, shown_frames

Row = dict[str, NDArray[np.generic]]


class CropDataset(Dataset[Row]):
    """Random access to the rows that `labelled_crops` keeps in memory, in the same order.

    A frame of which a mask says that nothing is seen is left out, as there. Works in any process it is sent
    to.

    Args:
        paths: sessions with poses of the object.
        model: the object.
        config: what the crops are like.
        split: name of the sessions' split to draw from; all frames when None.

    Raises:
        ToolkitError: a session lacks the object or the split, or no frame shows it.
    """

    def __init__(
        self, paths: Sequence[Path], model: ObjectModel, config: InputConfig, split: str | None = None
    ) -> None:
        self.paths, self.model, self.config = list(paths), model, config
        self.rows: list[tuple[int, int]] = []
        for number, path in enumerate(self.paths):
            cached_stokes(path)  # made here, once, and not by every worker
            with Session.open(path) as session:
                poses = session.object_poses(model.name)
                if split is not None and split not in session.splits:
                    known = ", ".join(session.splits) or "none"
                    raise ToolkitError(f"{path} has no split {split!r}; its splits: {known}")
                allowed = None if split is None else set(session.splits[split].tolist())
                for index in shown_frames(poses):
                    seen = poses.bbox_xywh[index][2:].min() > 0
                    if seen and (allowed is None or index in allowed):
                        self.rows.append((number, index))
        if not self.rows:
            raise ToolkitError(
                f"{', '.join(map(str, paths))}: no frame shows {model.name!r}; annotate or synthesize first"
            )
        self._forget()

    def __len__(self) -> int:
        return len(self.rows)

    def __getitem__(self, row: int) -> Row:
        number, index = self.rows[row]
        session, stokes = self._opened(number)
        poses = session.object_poses(self.model.name)
        return labelled_crop(
            stokes[index],
            poses.mask(index),
            poses.T_cam_obj[index],
            session.working_intrinsics,
            self.model,
            self.config,
            row,
        )

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


class EpochSampler(Sampler[int]):
    """The rows of one epoch in an order that follows from seed and epoch, shared out among ranks.

    All ranks draw equally many: where the count does not divide, rows from the order's beginning come twice.

    Args:
        count: rows of the data set.
        seed: of the order.
        rank, world: which of how many processes this is.
    """

    def __init__(self, count: int, seed: int = 0, rank: int = 0, world: int = 1) -> None:
        if not 0 <= rank < world:
            raise ToolkitError(
                f"rank {rank} of {world} processes does not exist; ranks go from 0 to {world - 1}"
            )
        self.count, self.seed, self.rank, self.world = count, seed, rank, world
        self.epoch = 0

    def set_epoch(self, epoch: int) -> None:
        """Chooses the epoch whose order comes next."""
        self.epoch = epoch

    def __len__(self) -> int:
        return -(-self.count // self.world)

    def __iter__(self) -> Iterator[int]:
        generator = torch.Generator().manual_seed(self.seed * 1_000_003 + self.epoch)
        order = torch.randperm(self.count, generator=generator)
        whole = order.repeat(-(-self.world // max(self.count, 1)) + 1)[: len(self) * self.world]
        return iter(whole[self.rank :: self.world].tolist())


def crop_loader(
    data: CropDataset, batch: int, *, workers: int = 1, seed: int = 0, rank: int = 0, world: int = 1
) -> DataLoader[LabelledCrops]:
    """Batches of labelled crops; call `loader.sampler.set_epoch(n)` before each epoch.

    Args:
        data: the crops.
        batch: rows a batch; the last one of an epoch is dropped where it is smaller.
        workers: processes; 0 reads in this one.
        seed: of the order.
        rank, world: which of how many training processes this is.
    """
    return DataLoader(
        data,  # type: ignore[arg-type]
        batch_size=batch,
        sampler=EpochSampler(len(data), seed, rank, world),
        num_workers=workers,
        collate_fn=collate,
        drop_last=True,
        worker_init_fn=_single_thread,
        multiprocessing_context="spawn" if workers else None,
        persistent_workers=workers > 0,
    )


def _single_thread(_: int) -> None:
    import cv2

    cv2.setNumThreads(1)
    torch.set_num_threads(1)
