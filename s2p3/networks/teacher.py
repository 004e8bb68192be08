"""The teacher: two encoders, a decoder to mask, normals and object coordinates, and a pose head that reads
those maps."""

from __future__ import annotations

from dataclasses import dataclass

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from s2p3.networks.encoder import DualEncoder
from s2p3.networks.pose_head import PoseHead, conv_norm_leaky, coordinate_channels, doubled

MAP_STRIDE = 4
_MAP_CHANNELS = 7
_POSE_STRIDES = {16: (2, 1, 2, 1), 32: (2, 2, 2, 1), 64: (2, 2, 2, 2)}  # by the side of the maps, down to 4x4


@dataclass(frozen=True)
class TeacherOutput:
    """What the teacher predicts for B crops of side S; maps at S / 4.

    Attributes:
        pose: (B, 9), see `pose_head`.
        mask_logits: (B, 1, S/4, S/4), visible mask.
        normals: (B, 3, S/4, S/4), unit, camera frame.
        coordinates: (B, 3, S/4, S/4), normalized object coordinates, -1 to 1 across the object's bounding
            box.
    """

    pose: Tensor
    mask_logits: Tensor
    normals: Tensor
    coordinates: Tensor


def pose_of(output: Tensor | TeacherOutput) -> Tensor:
    """The nine numbers (B, 9) of a student's or a teacher's answer."""
    return output.pose if isinstance(output, TeacherOutput) else output


class Teacher(nn.Module):
    """About 5.5 M weights. The pose head is the Patch-PnP of GDR-Net (Wang et al. 2021), narrower (our
    choice).

    Args:
        channels: of the two inputs, see `inputs.channel_counts`.
        size: side of the crops.
        total_stride: of the encoders, 16 or 32.
        width: of the decoder.
        imagenet: start the encoders from ImageNet weights.
    """

    def __init__(
        self,
        channels: tuple[int, int],
        size: int,
        total_stride: int,
        width: int,
        imagenet: bool,
    ) -> None:
        super().__init__()
        self.encoder = DualEncoder(channels, total_stride, imagenet)
        skip4, skip8, skip16 = self.encoder.skip_channels
        narrow, wide = width * 3 // 4, width * 3 // 2
        self.reduce = nn.Sequential(*conv_norm_leaky(self.encoder.channels, width, 1))
        self.skip16 = nn.Sequential(*conv_norm_leaky(skip16, width // 2, 1))
        self.decode16 = nn.Sequential(*conv_norm_leaky(width + width // 2, narrow))
        self.decode8 = nn.Sequential(*conv_norm_leaky(narrow + skip8, width))
        self.decode4 = nn.Sequential(
            *conv_norm_leaky(width + skip4, wide),
            *conv_norm_leaky(wide, wide),
            *conv_norm_leaky(wide, width),
        )
        self.maps = nn.Conv2d(width, _MAP_CHANNELS, 1)
        strides = _POSE_STRIDES[size // MAP_STRIDE]
        self.pose = PoseHead(_MAP_CHANNELS + 2, (64, 64, 64, 128), strides, hidden=128)

    def forward(self, polarization: Tensor, priors: Tensor) -> TeacherOutput:
        features, (skip4, skip8, skip16) = self.encoder(polarization, priors)
        x = self.reduce(features)
        if self.encoder.total_stride == 32:
            x = doubled(x)
        x = self.decode16(torch.cat([x, self.skip16(skip16)], dim=1))
        x = self.decode8(torch.cat([doubled(x), skip8], dim=1))
        x = self.decode4(torch.cat([doubled(x), skip4], dim=1))
        maps = self.maps(x)
        mask_logits, coordinates = maps[:, :1], maps[:, 4:7]
        normals = F.normalize(maps[:, 1:4], dim=1)
        inside = mask_logits.sigmoid()
        seen = torch.cat([coordinates, normals, coordinate_channels(maps)], dim=1) * inside
        return TeacherOutput(self.pose(torch.cat([inside, seen], dim=1)), mask_logits, normals, coordinates)
