"""From canonical crops to a batch: look through a view, augment, form channels, and carry the targets
along."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import torch
import torch.nn.functional as F
from torch import Tensor

from s2p3 import inputs
from s2p3.config import ExperimentConfig
from s2p3.inputs import NetworkInput, View, Window
from s2p3.networks.teacher import MAP_STRIDE
from s2p3.training.crops import Crops, LabelledCrops

_WHOLLY = 0.999  # of a resampled flag: every pixel under it had it


@dataclass(frozen=True)
class Targets:
    """The truth of B network inputs of side S; maps at S / 4.

    Attributes:
        rotation, translation: (B, 3, 3) and (B, 3) of T_cam_obj in the view's camera.
        mask: (B, 1, S/4, S/4), 0 to 1, visible mask.
        normals: (B, 3, S/4, S/4), unit inside, view's camera frame.
        coordinates: (B, 3, S/4, S/4).
    """

    rotation: Tensor
    translation: Tensor
    mask: Tensor
    normals: Tensor
    coordinates: Tensor


def view_window(crops: Crops, indices: Tensor, view: View, config: ExperimentConfig, size: int) -> Window:
    """The window of `view` into the chosen crops at `size` pixels a side."""
    canonical = crops.stokes.shape[-1]
    return inputs.window(view, crops.K[indices], canonical, config.input.canonical_zoom, size)


def at_half(mask: Tensor) -> Tensor:
    """A predicted mask, (B, 1, S, S), as zeros and ones."""
    return (mask > 0.5).float()


def as_predicted(mask: Tensor, generator: torch.Generator) -> Tensor:
    """A true mask, (B, 1, S, S), made wrong the way a detector's is: blurred, then cut at a random level, so
    it grows or shrinks."""
    blurred = F.avg_pool2d(mask, 5, 1, 2)
    level = 0.2 + 0.6 * torch.rand(len(mask), 1, 1, 1, generator=generator)
    return (blurred > level).float()


def form_input(
    crops: Crops,
    indices: Tensor,
    view: View,
    refractive_index: float,
    config: ExperimentConfig,
    augment: torch.Generator | None = None,
    cut: Callable[[Tensor], Tensor] = at_half,
) -> NetworkInput:
    """The network input of the chosen crops, seen through `view`.

    Args:
        augment: with a generator, photometric augmentation is applied.
        cut: makes zeros and ones of the masks; those that are the truth are cut `as_predicted`.
    """
    window = view_window(crops, indices, view, config, config.input.size)
    stokes = inputs.rotate_stokes(window.resample(crops.stokes[indices].float()), view.angle)
    stokes = measured = inputs.normalize_exposure(stokes)
    if augment is not None:
        stokes = inputs.augment_photometry(stokes, config.augmentation, augment)
    mask = None
    if config.input.background == "mask":
        mask = cut(window.resample(crops.mask[indices].float(), padding="zeros"))
    depth = None
    if crops.depth is not None:
        depth = window.resample(crops.depth[indices].float(), mode="nearest", padding="zeros")
    seen = inputs.network_channels(stokes, window.K, refractive_index, config.input, mask, depth)
    valid = torch.ones_like(stokes[:, :1], dtype=torch.bool)
    if crops.valid is not None:
        valid = window.resample(crops.valid[indices].float(), padding="zeros") > _WHOLLY
    return NetworkInput(*seen, window.K, measured, valid, depth)


def form_targets(crops: LabelledCrops, indices: Tensor, view: View, config: ExperimentConfig) -> Targets:
    """The truth of the same view."""
    size = config.input.size
    fine = view_window(crops, indices, view, config, size)
    coarse = view_window(crops, indices, view, config, size // MAP_STRIDE)
    mask = fine.resample(crops.mask[indices].float(), padding="zeros")
    normals = coarse.resample(crops.normals[indices].float(), mode="nearest", padding="zeros")
    return Targets(
        rotation=fine.rotation @ crops.rotation[indices],
        translation=turn_vectors(fine.rotation, crops.translation[indices]),
        mask=F.avg_pool2d(mask, MAP_STRIDE),
        normals=F.normalize(turn_maps(fine.rotation, normals), dim=1),
        coordinates=coarse.resample(crops.coordinates[indices].float(), mode="nearest", padding="zeros"),
    )


def turn_vectors(rotation: Tensor, vectors: Tensor) -> Tensor:
    """(B, 3, 3) applied to (B, 3)."""
    return torch.einsum("bij,bj->bi", rotation, vectors)


def turn_maps(rotation: Tensor, maps: Tensor) -> Tensor:
    """(B, 3, 3) applied to the vectors of maps (B, 3, h, w)."""
    return torch.einsum("bij,bjhw->bihw", rotation, maps)
