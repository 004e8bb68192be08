"""What becomes of BatchNorm statistics in another domain: they follow, are re-estimated first (AdaBN, Li et
al. 2016; our addition), or are frozen."""

from __future__ import annotations

from typing import TYPE_CHECKING

import torch
from torch import nn

from s2p3.config import ExperimentConfig, SelfSupervisionConfig
from s2p3.inputs import View
from s2p3.networks.student import Student
from s2p3.networks.teacher import Teacher
from s2p3.training.batches import form_input
from s2p3.training.crops import Crops

if TYPE_CHECKING:
    from typing_extensions import Self

_BATCH = 32
_MOMENTUM = 0.1


def set_momentum(network: nn.Module, momentum: float) -> None:
    """Sets how fast every BatchNorm of `network` follows its batches."""
    for module in network.modules():
        if isinstance(module, nn.BatchNorm2d):
            module.momentum = momentum


def freeze_norms(network: nn.Module) -> None:
    """Makes every BatchNorm of `network` keep its statistics in training, too; weights and names stay."""
    for parent in list(network.modules()):
        for name, child in parent.named_children():
            if type(child) is nn.BatchNorm2d:
                frozen = _FrozenBatchNorm(child.num_features, child.eps, affine=child.affine)
                frozen.load_state_dict(child.state_dict())
                setattr(parent, name, frozen.eval())


class _FrozenBatchNorm(nn.BatchNorm2d):
    """A BatchNorm that is always in evaluation mode."""

    def train(self, mode: bool = True) -> Self:
        del mode
        return super().train(False)


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
        indices = torch.randint(0, len(crops), (_BATCH,), generator=generator)
        view = View.random(_BATCH, config.augmentation, generator)
        seen = form_input(crops, indices, view, refractive_index, config, generator)
        network(seen.polarization, seen.priors)
    network.eval()
