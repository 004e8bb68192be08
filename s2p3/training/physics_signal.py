"""Whether polarization says anything about a data set: measured on every one before it is trained on.

`s2p3.synthesis.informativeness` says what is measured. Where poses are known the normals are the true ones;
of captured frames they are rendered at the poses the teacher gives, so an error of the teacher counts against
the signal. A set without signal can be trained on; but then L_physics cannot help, and its user should know.
"""

from __future__ import annotations

import warnings
from collections.abc import Iterable, Iterator
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from dataset.errors import ToolkitWarning
from s2p3.config import PhysicsVariant
from s2p3.objects import ObjectModel
from s2p3.rendering.differentiable import RenderMesh, render
from s2p3.synthesis.informativeness import Informativeness, measure
from s2p3.training.crops import Crops, LabelledCrops
from s2p3.training.examples import CropSource
from s2p3.training.ranks import is_first

_MEASURED = 64  # crops at most, spread over the set
_HARDLY_LESS = 0.9  # our choice: an error this close to chance is none the better
_INSIDE = 0.5

Seen = tuple[NDArray[np.float32], NDArray[np.float32], NDArray[np.bool_], NDArray[np.float64]]
"""Stokes (3, h, w), normals (h, w, 3), mask (h, w), K (3, 3) of a crop."""


def labelled_signal(source: CropSource, rows: Tensor, model: ObjectModel) -> Informativeness:
    """The figures of crops with known normals: of some of the `rows` of `source`."""
    return _mean(_seen(source.take(rows[_spread(len(rows))])), model)


def captured_signal(
    crops: Crops, rotation: Tensor, translation: Tensor, model: ObjectModel
) -> Informativeness:
    """The figures of captured crops, with normals rendered at estimated poses.

    Args:
        rotation, translation: (N, 3, 3) and (N, 3), T_cam_obj for each of the N crops.
    """
    rows = _spread(len(crops))
    chosen, side = crops.take(rows), crops.stokes.shape[-1]
    mesh = RenderMesh.from_mesh(model.mesh)
    with torch.no_grad():
        drawn = render(mesh, rotation[rows], translation[rows], chosen.K, side, side, silhouette=False)
    return _mean(_seen(chosen, drawn.normals, drawn.mask), model)


def objection(figures: Informativeness, physics: PhysicsVariant = "dolp") -> str | None:
    """Why polarization says nothing here; None where it does. The DoLP matters to a variant of L_physics that
    compares it alone."""
    if not figures.images:
        return "no crop shows enough of the object to measure what its polarization says"
    residual, chance = figures.dolp_residual, figures.dolp_residual_shuffled
    if physics in ("dolp", "dolp-gain") and residual >= _HARDLY_LESS * chance:
        return (
            f"L_physics cannot help here: min |rho - rho_hat| is {residual:.3f} at the object's normals and "
            f'{chance:.3f} at shuffled ones; try physics = "stokes", or "none"'
        )
    if figures.prior_error_deg >= _HARDLY_LESS * figures.chance_error_deg:
        return (
            f"the priors say nothing here: the best is {figures.prior_error_deg:.0f} deg from the object's "
            f"normals, chance {figures.chance_error_deg:.0f} deg; check refractive index and light"
        )
    return None


def report_signal(figures: Informativeness, beside: Path, physics: PhysicsVariant) -> None:
    """Keeps the figures as NAME.signal.json beside a checkpoint to be, and warns where they say nothing to a
    training with this variant of L_physics. Of several processes that train together the first one does."""
    if not is_first():
        return
    beside.parent.mkdir(parents=True, exist_ok=True)
    beside.with_suffix(".signal.json").write_text(figures.to_json() + "\n", encoding="utf-8")
    problem = objection(figures, physics)
    if problem is not None:
        warnings.warn(f"{beside.stem}: {problem}", ToolkitWarning, stacklevel=2)


def _spread(count: int) -> Tensor:
    return torch.linspace(0, count - 1, min(count, _MEASURED)).round().long()


def _seen(crops: Crops, normals: Tensor | None = None, drawn: Tensor | None = None) -> Iterator[Seen]:
    """The crops one by one, with their own normals or those given, where `drawn` is."""
    if normals is None:
        assert isinstance(crops, LabelledCrops)
        normals = crops.normals
    inside = (crops.mask > _INSIDE) & (normals.norm(dim=1, keepdim=True) > _INSIDE)
    if drawn is not None:
        inside = inside & (drawn > _INSIDE)
    if crops.valid is not None:
        inside = inside & crops.valid
    for index in range(len(crops)):
        yield (
            crops.stokes[index].float().numpy(),
            np.moveaxis(normals[index].float().numpy(), 0, -1),
            inside[index, 0].numpy(),
            crops.K[index].double().numpy(),
        )


def _mean(seen: Iterable[Seen], model: ObjectModel) -> Informativeness:
    parts = [measure(*one, model.refractive_index, seed) for seed, one in enumerate(seen)]
    return Informativeness.mean([part for part in parts if part is not None])
