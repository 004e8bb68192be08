"""What the networks see: crops of the polarization image around a detected box, and nothing else.

A frame's way: undistorted Stokes image (3, H, W) and box -> `extract_crop` (canonical, upright, larger than
needed) -> `resample` through a `View` (zoom, shift, in-plane rotation) -> `network_channels` (channels and
priors). Everything here is computed from Stokes and depth images, intrinsics, and predicted boxes and masks;
no pose, mask or normal of the truth is an argument.

Resampling happens before the channels are formed, because DoLP, AoLP and the priors are not linear in the
measurements. An image rotated about the optical axis by `a` (x towards y, so clockwise as displayed) is again
a physical image of the same camera: poses turn to Rz(a) T, and angles of polarization (counter-clockwise as
displayed) decrease by `a`.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal

import cv2
import numpy as np
import torch
import torch.nn.functional as F
from numpy.typing import ArrayLike, NDArray
from torch import Tensor

from dataset import Intrinsics
from s2p3 import physics
from s2p3.config import AugmentationConfig, InputConfig

PRIOR_CHANNELS, DEPTH_CHANNELS = 9, 3

_MEAN_INTENSITY = 0.35  # our choice: where `normalize_exposure` puts the mean of a crop
_FLOOR = 1e-3  # of S0: below it a degree of polarization means nothing


@dataclass(frozen=True)
class NetworkInput:
    """B crops as the networks take them.

    Attributes:
        polarization: (B, C, S, S), what the first encoder sees, see `polarization_channels`; the intensity of
            the baselines without polarization.
        priors: (B, D, S, S), what the second encoder sees: the normals n_d, n_s1, n_s2 of the physical model;
            of the baselines `depth_channels`, or the intensity again.
        K: (B, 3, 3) intrinsics of the crops, pixel centres at integers.
        stokes: (B, 3, S, S) as measured, for L_physics: turned and resampled, but not augmented otherwise.
        valid: (B, 1, S, S) bool, where they are a measurement: neither saturated nor too dark.
        depth: (B, 1, S, S) metres, 0 unknown; None where there is none.
    """

    polarization: Tensor
    priors: Tensor
    K: Tensor
    stokes: Tensor
    valid: Tensor
    depth: Tensor | None = None

    @property
    def size(self) -> int:
        return self.polarization.shape[-1]


def channel_counts(config: InputConfig) -> tuple[int, int]:
    """Channels of the two encoders' inputs under `config`."""
    if config.modality == "rgb":
        return 1, 1
    if config.modality == "rgbd":
        return 1, DEPTH_CHANNELS
    return 7 if config.aolp == "double_angle" else 6, PRIOR_CHANNELS


def square_box(box_xywh: ArrayLike, zoom: float = 1.0) -> NDArray[np.float64]:
    """The square (4,) around the centre of a box whose side is `zoom` times the box's longer side; pixel-edge
    coordinates."""
    x, y, w, h = np.asarray(box_xywh, dtype=np.float64)
    side = max(w, h) * zoom
    return np.array([x + (w - side) / 2, y + (h - side) / 2, side, side])


def extract_crop(
    image: NDArray[np.float32],
    box_xywh: ArrayLike,
    size: int,
    outside: Literal["repeated", "zeros"] = "repeated",
) -> NDArray[np.float32]:
    """Cuts a box out of `image` (C, H, W) and resizes it to (C, size, size), anti-aliased; outside there is
    the border again, or nothing.

    Pixel grid: that of `Intrinsics.crop(box_xywh, size)`.
    """
    x, y, w, h = np.asarray(box_xywh, dtype=np.float64)
    samples = max(1, math.ceil(max(w, h) / size))
    fine = size * samples
    matrix = np.array([[w / fine, 0, x + 0.5 * w / fine - 0.5], [0, h / fine, y + 0.5 * h / fine - 0.5]])
    crop = cv2.warpAffine(
        np.ascontiguousarray(np.moveaxis(image, 0, -1)),
        matrix,
        (fine, fine),
        flags=cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP,
        borderMode=cv2.BORDER_REPLICATE if outside == "repeated" else cv2.BORDER_CONSTANT,
    )
    crop = cv2.resize(crop, (size, size), interpolation=cv2.INTER_AREA) if samples > 1 else crop
    return np.ascontiguousarray(np.moveaxis(crop.reshape(size, size, -1), -1, 0))


def extract_depth(depth: NDArray[np.float32], box_xywh: ArrayLike, size: int) -> NDArray[np.float32]:
    """The same cut out of a depth image (H, W), on the same grid: the nearest pixel's value, because between
    surfaces there is none; 0, which is unknown, outside."""
    x, y, w, h = np.asarray(box_xywh, dtype=np.float64)
    matrix = np.array([[w / size, 0, x + 0.5 * w / size - 0.5], [0, h / size, y + 0.5 * h / size - 0.5]])
    flags = cv2.INTER_NEAREST | cv2.WARP_INVERSE_MAP
    crop = cv2.warpAffine(np.ascontiguousarray(depth), matrix, (size, size), flags=flags)
    return crop.astype(np.float32, copy=False)


