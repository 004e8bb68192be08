"""The compiled loops behind `physics.shape_priors`: row by row, no intermediate image.

The same closed forms as `physics.shape_priors_reference`, with fewer roots. With L = hypot(S1, S2) and, in
place of k, the half-angle m = (1 - k) / (1 + k) = L / (S0 + sqrt(S0^2 - L^2)):

    diffuse            sin = 2 n sqrt(m) g                cos = (n (1 - m) - (1 + m)) g
    below Brewster     sin = n sqrt(2 m / (m a + r))      cos = sqrt((r - m b) / (m a + r))
    above Brewster     sin = n sqrt(2 / (a + q))          cos = 2 n m / sqrt((a + q) (b + q))

    a = n^2 + 1   b = n^2 - 1   r^2 = m^2 b^2 + 4 n^2   q^2 = b^2 + 4 n^2 m^2
    g = 1 / sqrt((1 + m) (a (1 + m) - 2 n (1 - m)))

Compiled when first called and cached on disk; releases the GIL. A row takes four short loops without
branches: each is vectorized, and short enough for the processor to work on several pixels of it at once.
"""

from __future__ import annotations

from typing import Any

import numba
import numpy as np
from numpy.typing import NDArray

from dataset.mosaic_kernels import angle_stokes, colour_stokes, mono_stokes

Row = NDArray[np.float32]
Image = NDArray[np.float32]

_VECTOR_MATH = {"arcp", "contract", "nsz", "afn"}
"""Reciprocals and roots may be off in the last bits; NaN and infinity keep their meaning."""

_ONE, _TWO, _FOUR = np.float32(1), np.float32(2), np.float32(4)
_TINY = np.float32(1e-30)


_BAND = 8
"""Rows whose Stokes vectors stay in the processor's cache from one loop to the next."""


@numba.njit(inline="always")
def _rsqrt(x: np.float32) -> np.float32:
    return _ONE / np.sqrt(x)


@numba.njit(inline="always")
def _camera_frame(
    x: np.float32, y: np.float32, z: np.float32, a: np.float32, b: np.float32, c: np.float32, bend: np.float32
) -> tuple[np.float32, np.float32, np.float32]:
    """`physics.from_ray_frame` of one direction and the ray (a, b, c); bend = 1 / (1 + c)."""
    across = a * x + b * y
    along = z - across * bend
    return x + a * along, y + b * along, c * z - across


