"""Checkpoints of networks that were never trained: good enough to follow what reaches them."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import torch

from s2p3 import presets
from s2p3.config import ExperimentConfig
from s2p3.networks.build import build_student, build_teacher
from s2p3.networks.detector import Detector
from s2p3.objects import ObjectModel
from s2p3.training import checkpoint
from s2p3.training.checkpoint import CheckpointInfo


def eager_detector_config() -> ExperimentConfig:
    """Under which even an untrained detector reports something in every frame."""
    base = presets.quick()
    return replace(base, detector=replace(base.detector, threshold=0.01, minimum_score=0.0))


def save_untrained(folder: Path, model: ObjectModel, config: ExperimentConfig) -> dict[str, Path]:
    """Teacher, student and detector by kind."""
    torch.manual_seed(0)
    networks = {
        "teacher": build_teacher(config),
        "student": build_student(config),
        "detector": Detector(1, imagenet=False),
    }
    paths = {}
    for kind, network in networks.items():
        paths[kind] = folder / f"{kind}.safetensors"
        info = CheckpointInfo.of(kind, "pretrained", model, 0, config, {})  # type: ignore[arg-type]
        checkpoint.save(paths[kind], network.state_dict(), info)
    return paths
