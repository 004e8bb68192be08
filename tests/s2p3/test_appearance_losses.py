"""The baseline's losses on appearance: known colours, known similarities, gradients."""

from __future__ import annotations

import math
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
from safetensors.torch import save_file
from torch import Tensor

from dataset.errors import ToolkitError
from s2p3 import appearance_losses as appearance
from s2p3.networks.perceptual import Perceptual


def picture(batch: int, side: int, seed: int = 0) -> Tensor:
    generator = torch.Generator().manual_seed(seed)
    coarse = torch.rand(batch, 3, 8, 8, generator=generator, dtype=torch.float64)
    return torch.nn.functional.interpolate(coarse, side, mode="bicubic").clamp(0, 1)


def everywhere(image: Tensor) -> Tensor:
    return torch.ones_like(image[:, :1])


def test_lab_is_that_of_opencv() -> None:
    image = picture(1, 16).float()
    expected = cv2.cvtColor(np.ascontiguousarray(np.moveaxis(image[0].numpy(), 0, -1)), cv2.COLOR_RGB2LAB)
    found = appearance._lab(image)[0].permute(1, 2, 0).numpy()
    np.testing.assert_allclose(found, expected, atol=0.4)  # OpenCV interpolates the cube root


def test_colour_ignores_lightness_and_so_all_of_grey_images() -> None:
    image, target = picture(2, 16), picture(2, 16, 1)
    assert (appearance.colour_loss(image, target, everywhere(image)) > 0.02).all()
    grey, other = (one.mean(1, keepdim=True).expand(-1, 3, -1, -1) for one in (image, target))
    torch.testing.assert_close(
        appearance.colour_loss(grey, other, everywhere(image)), torch.zeros(2).double(), atol=1e-3, rtol=0
    )


@pytest.mark.parametrize("side", [176, 64, 16])
def test_structure_of_the_same_image_is_the_same(side: int) -> None:
    image = picture(1, side)
    mask = everywhere(image)
    assert appearance.structure_loss(image, image, mask) == pytest.approx(0, abs=1e-9)
    worse = [
        appearance.structure_loss(image, image + amount * picture(1, side, 2), mask) for amount in (0.1, 0.5)
    ]
    assert 0 < worse[0] < worse[1] < 1


def test_structure_by_hand() -> None:
    """Two flat images: variances vanish, structure is one, and luminance is left."""
    image, target = torch.full((1, 3, 16, 16), 0.2), torch.full((1, 3, 16, 16), 0.4)
    luminance = (2 * 0.2 * 0.4 + 1e-4) / (0.2**2 + 0.4**2 + 1e-4)
    found = appearance.structure_loss(image, target, everywhere(image))
    assert found == pytest.approx(1 - luminance, abs=1e-4)


def test_the_mask_entropy_weighs_inside_and_outside_alike() -> None:
    target = torch.zeros(1, 1, 10, 10)
    target[..., :1, :] = 1  # a tenth of the pixels
    perfect = appearance.mask_entropy(target, target)
    assert perfect == pytest.approx(-2 * math.log(0.98), rel=1e-4)
    half = torch.full_like(target, 0.5)
    assert appearance.mask_entropy(half, target) == pytest.approx(2 * math.log(2), rel=1e-4)


def test_a_white_sphere_is_brightest_in_the_middle() -> None:
    normals = torch.nn.functional.normalize(torch.tensor([[0.0, 0, -1], [1.0, 0, -1]]), dim=1)
    normals = normals.T.reshape(1, 3, 1, 2)
    rays = torch.tensor([0.0, 0, 1]).view(1, 3, 1, 1).expand(-1, -1, -1, 2)
    image = appearance.shaded(normals, rays)
    torch.testing.assert_close(image[0, :, 0], torch.tensor([1, math.sqrt(0.5)]).expand(3, -1))
    bright = appearance.exposed_like(image, 0.3 * image, torch.ones(1, 1, 1, 2))
    torch.testing.assert_close(bright, 0.3 * image)


@pytest.mark.parametrize("loss", [appearance.colour_loss, appearance.structure_loss])
def test_gradients_of_appearance(loss: object) -> None:
    image = (0.1 + 0.8 * picture(1, 12)).requires_grad_()
    mask = everywhere(image)
    assert callable(loss)
    assert torch.autograd.gradcheck(lambda x: loss(x, picture(1, 12, 3), mask), (image,))


def test_gradients_of_the_mask_entropy() -> None:
    mask = picture(1, 4)[:, :1].requires_grad_()
    target = (picture(1, 4, 5)[:, :1] > 0.5).double()
    assert torch.autograd.gradcheck(lambda x: appearance.mask_entropy(x, target), (mask,))


def stored_weights(path: Path) -> Path:
    """A file as its user would make one, of random numbers."""
    torch.manual_seed(0)
    state = Perceptual().state_dict()
    weights = {name: value for name, value in state.items() if name.startswith("features")}
    weights |= {f"lin{n}.model.1.weight": state[f"linear.{n}.weight"].abs() for n in range(5)}
    save_file(weights, path)
    return path


def test_perceptual_distance_grows_with_the_difference(tmp_path: Path) -> None:
    distance = Perceptual.load(stored_weights(tmp_path / "lpips.safetensors"))
    image, noise = picture(2, 64).float(), picture(2, 64, 4).float()
    assert distance(image, image).tolist() == [0, 0]
    near, far = distance(image, image + 0.05 * noise), distance(image, image + 0.5 * noise)
    assert (near > 0).all()
    assert (near < far).all()
    assert not any(weight.requires_grad for weight in distance.parameters())


@pytest.mark.parametrize("content", [None, b"", {"features.0.weight": torch.zeros(1)}])
def test_a_file_without_the_weights_is_refused(content: object, tmp_path: Path) -> None:
    path = tmp_path / "lpips.safetensors"
    if isinstance(content, bytes):
        path.write_bytes(content)
    elif isinstance(content, dict):
        save_file(content, path)
    with pytest.raises(ToolkitError, match="no weights of LPIPS"):
        Perceptual.load(path)
