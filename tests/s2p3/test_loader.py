"""The loader hands out the crops that training keeps in memory, in an order that a seed fixes."""

from __future__ import annotations

import pickle
import runpy
from dataclasses import fields, replace
from pathlib import Path

import numpy as np
import pytest
import torch

from dataset.errors import ToolkitError
from dataset.session import write_split
from s2p3.config import fast
from s2p3.objects import build
from s2p3.training.crops import LabelledCrops, collate, labelled_crops
from s2p3.training.loader import CropDataset, EpochSampler, crop_loader


@pytest.fixture(scope="module")
def session(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("loader") / "session.h5"
    bench = runpy.run_path(str(Path(__file__).parents[2] / "tools" / "bench" / "loader.py"))
    bench["write_session"](path, 6)
    return path


CONFIG = replace(fast().input, size=32, canonical_size=48)


def same(one: LabelledCrops, other: LabelledCrops, tolerance: float) -> None:
    for field in fields(LabelledCrops):
        a, b = getattr(one, field.name), getattr(other, field.name)
        assert (a.shape, a.dtype) == (b.shape, b.dtype)
        torch.testing.assert_close(a.float(), b.float(), atol=tolerance, rtol=tolerance)


def test_rows_are_those_of_training_in_memory(session: Path) -> None:
    model = build("cup")
    data = CropDataset([session, session], model, CONFIG)
    assert len(data) == 12
    expected = labelled_crops([session, session], model, CONFIG)
    same(collate([data[row] for row in range(len(data))]), expected, 2e-3)


def test_a_worker_hands_out_an_epoch(session: Path) -> None:
    model = build("cup")
    data = CropDataset([session], model, CONFIG)
    here = list(crop_loader(data, 2, workers=0, seed=3))
    spawned = list(crop_loader(data, 2, workers=1, seed=3))
    assert len(here) == len(spawned) == 3
    for one, other in zip(here, spawned, strict=True):
        same(one, other, 0)
    assert sorted(int(row) for batch in here for row in batch.frames) == list(range(6))


def test_a_data_set_travels_without_its_handles(session: Path) -> None:
    data = CropDataset([session], build("cup"), CONFIG)
    before = data[2]
    copy = pickle.loads(pickle.dumps(data))
    assert copy._open == {}
    np.testing.assert_array_equal(copy[2]["stokes"], before["stokes"])


def test_a_split_limits_the_rows(session: Path) -> None:
    write_split(session, "train", [1, 4])
    assert len(CropDataset([session], build("cup"), CONFIG, "train")) == 2
    with pytest.raises(ToolkitError, match="no split 'x'; its splits: train"):
        CropDataset([session], build("cup"), CONFIG, "x")


@pytest.mark.parametrize(("count", "world"), [(12, 1), (12, 3), (13, 4), (3, 5)])
def test_ranks_share_an_epoch(count: int, world: int) -> None:
    def order(seed: int, epoch: int) -> list[list[int]]:
        samplers = [EpochSampler(count, seed, rank, world) for rank in range(world)]
        for sampler in samplers:
            sampler.set_epoch(epoch)
        return [list(sampler) for sampler in samplers]

    shares = order(0, 0)
    assert {len(share) for share in shares} == {-(-count // world)}
    assert {row for share in shares for row in share} == set(range(count))
    assert order(0, 0) == shares
    if count > 3:
        assert order(0, 1) != shares
        assert order(1, 0) != shares


@pytest.mark.parametrize("rank", [-1, 2])
def test_a_rank_that_does_not_exist_is_refused(rank: int) -> None:
    with pytest.raises(ToolkitError, match="does not exist"):
        EpochSampler(4, 0, rank, 2)
