"""The losses on appearance of Self6D++ (Wang et al. 2021), the RGB-D baseline: colour in LAB, structure by
MS-SSIM, perceptual distance by LPIPS, and its re-weighted cross entropy of masks.

They compare a rendered with a captured image, (B, 3, h, w) in 0..1, where `mask` (B, 1, h, w) sees the
object. The polarization camera's colours are averaged throughout the toolkit, and objects have no texture: on
grey images the colour term is zero whatever the pose, which is what the S2P3 paper objects to in it.
"""

from __future__ import annotations

import math
from functools import cache

import torch
import torch.nn.functional as F
from torch import Tensor

SCALES = (0.0448, 0.2856, 0.3001, 0.2363, 0.1333)
"""Weights of MS-SSIM's scales, from full resolution down (Wang et al. 2003)."""

_WINDOW, _SIGMA = 11, 1.5
_C1, _C2 = 0.01**2, 0.03**2
_RGB_TO_XYZ = (
    (0.412453, 0.357580, 0.180423),
    (0.212671, 0.715160, 0.072169),
    (0.019334, 0.119193, 0.950227),
)
_WHITE = (0.950456, 1.0, 1.088754)  # D65
_AB_RANGE = 100.0
_SOFT = 0.02  # masks are moved this far from 0 and 1, where the cross entropy is infinite


def shaded(normals: Tensor, rays: Tensor) -> Tensor:
    """What a white matt object looks like, lit from the camera (B, 3, h, w): the rendering of an object
    without texture (our choice).

    Args:
        normals: (B, 3, h, w) rendered, unit, zero outside the object.
        rays: (B, 3, h, w) unit viewing rays.
    """
    return (-(normals * rays).sum(1, keepdim=True)).clamp(0, 1).expand(-1, 3, -1, -1)


def exposed_like(image: Tensor, target: Tensor, mask: Tensor) -> Tensor:
    """`image` times the factor that brings it closest to `target` over `mask`: lamps are unknown. No gradient
    flows to the factor."""
    weight = mask.detach()
    fit = (image * target * weight).sum((1, 2, 3)) / (image.square() * weight).sum((1, 2, 3)).clamp_min(1e-6)
    return image * fit.detach()[:, None, None, None]


def colour_loss(image: Tensor, target: Tensor, mask: Tensor) -> Tensor:
    """Mean L1 distance (B,) of a and b of CIE LAB over the mask, in units of 100; lightness is left out."""
    difference = (_lab(image)[:, 1:] - _lab(target)[:, 1:]).abs().sum(1, keepdim=True) / _AB_RANGE
    return (difference * mask).sum((1, 2, 3)) / mask.sum((1, 2, 3)).clamp_min(1)


def structure_loss(image: Tensor, target: Tensor, mask: Tensor) -> Tensor:
    """1 - MS-SSIM (B,) of the masked images (Wang et al. 2003).

    Of small crops only as many scales as hold the window of 11 pixels, their weights brought to a sum of one
    (our choice).
    """
    image, target = image * mask, target * mask
    scales = min(len(SCALES), int(math.log2(image.shape[-1] / _WINDOW)) + 1)
    weights = image.new_tensor(SCALES[:scales]) / sum(SCALES[:scales])
    similarity = image.new_ones(len(image))
    for scale, weight in enumerate(weights):
        structure, whole = _ssim(image, target)
        similarity = similarity * (whole if scale == scales - 1 else structure).clamp_min(1e-6) ** weight
        image, target = F.avg_pool2d(image, 2), F.avg_pool2d(target, 2)
    return 1 - similarity


def mask_entropy(mask: Tensor, target: Tensor) -> Tensor:
    """The re-weighted cross entropy (B,) of a rendered mask against a predicted one, (B, 1, h, w), 0 to 1:
    the object's pixels and the others have the same weight, however many they are."""
    soft = _SOFT + (1 - 2 * _SOFT) * mask
    inside = (target > 0.5).to(mask.dtype)
    total = mask.new_zeros(len(mask))
    for side, error in ((inside, -target * soft.log()), (1 - inside, -(1 - soft).log())):
        total = total + (error * side).sum((1, 2, 3)) / side.sum((1, 2, 3)).clamp_min(1)
    return total


def _lab(rgb: Tensor) -> Tensor:
    """sRGB (B, 3, h, w) in 0..1 -> CIE LAB."""
    rgb = rgb.clamp(0, 1)
    linear = torch.where(rgb > 0.04045, ((rgb.clamp_min(0.04045) + 0.055) / 1.055) ** 2.4, rgb / 12.92)
    xyz = torch.einsum("ij,bjhw->bihw", rgb.new_tensor(_RGB_TO_XYZ), linear)
    xyz = xyz / rgb.new_tensor(_WHITE)[:, None, None]
    root = torch.where(xyz > 0.008856, xyz.clamp_min(0.008856) ** (1 / 3), 7.787 * xyz + 4 / 29)
    x, y, z = root.unbind(1)
    return torch.stack([116 * y - 16, 500 * (x - y), 200 * (y - z)], dim=1)


def _ssim(image: Tensor, target: Tensor) -> tuple[Tensor, Tensor]:
    """Contrast-structure and the whole SSIM, means (B,) over the pixels the window fits into."""
    window = _gaussian(image.dtype, image.shape[1])

    def mean(values: Tensor) -> Tensor:
        return F.conv2d(values, window.to(values.device), groups=values.shape[1])

    mu, nu = mean(image), mean(target)
    variance, other = mean(image * image) - mu * mu, mean(target * target) - nu * nu
    covariance = mean(image * target) - mu * nu
    structure = (2 * covariance + _C2) / (variance + other + _C2)
    luminance = (2 * mu * nu + _C1) / (mu * mu + nu * nu + _C1)
    return structure.mean((1, 2, 3)), (luminance * structure).mean((1, 2, 3))


@cache
def _gaussian(dtype: torch.dtype, channels: int) -> Tensor:
    """(channels, 1, 11, 11), each of sum one."""
    offset = torch.arange(_WINDOW, dtype=dtype) - _WINDOW // 2
    line = torch.exp(-offset.square() / (2 * _SIGMA**2))
    square = line[:, None] * line[None]
    return (square / square.sum()).expand(channels, 1, -1, -1).contiguous()
