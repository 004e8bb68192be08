"""Depthwise convolution on tiny maps, quick to train on a CPU.

The backward pass of torch's depthwise 5x5 convolution on 4x4 maps takes most of a training step on CPUs
without AVX-512. Here every output pixel is a weighted sum of every input pixel, the weights looked up in the
kernel: more arithmetic, but over contiguous channels, and three to four times faster. The result is that of
`torch.nn.functional.conv2d`, which a test asserts.
"""

from __future__ import annotations

from functools import lru_cache
from typing import Any

import torch
import torch.nn.functional as F
from torch import Tensor, nn

LARGEST_MAP = 4
"""Side of the largest map for which this way is the quicker one."""


class DepthwiseConv(nn.Conv2d):
    """Drop-in for `nn.Conv2d` with groups = channels, square odd kernel, half padding, no bias."""

    def __init__(self, channels: int, kernel: int, stride: int) -> None:
        super().__init__(channels, channels, kernel, stride, kernel // 2, groups=channels, bias=False)

    def forward(self, x: Tensor) -> Tensor:
        tiny = x.shape[2] == x.shape[3] and x.shape[3] <= LARGEST_MAP and self.weight.shape[-1] == 5
        if tiny and self.stride == (1, 1) and torch.is_grad_enabled() and x.device.type == "cpu":
            output: Tensor = _TinyDepthwise.apply(x, self.weight)
            return output
        return super().forward(x)


@lru_cache(maxsize=8)
def _tap_selector(side: int, kernel: int) -> Tensor:
    """(side**4, kernel**2), one-hot rows: which kernel tap joins each output pixel to each input pixel, if
    any."""
    position = torch.arange(side)
    y, x = (axis.reshape(-1) for axis in torch.meshgrid(position, position, indexing="ij"))
    down, right = y[None, :] - y[:, None] + kernel // 2, x[None, :] - x[:, None] + kernel // 2
    joined = (down >= 0) & (down < kernel) & (right >= 0) & (right < kernel)
    tap = torch.where(joined, down * kernel + right, kernel * kernel)
    return F.one_hot(tap.reshape(-1), kernel * kernel + 1)[:, :-1].to(torch.float32)


class _TinyDepthwise(torch.autograd.Function):
    """y[b, o, c] = sum_i M[o, i, c] x[b, i, c] over the pixels i, o of a square map; M holds kernel taps."""

    @staticmethod
    def forward(ctx: Any, x: Tensor, weight: Tensor) -> Tensor:
        batch, channels, side, _ = x.shape
        pixels = side * side
        selector = _tap_selector(side, weight.shape[-1]).to(x.dtype)
        matrix = (selector @ weight.reshape(channels, -1).T).view(pixels, pixels, channels)
        flat = x.permute(0, 2, 3, 1).reshape(batch, pixels, channels)
        y = torch.zeros_like(flat)
        for i in range(pixels):
            y.addcmul_(matrix[:, i], flat[:, i : i + 1])
        ctx.save_for_backward(flat, matrix, selector)
        return y.view(batch, side, side, channels).permute(0, 3, 1, 2)

    @staticmethod
    def backward(ctx: Any, gradient: Tensor) -> tuple[Tensor, Tensor]:
        flat, matrix, selector = ctx.saved_tensors
        batch, pixels, channels = flat.shape
        side, kernel = gradient.shape[-1], int(selector.shape[1] ** 0.5)
        gradient = gradient.permute(0, 2, 3, 1).reshape(batch, pixels, channels)
        to_input, to_matrix = torch.zeros_like(flat), torch.zeros_like(matrix)
        for o in range(pixels):
            to_input.addcmul_(matrix[o], gradient[:, o : o + 1])
        for b in range(batch):
            to_matrix.addcmul_(gradient[b][:, None], flat[b][None])
        to_weight = (selector.T @ to_matrix.view(-1, channels)).T.reshape(channels, 1, kernel, kernel)
        return to_input.view(batch, side, side, channels).permute(0, 3, 1, 2), to_weight
