"""What a network weighs and costs, counted on the network itself."""

from __future__ import annotations

import dataclasses
from typing import Any, Literal

import torch
from torch import Tensor
from torch.utils.flop_counter import FlopCounterMode

from s2p3.config import ExperimentConfig
from s2p3.inputs import channel_counts
from s2p3.networks.build import build_student, build_teacher
from s2p3.networks.teacher import TeacherOutput

_SIZE = 256
_STRIDE: Literal[32] = 32
_INPUTS = ("polarization", "priors")
_BUILDERS = {"teacher": build_teacher, "student": build_student}


def describe(kind: Literal["teacher", "student"], config: ExperimentConfig) -> dict[str, Any]:
    """The network of an experiment in numbers.

    Args:
        kind: of network.

    Returns:
        parameters: weights that are trained; gflop_256: 1e9 floating-point operations (two for a
        multiplication with addition) for one crop of 256x256 at the published stride; inputs, outputs: names
        and shapes for one crop of the experiment's size.
    """
    large = dataclasses.replace(
        config,
        input=dataclasses.replace(config.input, size=_SIZE, canonical_size=2 * _SIZE),
        network=dataclasses.replace(config.network, total_stride=_STRIDE),
    )
    build = _BUILDERS[kind]
    network, seen = build(config).eval(), _crop(config)
    with torch.no_grad():
        output = network(*seen)
        with FlopCounterMode(display=False) as counter:
            build(large).eval()(*_crop(large))
    outputs = vars(output) if isinstance(output, TeacherOutput) else {"pose": output}
    return {
        "parameters": sum(weight.numel() for weight in network.parameters()),
        "gflop_256": round(counter.get_total_flops() / 1e9, 3),
        "inputs": _shapes(dict(zip(_INPUTS, seen, strict=True))),
        "outputs": _shapes(outputs),
    }


def _crop(config: ExperimentConfig) -> list[Tensor]:
    side = config.input.size
    return [torch.zeros(1, count, side, side) for count in channel_counts(config.input)]


def _shapes(tensors: dict[str, Tensor]) -> dict[str, list[int]]:
    return {name: list(tensor.shape) for name, tensor in tensors.items()}
