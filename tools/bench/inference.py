"""How long one image takes, in turns in one process on one thread: student, teacher, the student as ONNX, the
priors and the detector at the paper's sizes. Weights are untrained: they do not change the time.

    python tools/bench/inference.py --json

`ratio` is the teacher's time by the student's, `onnx_gain` the student's by its ONNX file's. The paper states
13.0 ms for the priors and 15.4 ms for the detection, of hardware of its own.
"""

from __future__ import annotations

import argparse
import json
import tempfile
from pathlib import Path

import torch
from timing import in_turns

from s2p3 import config, physics
from s2p3.evaluation.export import WORKING_SIZE
from s2p3.inputs import channel_count
from s2p3.networks.detector import Detector, detector_input, downsample
from s2p3.networks.encoder import PRIOR_CHANNELS
from s2p3.networks.lite0 import channels_last
from s2p3.networks.onnx_files import OnnxNetwork, write_onnx
from s2p3.training.pretrain import build_student, build_teacher

PAPER_MS = {"priors": 13.0, "detector": 15.4}


@torch.no_grad()
def measure(rounds: int) -> dict[str, float]:
    """Median milliseconds, batch 1, 256x256; priors and detector of a 612x512 image."""
    torch.set_num_threads(1)
    torch.manual_seed(0)
    settings = config.paper()
    side, (width, height) = settings.input.size, WORKING_SIZE
    sizes = (channel_count(settings.input), PRIOR_CHANNELS)
    seen = [torch.rand(1, channels, side, side) for channels in sizes]
    fast = [image.contiguous(memory_format=torch.channels_last) for image in seen]
    student, teacher = build_student(settings).eval(), build_teacher(settings).eval()
    detector = channels_last(Detector(imagenet=False)).eval()
    stokes = torch.rand(1, 3, height, width) * torch.tensor([1.0, 0.2, 0.2]).view(1, 3, 1, 1)
    K = torch.tensor([[[800.0, 0, width / 2], [0, 800.0, height / 2], [0, 0, 1]]])
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "student.onnx"
        write_onnx(student, seen, path, "bench")
        exported = OnnxNetwork.load(path)
    found = in_turns(
        {
            "student_ms": lambda: student(*fast),
            "teacher_ms": lambda: teacher(*fast),
            "student_onnx_ms": lambda: exported(*seen),
            "priors_ms": lambda: physics.shape_priors(stokes, 1.5, K),
            "detector_ms": lambda: detector(detector_input(downsample(stokes, settings.detector.level))),
        },
        rounds,
    )
    gains = {
        "ratio": found["teacher_ms"] / found["student_ms"],
        "onnx_gain": found["student_ms"] / found["student_onnx_ms"],
    }
    return found | gains | {f"paper_{name}_ms": value for name, value in PAPER_MS.items()}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--json", action="store_true", help="one JSON object on stdout")
    parser.add_argument("--rounds", type=int, default=40)
    arguments = parser.parse_args()
    result = {name: round(value, 3) for name, value in measure(arguments.rounds).items()}
    print(json.dumps(result) if arguments.json else "\n".join(f"{k:<18}{v}" for k, v in result.items()))


if __name__ == "__main__":
    main()
