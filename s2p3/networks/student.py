"""The student: the teacher's two encoders and a pose head directly on their features; no decoder, no dense
maps."""

from __future__ import annotations

import torch
from torch import Tensor, nn

from s2p3.networks.encoder import DualEncoder
from s2p3.networks.pose_head import PoseHead, conv_norm_leaky, coordinate_channels


class Student(nn.Module):
    """About 5 M weights, arguments as `Teacher`. The head's layers are our choice."""

    def __init__(
        self,
        channels: tuple[int, int],
        size: int,
        total_stride: int,
        width: int,
        hidden: int,
        imagenet: bool,
    ) -> None:
        super().__init__()
        self.encoder = DualEncoder(channels, total_stride, imagenet)
        self.reduce = nn.Sequential(*conv_norm_leaky(self.encoder.channels + 2, width, 1))
        self.pose = PoseHead(width, (width,), (size // total_stride // 4,), hidden)

    def forward(self, polarization: Tensor, priors: Tensor) -> Tensor:
        """(B, C, S, S) and (B, D, S, S) -> (B, 9), see `pose_head`."""
        features, _ = self.encoder(polarization, priors)
        output: Tensor = self.pose(self.reduce(torch.cat([features, coordinate_channels(features)], dim=1)))
        return output
