"""Pictures of polarization: S0, DoLP, AoLP and normals as a person can look at them."""

from __future__ import annotations

import math
from pathlib import Path

import cv2
import numpy as np
import torch
from numpy.typing import NDArray

from dataset.errors import ToolkitError
from dataset.frames import Mosaic
from dataset.polarimetry import Raw, Stokes, decode
from s2p3.physics import shape_priors

Picture = NDArray[np.uint8]

_NOMINAL_FIELD_OF_VIEW = 0.7
"""Focal length in image widths where no calibration is at hand (our choice: the paper's lens)."""


def intensity(stokes: Stokes) -> Picture:
    """(h, w) grey picture of S0, stretched to its brightest percent, gamma 2.2."""
    bright = max(float(np.percentile(stokes.s0, 99)), 1e-6)
    return _to_bytes(np.clip(stokes.s0 / bright, 0, 1) ** (1 / 2.2))


def degree(stokes: Stokes, full_scale: float = 1.0) -> Picture:
    """(h, w, 3) BGR picture of the DoLP, dark blue 0 to yellow `full_scale`."""
    levels = _to_bytes(np.clip(stokes.dolp / full_scale, 0, 1))
    return np.asarray(cv2.applyColorMap(levels, cv2.COLORMAP_VIRIDIS), np.uint8)


def angle(stokes: Stokes) -> Picture:
    """(h, w, 3) BGR picture of the AoLP: hue is the angle (0 and 180 degrees alike), brightness the DoLP's
    root.
    """
    hue = np.mod(stokes.aolp * (180 / np.pi), 180).astype(np.uint8)
    value = _to_bytes(np.sqrt(np.clip(stokes.dolp, 0, 1)))
    picture = np.dstack([hue, np.full_like(hue, 220), value])
    return np.asarray(cv2.cvtColor(picture, cv2.COLOR_HSV2BGR), np.uint8)


def normals(directions: NDArray[np.floating], mask: NDArray[np.bool_] | None = None) -> Picture:
    """(h, w, 3) BGR picture of unit normals (h, w, 3) in the camera frame: x right red, y up green, towards
    the camera blue.
    """
    shown = np.stack([-directions[..., 2], -directions[..., 1], directions[..., 0]], axis=-1)
    picture = _to_bytes(0.5 + 0.5 * shown)
    if mask is not None:
        picture[~mask] = 0
    return picture


def decode_picture(raw: Path, layout: Mosaic, out: Path, index: float) -> list[Path]:
    """Decodes a raw mosaic in an image file and writes its pictures.

    Returns:
        The files written: s0, dolp, aolp, normals_diffuse, normals_specular_1, normals_specular_2 (.png).

    Raises:
        ToolkitError: no such image, not a mosaic of this layout, or an impossible index.
    """
    pixels = _read_mosaic(raw)
    if not 1 < index < math.inf:
        raise ToolkitError(
            f"--index {index:g} is not a refractive index of something in air; give a number above 1"
        )
    stokes = decode(pixels, layout, bits=_significant_bits(pixels))
    priors = prior_normals(stokes, nominal_camera_matrix(*stokes.shape), index)
    pictures = {"s0": intensity(stokes), "dolp": degree(stokes), "aolp": angle(stokes)} | {
        f"normals_{name}": normals(prior)
        for name, prior in zip(("diffuse", "specular_1", "specular_2"), priors, strict=True)
    }
    out.mkdir(parents=True, exist_ok=True)
    paths = []
    for name, picture in pictures.items():
        paths.append(out / f"{name}.png")
        cv2.imwrite(str(paths[-1]), picture)
    return paths


def prior_normals(stokes: Stokes, K: NDArray[np.float64], index: float) -> NDArray[np.float32]:
    """(3, h, w, 3) the normals n_d, n_s1, n_s2 of one frame (paper, equation 5), camera frame."""
    maps = shape_priors(torch.from_numpy(stokes.stack())[None], index, torch.from_numpy(K).float()[None])[0]
    return maps.reshape(3, 3, *stokes.shape).permute(0, 2, 3, 1).numpy()


def nominal_camera_matrix(height: int, width: int) -> NDArray[np.float64]:
    """(3, 3) pinhole matrix of a plausible lens, for pictures of uncalibrated frames."""
    focal = _NOMINAL_FIELD_OF_VIEW * width
    return np.array([[focal, 0, (width - 1) / 2], [0, focal, (height - 1) / 2], [0, 0, 1]])


def _read_mosaic(path: Path) -> Raw:
    """The pixels (H, W) of an image file, as they are stored."""
    try:
        coded = np.fromfile(path, np.uint8)
    except OSError as error:
        raise ToolkitError(f"{path} cannot be read ({error.strerror}); check the path") from error
    pixels = cv2.imdecode(coded, cv2.IMREAD_UNCHANGED) if coded.size else None
    if pixels is None:
        raise ToolkitError(f"{path} is not an image; give a PNG or TIFF of a raw mosaic")
    if pixels.ndim != 2 or pixels.dtype not in (np.uint8, np.uint16):
        shape = " x ".join(map(str, pixels.shape))
        raise ToolkitError(
            f"{path} is no raw mosaic but {shape} {pixels.dtype}; give an image of one channel, 8 or 16 bits"
        )
    mosaic: Raw = np.asarray(pixels, np.uint8 if pixels.dtype == np.uint8 else np.uint16)
    return mosaic


def _significant_bits(pixels: Raw) -> int:
    """8, 10, 12 or 16: the fewest that hold the brightest pixel; 16-bit files rarely say."""
    if pixels.dtype == np.uint8:
        return 8
    return next((bits for bits in (10, 12) if int(pixels.max()) < 1 << bits), 16)


def _to_bytes(values: NDArray[np.floating]) -> Picture:
    return np.rint(255 * values).astype(np.uint8)
