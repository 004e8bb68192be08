"""Checkpoints to ONNX files, which `Estimator` and `Finder` read like the checkpoints themselves."""

from __future__ import annotations

import shutil
from pathlib import Path

import torch
from torch import Tensor, nn

from dataset.errors import ToolkitError
from s2p3.inputs import channel_counts
from s2p3.networks.detector import detector_input, downsample
from s2p3.networks.onnx_files import write_onnx
from s2p3.training import checkpoint
from s2p3.training.checkpoint import CheckpointInfo
from s2p3.training.detection import load_detector
from s2p3.training.supervised import load_student, load_teacher
from s2p3.writable import check_folder

WORKING_SIZE = (612, 512)
"""(width, height) of the polarization image that a detector is exported for: the paper's."""


def export(path: Path, out: Path, image_size: tuple[int, int] = WORKING_SIZE) -> float:
    """Writes the network of a checkpoint as `out` (NAME.onnx), with the checkpoint's NAME.json beside it.

    Args:
        image_size: (width, height) of the polarization image; a detector's file takes this size only.

    Returns:
        The largest relative difference from the checkpoint's network, see `write_onnx`.

    Raises ToolkitError: no such checkpoint; `out` cannot be written; the exported network differs.
    """
    if out.suffix != ".onnx" or out.is_dir():
        raise ToolkitError(f"{out}: an exported network is a file NAME.onnx; name it so")
    check_folder(out.parent)
    info = checkpoint.read_info(path)
    load = {"teacher": load_teacher, "student": load_student, "detector": load_detector}[info.kind]
    network: nn.Module = load(path)[0]
    description = path.with_suffix(".json")
    worst = write_onnx(network, _examples(info, image_size), out, description.read_text(encoding="utf-8"))
    beside = out.with_suffix(".json")
    if beside.resolve() != description.resolve():
        shutil.copyfile(description, beside)
    return worst


def _examples(info: CheckpointInfo, image_size: tuple[int, int]) -> tuple[Tensor, ...]:
    """Inputs of the network's sizes and about its units."""
    generator = torch.Generator().manual_seed(1)
    if info.kind == "detector":
        width, height = image_size
        stokes = torch.rand(1, 3, height, width, generator=generator) * torch.tensor([1, 0.2, 0.2]).view(
            1, 3, 1, 1
        )
        return (detector_input(downsample(stokes, info.config.detector.level)),)
    side = info.config.input.size
    counts = channel_counts(info.config.input)
    return tuple(torch.rand(1, count, side, side, generator=generator) for count in counts)
