"""The two encoders that teacher and student share: one for polarization, one for the physical priors."""

from __future__ import annotations

import torch
from torch import Tensor, nn

from s2p3.networks.lite0 import Lite0, load_imagenet

PRIOR_CHANNELS = 9
_BLOCKS = 15
_TAPS = (2, 4, 10)


class DualEncoder(nn.Module):
    """Two Lite0 trunks (blocks 0-14) side by side; features and skips are concatenated.

    Inputs are normalized by a BatchNorm without weights, so that channels of any unit reach the ImageNet
    stems at unit variance (our choice).

    Attributes:
        channels: of the deepest features (384).
        skip_channels: of the features at strides 4, 8 and 16.
    """

    def __init__(self, polarization_channels: int, total_stride: int = 32, imagenet: bool = True) -> None:
        super().__init__()
        self.normalize_polarization = nn.BatchNorm2d(polarization_channels, affine=False, momentum=0.02)
        self.normalize_priors = nn.BatchNorm2d(PRIOR_CHANNELS, affine=False, momentum=0.02)
        self.polarization = Lite0(polarization_channels, _BLOCKS, _TAPS, total_stride)
        self.priors = Lite0(PRIOR_CHANNELS, _BLOCKS, _TAPS, total_stride)
        if imagenet:
            load_imagenet(self.polarization)
            load_imagenet(self.priors)
        self.total_stride = total_stride
        self.channels = 2 * self.polarization.block_channels[-1]
        self.skip_channels = tuple(2 * self.polarization.block_channels[tap] for tap in _TAPS)

    def forward(self, polarization: Tensor, priors: Tensor) -> tuple[Tensor, list[Tensor]]:
        """(B, C, S, S) and (B, 9, S, S) -> features (B, 384, S / stride, S / stride) and skips at strides 4,
        8, 16."""
        a, skips_a = self.polarization(self.normalize_polarization(polarization))
        b, skips_b = self.priors(self.normalize_priors(priors))
        skips = [torch.cat(pair, dim=1) for pair in zip(skips_a, skips_b, strict=True)]
        return torch.cat([a, b], dim=1), skips
