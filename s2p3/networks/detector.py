"""The detector: where the object is in a polarization image, as a visible mask and a box. Our own design; the
paper only says that a customized detector is trained on synthetic data.

It sees the image down-sampled (`level`), S0 and the direction and degree of polarization. Every pixel of the
predicted mask votes for the box by its distances to the four sides; the box is the weighted median of the
votes.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import cv2
import numpy as np
import torch
import torch.nn.functional as F
from numpy.typing import NDArray
from torch import Tensor, nn

from s2p3.inputs import degree_of_polarization, normalize_exposure
from s2p3.networks.lite0 import Lite0, load_imagenet
from s2p3.networks.pose_head import conv_norm_leaky, doubled

CELL = 2
"""Side of an output cell in pixels of the down-sampled image."""
_STRIDE = 16
_TAPS = (0, 2, 4)
_BLOCKS = 11
_DISTANCE_UNIT = 16.0  # pixels of the down-sampled image
_MINIMUM_CELLS = 6


@dataclass(frozen=True)
class Detection:
    """One object found in one image.

    Attributes:
        box_xywh: (4,) pixel-edge coordinates of the polarization image.
        mask: (H, W) bool, visible mask at the polarization image.
        score: mean mask probability, 0 to 1.
    """

    box_xywh: NDArray[np.float64]
    mask: NDArray[np.bool_]
    score: float


class Detector(nn.Module):
    """Lite0 blocks 0-10 with a decoder back to stride 2, one mask per class and four distances per cell, to
    the box of the class that the cell shows."""

    def __init__(self, classes: int, imagenet: bool) -> None:
        super().__init__()
        self.classes = classes
        self.trunk = Lite0(4, _BLOCKS, _TAPS)
        if imagenet:
            load_imagenet(self.trunk)
        skip2, skip4, skip8 = (self.trunk.block_channels[tap] for tap in _TAPS)
        self.normalize = nn.BatchNorm2d(4, affine=False, momentum=0.02)
        self.decode8 = nn.Sequential(*conv_norm_leaky(self.trunk.block_channels[-1] + skip8, 64))
        self.decode4 = nn.Sequential(*conv_norm_leaky(64 + skip4, 48))
        self.decode2 = nn.Sequential(*conv_norm_leaky(48 + skip2, 32))
        self.output = nn.Conv2d(32, classes + 4, 1)

    def forward(self, image: Tensor) -> tuple[Tensor, Tensor]:
        """(B, 4, h, w), sides multiples of 16, from `detector_input` -> mask logits (B, classes, h/2, w/2)
        and distances (B, 4, h/2, w/2) to the box's left, top, right and bottom, in pixels of the down-sampled
        image."""
        x, (skip2, skip4, skip8) = self.trunk(self.normalize(image))
        x = self.decode8(torch.cat([doubled(x), skip8], dim=1))
        x = self.decode4(torch.cat([doubled(x), skip4], dim=1))
        x = self.output(self.decode2(torch.cat([doubled(x), skip2], dim=1)))
        return x[:, : self.classes], F.softplus(x[:, self.classes :]) * _DISTANCE_UNIT


def downsample(stokes: Tensor, level: int) -> Tensor:
    """(B, C, H, W) -> (B, C, H // level, W // level), mean of blocks."""
    return F.avg_pool2d(stokes, level)


def detector_input(stokes: Tensor) -> Tensor:
    """Down-sampled Stokes images (B, 3, h, w) -> (B, 4, h', w') padded to multiples of 16: root of S0
    (exposure removed), DoLP, and the direction of polarization weighted by the root of the DoLP."""
    stokes = normalize_exposure(stokes)
    s0, s1, s2 = stokes.unbind(1)
    dolp = degree_of_polarization(stokes)
    weight = dolp.sqrt() / torch.hypot(s1, s2).clamp_min(1e-6)
    image = torch.stack([s0.clamp(0, 3).sqrt(), dolp, s1 * weight, s2 * weight], dim=1)
    height, width = image.shape[2:]
    padded = F.pad(image, (0, -width % _STRIDE, 0, -height % _STRIDE), mode="replicate")
    return padded.contiguous(memory_format=torch.channels_last)


DetectorNetwork = Callable[[Tensor], tuple[Tensor, Tensor]]
"""A `Detector`, or what takes and gives the same."""


@torch.no_grad()
def detect(
    network: DetectorNetwork,
    stokes: NDArray[np.float32],
    level: int,
    threshold: float,
    minimum_score: float,
    class_index: int = 0,
) -> Detection | None:
    """Finds one object in one undistorted polarization image.

    Args:
        stokes: (3, H, W).
        level, threshold, minimum_score: see `s2p3.config.DetectorConfig`.
        class_index: of the object, in the order the detector was trained for.

    Returns None where nothing is found.
    """
    height, width = stokes.shape[1:]
    logits, distances = network(detector_input(downsample(torch.from_numpy(stokes)[None], level)))
    rows, columns = -(-(height // level) // CELL), -(-(width // level) // CELL)
    probability = logits[0, class_index].sigmoid().numpy()[:rows, :columns]
    cells = _largest_blob(probability, threshold)
    if cells is None:
        return None
    weights = probability[cells]
    score = float(weights.mean())
    if score < minimum_score:
        return None
    votes = _votes(cells, distances[0].numpy())
    left, top, right, bottom = (level * _weighted_median(side, weights) for side in votes)
    fine = cv2.resize(np.where(_grown(cells), probability, 0), None, fx=level * CELL, fy=level * CELL)
    mask = np.zeros((height, width), dtype=bool)
    part = fine[:height, :width] > threshold
    mask[: part.shape[0], : part.shape[1]] = part
    box = np.array([left, top, max(right - left, 1.0), max(bottom - top, 1.0)])
    return Detection(box, mask, score)


def _largest_blob(probability: NDArray[np.float32], threshold: float) -> NDArray[np.bool_] | None:
    count, labels = cv2.connectedComponents((probability > threshold).astype(np.uint8))
    weights = np.bincount(labels.ravel(), probability.ravel(), minlength=count)
    weights[0] = 0
    cells: NDArray[np.bool_] = labels == int(weights.argmax())
    return cells if count > 1 and cells.sum() >= _MINIMUM_CELLS else None


def _grown(cells: NDArray[np.bool_]) -> NDArray[np.bool_]:
    grown: NDArray[np.bool_] = cv2.dilate(cells.astype(np.uint8), np.ones((3, 3), np.uint8)) > 0
    return grown


def _votes(cells: NDArray[np.bool_], distances: NDArray[np.float32]) -> NDArray[np.float64]:
    """(4, n): left, top, right, bottom as each cell sees them, edge coordinates of the down-sampled image."""
    y, x = (CELL * (np.array(axis) + 0.5) for axis in np.nonzero(cells))
    left, top, right, bottom = distances[:, : cells.shape[0], : cells.shape[1]][:, cells]
    return np.stack([x - left, y - top, x + right, y + bottom])


def _weighted_median(values: NDArray[np.float64], weights: NDArray[np.float32]) -> float:
    order = np.argsort(values)
    below = np.cumsum(weights[order])
    return float(values[order[np.searchsorted(below, below[-1] / 2)]])
