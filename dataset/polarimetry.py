"""From a polarization mosaic to Stokes vectors and back.

Angles are counter-clockwise as displayed (y up), 0 along image right, always in the order 0, 45, 90, 135
degrees. A pixel behind a polarizer at angle a reads I_a = (S0 + S1 cos 2a + S2 sin 2a) / 2. Intensities are
scaled so that the sensor's white level is 1; S0 of unpolarized white light is then 2.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from dataset.errors import ToolkitError
from dataset.frames import SUPERPIXEL, Mosaic
from dataset.mosaic_kernels import angle_stokes, calibrated_stokes, colour_stokes, mono_stokes, sample_stokes
from dataset.polarizer_response import POLARIZER_CELL, PolarizerResponse

Raw = NDArray[np.uint8] | NDArray[np.uint16]
Image = NDArray[np.float32]

ANGLES_DEG: tuple[int, int, int, int] = (0, 45, 90, 135)

SATURATED = 0.995
"""Fraction of the white level from which a pixel counts as saturated (our choice)."""

DARK = 0.01
"""S0 under which polarization is noise (our choice: half a percent of the white level per pixel)."""

_SITES = [
    next((row, column) for row in range(2) for column in range(2) if POLARIZER_CELL[row][column] == angle)
    for angle in ANGLES_DEG
]


@dataclass(frozen=True, eq=False)
class Stokes:
    """A linear Stokes image.

    Attributes:
        s0, s1, s2: (h, w) float32.
        valid: (h, w) bool: neither saturated nor too dark, and every source pixel was seen.
    """

    s0: Image
    s1: Image
    s2: Image
    valid: NDArray[np.bool_]

    @staticmethod
    def from_angles(intensities: NDArray[np.floating], valid: NDArray[np.bool_] | None = None) -> Stokes:
        """Least squares from (4, h, w) intensities at 0, 45, 90, 135 degrees.

        With these four angles the normal equations are diagonal: S0 is half the sum, S1 = I0 - I90,
        S2 = I45 - I135. All pixels count as valid unless `valid` (h, w) says otherwise.

        Raises:
            ToolkitError: not four images.
        """
        images = as_angles(intensities)
        out = np.empty((3, *images.shape[1:]), np.float32)
        angle_stokes(images, 0, out)
        return Stokes(out[0], out[1], out[2], np.ones(out.shape[1:], bool) if valid is None else valid)

    @property
    def shape(self) -> tuple[int, int]:
        """(h, w)."""
        height, width = self.s0.shape
        return height, width

    @property
    def dolp(self) -> Image:
        """(h, w) degree of linear polarization, clipped to [0, 1]; 0 where there is no light."""
        lit = self.s0 > 0
        polarized = np.hypot(self.s1, self.s2)
        return np.minimum(np.divide(polarized, self.s0, out=np.zeros_like(self.s0), where=lit), np.float32(1))

    @property
    def aolp(self) -> Image:
        """(h, w) angle of linear polarization, radians in [0, pi)."""
        angle = np.mod(0.5 * np.arctan2(self.s2, self.s1), np.float32(np.pi))
        return np.where(angle < np.pi, angle, np.float32(0))

    def stack(self) -> Image:
        """(3, h, w): S0, S1, S2."""
        return np.stack([self.s0, self.s1, self.s2])

    def angles(self) -> Image:
        """(4, h, w): the intensities behind polarizers at 0, 45, 90, 135 degrees."""
        doubled = [self.s0 + self.s1, self.s0 + self.s2, self.s0 - self.s1, self.s0 - self.s2]
        return np.float32(0.5) * np.stack(doubled)


def superpixel(layout: Mosaic) -> int:
    """Side of the smallest block that holds every angle (and colour) once: 2 or 4 pixels."""
    size = SUPERPIXEL.get(layout)
    if size is None:
        raise ToolkitError(f"mosaic layout {layout!r} is unknown; use one of {', '.join(SUPERPIXEL)}")
    return size


def white_level(bits: int) -> int:
    """The largest value of a pixel of so many bits."""
    return (1 << bits) - 1


def as_angles(intensities: NDArray[np.floating]) -> Image:
    """Angle images (4, h, w) as contiguous float32.

    Raises:
        ToolkitError: of another shape.
    """
    images = np.ascontiguousarray(intensities, dtype=np.float32)
    if images.ndim != 3 or len(images) != 4:
        raise ToolkitError(
            f"angle images must be (4, h, w), at {ANGLES_DEG} degrees; these are of shape {images.shape}"
        )
    return images


def as_words(raw: NDArray[Any]) -> NDArray[Any]:
    """A colour mosaic (H, W) as `colour_stokes` reads it: (H, W/4), the four pixels of a super-pixel's row in
    one word."""
    return np.require(np.ascontiguousarray(raw).view(f"u{4 * raw.itemsize}"), requirements="A")


def split_angles(raw: Raw) -> Raw:
    """The mosaic (H, W) as (4, H/2, W/2) angle images in its own dtype; each of a colour sensor's holds a
    Bayer mosaic with red at the top left.

    Raises:
        ToolkitError: H or W is odd.
    """
    check_mosaic(raw, 2)
    angles: Raw = np.empty((4, raw.shape[0] // 2, raw.shape[1] // 2), raw.dtype)
    for image, (row, column) in zip(angles, _SITES, strict=True):
        image[:] = raw[row::2, column::2]
    return angles


def split_colours(raw: Raw) -> Image:
    """A colour mosaic (H, W) as (4, H/4, W/4, 3) float32 R, G, B per angle, in raw counts, the two green
    pixels averaged.

    Raises:
        ToolkitError: H or W is not a multiple of 4.
    """
    check_mosaic(raw, 4)
    bayer = split_angles(raw).astype(np.float32)
    green = 0.5 * (bayer[:, 0::2, 1::2] + bayer[:, 1::2, 0::2])
    return np.stack([bayer[:, 0::2, 0::2], green, bayer[:, 1::2, 1::2]], axis=-1)


def decode(raw: Raw, layout: Mosaic, bits: int, response: PolarizerResponse | None = None) -> Stokes:
    """The Stokes image of a mosaic, one pixel per super-pixel.

    Args:
        raw: (H, W) uint8 or uint16 mosaic.
        layout: "mono": (H/2, W/2) from 2x2 cells; "colour": (H/4, W/4), each angle the mean of its four
            Bayer pixels (red, two greens, blue).
        bits: significant bits; sets the white level.
        response: of the very sensor, as calibrated: every 2x2 cell is demodulated by its own least squares,
            then the cells of a colour super-pixel are averaged. Without one, the ideal cell.

    A pixel is valid when none of its cell's raw values is saturated and S0 reaches `DARK`.

    Raises:
        ToolkitError: not a mosaic of whole super-pixels, unknown layout, not 8 or 16 bits wide, or a
            response of another size.
    """
    size = superpixel(layout)
    check_mosaic(raw, size)
    height, width = raw.shape[0] // size, raw.shape[1] // size
    out = np.empty((3, height, width), np.float32)
    valid = np.empty((height, width), np.bool_)
    white = white_level(bits)
    pixels, scale = np.ascontiguousarray(raw), np.float32(1 / white)
    if response is not None:
        if response.shape != raw.shape:
            raise ToolkitError(
                f"the polarizer response is of a {response.shape[1]}x{response.shape[0]} mosaic, this one "
                f"has {raw.shape[1]}x{raw.shape[0]}; calibrate them with the same region of interest"
            )
        cells = size // 2
        calibrated_stokes(
            pixels, response.demodulation, cells, scale, SATURATED * white, np.float32(DARK), out, valid
        )
    elif layout == "mono":
        mono_stokes(pixels, scale, SATURATED * white, np.float32(DARK), out, valid)
    else:
        colour_stokes(as_words(pixels), scale, SATURATED * white, np.float32(DARK), out, valid)
    return Stokes(out[0], out[1], out[2], valid)


def sample_mosaic(
    stokes: Stokes,
    layout: Mosaic,
    shape: tuple[int, int] | None = None,
    colour_gains: tuple[float, float, float] = (1.0, 1.0, 1.0),
) -> Image:
    """What an ideal polarization sensor would see: (H, W) float32 intensities, white = 1, unclipped.

    Args:
        stokes: on any grid of which the mosaic is a whole multiple; each of its pixels lights a block.
        layout: of the sensor.
        shape: (H, W) of the mosaic; a super-pixel per Stokes pixel when None.
        colour_gains: sensor response to R, G, B; a mono sensor ignores it.

    Raises:
        ToolkitError: the mosaic is not a whole multiple of the Stokes image or of the super-pixel.
    """
    size = superpixel(layout)
    height, width = shape if shape is not None else (stokes.shape[0] * size, stokes.shape[1] * size)
    block = height // stokes.shape[0]
    if height % size or width % size or (block * stokes.shape[0], block * stokes.shape[1]) != (height, width):
        raise ToolkitError(
            f"sample_mosaic: a {height}x{width} {layout} mosaic is no whole multiple of the Stokes image "
            f"{stokes.shape[0]}x{stokes.shape[1]} and of its {size}x{size} super-pixel"
        )
    out = np.empty((height, width), np.float32)
    red, green, blue = colour_gains if layout == "colour" else (1.0, 1.0, 1.0)
    gains = np.array([[red, green], [green, blue]], np.float32)
    sample_stokes(stokes.s0, stokes.s1, stokes.s2, block, gains, out)
    return out


def quantize(intensity: Image, bits: int) -> Raw:
    """Intensities (H, W), white = 1, rounded and clipped to counts: uint8 up to 8 bits, else uint16."""
    white = np.float32(white_level(bits))
    counts = np.clip(np.rint(intensity * white), 0, white)
    return counts.astype(np.uint8) if bits <= 8 else counts.astype(np.uint16)


def encode(
    stokes: Stokes,
    layout: Mosaic,
    bits: int,
    colour_gains: tuple[float, float, float] = (1.0, 1.0, 1.0),
    shape: tuple[int, int] | None = None,
) -> Raw:
    """The forward model of a noiseless sensor: `sample_mosaic`, then `quantize`. To add noise, put it
    between the two."""
    return quantize(sample_mosaic(stokes, layout, shape, colour_gains), bits)


def remap(stokes: Stokes, map_x: Image, map_y: Image) -> Stokes:
    """Resamples a Stokes image bilinearly at (map_x, map_y), each (h', w') float32 pixel positions.

    A pixel is valid where every contributing source pixel is. The polarization angles are kept: lens
    distortion turns the image by far less than they are measured to.
    """
    channels = np.dstack([stokes.s0, stokes.s1, stokes.s2, stokes.valid.astype(np.float32)])
    moved = cv2.remap(channels, map_x, map_y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_CONSTANT)
    s0, s1, s2, valid = (np.ascontiguousarray(moved[..., i], dtype=np.float32) for i in range(4))
    return Stokes(s0, s1, s2, valid > 0.999)


def check_mosaic(raw: Raw, size: int) -> None:
    """Raises a ToolkitError unless `raw` is a mosaic of whole super-pixels of this size."""
    if raw.ndim != 2 or raw.shape[0] % size or raw.shape[1] % size or raw.size == 0:
        raise ToolkitError(
            f"a raw mosaic must be a (H, W) image of whole {size}x{size} super-pixels, got shape {raw.shape}"
        )
    if raw.dtype not in (np.uint8, np.uint16):
        raise ToolkitError(f"a raw mosaic must hold uint8 or uint16, got {raw.dtype}")
