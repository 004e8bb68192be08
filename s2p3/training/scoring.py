"""How good a network is on labelled crops it was not trained on, by the metric of the evaluation."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from torch import nn

from dataset import SE3
from s2p3 import metrics
from s2p3.config import ExperimentConfig
from s2p3.inputs import View
from s2p3.networks.pose_head import decode_pose
from s2p3.networks.teacher import pose_of
from s2p3.objects import ObjectModel
from s2p3.training.batches import form_input
from s2p3.training.crops import LabelledCrops

_CHUNK = 32


@dataclass(frozen=True)
class PoseScorer:
    """Recall of ADD, or of ADD-S for an object with a symmetry, at 10 % of the diameter, percent.

    Crops are cut at the annotated boxes and masks, without augmentation: this chooses among weights, and does
    not replace the evaluation.
    """

    crops: LabelledCrops
    model: ObjectModel
    config: ExperimentConfig

    @property
    def name(self) -> str:
        """Which of the two it is."""
        return f"{metrics.metric_name(self.model).lower().replace('-', '_')}_recall_10"

    @torch.no_grad()
    def __call__(self, network: nn.Module) -> float:
        error = metrics.surface_errors(self.model)[metrics.metric_name(self.model)]
        errors = []
        for start in range(0, len(self.crops), _CHUNK):
            chosen = torch.arange(start, min(start + _CHUNK, len(self.crops)))
            estimated = self._poses(network, chosen)
            true = SE3(
                *(part[chosen].double().numpy() for part in (self.crops.rotation, self.crops.translation))
            )
            errors.append(error(estimated, true))
        return metrics.recall(np.concatenate(errors), 0.1 * self.model.diameter)

    def _poses(self, network: nn.Module, chosen: torch.Tensor) -> SE3:
        view = View.centred(len(chosen), self.config.input.zoom)
        seen = form_input(self.crops, chosen, view, self.model.refractive_index, self.config)
        device = next(network.parameters()).device
        output = pose_of(network(seen.polarization.to(device), seen.priors.to(device))).cpu()
        rotation, translation, _ = decode_pose(output, seen.K, seen.size, self.model.diameter)
        return SE3(rotation.double().numpy(), translation.double().numpy())
