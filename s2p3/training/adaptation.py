"""AdaBN (Li et al. 2016): BatchNorm statistics re-estimated on the captured domain, weights untouched. Our
addition."""

from __future__ import annotations

import torch
from torch import nn

from s2p3.config import ExperimentConfig, SelfSupervisionConfig
from s2p3.inputs import View
from s2p3.networks.student import Student
from s2p3.networks.teacher import Teacher
from s2p3.training.batches import form_input
from s2p3.training.crops import Crops
from s2p3.training.loop import sample_indices

_BATCH = 32
_MOMENTUM = 0.1


def set_momentum(network: nn.Module, momentum: float) -> None:
    """Sets how fast every BatchNorm of `network` follows its batches."""
    for module in network.modules():
        if isinstance(module, nn.BatchNorm2d):
            module.momentum = momentum


@torch.no_grad()
def adapt_batch_norm(
    network: Teacher | Student,
    crops: Crops,
    refractive_index: float,
    config: ExperimentConfig,
    settings: SelfSupervisionConfig,
) -> None:
    """Runs `settings.adapt_batches` augmented batches through `network` in place; leaves it in evaluation
    mode."""
    generator = torch.Generator().manual_seed(settings.seed)
    set_momentum(network, _MOMENTUM)
    network.train()
    for _ in range(settings.adapt_batches):
        indices = sample_indices(len(crops), _BATCH, generator)
        view = View.random(_BATCH, config.augmentation, generator)
        seen = form_input(crops, indices, view, refractive_index, config, generator)
        network(seen.polarization, seen.priors)
    network.eval()
