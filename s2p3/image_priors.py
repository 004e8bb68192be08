"""Shape priors of whole pictures at a camera's rate: from a raw mosaic, or from four angle images.

`physics.shape_priors` of the same Stokes image gives the same. Here the image is worked through in bands
whose Stokes vectors never leave the processor's cache: a third less goes through memory.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from dataset import ToolkitError
from dataset.frames import Mosaic
from dataset.polarimetry import DARK as FAINT
from dataset.polarimetry import SATURATED, Raw, as_angles, as_words, check_mosaic, superpixel, white_level
from s2p3 import physics_kernels as kernels
from s2p3.physics import DARK, check_index
from s2p3.physics_kernels import Image, Row


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
    white = white_level(bits)
    limits = np.float32(1 / white), SATURATED * white, np.float32(FAINT)
    out, valid = _checked(out, shape), np.empty(shape, np.bool_)
    if layout == "colour":
        kernels.colour_priors(as_words(raw), *limits, *_constants(index, K), out, valid)
    else:
        kernels.mono_priors(np.ascontiguousarray(raw), *limits, *_constants(index, K), out, valid)
    return out, valid


def angle_priors(
    intensities: NDArray[np.floating], index: float, K: ArrayLike, out: Image | None = None
) -> Image:
    """The three normal maps (9, h, w) of angle images (4, h, w) at 0, 45, 90, 135 degrees.

    Arguments and errors as of `mosaic_priors`.
    """
    images = as_angles(intensities)
    out = _checked(out, images.shape[1:])
    kernels.angle_priors(images, *_constants(index, K), out)
    return out


def _constants(index: float, K: ArrayLike) -> tuple[Row, np.float32, np.float32]:
    """fx, fy, cx, cy, the index, and what is no light."""
    check_index(index)
    matrix = np.asarray(K, np.float32)
    pinhole = np.array([matrix[0, 0], matrix[1, 1], matrix[0, 2], matrix[1, 2]], np.float32)
    return pinhole, np.float32(index), np.float32(DARK)


def _checked(out: Image | None, shape: tuple[int, ...]) -> Image:
    """An array for the priors of an image of this shape."""
    if out is None:
        return np.empty((9, *shape), np.float32)
    if out.shape != (9, *shape) or out.dtype != np.float32 or not out.flags.c_contiguous:
        raise ToolkitError(
            f"priors of a {shape[0]}x{shape[1]} image need a contiguous float32 array (9, h, w) to go into, "
            f"not {out.dtype} {out.shape}"
        )
    return out
