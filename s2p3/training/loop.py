"""One plain training loop: seeded by step, averaged weights, JSON lines, checkpoints, exact resume.

Randomness comes from one generator per step, seeded by (seed, step), so a run that was stopped and resumed
sees the same batches, augmentations and noise as one that was not, and its losses are the same numbers.
"""

from __future__ import annotations

import copy
import hashlib
import json
import math
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Literal, TypeVar

import torch
from safetensors import safe_open
from safetensors.torch import load_file
from torch import Tensor, nn

from dataset.errors import ToolkitError
from s2p3.training.checkpoint import save_tensors
from s2p3.training.progress import OnStep, reporting

Losses = dict[str, Tensor]
LossAt = Callable[[torch.Generator], Losses]
Network = TypeVar("Network", bound=nn.Module)

_WARM_UP = 0.08
_LOG_EVERY = 10
_MAX_SKIPPED = 20


@dataclass(frozen=True)
class LoopConfig:
    """How to optimize; the fields mean what they mean in `s2p3.config`."""

    steps: int
    learning_rate: float
    schedule: Literal["cosine", "halving"]
    weight_decay: float
    clip_norm: float
    ema: float
    seed: int
    checkpoint_every: int


def optimize(
    network: Network,
    loss_at: LossAt,
    config: LoopConfig,
    path: Path,
    fingerprint: str,
    label: str,
    on_step: OnStep | None = None,
) -> Network:
    """Trains `network` in place and returns the averaged network, in evaluation mode.

    Args:
        loss_at: forms the losses of one batch from a seeded generator; their entry "total" is minimized, the
            rest logged.
        path: of the checkpoint to be; the log NAME.log.jsonl and the resume file NAME.resume.safetensors
            stand beside it.
        fingerprint: of everything the run depends on besides `config`; a resume file of another run is
            refused.
        label: what the progress bar and messages call this run.
        on_step: called after every step with step, steps and the latest losses; without it a progress bar is
            shown.

    Raises ToolkitError: the resume file belongs to other settings; the loss is not finite again and again.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    run = hashlib.sha256(f"{config}{fingerprint}".encode()).hexdigest()[:16]
    resume = path.with_suffix(".resume.safetensors")
    log_path = path.with_suffix(".log.jsonl")
    average = copy.deepcopy(network).eval()
    optimizer = torch.optim.AdamW(
        network.parameters(), config.learning_rate, weight_decay=config.weight_decay, fused=True
    )
    first = _restore(resume, run, network, average, optimizer) if resume.exists() else 0
    _truncate(log_path, first)
    skipped = 0
    started = time.perf_counter()
    with reporting(label, config.steps, on_step) as report:
        for step in range(first, config.steps):
            for group in optimizer.param_groups:
                group["lr"] = config.learning_rate * rate_factor(config.schedule, step / config.steps)
            network.train()
            generator = torch.Generator().manual_seed(config.seed * 1_000_003 + step)
            losses = loss_at(generator)
            optimizer.zero_grad(set_to_none=True)
            losses["total"].backward()
            norm = torch.nn.utils.clip_grad_norm_(network.parameters(), config.clip_norm)
            skipped = 0 if torch.isfinite(norm) else skipped + 1
            if skipped > _MAX_SKIPPED:
                raise ToolkitError(
                    f"{label}: the gradient was not finite {skipped} times in a row at step {step}; "
                    "lower the learning rate, or check the data with `s2p3 dataset validate`"
                )
            if skipped == 0:
                optimizer.step()
                update_average(average, network, min(config.ema, (step + 1) / (step + 10)))
            done = step + 1
            values = {name: float(loss.detach()) for name, loss in losses.items()}
            report(done, config.steps, values)
            if done % _LOG_EVERY == 0 or done == config.steps:
                seconds = round(time.perf_counter() - started, 2)
                rate = optimizer.param_groups[0]["lr"]
                _log(log_path, {"step": done, "seconds": seconds, "learning_rate": rate, **values})
            if done % config.checkpoint_every == 0 and done < config.steps:
                _store(resume, run, done, network, average, optimizer)
    resume.unlink(missing_ok=True)
    return average.eval()


def rate_factor(schedule: Literal["cosine", "halving"], progress: float) -> float:
    """Learning rate relative to its highest, at `progress` from 0 to 1."""
    if schedule == "halving":
        return 0.5 ** int(progress * 4)
    if progress < _WARM_UP:
        return (progress + 1e-3) / (_WARM_UP + 1e-3)
    return 0.5 * (1 + math.cos(math.pi * (progress - _WARM_UP) / (1 - _WARM_UP)))


@torch.no_grad()
def update_average(average: nn.Module, network: nn.Module, decay: float) -> None:
    """Moves every tensor of `average`, BatchNorm statistics included, towards `network`; with decay 0 copies
    it."""
    for mean, value in zip(average.state_dict().values(), network.state_dict().values(), strict=True):
        if mean.is_floating_point():
            mean.lerp_(value, 1 - decay)
        else:
            mean.copy_(value)


def steps_of(steps: int, epochs: int, batch: int, samples: int) -> int:
    """Optimizer steps: `steps`, or those of `epochs` passes where that is given."""
    return epochs * max(1, samples // batch) if epochs else steps


def sample_indices(samples: int, batch: int, generator: torch.Generator) -> Tensor:
    """(batch,) indices drawn with replacement."""
    return torch.randint(0, samples, (batch,), generator=generator)


def _store(
    path: Path, run: str, step: int, network: nn.Module, average: nn.Module, optimizer: torch.optim.Optimizer
) -> None:
    tensors = {f"network.{name}": value for name, value in network.state_dict().items()}
    tensors |= {f"average.{name}": value for name, value in average.state_dict().items()}
    for index, state in optimizer.state_dict()["state"].items():
        tensors |= {f"optimizer.{index}.{name}": value for name, value in state.items()}
    save_tensors(path, tensors, {"run": run, "step": str(step)})


def _restore(
    path: Path, run: str, network: nn.Module, average: nn.Module, optimizer: torch.optim.Optimizer
) -> int:
    with safe_open(path, "pt") as file:
        metadata = file.metadata()
    if metadata.get("run") != run:
        raise ToolkitError(
            f"{path}: was left by a run with other settings or data; "
            "delete it, or choose another output folder"
        )
    parts: dict[str, dict[str, Tensor]] = {"network": {}, "average": {}, "optimizer": {}}
    for name, value in load_file(path).items():
        part, rest = name.split(".", 1)
        parts[part][rest] = value
    network.load_state_dict(parts["network"])
    average.load_state_dict(parts["average"])
    states: dict[int, dict[str, Tensor]] = {}
    weights = [weight for group in optimizer.param_groups for weight in group["params"]]
    for name, value in parts["optimizer"].items():
        index, field = name.split(".")
        if value.dim() > 0:  # the fused kernel walks weight and moments side by side: same memory layout
            value = torch.empty_like(weights[int(index)]).copy_(value)
        states.setdefault(int(index), {})[field] = value
    optimizer.load_state_dict({**optimizer.state_dict(), "state": states})
    return int(metadata["step"])


def _truncate(path: Path, step: int) -> None:
    """Drops the log lines after `step`: those of a run that was stopped after its last checkpoint."""
    lines = path.read_text(encoding="utf-8").splitlines() if step and path.exists() else []
    kept = [line for line in lines if json.loads(line)["step"] <= step]
    path.write_text("".join(line + "\n" for line in kept), encoding="utf-8")


def _log(path: Path, values: dict[str, float]) -> None:
    with path.open("a", encoding="utf-8") as file:
        file.write(json.dumps(values) + "\n")
