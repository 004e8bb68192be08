"""Pictures of normals, of objects over an image, and of raw mosaics in files."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import torch
from numpy.typing import NDArray

from dataset.errors import ToolkitError
from dataset.frames import Mosaic
from dataset.pictures import Picture, angle, degree, intensity, nominal_camera_matrix, to_bytes
from dataset.polarimetry import Raw, Stokes, decode
from s2p3.image_priors import mosaic_priors
from s2p3.physics import check_index, shape_priors
from s2p3.rendering.rasterizer import Raster

CONTOUR_BGR = (80, 220, 255)

_SHADE_BGR = (255, 190, 60)
_OPACITY = 0.45


def normals(directions: NDArray[np.floating], mask: NDArray[np.bool_] | None = None) -> Picture:
    """(h, w, 3) BGR picture of unit normals (h, w, 3) in the camera frame: x right red, y up green, towards
    the camera blue.
    """
    shown = np.stack([-directions[..., 2], -directions[..., 1], directions[..., 0]], axis=-1)
    picture = to_bytes(0.5 + 0.5 * shown)
    if mask is not None:
        picture[~mask] = 0
    return picture


def draw_object(picture: Picture, raster: Raster) -> None:
    """Draws an object over a BGR picture (h, w, 3), in place: shaded as if lit from the camera, with its
    outline.
    """
    inside = raster.mask
    if not inside.any():
        return
    facing = np.clip(-raster.normals[..., 2], 0.15, 1.0)[..., None]
    window = picture[raster.window]
    mixed = (1 - _OPACITY) * window + _OPACITY * facing * np.array(_SHADE_BGR)
    window[inside] = mixed[inside].astype(np.uint8)
    whole = np.zeros(picture.shape[:2], np.uint8)
    whole[raster.window] = inside
    contours, _ = cv2.findContours(whole, cv2.RETR_LIST, cv2.CHAIN_APPROX_NONE)
    cv2.drawContours(picture, contours, -1, CONTOUR_BGR, max(1, picture.shape[1] // 500), cv2.LINE_AA)


def decode_picture(raw: Path, layout: Mosaic, out: Path, index: float) -> list[Path]:
    """Decodes a raw mosaic in an image file and writes its pictures.

    Returns:
        The files written: s0, dolp, aolp, normals_diffuse, normals_specular_1, normals_specular_2 (.png).

    Raises:
        ToolkitError: no such image, not a mosaic of this layout, or an impossible index.
    """
    pixels = _read_mosaic(raw)
    check_index(index)
    bits = _significant_bits(pixels)
    stokes = decode(pixels, layout, bits)
    priors, _ = mosaic_priors(pixels, layout, bits, index, nominal_camera_matrix(*stokes.shape))
    pictures = {"s0": intensity(stokes), "dolp": degree(stokes), "aolp": angle(stokes)} | {
        f"normals_{name}": normals(prior)
        for name, prior in zip(("diffuse", "specular_1", "specular_2"), _pixelwise(priors), strict=True)
    }
    out.mkdir(parents=True, exist_ok=True)
    paths = []
    for name, picture in pictures.items():
        paths.append(out / f"{name}.png")
        cv2.imwrite(str(paths[-1]), picture)
    return paths


def prior_normals(stokes: Stokes, K: NDArray[np.float64], index: float) -> NDArray[np.float32]:
    """(3, h, w, 3) the normals n_d, n_s1, n_s2 of one frame (paper, equation 5), camera frame."""
    stack, camera = torch.from_numpy(stokes.stack()), torch.from_numpy(K).float()
    return _pixelwise(shape_priors(stack[None], index, camera[None])[0].numpy())


def _pixelwise(priors: NDArray[np.float32]) -> NDArray[np.float32]:
    """(9, h, w) -> (3, h, w, 3)."""
    return np.moveaxis(priors.reshape(3, 3, *priors.shape[1:]), 1, -1)


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
