"""From nine numbers to a pose: allocentric 6-D rotation and scale-invariant translation, as the paper's pose
heads predict.

A head's output `o` (B, 9) holds the first two columns of the allocentric rotation (Zhou et al. 2019; the
identity is added, so that zeros mean the identity) and the scale-invariant translation of CDPN (Li et al.
2019), both relative to the crop: the object's centre as an offset from the crop's centre in units of the
crop's side, and the depth relative to that at which the object's diameter would fill 1 / NOMINAL_ZOOM of the
crop. A crop is described by its intrinsics alone, and `size`.
"""

from __future__ import annotations

import torch
import torch.nn.functional as F
from torch import Tensor, nn

OUTPUTS = 9
NOMINAL_ZOOM = 1.4  # our choice: makes the typical relative depth about one
_DEPTH_RANGE_M = (0.02, 20.0)


class PoseHead(nn.Module):
    """(B, channels, grid, grid) features -> (B, 9). Keeps the spatial layout up to a fully connected layer
    (no pooling: with it the head cannot tell where in the crop things are). LeakyReLU: plain ReLU units died
    here. Our choice.

    Args:
        channels: of the input.
        widths: output channels of the 3x3 convolutions.
        strides: of those convolutions; together they must bring the input down to 4x4.
        hidden: units of the hidden layer.
    """

    def __init__(self, channels: int, widths: tuple[int, ...], strides: tuple[int, ...], hidden: int) -> None:
        super().__init__()
        layers: list[nn.Module] = []
        for width, stride in zip(widths, strides, strict=True):
            layers += conv_norm_leaky(channels, width, 3, stride)
            channels = width
        self.convolutions = nn.Sequential(*layers)
        self.hidden = nn.Linear(channels * 4 * 4, hidden)
        self.output = nn.Linear(hidden, OUTPUTS)
        nn.init.normal_(self.output.weight, std=0.02)
        nn.init.zeros_(self.output.bias)

    def forward(self, features: Tensor) -> Tensor:
        x = self.convolutions(features).flatten(1)
        output: Tensor = self.output(F.leaky_relu(self.hidden(x), 0.1))
        return output


def conv_norm_leaky(inputs: int, outputs: int, kernel: int = 3, stride: int = 1) -> list[nn.Module]:
    """Convolution, BatchNorm, LeakyReLU(0.1)."""
    return [
        nn.Conv2d(inputs, outputs, kernel, stride, kernel // 2, bias=False),
        nn.BatchNorm2d(outputs),
        nn.LeakyReLU(0.1, inplace=True),
    ]


def doubled(x: Tensor) -> Tensor:
    """(B, C, H, W) -> (B, C, 2 H, 2 W), every value four times, as decoders do."""
    return F.interpolate(x, scale_factor=2.0, mode="nearest")


def coordinate_channels(like: Tensor) -> Tensor:
    """(B, 2, H, W): x and y of every pixel of `like` (B, C, H, W), from -1 to 1 across the crop."""
    batch, _, height, width = like.shape
    x = torch.linspace(-1, 1, width, dtype=like.dtype, device=like.device)
    y = torch.linspace(-1, 1, height, dtype=like.dtype, device=like.device)
    return torch.stack(torch.meshgrid(x, y, indexing="xy")).expand(batch, -1, -1, -1)


def rotation_from_6d(columns: Tensor) -> Tensor:
    """(B, 6), two columns -> (B, 3, 3) rotation by Gram-Schmidt (Zhou et al. 2019)."""
    a = F.normalize(columns[:, :3], dim=1)
    b = columns[:, 3:6]
    b = F.normalize(b - (a * b).sum(1, keepdim=True) * a, dim=1)
    return torch.stack([a, b, torch.linalg.cross(a, b)], dim=-1)


def ray_rotation(translation: Tensor) -> Tensor:
    """(B, 3, 3): the smallest rotation that takes the optical axis onto the direction of `translation` (B,
    3).

    R = ray_rotation(t) @ R_allocentric. Raises nothing; the direction must not be exactly backwards.
    """
    x, y, z = F.normalize(translation, dim=1).unbind(1)
    zero = torch.zeros_like(x)
    # Rodrigues' formula for the axis (-y, x, 0) with sine |(x, y)| and cosine z
    cross = torch.stack([zero, zero, x, zero, zero, y, -x, -y, zero], dim=1).view(-1, 3, 3)
    identity = torch.eye(3, dtype=translation.dtype, device=translation.device)
    return identity + cross + cross @ cross / (1 + z)[:, None, None]


def site_from_translation(translation: Tensor, K: Tensor, size: int, diameter_m: float) -> Tensor:
    """(B, 3): centre offset x, y in crop sides, relative depth; the inverse of `translation_from_site`."""
    pixel = torch.einsum("bij,bj->bi", K[:, :2], translation / translation[:, 2:])
    offset = (pixel - (size - 1) / 2) / size
    return torch.cat([offset, translation[:, 2:] / _unit_depth(K, size, diameter_m)], dim=1)


def translation_from_site(site: Tensor, K: Tensor, size: int, diameter_m: float) -> Tensor:
    """(B, 3) metres, camera frame, from the scale-invariant translation `site` (B, 3) of a crop with
    intrinsics `K`."""
    z = (site[:, 2:] * _unit_depth(K, size, diameter_m)).clamp(*_DEPTH_RANGE_M)
    pixel = site[:, :2] * size + (size - 1) / 2
    focal = torch.stack([K[:, 0, 0], K[:, 1, 1]], dim=1)
    return torch.cat([(pixel - K[:, :2, 2]) / focal * z, z], dim=1)


def decode_pose(output: Tensor, K: Tensor, size: int, diameter_m: float) -> tuple[Tensor, Tensor, Tensor]:
    """A head's (B, 9) output -> rotation (B, 3, 3) and translation (B, 3) of T_cam_obj, and the allocentric
    rotation.

    Args:
        K: (B, 3, 3) intrinsics of the crops, pixel centres at integers.
        size: side of the crops, pixels.
        diameter_m: of the object.
    """
    site = output[:, 6:9] + output.new_tensor([0.0, 0.0, 1.0])
    translation = translation_from_site(site, K, size, diameter_m)
    allocentric = rotation_from_6d(output[:, :6] + output.new_tensor([1.0, 0.0, 0.0, 0.0, 1.0, 0.0]))
    return ray_rotation(translation) @ allocentric, translation, allocentric


def _unit_depth(K: Tensor, size: int, diameter_m: float) -> Tensor:
    """(B, 1): the depth, metres, at which the diameter fills 1 / NOMINAL_ZOOM of the crop."""
    return K[:, 0, 0, None] * diameter_m * NOMINAL_ZOOM / size
