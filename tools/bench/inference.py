"""How long one image takes, in turns in one process on one thread: student, teacher, the student as ONNX, the
priors and the detector. Weights are untrained: they do not change the time.

    python tools/bench/inference.py --json

Networks see one crop of 256x256; `ratio` is the teacher's time by the student's. Priors and detector see an
image of 612x512, the detector from the Stokes image to mask and box: the paper states 13.0 and 15.4 ms for
them, and 7.3 ms for its student on an NVIDIA 2080, about 30 % faster than its teacher.
"""

from __future__ import annotations

import argparse
import json
import tempfile
from pathlib import Path

import numpy as np
import torch
from timing import in_turns

from s2p3 import physics, presets
from s2p3.evaluation.export import WORKING_SIZE
from s2p3.inputs import channel_counts
from s2p3.networks.build import build_student, build_teacher
from s2p3.networks.detector import Detector, detect
from s2p3.networks.lite0 import channels_last
from s2p3.networks.onnx_files import OnnxNetwork, write_onnx


@torch.no_grad()
def measure(rounds: int) -> dict[str, float]:
    """Median milliseconds, batch 1, and the ratio."""
    torch.set_num_threads(1)
    torch.manual_seed(0)
    settings = presets.paper()
    side, (width, height) = settings.input.size, WORKING_SIZE
    seen = [torch.rand(1, channels, side, side) for channels in channel_counts(settings.input)]
    fast = [image.contiguous(memory_format=torch.channels_last) for image in seen]
    student, teacher = build_student(settings).eval(), build_teacher(settings).eval()
    detector = channels_last(Detector(1, imagenet=False)).eval()
    stokes = torch.rand(1, 3, height, width) * torch.tensor([1.0, 0.2, 0.2]).view(1, 3, 1, 1)
    image = np.ascontiguousarray(stokes[0].numpy())
    K = torch.tensor([[[800.0, 0, width / 2], [0, 800.0, height / 2], [0, 0, 1]]])
    level = settings.detector.level
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "student.onnx"
        write_onnx(student, seen, path, "bench")
        exported = OnnxNetwork.load(path)
    found = in_turns(
        {
            "student_ms": lambda: student(*fast),
            "teacher_ms": lambda: teacher(*fast),
            "priors_ms": lambda: physics.shape_priors(stokes, 1.5, K),
            "detector_ms": lambda: detect(detector, image, level, threshold=0.0, minimum_score=0.0),
            "student_onnx_ms": lambda: exported(*seen),
        },
        rounds,
    )
    student_ms, teacher_ms = found.pop("student_ms"), found.pop("teacher_ms")
    return {
        "student_ms": student_ms,
        "teacher_ms": teacher_ms,
        "ratio": teacher_ms / student_ms,
        **found,
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--json", action="store_true", help="one JSON object on stdout")
    parser.add_argument("--rounds", type=int, default=40)
    arguments = parser.parse_args()
    result = {name: round(value, 3) for name, value in measure(arguments.rounds).items()}
    print(json.dumps(result) if arguments.json else "\n".join(f"{k:<18}{v}" for k, v in result.items()))


if __name__ == "__main__":
    main()
