"""The loader hands out the crops that training keeps in memory, in an order that a seed fixes."""

from __future__ import annotations

import pickle
import runpy
import signal
import subprocess
import sys
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pytest
import torch
from torch import Tensor

from dataset.errors import ToolkitError
from s2p3.objects import build
from s2p3.presets import fast
from s2p3.training import loader
from s2p3.training.crops import LabelledCrops, collate, labelled_crops
from s2p3.training.loader import CropDataset, Share, Steps, stream
from s2p3.training.supervised import LabelledData
from s2p3.training.trees import named_tensors


@pytest.fixture(scope="module")
def session(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("loader") / "session.h5"
    bench = runpy.run_path(str(Path(__file__).parents[2] / "tools" / "bench" / "loader.py"))
    bench["write_session"](path, 6)
    return path


CONFIG = replace(fast().input, canonical_size=88)
EXPERIMENT = replace(fast(), input=CONFIG)


def same(one: LabelledCrops, other: LabelledCrops, tolerance: float) -> None:
    found, expected = one.tensors(), other.tensors()
    assert set(found) == set(expected)
    for name, a in found.items():
        b = expected[name]
        assert (a.shape, a.dtype) == (b.shape, b.dtype)
        torch.testing.assert_close(a.float(), b.float(), atol=tolerance, rtol=tolerance)


def test_rows_are_those_of_training_in_memory(session: Path) -> None:
    model = build("cup")
    data = CropDataset([session, session], model, CONFIG)
    assert len(data) == 12
    expected = labelled_crops([session, session], model, CONFIG)
    same(collate([data[row] for row in range(len(data))]), expected, 2e-3)


def augmented(source: CropDataset | LabelledCrops) -> LabelledData:
    return LabelledData(source, torch.arange(6), 1.5, EXPERIMENT)


def test_workers_make_the_same_batches_from_any_step_on_memory_or_disk(session: Path) -> None:
    model = build("cup")
    crops = labelled_crops([session], model, CONFIG)
    here = [named_tensors(batch, "") for batch in stream(Steps(augmented(crops), 2, seed=3), 0, 5)]
    spawned = stream(Steps(augmented(crops), 2, seed=3), 2, 5, workers=1)
    for one, other in zip(here[2:], spawned, strict=True):
        parts = named_tensors(other, "")
        assert one.keys() == parts.keys()
        assert all(torch.equal(one[name], parts[name]) for name in one)
        assert parts[".seen.priors"].is_contiguous(memory_format=torch.channels_last)
    off_disk = stream(Steps(augmented(CropDataset([session], model, CONFIG)), 2, seed=3), 2, 5)
    for one, other in zip(here[2:], off_disk, strict=True):
        for name, part in named_tensors(other, "").items():
            apart = (part.float() - one[name].float()).abs() > 0.05
            assert apart.float().mean() < 1e-3, (
                name
            )  # where nothing is polarized, a prior's side is a toss-up


def test_a_data_set_travels_without_its_handles(session: Path) -> None:
    data = CropDataset([session], build("cup"), CONFIG)
    before = data[2]
    copy = pickle.loads(pickle.dumps(data))
    assert copy._open == {}
    np.testing.assert_array_equal(copy[2]["stokes"], before["stokes"])


@pytest.mark.parametrize(("count", "batch", "world"), [(12, 4, 1), (12, 6, 3), (13, 4, 4), (3, 8, 2)])
def test_processes_share_epochs_that_a_seed_orders(count: int, batch: int, world: int) -> None:
    def rows(seed: int, step: int) -> list[int]:
        steps = [Steps(Rows(count), batch, seed, Share(rank, world)) for rank in range(world)]
        shares = [part[step] for part in steps]
        assert {len(share) for share in shares} == {batch // world}
        return [row for share in shares for row in share]

    whole = [row for step in range(count) for row in rows(0, step)]
    assert sorted(whole) == sorted(list(range(count)) * batch)
    together = [row for step in range(count) for row in Steps(Rows(count), batch, 0)[step]]
    for epoch in range(batch):
        assert sorted(together[epoch * count : (epoch + 1) * count]) == list(range(count))
    assert rows(0, 0) == rows(0, 0)
    if count > 3:
        assert rows(0, 0) != rows(1, 0)


@dataclass(frozen=True)
class Rows:
    """The numbers of the rows, without anything in them."""

    count: int

    def __len__(self) -> int:
        return self.count

    def __call__(self, rows: Tensor, generator: torch.Generator) -> list[int]:
        del generator
        return rows.tolist()


def test_workers_leave_ctrl_c_to_who_started_them() -> None:
    asked = [sys.executable, "-c", "import signal; print(signal.getsignal(signal.SIGINT) is signal.SIG_IGN)"]
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    try:
        with loader._deaf_to_interrupts():
            started = subprocess.run(asked, capture_output=True, text=True, check=True)
        assert started.stdout == "True\n"
        assert signal.getsignal(signal.SIGINT) is signal.default_int_handler
    finally:
        signal.signal(signal.SIGINT, before)


def test_too_little_shared_memory_is_said_before_it_kills(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(loader, "_ROOM_FOR_BATCHES", 1 << 60)
    with pytest.raises(ToolkitError, match=r"/dev/shm.*--shm-size.*--workers 0"):
        next(stream(Steps(Rows(4), 2, 0), 0, 2, workers=1))


def test_what_keeps_a_worker_from_its_batch_is_said_in_one_line(session: Path) -> None:
    broken = CropDataset([session], build("cup"), CONFIG)
    broken.paths[0] = session.with_name("gone.h5")
    with pytest.raises(ToolkitError, match=r"^[^\n]*gone.h5[^\n]*$"):
        next(stream(Steps(augmented(broken), 2, seed=3), 0, 5, workers=1))


@pytest.mark.parametrize("rank", [-1, 2])
def test_a_rank_that_does_not_exist_is_refused(rank: int) -> None:
    with pytest.raises(ToolkitError, match="does not exist"):
        Share(rank, 2)


def test_a_batch_that_cannot_be_shared_out_is_refused() -> None:
    with pytest.raises(ToolkitError, match="3 cannot be shared out among 2"):
        Steps(Rows(9), 3, 0, Share(0, 2))