def crop_intrinsics(intrinsics: Intrinsics, box_xywh: ArrayLike, size: int) -> NDArray[np.float32]:
    """(3, 3) pinhole matrix of `extract_crop`'s result."""
    return intrinsics.crop(box_xywh, size).K.astype(np.float32)


@dataclass(frozen=True)
class View:
    """How B network inputs look into their canonical crops.

    Attributes:
        zoom: (B,) side of the region, in units of the box.
        shift: (B, 2) of the region's centre, in units of the box.
        angle: (B,) in-plane rotation, radians, x towards y.
    """

    zoom: Tensor
    shift: Tensor
    angle: Tensor

    @staticmethod
    def centred(batch: int, zoom: float) -> View:
        """The unaugmented view."""
        return View(torch.full((batch,), zoom), torch.zeros(batch, 2), torch.zeros(batch))

    @staticmethod
    def random(batch: int, config: AugmentationConfig, generator: torch.Generator) -> View:
        """Views drawn uniformly from the ranges of `config`."""

        def uniform(low: float, high: float, *shape: int) -> Tensor:
            return low + (high - low) * torch.rand(batch, *shape, generator=generator)

        angle = math.radians(config.rotation_deg)
        return View(
            uniform(config.zoom_min, config.zoom_max),
            uniform(-config.shift, config.shift, 2),
            uniform(-angle, angle),
        )

    @property
    def rotation(self) -> Tensor:
        """(B, 3, 3): Rz, which maps the canonical camera frame to the view's."""
        cos, sin = self.angle.cos(), self.angle.sin()
        zero, one = torch.zeros_like(cos), torch.ones_like(cos)
        return torch.stack([cos, -sin, zero, sin, cos, zero, zero, zero, one], dim=1).view(-1, 3, 3)


@dataclass(frozen=True)
class Window:
    """A `View` worked out for given canonical crops.

    Attributes:
        K: (B, 3, 3) intrinsics of the view, for `size` x `size` pixels.
        source: (B, size, size, 2) canonical pixel (x, y) under every pixel of the view.
        rotation: (B, 3, 3) as `View.rotation`.
        canonical_size: side of the canonical crops.
    """

    K: Tensor
    source: Tensor
    rotation: Tensor
    canonical_size: int

    def resample(self, maps: Tensor, mode: str = "bilinear", padding: str = "reflection") -> Tensor:
        """Maps (B, C, P, P) on the canonical crops -> (B, C, size, size); values are carried over, not
        rotated."""
        grid = (2 * self.source + 1) / self.canonical_size - 1
        return F.grid_sample(maps, grid, mode=mode, padding_mode=padding, align_corners=False)


def window(view: View, K: Tensor, canonical_size: int, canonical_zoom: float, size: int) -> Window:
    """Works out `view` for canonical crops with intrinsics `K` (B, 3, 3), at `size` pixels a side."""
    box = canonical_size / canonical_zoom
    rotation = view.rotation
    inverse = torch.linalg.inv(K)
    turn = (K @ rotation @ inverse)[:, :2]  # pixels of the canonical crop -> pixels of the turned camera
    middle = turn @ K.new_tensor([(canonical_size - 1) / 2, (canonical_size - 1) / 2, 1.0])
    side = view.zoom * box
    corner = middle + view.shift * box + 0.5 - side[:, None] / 2
    scale = size / side
    K_view = K.clone()
    K_view[:, 0, 0] *= scale
    K_view[:, 1, 1] *= scale
    K_view[:, :2, 2] = (K[:, :2, 2] + 0.5 - corner) * scale[:, None] - 0.5
    steps = torch.arange(size, dtype=K.dtype)
    pixels = torch.stack([*torch.meshgrid(steps, steps, indexing="xy"), torch.ones(size, size)], dim=-1)
    back = (K @ rotation.transpose(1, 2) @ torch.linalg.inv(K_view))[:, :2]
    return Window(K_view, torch.einsum("bij,hwj->bhwi", back, pixels), rotation, canonical_size)


def rotate_stokes(stokes: Tensor, angle: Tensor) -> Tensor:
    """Stokes values (B, 3, ...) of an image turned by `angle` (B,), x towards y: the AoLP decreases by it."""
    shape = (-1,) + (1,) * (stokes.dim() - 2)
    cos, sin = (2 * angle).cos().view(shape), (2 * angle).sin().view(shape)
    s0, s1, s2 = stokes.unbind(1)
    return torch.stack([s0, s1 * cos + s2 * sin, s2 * cos - s1 * sin], dim=1)


def normalize_exposure(stokes: Tensor) -> Tensor:
    """Scales each of (B, 3, H, W) so that its mean S0 is fixed: exposure and lamp power drop out (our
    choice)."""
    mean = stokes[:, :1].mean((2, 3), keepdim=True).clamp_min(1e-6)
    return stokes * (_MEAN_INTENSITY / mean)


