"""Labels made once on upright crops, and warped along with every view of them."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import pytest
import torch

from s2p3 import presets
from s2p3.config import ExperimentConfig, SelfSupervisionConfig
from s2p3.inputs import View
from s2p3.objects import ObjectModel
from s2p3.rendering.differentiable import RenderMesh, render
from s2p3.training import LabelledCrops, labelled_crops
from s2p3.training.batches import view_window
from s2p3.training.pseudo_labels import PseudoLabels, pooled_maps, warp_labels

EVERY = torch.arange(8)


@pytest.fixture(scope="module")
def experiment() -> ExperimentConfig:
    return presets.quick()


@pytest.fixture(scope="module")
def crops(cup_session: Path, cup: ObjectModel, experiment: ExperimentConfig) -> LabelledCrops:
    return labelled_crops([cup_session], cup, experiment.input)


def true_labels(crops: LabelledCrops, mesh: RenderMesh, experiment: ExperimentConfig) -> PseudoLabels:
    """Those of a teacher that knows the truth: rendered on the upright crops."""
    size = experiment.input.size
    K = view_window(crops, EVERY, View.centred(8, experiment.input.zoom), experiment, size).K
    drawn = pooled_maps(render(mesh, crops.rotation, crops.translation, K, size, size, silhouette=False))
    return PseudoLabels(crops.rotation, crops.translation, *drawn, *drawn, torch.zeros(8))


@pytest.mark.parametrize("angle", [0.0, 0.6, -0.9])
def test_labels_carried_into_a_view_are_those_rendered_in_it(
    angle: float, crops: LabelledCrops, cup: ObjectModel, experiment: ExperimentConfig
) -> None:
    """Maps that were turned, shifted and scaled against a rendering at the pose turned by hand."""
    mesh, size = RenderMesh.from_mesh(cup.mesh), experiment.input.size
    view = View(torch.full((8,), 1.25), torch.tensor([[0.1, -0.06]]).expand(8, 2), torch.full((8,), angle))
    warped = warp_labels(true_labels(crops, mesh, experiment), crops, EVERY, view, mesh, experiment)
    cos, sin = float(view.angle[0].cos()), float(view.angle[0].sin())
    turn = torch.tensor([[cos, -sin, 0.0], [sin, cos, 0.0], [0.0, 0.0, 1.0]])  # about z: x towards y
    rotation, translation = turn @ crops.rotation, crops.translation @ turn.T
    torch.testing.assert_close(warped.rotation, rotation)
    torch.testing.assert_close(warped.translation, translation)
    K = view_window(crops, EVERY, view, experiment, size).K
    mask, normals = pooled_maps(render(mesh, rotation, translation, K, size, size, silhouette=False))
    torch.testing.assert_close(warped.rendered_mask, mask)
    seen, true = warped.mask > 0.5, mask > 0.5
    overlap = (seen & true).sum((1, 2, 3)) / (seen | true).sum((1, 2, 3))
    assert overlap.min() > 0.9
    inside = ((warped.mask > 0.99) & (mask > 0.99))[:, 0]
    apart = (warped.normals * normals).sum(1).clamp(-1, 1).acos().rad2deg()[inside]
    assert inside.sum() > 200
    assert apart.median() < 1.5


@pytest.mark.parametrize(
    ("quantile", "threshold"), [(0.0, 0.1), (0.25, 0.2), (0.5, 0.4), (0.6, 0.5), (1.0, 0.9)]
)
def test_the_threshold_is_a_quantile_of_delta_unless_it_is_given(quantile: float, threshold: float) -> None:
    nothing = torch.zeros(5, 1)
    labels = PseudoLabels(*[nothing] * 6, delta=torch.tensor([0.9, 0.2, 0.4, 0.1, 0.65]))
    settings = SelfSupervisionConfig(threshold_quantile=quantile)
    assert labels.threshold(settings) == pytest.approx(threshold, abs=1e-6)
    assert labels.threshold(dataclasses.replace(settings, threshold=0.25)) == 0.25
