"""One plain training loop: seeded by step, averaged weights, the best of them kept, exact resume.

Batch n follows from the seed and n alone (see `loader`), so a run that was stopped and resumed sees the same
batches, augmentations and noise as one that was not, and its losses are the same numbers. Several processes
(`accelerate launch`, `torchrun`) share every batch out among themselves and average their gradients.
"""

from __future__ import annotations

import copy
import hashlib
import math
import time
from collections.abc import Callable
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Generic, Protocol, TypeVar

import torch
from torch import Tensor, nn

from dataset.errors import ToolkitError
from s2p3.config import Schedule, StageConfig
from s2p3.progress import Report, quiet
from s2p3.training.checkpoint import RESUME, Validation, save_tensors
from s2p3.training.loader import Data, Steps, stream
from s2p3.training.log import RunLog
from s2p3.training.processes import Processes
from s2p3.training.resume import State
from s2p3.training.trees import named_tensors, to_device

Losses = dict[str, Tensor]
Forward = Callable[..., Any]
Network = TypeVar("Network", bound=nn.Module)

_WARM_UP = 0.08
_FLAT = 0.72
_LOG_EVERY = 10


class Objective(Protocol):
    """What a stage minimizes. A dataclass where it holds tensors: they are brought to the network's
    device."""

    def __call__(self, forward: Forward, batch: Any) -> Losses:
        """The losses of one batch: "total" is minimized, the rest logged.

        Args:
            forward: the network; its outputs are float32, whatever it computes in.
            batch: what the stage's `Data` made.
        """


@dataclass(frozen=True)
class Score:
    """How good a network is, on what it was not trained on.

    Attributes:
        name: of the number, which is the higher the better.
        of: the number of a network in evaluation mode.
        times: how often it is taken, at equal distances, the last time at the end.
        frames: that it is taken on, in words.
    """

    name: str
    of: Callable[[Any], float]
    times: int
    frames: str

    def is_due(self, done: int, steps: int) -> bool:
        """Whether it is taken after `done` of `steps` steps."""
        return self.times * done // steps > self.times * (done - 1) // steps


@dataclass(frozen=True)
class Trained(Generic[Network]):
    """What a training has come to.

    Attributes:
        network: with the weights to keep, on the CPU, in evaluation mode.
        step: after which it had them.
        validation: how they were chosen; None where they are the last.
    """

    network: Network
    step: int
    validation: Validation | None = None


@dataclass(frozen=True)
class Run:
    """A training: what it is called, where it writes, how it is fed and shown.

    Attributes:
        label: what progress and messages call it.
        path: of the checkpoint to be. The log NAME.log.jsonl, the folder tensorboard/NAME and, until
            `checkpoint.save` has written it, the resume file NAME.resume.safetensors stand beside it.
        fingerprint: of everything it depends on besides its settings; a resume file of another one is
            refused.
        workers: processes that make the batches; with 0 this one does.
        report: told of every step, with the latest losses.
    """

    label: str
    path: Path
    fingerprint: str
    workers: int = 0
    report: Report = quiet


def optimize(
    network: Network,
    data: Data,
    objective: Objective,
    settings: StageConfig,
    run: Run,
    score: Score | None = None,
) -> Trained[Network]:
    """Trains `network` in place; returns its averaged weights: the best or, where none are scored, the last.

    Args:
        data: what the batches are drawn from.

    Raises ToolkitError: the resume file belongs to other settings; a loss or gradient is not finite.
    """
    run.path.parent.mkdir(parents=True, exist_ok=True)
    steps = settings.steps_over(len(data))
    whole = hashlib.sha256(f"{settings} {steps} {run.fingerprint}".encode()).hexdigest()[:16]
    processes = Processes.start()
    objective = to_device(objective, processes.device)
    network.to(processes.device)
    average = copy.deepcopy(network).eval()
    optimizer = torch.optim.AdamW(
        network.parameters(), settings.learning_rate, weight_decay=settings.weight_decay, fused=True
    )
    state = State(run.path.with_suffix(RESUME), whole, network, average, optimizer)
    first = processes.common_step(state.restore())
    forward = processes.prepare(network)
    batches = stream(Steps(data, settings.batch, settings.seed, processes.share), first, steps, run.workers)
    started = time.perf_counter()
    with RunLog(run.path, first) as log, closing(batches):
        for done, batch in enumerate(batches, start=first + 1):
            rate = settings.learning_rate * rate_factor(settings.schedule, (done - 1) / steps)
            for group in optimizer.param_groups:
                group["lr"] = rate
            network.train()
            batch = to_device(batch, processes.device)
            losses = objective(forward, batch)
            optimizer.zero_grad(set_to_none=True)
            losses["total"].backward()
            norm = float(nn.utils.clip_grad_norm_(network.parameters(), settings.clip_norm))
            values = {name: float(loss.detach()) for name, loss in losses.items()}
            if not math.isfinite(values["total"] + norm):
                kept = run.path.with_suffix(f".bad-batch{processes.suffix}.safetensors")
                raise _not_finite(run.label, done, values, norm, kept, network, batch)
            optimizer.step()
            update_average(average, network, min(settings.ema, done / (done + 9)))
            if not processes.first:
                continue
            scored = score is not None and score.is_due(done, steps)
            if score is not None and scored:
                values[score.name] = score.of(average)
                state.consider(done, values[score.name])
            run.report(run.label, done, steps, values)
            if scored or done % _LOG_EVERY == 0 or done == steps:
                seconds = round(time.perf_counter() - started, 2)
                log.write({"step": done, "seconds": seconds, "learning_rate": rate, **values})
            if done % settings.checkpoint_every == 0 or done == steps:
                state.store(done)
    best = state.best
    if best is not None:
        average.load_state_dict(best.weights)
    processes.broadcast(average)
    average = average.cpu().eval()
    if best is None or score is None:
        return Trained(average, steps)
    return Trained(average, best.step, Validation(score.name, best.score, score.frames))


def rate_factor(schedule: Schedule, progress: float) -> float:
    """Learning rate relative to its highest, at `progress` from 0 to 1."""
    if schedule == "halving":
        return 0.5 ** int(progress * 4)
    if schedule == "flat":
        return 0.5 * (1 + math.cos(math.pi * max(progress - _FLAT, 0) / (1 - _FLAT)))
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


def _not_finite(
    label: str,
    step: int,
    values: dict[str, float],
    norm: float,
    path: Path,
    network: nn.Module,
    batch: Any,
) -> ToolkitError:
    """Keeps what a step that cannot be taken was made of: the batch, and the weights that it met."""
    tensors = named_tensors(batch, "batch") | named_tensors(network.state_dict(), "network")
    save_tensors(path, tensors, {"step": str(step)})
    wrong = [name for name, value in values.items() if not math.isfinite(value) and name != "total"]
    what = f"the loss ({', '.join(wrong) or 'total'})" if wrong or math.isfinite(norm) else "the gradient"
    return ToolkitError(
        f"{label}: {what} is not finite at step {step}; the batch and the weights are in {path}; lower the "
        "learning rate, or check the data with: s2p3 dataset validate"
    )
