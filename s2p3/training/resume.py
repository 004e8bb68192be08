"""What an interrupted training goes on from: weights, their average, the optimizer's moments, the best so
far."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import torch
from safetensors import SafetensorError, safe_open
from safetensors.torch import load_file
from torch import Tensor, nn

from dataset.errors import ToolkitError
from s2p3.training.checkpoint import save_tensors


@dataclass(frozen=True)
class Best:
    """The averaged weights that scored highest, and when."""

    weights: dict[str, Tensor]
    step: int
    score: float


@dataclass
class State:
    """A training in progress, and its resume file.

    Attributes:
        path: of the file.
        run: what the training is, as a hash: the file of another one is refused.
        network, average, optimizer: filled by `restore`, read by `store`.
        best: so far.
    """

    path: Path
    run: str
    network: nn.Module
    average: nn.Module
    optimizer: torch.optim.Optimizer
    best: Best | None = None

    def consider(self, step: int, score: float) -> None:
        """Keeps the average as it is now, if none scored as high before."""
        if self.best is None or score > self.best.score:
            weights = {name: value.clone() for name, value in self.average.state_dict().items()}
            self.best = Best(weights, step, score)

    def store(self, step: int) -> None:
        """Writes the file: `step` steps are done."""
        tensors = {f"network.{name}": value for name, value in self.network.state_dict().items()}
        tensors |= {f"average.{name}": value for name, value in self.average.state_dict().items()}
        for index, state in self.optimizer.state_dict()["state"].items():
            tensors |= {f"optimizer.{index}.{name}": value for name, value in state.items()}
        metadata = {"run": self.run, "step": str(step)}
        if self.best is not None:
            tensors |= {f"best.{name}": value for name, value in self.best.weights.items()}
            metadata |= {"best_step": str(self.best.step), "best_score": repr(self.best.score)}
        save_tensors(self.path, tensors, metadata)

    def restore(self) -> int:
        """Reads the file, if there is one; returns how many steps are done.

        Raises ToolkitError: it is damaged, or was left by another training.
        """
        if not self.path.exists():
            return 0
        try:
            with safe_open(self.path, "pt") as file:
                metadata = file.metadata() or {}
            tensors = load_file(self.path)
        except (OSError, SafetensorError) as error:
            raise ToolkitError(f"{self.path}: damaged ({error}); delete it to start anew") from error
        if metadata.get("run") != self.run:
            raise ToolkitError(
                f"{self.path}: was left by a run with other settings or data; "
                "delete it, or choose another output folder"
            )
        parts: dict[str, dict[str, Tensor]] = {"network": {}, "average": {}, "optimizer": {}, "best": {}}
        for name, value in tensors.items():
            part, rest = name.split(".", 1)
            parts[part][rest] = value
        self.network.load_state_dict(parts["network"])
        self.average.load_state_dict(parts["average"])
        self._restore_moments(parts["optimizer"])
        if parts["best"]:
            self.best = Best(parts["best"], int(metadata["best_step"]), float(metadata["best_score"]))
        return int(metadata["step"])

    def _restore_moments(self, moments: dict[str, Tensor]) -> None:
        states: dict[int, dict[str, Tensor]] = {}
        weights = [weight for group in self.optimizer.param_groups for weight in group["params"]]
        for name, value in moments.items():
            index, field = name.split(".")
            if value.dim() > 0:  # the fused kernel walks weight and moments side by side: same memory layout
                value = torch.empty_like(weights[int(index)]).copy_(value)
            states.setdefault(int(index), {})[field] = value
        self.optimizer.load_state_dict({**self.optimizer.state_dict(), "state": states})
