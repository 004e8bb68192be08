"""LPIPS (Zhang et al. 2018), for the baseline: distance of images in the features of AlexNet.

No package ships the weights. They come from a file its user names, one .safetensors with the tensors of
torchvision's AlexNet (`features.0.weight` and so on) and of LPIPS' linear layers (`lin0.model.1.weight` to
`lin4.model.1.weight`), both under the names their authors gave them.
"""

from __future__ import annotations

from pathlib import Path

import torch.nn.functional as F
from safetensors import SafetensorError
from safetensors.torch import load_file
from torch import Tensor, nn

from dataset.errors import ToolkitError

_MEAN, _STD = (0.485, 0.456, 0.406), (0.229, 0.224, 0.225)
# index in AlexNet's `features`, inputs, outputs, kernel, stride, padding; whether it is pooled before
_LAYERS = (
    (0, 3, 64, 11, 4, 2, False),
    (3, 64, 192, 5, 1, 2, True),
    (6, 192, 384, 3, 1, 1, True),
    (8, 384, 256, 3, 1, 1, False),
    (10, 256, 256, 3, 1, 1, False),
)


class Perceptual(nn.Module):
    """Distance (B,) of images (B, 3, h, w) in 0..1; its weights stay as they are."""

    def __init__(self) -> None:
        super().__init__()
        self.features = nn.ModuleDict(
            {
                str(index): nn.Conv2d(inputs, outputs, kernel, stride, padding)
                for index, inputs, outputs, kernel, stride, padding, _ in _LAYERS
            }
        )
        self.linear = nn.ModuleList(nn.Conv2d(outputs, 1, 1, bias=False) for _, _, outputs, *_ in _LAYERS)
        self.requires_grad_(False)

    @staticmethod
    def load(path: Path) -> Perceptual:
        """Reads the file described above. Raises ToolkitError: missing, or not such a file."""
        try:
            stored = load_file(path)
            network = Perceptual()
            weights = {name: stored[name] for name in network.state_dict() if name.startswith("features")}
            weights |= {
                f"linear.{layer}.weight": stored[f"lin{layer}.model.1.weight"]
                for layer in range(len(_LAYERS))
            }
            network.load_state_dict(weights)
        except (OSError, SafetensorError, KeyError, RuntimeError) as error:
            reason = str(error).splitlines()[-1].strip()
            raise ToolkitError(
                f"{path}: no weights of LPIPS ({reason}); a .safetensors file holds AlexNet's features.* and "
                "lin0.model.1.weight to lin4.model.1.weight; or leave lpips_weights empty to do without"
            ) from error
        return network.eval()

    def forward(self, image: Tensor, target: Tensor) -> Tensor:
        mean, std = (image.new_tensor(values)[:, None, None] for values in (_MEAN, _STD))
        x, y = (image - mean) / std, (target - mean) / std
        total = image.new_zeros(len(image))
        for (index, *_, pooled), linear in zip(_LAYERS, self.linear, strict=True):
            layer = self.features[str(index)]
            if pooled:
                x, y = F.max_pool2d(x, 3, 2), F.max_pool2d(y, 3, 2)
            x, y = F.relu(layer(x)), F.relu(layer(y))
            difference = (F.normalize(x, dim=1) - F.normalize(y, dim=1)).square()
            total = total + linear(difference).mean((1, 2, 3))
        return total
