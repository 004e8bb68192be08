"""How long a path-traced frame set takes, and whether two workers halve it:

    python tools/bench/synthesis.py --json

Renders the first frames with one worker and with two: light paths, denoising, sensor, compression, as
`s2p3 synthesize` does. CPU seconds say what a frame costs on a machine that does other things, too; wall
seconds want a quiet one. Starting (imports, the first kernels) is timed apart: it is paid once. "linearity"
is the speed-up of two workers over two; "minutes_for_400_on_2_workers" extrapolates, it is not a run of 400.
"""

from __future__ import annotations

import argparse
import json
import time
from concurrent.futures import ProcessPoolExecutor
from dataclasses import asdict, dataclass
from multiprocessing import get_context

import cv2
import torch

from s2p3 import objects
from s2p3.synthesis import SYNTHETIC, PathTraced, Recipe, session_camera

TARGET_SETS, TARGET_MINUTES = 400, 45


@dataclass(frozen=True)
class Timing:
    """Of a set rendered by so many workers, its first frames apart."""

    workers: int
    frames: int
    cpu_s_per_set: float
    wall_s_per_set: float
    start_s: float


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--object", default="cup", choices=objects.NAMES)
    parser.add_argument("--frames", type=int, default=16, help="per number of workers, at least 4")
    parser.add_argument("--samples", type=int, default=32)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--json", action="store_true")
    options = parser.parse_args()
    backend = PathTraced.here(options.samples)
    recipe = Recipe(objects.build(options.object), session_camera(), SYNTHETIC, backend, options.seed)
    one, two = (timed(recipe, max(options.frames, 4), workers) for workers in (1, 2))
    speedup = one.wall_s_per_set / two.wall_s_per_set
    result = {
        "object": options.object,
        "seed": options.seed,
        "backend": ", ".join(f"{key} {value}" for key, value in backend.describe().items()),
        "1 worker": asdict(one),
        "2 workers": asdict(two),
        "cpu_s_per_set": one.cpu_s_per_set,
        "wall_s_per_set_2_workers": two.wall_s_per_set,
        "speedup_2_workers": speedup,
        "linearity": speedup / 2,
        "minutes_for_400_on_2_workers": (TARGET_SETS * two.wall_s_per_set + two.start_s) / 60,
        "target_minutes": TARGET_MINUTES,
    }
    if options.json:
        print(json.dumps(result))
        return
    for timing in (one, two):
        print(
            f"{timing.workers} worker(s): {timing.cpu_s_per_set:.2f} CPU s and "
            f"{timing.wall_s_per_set:.2f} s a set ({timing.frames} frames; start {timing.start_s:.1f} s)"
        )
    print(
        f"two workers are {speedup:.2f} times as fast; {TARGET_SETS} sets take "
        f"{result['minutes_for_400_on_2_workers']:.1f} min on two"
    )


def timed(recipe: Recipe, frames: int, workers: int) -> Timing:
    """Renders frames in processes of their own; the clocks start once each has rendered two."""
    with ProcessPoolExecutor(workers, get_context("spawn"), _start, (recipe,)) as pool:
        began = time.perf_counter()
        list(pool.map(_cpu_s, range(2 * workers)))
        begun = time.perf_counter()
        cpu_s = list(pool.map(_cpu_s, range(2 * workers, 2 * workers + frames)))
        ended = time.perf_counter()
    return Timing(workers, frames, sum(cpu_s) / frames, (ended - begun) / frames, begun - began)


_recipe: list[Recipe] = []  # of a worker process


def _start(recipe: Recipe) -> None:
    cv2.setNumThreads(1)
    torch.set_num_threads(1)
    _recipe[:] = [recipe]


def _cpu_s(index: int) -> float:
    before = time.process_time()
    _recipe[0].part(index)
    return time.process_time() - before


if __name__ == "__main__":
    main()
