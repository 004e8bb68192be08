"""Shape priors of whole pictures at a camera's rate: from a raw mosaic, or from four angle images.

`physics.shape_priors` of the same Stokes image gives the same. Here the image is worked through in bands
whose Stokes vectors never leave the processor's cache, which halves what goes through memory: all there is
left to save.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import ArrayLike, NDArray

from dataset import ToolkitError
from dataset.frames import Mosaic
from dataset.mosaic_kernels import angle_stokes
from dataset.polarimetry import Raw, as_angles, check_mosaic, decode, superpixel
from s2p3.physics import DARK, check_index
from s2p3.physics_kernels import priors

Image = NDArray[np.float32]
Planes = tuple[Image, Image, Image]

_BAND = 32  # rows


def mosaic_priors(
    raw: Raw, layout: Mosaic, bits: int, index: float, K: ArrayLike, out: Image | None = None
) -> tuple[Image, NDArray[np.bool_]]:
    """The three normal maps of a raw mosaic, and where they are valid.

    Args:
        raw, layout, bits: see `dataset.polarimetry.decode`; of h x w super-pixels.
        index: refractive index.
        K: (3, 3) intrinsics of the super-pixels.
        out: (9, h, w) float32, contiguous, to put the result into: at a camera's rate a fresh array costs
            more than what is computed into it.

    Returns:
        (9, h, w) as of `physics.shape_priors`, and (h, w) bool: neither saturated nor dark.

    Raises:
        ToolkitError: no such mosaic, an index of nothing in air, or `out` is another array.
    """
    size = superpixel(layout)
    check_mosaic(raw, size)
    shape = raw.shape[0] // size, raw.shape[1] // size
    valid = np.empty(shape, np.bool_)

    def measured(top: int, end: int) -> Planes:
        stokes = decode(raw[size * top : size * end], layout, bits)
        valid[top:end] = stokes.valid
        return stokes.s0, stokes.s1, stokes.s2

    return _in_bands(measured, shape, index, K, out), valid


def angle_priors(
    intensities: NDArray[np.floating], index: float, K: ArrayLike, out: Image | None = None
) -> Image:
    """The three normal maps (9, h, w) of angle images (4, h, w) at 0, 45, 90, 135 degrees.

    Arguments and errors as of `mosaic_priors`.
    """
    images = as_angles(intensities)
    height, width = images.shape[1:]

    def measured(top: int, end: int) -> Planes:
        band = np.empty((3, end - top, width), np.float32)
        angle_stokes(images, top, band)
        return band[0], band[1], band[2]

    return _in_bands(measured, (height, width), index, K, out)


def _in_bands(
    measured: Callable[[int, int], Planes],
    shape: tuple[int, int],
    index: float,
    K: ArrayLike,
    out: Image | None,
) -> Image:
    """Priors of an image whose rows from `top` up to `end` have the Stokes vectors `measured(top, end)`."""
    check_index(index)
    matrix = np.asarray(K, np.float32)
    pinhole = np.array([matrix[0, 0], matrix[1, 1], matrix[0, 2], matrix[1, 2]], np.float32)
    if out is None:
        out = np.empty((9, *shape), np.float32)
    elif out.shape != (9, *shape) or out.dtype != np.float32 or not out.flags.c_contiguous:
        raise ToolkitError(
            f"priors of a {shape[0]}x{shape[1]} image need a contiguous float32 array (9, h, w) to go into, "
            f"not {out.dtype} {out.shape}"
        )
    for top in range(0, shape[0], _BAND):
        s0, s1, s2 = measured(top, min(top + _BAND, shape[0]))
        priors(s0, s1, s2, pinhole, np.float32(index), np.float32(DARK), top, out)
    return out