def augment_photometry(stokes: Tensor, config: AugmentationConfig, generator: torch.Generator) -> Tensor:
    """Random exposure, DoLP scale, blur and shot noise; each acts on all four angles together, as light
    would.

    Takes and returns (B, 3, H, W) with normalized exposure.
    """
    batch = len(stokes)

    def symmetric(width: float) -> Tensor:
        return 1 + width * (2 * torch.rand(batch, 1, 1, 1, generator=generator) - 1)

    gain, dolp = symmetric(config.gain), symmetric(config.dolp)
    stokes = torch.cat([stokes[:, :1], stokes[:, 1:] * dolp], dim=1) * gain
    blurred = F.avg_pool2d(stokes, 3, 1, 1, count_include_pad=False)
    amount = torch.rand(batch, 1, 1, 1, generator=generator)
    amount = amount * (torch.rand(batch, 1, 1, 1, generator=generator) < config.blur)
    angles = intensities(stokes + amount * (blurred - stokes)).clamp_min(0)
    noise = torch.randn(angles.shape, generator=generator)
    return stokes_from_intensities(angles + config.noise * angles.sqrt() * noise)


def intensities(stokes: Tensor) -> Tensor:
    """(B, 3, H, W) -> the intensities (B, 4, H, W) behind polarizers at 0, 45, 90, 135 degrees (Eq. 1)."""
    s0, s1, s2 = stokes.unbind(1)
    return torch.stack([s0 + s1, s0 + s2, s0 - s1, s0 - s2], dim=1) / 2


def stokes_from_intensities(angles: Tensor) -> Tensor:
    """The least-squares inverse of `intensities` (Eq. 2)."""
    i0, i45, i90, i135 = angles.unbind(1)
    return torch.stack([(i0 + i45 + i90 + i135) / 2, i0 - i90, i45 - i135], dim=1)


def degree_of_polarization(stokes: Tensor) -> Tensor:
    """(B, 3, H, W) -> DoLP (B, H, W) in 0..1; zero where there is no light."""
    s0, s1, s2 = stokes.unbind(1)
    return torch.where(s0 > _FLOOR, torch.hypot(s1, s2) / s0.clamp_min(_FLOOR), 0.0).clamp(0, 1)


def polarization_channels(stokes: Tensor, config: InputConfig) -> Tensor:
    """(B, 3, H, W) -> (B, C, H, W): the four intensities, DoLP, and the AoLP as `config.aolp` says."""
    dolp = degree_of_polarization(stokes)
    _, s1, s2 = stokes.unbind(1)
    if config.aolp == "angle":
        direction = [(0.5 * torch.atan2(s2, s1)).remainder(math.pi)]
    else:
        weight = dolp.sqrt() / torch.hypot(s1, s2).clamp_min(1e-6)
        direction = [s1 * weight, s2 * weight]
    angles = intensities(stokes).clamp(0, 1.5)
    return torch.cat([angles, torch.stack([dolp, *direction], dim=1)], dim=1)


def depth_channels(depth: Tensor, K: Tensor) -> Tensor:
    """(B, 1, S, S) metres, 0 unknown -> (B, 3, S, S): relief, distance, and where the depth is known.

    Distance is the crop's median depth, relief the difference from it; both as the width of the crop at that
    depth, metres, so that they mean the same at any zoom, as the scale-invariant translation does (our
    choice).
    """
    known = depth > 0
    width_at = depth * (depth.shape[-1] / K[:, 0, 0, None, None, None])
    flat = torch.where(known, width_at, float("nan")).flatten(2)
    distance = flat.nanmedian(dim=2).values.nan_to_num(0.0)[..., None, None]
    relief = torch.where(known, width_at - distance, 0.0)
    return torch.cat([relief, distance.expand_as(relief), known.to(depth.dtype)], dim=1)


def network_channels(
    stokes: Tensor,
    K: Tensor,
    refractive_index: float,
    config: InputConfig,
    mask: Tensor | None = None,
    depth: Tensor | None = None,
) -> tuple[Tensor, Tensor]:
    """What the two encoders see of B crops: `NetworkInput.polarization` and `.priors`.

    Args:
        stokes: (B, 3, S, S) with normalized exposure.
        K: (B, 3, 3) of the crops.
        refractive_index: of the object; enters the priors.
        mask: (B, 1, S, S) predicted; required where `config.background` is "mask".
        depth: (B, 1, S, S) metres, 0 unknown; required where `config.modality` is "rgbd".

    Intensities are shown with their background in any case.
    """
    assert config.background == "keep" or mask is not None, "a masked background needs the predicted mask"
    shown = mask if mask is not None and config.background == "mask" else torch.ones_like(stokes[:, :1])
    first = stokes[:, :1] / 2
    second = first
    if config.modality == "polarization":
        first = polarization_channels(stokes, config)
        first = torch.cat([first[:, :4], first[:, 4:] * shown], dim=1)
        second = physics.shape_priors(stokes, refractive_index, K) * shown
    elif config.modality == "rgbd":
        assert depth is not None, "rgbd needs depth"
        second = depth_channels(depth * shown, K)
    last = torch.channels_last
    return first.contiguous(memory_format=last), second.contiguous(memory_format=last)
