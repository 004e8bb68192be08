"""Whether the loader keeps ahead of the student: `python tools/bench/loader.py [--size 128] [--json]`.

Peers in the same run: the student's training step on tensors that are ready, and reading the same mosaics
from a plain file of raw bytes. The session is synthetic in layout only: random polarized images of 612x512, a
known mesh at random poses. One loader process with one thread; the step runs alone, with one thread.
"""

from __future__ import annotations

import argparse
import json
import os
import tempfile
import time
from collections.abc import Callable
from contextlib import closing
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch

from dataset import SE3, CameraInfo, Intrinsics, RawFrame
from dataset.polarimetry import Stokes, encode
from dataset.session import ObjectPoses, Session, SessionWriter, mask_box, write_object, write_poses
from s2p3.inputs import View
from s2p3.networks.build import build_student
from s2p3.objects import build
from s2p3.presets import fast
from s2p3.rendering import rasterize
from s2p3.training.batches import form_input, form_targets
from s2p3.training.crops import LabelledCrops
from s2p3.training.loader import CropDataset, Steps, stream
from s2p3.training.supervised import model_tensors, pose_terms

HEIGHT, WIDTH, BATCH = 512, 612, 16
OBJECT = "cup"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument(
        "--size", type=int, choices=(64, 128, 256), default=128, help="side of the network's input, pixels"
    )
    parser.add_argument("--frames", type=int, default=96, help="frames of the session")
    parser.add_argument("--seconds", type=float, default=10.0, help="for each measurement")
    parser.add_argument("--json", action="store_true")
    options = parser.parse_args()
    os.environ["OMP_NUM_THREADS"] = "1"
    torch.set_num_threads(1)
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "session.h5"
        write_session(path, options.frames)
        result = measure(path, options.size, options.seconds)
    if options.json:
        print(json.dumps(result))
    else:
        for name, value in result.items():
            print(f"{name:22}{value:10.2f}")


@dataclass(frozen=True)
class Plain:
    """Batches of crops as they come off the disk."""

    crops: CropDataset

    def __len__(self) -> int:
        return len(self.crops)

    def __call__(self, rows: torch.Tensor, generator: torch.Generator) -> LabelledCrops:
        del generator
        return self.crops.take(rows)


def measure(path: Path, size: int, seconds: float) -> dict[str, float]:
    """The rates, in images and megabytes of pixels a second."""
    model, config = build(OBJECT), fast()
    config = replace(
        config,
        input=replace(config.input, size=size, canonical_size=size * 3 // 2),
        network=replace(config.network, total_stride=32 if size == 256 else 16),  # 32 as published
    )
    with closing(
        stream(Steps(Plain(CropDataset([path], model, config.input)), BATCH, 0), 0, 10**6, 1)
    ) as batches:
        crops = next(batches)  # the worker has started and read its first batches
        images = rate(lambda: len(next(batches)), seconds)

    indices, view = torch.arange(len(crops)), View.centred(len(crops), config.input.zoom)
    batch = form_input(crops, indices, view, model.refractive_index, config)
    targets = form_targets(crops, indices, view, config)
    student = build_student(config).train()
    optimizer = torch.optim.AdamW(student.parameters(), 1e-4, fused=True)
    points, symmetries = model_tensors(model)

    def step() -> int:
        output = student(batch.polarization, batch.priors)
        terms = pose_terms(output, batch.K, targets, batch.size, model.diameter, points, symmetries)
        optimizer.zero_grad(set_to_none=True)
        terms["total"].backward()
        optimizer.step()
        return len(crops)

    student_images = rate(step, seconds)
    h5, raw = reading_rates(path, seconds / 2)
    return {
        "images_per_s": images,
        "student_images_per_s": student_images,
        "ratio": images / student_images,
        "h5_read_MBps": h5,
        "raw_read_MBps": raw,
    }


def reading_rates(path: Path, seconds: float) -> tuple[float, float]:
    """Megabytes of pixels a second: checked mosaics from the session, and the same bytes from a plain
    file."""
    plain = path.with_suffix(".raw")
    with Session.open(path) as session:
        count = len(session)
        with plain.open("wb") as stream:
            for index in range(count):
                stream.write(session.raw(index).tobytes())
        size = session.raw(0).nbytes
        h5 = rate(lambda: sum(session.raw(index).nbytes for index in range(count)), seconds)

    def read_plain() -> int:
        with plain.open("rb") as stream:
            return sum(len(stream.read(size)) for _ in range(count))

    return h5 / 1e6, rate(read_plain, seconds) / 1e6


def rate(work: Callable[[], int], seconds: float) -> float:
    """What `work` returns, summed, a second; after one call that does not count."""
    work()
    done, start = 0, time.perf_counter()
    while time.perf_counter() - start < seconds:
        done += work()
    return done / (time.perf_counter() - start)


def write_session(path: Path, frames: int) -> None:
    """A session of smooth, noisy, polarized images in which the object is at random poses."""
    rng, model = np.random.default_rng(0), build(OBJECT)
    camera = CameraInfo("bench", "bench", "", "", "Mono12", "mono", 2 * WIDTH, 2 * HEIGHT, 12, 0)
    K = np.array([[703.4, 0, 607.8], [0, 703.5, 503.3], [0, 0, 1.0]])
    mosaic = Intrinsics(K, np.zeros(0), camera.height, camera.width)
    working = mosaic.at(2)
    poses, masks = [], []
    y, x = np.mgrid[:HEIGHT, :WIDTH].astype(np.float32) / HEIGHT
    with SessionWriter(path, "synthetic", camera, intrinsics=mosaic) as writer:
        for index in range(frames):
            noise = rng.normal(0, 0.005, (3, HEIGHT, WIDTH)).astype(np.float32)
            s0 = 0.6 + 0.3 * np.sin(5 * x + index) + noise[0]
            light = [s0, 0.3 * s0 * np.cos(7 * y) + noise[1], 0.3 * s0 * np.sin(7 * y) + noise[2]]
            stokes = Stokes(*(np.asarray(part, np.float32) for part in light), np.ones((HEIGHT, WIDTH), bool))
            now = time.monotonic_ns()
            writer.add_frame(RawFrame(encode(stokes, "mono", 12), "Mono12", index, now, now, 1.0, 0.0, 0))
            shift = [*rng.uniform(-0.08, 0.08, 2), rng.uniform(0.4, 0.6)]
            poses.append(SE3.from_rotvec(rng.normal(size=3), shift))
            masks.append(rasterize(model.mesh, poses[-1], working).mask)
    boxes = np.stack([mask_box(mask) for mask in masks])
    write_object(path, model.to_record())
    truth = ObjectPoses(SE3.stack(poses), np.ones(frames), boxes, masks)
    write_poses(path, SE3.identity((frames,)), 0.0, 0.0, {model.name: truth})


if __name__ == "__main__":
    main()
