"""The two encoders that teacher and student share: one for polarization, one for the physical priors."""

from __future__ import annotations

import torch
from torch import Tensor, nn

from s2p3.networks.lite0 import Lite0, load_imagenet

_BLOCKS = 15
_TAPS = (2, 4, 10)


class DualEncoder(nn.Module):
    """Two Lite0 trunks (blocks 0-14) side by side; features and skips are concatenated.

    Inputs are normalized by a BatchNorm without weights, so that channels of any unit reach the ImageNet
    stems at unit variance (our choice).

    Args:
        channels: of the two inputs, see `inputs.channel_counts`.
        total_stride: 16 or 32, see `Lite0`.
        imagenet: start from ImageNet weights.

    Attributes:
        channels: of the deepest features (384).
        skip_channels: of the features at strides 4, 8 and 16.
    """

    def __init__(self, channels: tuple[int, int], total_stride: int, imagenet: bool) -> None:
        super().__init__()
        first, second = channels
        self.normalize_polarization = nn.BatchNorm2d(first, affine=False, momentum=0.02)
        self.normalize_priors = nn.BatchNorm2d(second, affine=False, momentum=0.02)
        self.polarization = Lite0(first, _BLOCKS, _TAPS, total_stride)
        self.priors = Lite0(second, _BLOCKS, _TAPS, total_stride)
        if imagenet:
            load_imagenet(self.polarization)
            load_imagenet(self.priors)
        self.total_stride = total_stride
        self.channels = 2 * self.polarization.block_channels[-1]
        self.skip_channels = tuple(2 * self.polarization.block_channels[tap] for tap in _TAPS)

    def forward(self, polarization: Tensor, priors: Tensor) -> tuple[Tensor, list[Tensor]]:
        """(B, C, S, S) and (B, D, S, S) -> features (B, 384, S / stride, S / stride) and skips at strides 4,
        8, 16."""
        a, skips_a = self.polarization(self.normalize_polarization(polarization))
        b, skips_b = self.priors(self.normalize_priors(priors))
        skips = [torch.cat(pair, dim=1) for pair in zip(skips_a, skips_b, strict=True)]
        return torch.cat([a, b], dim=1), skips
