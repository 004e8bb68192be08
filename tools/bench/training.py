"""Whether training keeps the network busy: `python tools/bench/training.py [--size 128] [--json]`.

Images a second of the student's training, batch 16, two cores: one thread for the network, one worker process
with one thread that augments.

    images_per_s          the whole loop, `training.loop.optimize`: batches from the worker, losses,
                          gradients, AdamW, averaged weights, checks, log; crops in memory
    disk_images_per_s     the same with crops made anew from the session's decoded cache and the mesh
    network_images_per_s  the same network, losses, gradients and AdamW, over and over on one batch that is
                          ready, while the worker is idle
    ratio, disk_ratio     of either loop to the network alone: the median over turns

Loop and network alone take turns of some steps, so that what slows the machine slows both. The worker is up
to two batches ahead when a turn begins: steps that could live on these are not timed. The session is
synthetic in layout only: random polarized images of 612x512, a known mesh at random poses.
"""

from __future__ import annotations

import argparse
import json
import os
import tempfile
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from statistics import median

import torch
from loader import BATCH, OBJECT, write_session

from s2p3.config import ExperimentConfig, StageConfig
from s2p3.networks.build import build_student
from s2p3.objects import ObjectModel, build
from s2p3.presets import fast
from s2p3.training.crops import labelled_crops
from s2p3.training.examples import CropSource
from s2p3.training.loader import CropDataset, Steps
from s2p3.training.loop import Run, optimize
from s2p3.training.supervised import LabelledData, SupervisedObjective, model_tensors

_AHEAD, _TIMED = 4, 8
"""Steps of a turn that are not timed, and that are."""


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument(
        "--size", type=int, choices=(64, 128, 256), default=128, help="side of the network's input, pixels"
    )
    parser.add_argument("--frames", type=int, default=96, help="frames of the session")
    parser.add_argument("--turns", type=int, default=4)
    parser.add_argument("--json", action="store_true")
    options = parser.parse_args()
    os.environ["OMP_NUM_THREADS"] = "1"
    torch.set_num_threads(1)
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "session.h5"
        write_session(path, options.frames)
        result = measure(path, options.size, options.turns)
    if options.json:
        print(json.dumps(result))
    else:
        for name, value in result.items():
            print(f"{name:22}{value:10.2f}")


def measure(path: Path, size: int, turns: int) -> dict[str, float]:
    """The rates, in images a second, and their ratios."""
    model, config = build(OBJECT), fast()
    config = replace(
        config,
        input=replace(config.input, size=size, canonical_size=size * 3 // 2),
        network=replace(config.network, total_stride=32 if size == 256 else 16),  # 32 as published
    )
    memory = train(labelled_crops([path], model, config.input), model, config, turns, path)
    disk = train(CropDataset([path], model, config.input), model, config, turns, path)
    return {
        "images_per_s": median(memory.loop),
        "disk_images_per_s": median(disk.loop),
        "network_images_per_s": median(memory.alone + disk.alone),
        "ratio": memory.ratio,
        "disk_ratio": disk.ratio,
        "size": size,
        "batch": BATCH,
    }


@dataclass
class Turns:
    """Is called by the loop after every step, and lets the network alone have its turn after the loop's.

    Attributes:
        step: of the network alone.
        loop, alone: images a second, by turn.
    """

    step: Callable[[], None]
    loop: list[float] = field(default_factory=list)
    alone: list[float] = field(default_factory=list)
    since: float = 0.0

    def __call__(self, label: str, done: int, total: int, values: Mapping[str, float]) -> None:
        del label, total, values
        place = done % (_AHEAD + _TIMED)
        if place == _AHEAD:
            self.since = time.perf_counter()
        if place == 0:
            self.loop.append(BATCH * _TIMED / (time.perf_counter() - self.since))
            self.step()
            start = time.perf_counter()
            for _ in range(_TIMED):
                self.step()
            self.alone.append(BATCH * _TIMED / (time.perf_counter() - start))

    @property
    def ratio(self) -> float:
        """Loop by network alone."""
        return median(loop / alone for loop, alone in zip(self.loop, self.alone, strict=True))


def train(
    source: CropSource, model: ObjectModel, config: ExperimentConfig, turns: int, beside: Path
) -> Turns:
    """Trains a student from crops that come from `source`, taking turns."""
    rows = torch.arange(len(source))
    data = LabelledData(source, rows, model.refractive_index, config)
    objective = SupervisedObjective(*model_tensors(model), model.diameter, dense_weight=0.0)
    settings = StageConfig(steps=turns * (_AHEAD + _TIMED), batch=BATCH)
    clock = Turns(alone(data, objective, config))
    path = beside.with_name(type(source).__name__) / "student.safetensors"
    optimize(
        build_student(config), data, objective, settings, Run("bench", path, "", workers=1, report=clock)
    )
    return clock


def alone(data: LabelledData, objective: SupervisedObjective, config: ExperimentConfig) -> Callable[[], None]:
    """A step of a student of its own on a batch that is ready."""
    network, batch = build_student(config).train(), Steps(data, BATCH, 0)[0]
    optimizer = torch.optim.AdamW(network.parameters(), 1e-4, fused=True)

    def step() -> None:
        losses = objective(network, batch)
        optimizer.zero_grad(set_to_none=True)
        losses["total"].backward()
        optimizer.step()

    return step


if __name__ == "__main__":
    main()
