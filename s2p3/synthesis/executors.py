"""Who renders the frames of a set: this process, several on this machine, or a Ray cluster.

Whoever it is hands back bytes; one process stores them. So workers need no common disk, and a set that was
interrupted lacks the frames under way and no other.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from multiprocessing import get_context
from typing import Any, Literal

from dataset import ToolkitError
from s2p3.synthesis.frames import Recipe

Executor = Literal["local", "ray"]

_AHEAD = 2  # frames handed to each worker before the first is back


def rendered(
    recipe: Recipe, indices: Sequence[int], workers: int, executor: Executor = "local"
) -> Iterator[tuple[int, bytes]]:
    """Renders frames and yields (index, `Recipe.part`) as they are done, in any order.

    Args:
        workers: processes, or actors of one CPU each.
        executor: "ray" uses the cluster that RAY_ADDRESS names, or starts one on this machine.

    Raises:
        ToolkitError: Ray is missing, or a worker was ended from outside.
    """
    if not indices:
        return iter(())
    if executor == "ray":
        return _by_ray(recipe, indices, workers)
    if workers <= 1:
        return ((index, recipe.part(index)) for index in indices)
    return _by_processes(recipe, indices, workers)


class _Worker:
    """A process of its own with one thread for everything.

    Args:
        recipe: travels once, not with every frame.
    """

    def __init__(self, recipe: Recipe) -> None:
        import cv2
        import torch

        cv2.setNumThreads(1)
        torch.set_num_threads(1)
        self._recipe = recipe

    def part(self, index: int) -> tuple[int, bytes]:
        return index, self._recipe.part(index)


_worker: list[_Worker] = []  # of a worker process


def _start(recipe: Recipe) -> None:
    _worker[:] = [_Worker(recipe)]


def _part(index: int) -> tuple[int, bytes]:
    return _worker[0].part(index)


def _by_processes(recipe: Recipe, indices: Sequence[int], workers: int) -> Iterator[tuple[int, bytes]]:
    # a forked child would inherit the threads of torch and OpenCV half alive
    with ProcessPoolExecutor(workers, get_context("spawn"), _start, (recipe,)) as pool:
        pending: set[Future[tuple[int, bytes]]] = set()
        waiting = iter(indices)
        try:
            while True:
                for index in waiting:
                    pending.add(pool.submit(_part, index))
                    if len(pending) >= _AHEAD * workers:
                        break
                if not pending:
                    return
                done, pending = wait(pending, return_when=FIRST_COMPLETED)
                yield from (future.result() for future in done)
        except BrokenProcessPool as error:
            raise ToolkitError(
                "a rendering process was ended from outside, perhaps for want of memory; the same command "
                "goes on, fewer --workers need less"
            ) from error
        finally:
            for future in pending:
                future.cancel()


def _by_ray(recipe: Recipe, indices: Sequence[int], workers: int) -> Iterator[tuple[int, bytes]]:
    ray = _ray()
    started = not ray.is_initialized()
    if started:
        ray.init(log_to_driver=False, include_dashboard=False, logging_level="warning")
    try:
        shared = ray.put(recipe)
        actors = [ray.remote(_Worker).options(num_cpus=1).remote(shared) for _ in range(max(workers, 1))]
        waiting = iter(indices)
        pending = {
            actor.part.remote(index): actor for actor, index in zip(actors * _AHEAD, waiting, strict=False)
        }
        while pending:
            (done,), _ = ray.wait(list(pending), num_returns=1)
            actor = pending.pop(done)
            for index in waiting:
                pending[actor.part.remote(index)] = actor
                break
            yield _fetched(ray, done)
    finally:
        if started:
            ray.shutdown()


def _fetched(ray: Any, done: Any) -> tuple[int, bytes]:
    try:
        index, part = ray.get(done)
    except ray.exceptions.RayTaskError as error:
        cause = error.cause
        raise cause if isinstance(cause, ToolkitError) else error from None
    except ray.exceptions.RayActorError as error:
        raise ToolkitError(
            "a rendering actor was ended, perhaps with its node; the same command goes on where it was"
        ) from error
    return int(index), bytes(part)


def _ray() -> Any:
    try:
        import ray
    except ImportError as error:
        raise ToolkitError(f"--executor ray needs Ray ({error}); pip install 's2p3[cluster]'") from error
    return ray