@numba.njit(cache=True, nogil=True, fastmath=_VECTOR_MATH, error_model="numpy")
def priors(
    s0s: Image,
    s1s: Image,
    s2s: Image,
    pinhole: Row,
    index: np.float32,
    dark: np.float32,
    top: int,
    out: NDArray[np.float32],
) -> None:
    """Stokes images (h, W) and fx, fy, cx, cy -> normals n_d, n_s1, n_s2: rows `top` to `top + h` of
    (9, H, W)."""
    a, b = index * index + _ONE, index * index - _ONE
    b2, n2, sqrt2n = b * b, _FOUR * index * index, np.sqrt(_TWO) * index
    grazing = b / (a + _TWO * index)  # m of the largest diffuse polarization, where k = 1 / n
    root_grazing = np.sqrt(grazing)
    height, width = s0s.shape
    us, ray_z, bend, half, root, cosine, sine = np.empty((7, width), np.float32)
    fx, fy, cx, cy = pinhole
    for x in range(width):
        us[x] = (np.float32(x) - cx) / fx
    for y in range(height):
        row = top + y
        v = (np.float32(row) - cy) / fy
        for x in range(width):
            s1, s2 = s1s[y, x], s2s[y, x]
            polarized = np.sqrt(s1 * s1 + s2 * s2)
            s0 = max(max(s0s[y, x], polarized), dark)
            m = polarized / (s0 + np.sqrt((s0 - polarized) * (s0 + polarized)))
            half[x] = m
            # The azimuth, half the angle of (S1, S2), bisects that and the nearer half of the S1 axis.
            longer = polarized + abs(s1)
            scale = _rsqrt(max(_TWO * polarized * longer, _TINY))
            longer, shorter = longer * scale, abs(s2) * scale
            longer = longer if polarized > dark else _ONE
            cosine[x], turned = (longer, shorter) if s1 >= 0 else (shorter, longer)
            sine[x] = -turned if s2 < 0 else turned

        ox, oy, oz = out[0, row], out[1, row], out[2, row]
        for x in range(width):
            # Roots that the later loops need, too: here the processor's divider would be idle.
            c, root[x] = _rsqrt(_ONE + us[x] * us[x] + v * v), np.sqrt(half[x])
            ray_z[x], bend[x] = c, _ONE / (_ONE + c)
            m = min(half[x], grazing)
            g = _rsqrt((_ONE + m) * (a * (_ONE + m) - _TWO * index * (_ONE - m)))
            sin, z = _TWO * index * min(root[x], root_grazing) * g, (_ONE + m - index * (_ONE - m)) * g
            normal = _camera_frame(cosine[x] * sin, -sine[x] * sin, z, us[x] * c, v * c, c, bend[x])
            ox[x], oy[x], oz[x] = normal

        ox, oy, oz = out[3, row], out[4, row], out[5, row]
        for x in range(width):
            m, c = half[x], ray_z[x]
            r = np.sqrt(m * m * b2 + n2)
            scale = _rsqrt(m * a + r)
            sin, z = sqrt2n * root[x] * scale, -np.sqrt(r - m * b) * scale
            normal = _camera_frame(-sine[x] * sin, -cosine[x] * sin, z, us[x] * c, v * c, c, bend[x])
            ox[x], oy[x], oz[x] = normal

        ox, oy, oz = out[6, row], out[7, row], out[8, row]
        for x in range(width):
            m, c = half[x], ray_z[x]
            q = np.sqrt(b2 + n2 * m * m)
            scale = _rsqrt(a + q)
            sin, z = sqrt2n * scale, -_TWO * index * m * scale * _rsqrt(b + q)
            normal = _camera_frame(-sine[x] * sin, -cosine[x] * sin, z, us[x] * c, v * c, c, bend[x])
            ox[x], oy[x], oz[x] = normal


@numba.njit(cache=True, nogil=True)
def angle_priors(images: Image, pinhole: Row, index: np.float32, dark: np.float32, out: Image) -> None:
    """(4, H, W) angle images -> (9, H, W) normals."""
    _, height, width = images.shape
    for top in range(0, height, _BAND):
        stokes = np.empty((3, min(_BAND, height - top), width), np.float32)
        angle_stokes(images, top, stokes)
        priors(stokes[0], stokes[1], stokes[2], pinhole, index, dark, top, out)


@numba.njit(cache=True, nogil=True)
def colour_priors(
    words: NDArray[Any],
    scale: np.float32,
    saturated: float,
    dim: np.float32,
    pinhole: Row,
    index: np.float32,
    dark: np.float32,
    out: Image,
    valid: NDArray[np.bool_],
) -> None:
    """A mosaic as `colour_stokes` takes it -> (9, H, W) normals, and (H, W) validity."""
    height, width = valid.shape
    for top in range(0, height, _BAND):
        end = min(top + _BAND, height)
        stokes = np.empty((3, end - top, width), np.float32)
        colour_stokes(words[4 * top : 4 * end], scale, saturated, dim, stokes, valid[top:end])
        priors(stokes[0], stokes[1], stokes[2], pinhole, index, dark, top, out)


@numba.njit(cache=True, nogil=True)
def mono_priors(
    pixels: NDArray[Any],
    scale: np.float32,
    saturated: float,
    dim: np.float32,
    pinhole: Row,
    index: np.float32,
    dark: np.float32,
    out: Image,
    valid: NDArray[np.bool_],
) -> None:
    """A mosaic as `mono_stokes` takes it -> (9, H, W) normals, and (H, W) validity."""
    height, width = valid.shape
    for top in range(0, height, _BAND):
        end = min(top + _BAND, height)
        stokes = np.empty((3, end - top, width), np.float32)
        mono_stokes(pixels[2 * top : 2 * end], scale, saturated, dim, stokes, valid[top:end])
        priors(stokes[0], stokes[1], stokes[2], pinhole, index, dark, top, out)
