"""One process of a small training, for tests that start several: python linear_run.py FOLDER.

A linear network learns from rows that are pictures of their own number, so that what each process saw can be
told. Leaves `seen-RANK.json`, the numbers it saw, and `weights-RANK.safetensors`, what it came to.
"""

from __future__ import annotations

import json
import sys
from dataclasses import dataclass
from pathlib import Path

import torch
from safetensors.torch import save_file
from torch import Tensor, nn

from s2p3.config import StageConfig
from s2p3.training.loop import Forward, Losses, Run, Score, optimize
from s2p3.training.processes import Processes

ROWS = 12
SETTINGS = StageConfig(steps=30, batch=4, learning_rate=1e-2, checkpoint_every=5)


@dataclass(frozen=True)
class Numbers:
    """Rows, each a vector that follows from its number, and a target."""

    def __len__(self) -> int:
        return ROWS

    def __call__(self, rows: Tensor, generator: torch.Generator) -> tuple[Tensor, Tensor, Tensor]:
        inputs = torch.stack([torch.sin(rows + 1.0), torch.cos(2 * rows + 0.5)], dim=1)
        del generator
        return rows, inputs, inputs.sum(1, keepdim=True)


@dataclass
class Squares:
    """Mean squared error; takes down the rows of every batch."""

    seen: list[list[int]]

    def __call__(self, forward: Forward, batch: tuple[Tensor, Tensor, Tensor]) -> Losses:
        rows, inputs, targets = batch
        self.seen.append(rows.tolist())
        return {"total": (forward(inputs) - targets).square().mean()}


def network() -> nn.Module:
    torch.manual_seed(0)
    return nn.Linear(2, 1)


@torch.no_grad()
def closeness(network: nn.Module) -> float:
    """The higher, the nearer all rows' outputs are to their targets."""
    _, inputs, targets = Numbers()(torch.arange(ROWS), torch.Generator())
    return -float((network(inputs) - targets).abs().mean())


def run(folder: Path) -> None:
    torch.set_num_threads(1)
    folder.mkdir(exist_ok=True)
    objective = Squares([])
    score = Score("closeness", closeness, 3, "all numbers")
    path = folder / "linear.safetensors"
    trained = optimize(network(), Numbers(), objective, SETTINGS, Run("linear", path, ""), score)
    rank = Processes.start().share.rank
    (folder / f"seen-{rank}.json").write_text(json.dumps(objective.seen))
    weights = {name: value.contiguous() for name, value in trained.network.state_dict().items()}
    save_file(weights, folder / f"weights-{rank}.safetensors")


if __name__ == "__main__":
    run(Path(sys.argv[1]))
