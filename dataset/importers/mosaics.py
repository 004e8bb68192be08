"""Images behind polarizers put back into the mosaic a sensor would have sent."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from dataset.bop.layout import read_image
from dataset.errors import ToolkitError
from dataset.polarimetry import ANGLES_DEG, POLARIZER_CELL, Image, Raw, Stokes, encode


def colour_mosaic(images: NDArray[np.uint8] | NDArray[np.uint16]) -> Raw:
    """R, G, B images (4, h, w, 3) at 0, 45, 90, 135 degrees -> the colour mosaic (4h, 4w) that
    `polarimetry.split_colours` turns back into them exactly: both green pixels hold the same value.

    Raises:
        ToolkitError: not such an array.
    """
    if images.ndim != 4 or images.shape[0] != 4 or images.shape[3] != 3:
        raise ToolkitError(f"colour_mosaic: expected four RGB images (4, h, w, 3), got {images.shape}")
    _, height, width, _ = images.shape
    bayer = np.empty((4, 2 * height, 2 * width), images.dtype)
    for (row, column), channel in (((0, 0), 0), ((0, 1), 1), ((1, 0), 1), ((1, 1), 2)):
        bayer[:, row::2, column::2] = images[..., channel]
    return mono_mosaic(bayer)


def angle_images(folder: Path, number: int) -> NDArray[np.uint8]:
    """The images (4, h, w, 3) of a frame behind a polarizer, FOLDER/pol/NNNNNN_ANGLE.png.

    Raises:
        ToolkitError: one is missing, or they are not four RGB images of one size.
    """
    images = [read_image(folder / "pol" / f"{number:06d}_{angle}.png") for angle in ANGLES_DEG]
    if any(image.shape != images[0].shape or image.ndim != 3 or image.dtype != np.uint8 for image in images):
        raise ToolkitError(f"{folder}/pol/{number:06d}_*.png are not four RGB images of one size, 8 bit")
    return np.stack(images)


def mono_mosaic(images: NDArray[np.uint8] | NDArray[np.uint16]) -> Raw:
    """Images (4, h, w) at 0, 45, 90, 135 degrees -> the mosaic (2h, 2w) of a monochrome sensor."""
    _, height, width = images.shape
    mosaic: Raw = np.empty((2 * height, 2 * width), images.dtype)
    for row in range(2):
        for column in range(2):
            mosaic[row::2, column::2] = images[ANGLES_DEG.index(POLARIZER_CELL[row][column])]
    return mosaic


def stokes_mosaic(stack: Image, bits: int) -> Raw:
    """S0, S1, S2 (3, h, w) -> the monochrome mosaic (2h, 2w) that decodes to them, to half a count."""
    return encode(Stokes(stack[0], stack[1], stack[2], np.ones(stack.shape[1:], dtype=bool)), "mono", bits)
