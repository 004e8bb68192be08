"""The compiled inner loops of `dataset.pixel_formats`: pixels that share bytes, in one pass over the buffer.

Compiled once for this machine and cached on disk; they release the GIL. A group is the fewest pixels that
fill whole bytes: two of 12 bits in three bytes, four of 10 bits in five. The last group may be cut off.
"""

from __future__ import annotations

from collections.abc import Callable

import numba
import numpy as np
from numpy.typing import NDArray

Bytes = NDArray[np.uint8]
Pixels = NDArray[np.uint16]
Unpack = Callable[[Bytes, Pixels], None]
Pack = Callable[[Pixels, Bytes], None]

_READ_BYTES, _READ_PIXELS = (
    numba.types.Array(kind, 1, "C", readonly=True) for kind in (numba.uint8, numba.uint16)
)
_unpacks = numba.njit(numba.void(_READ_BYTES, numba.uint16[::1]), cache=True, nogil=True)
_packs = numba.njit(numba.void(_READ_PIXELS, numba.uint8[::1]), cache=True, nogil=True)


def _unpack_12_lsb(data: Bytes, pixels: Pixels) -> None:
    """A bit stream, least significant bit first."""
    for i in range(pixels.size // 2):
        a, b, c = np.uint16(data[3 * i]), np.uint16(data[3 * i + 1]), np.uint16(data[3 * i + 2])
        pixels[2 * i] = a | (b & 0x0F) << 8
        pixels[2 * i + 1] = b >> 4 | c << 4
    if pixels.size % 2:
        pixels[-1] = np.uint16(data[-2]) | (np.uint16(data[-1]) & 0x0F) << 8


def _unpack_12_gige(data: Bytes, pixels: Pixels) -> None:
    """High byte, the low nibbles of both, high byte."""
    for i in range(pixels.size // 2):
        a, b, c = np.uint16(data[3 * i]), np.uint16(data[3 * i + 1]), np.uint16(data[3 * i + 2])
        pixels[2 * i] = a << 4 | b & 0x0F
        pixels[2 * i + 1] = c << 4 | b >> 4
    if pixels.size % 2:
        pixels[-1] = np.uint16(data[-2]) << 4 | np.uint16(data[-1]) & 0x0F


def _unpack_10_lsb(data: Bytes, pixels: Pixels) -> None:
    """A bit stream, least significant bit first."""
    for i in range(pixels.size // 4):
        a, b, c = np.uint16(data[5 * i]), np.uint16(data[5 * i + 1]), np.uint16(data[5 * i + 2])
        d, e = np.uint16(data[5 * i + 3]), np.uint16(data[5 * i + 4])
        pixels[4 * i] = a | (b & 0x03) << 8
        pixels[4 * i + 1] = b >> 2 | (c & 0x0F) << 6
        pixels[4 * i + 2] = c >> 4 | (d & 0x3F) << 4
        pixels[4 * i + 3] = d >> 6 | e << 2
    for k in range(pixels.size // 4 * 4, pixels.size):
        bit = 10 * k
        low, high = np.uint16(data[bit // 8]), np.uint16(data[bit // 8 + 1])
        pixels[k] = (low | high << 8) >> bit % 8 & 0x3FF


def _pack_12_lsb(pixels: Pixels, data: Bytes) -> None:
    for i in range(pixels.size // 2):
        p, q = pixels[2 * i], pixels[2 * i + 1]
        data[3 * i] = p & 0xFF
        data[3 * i + 1] = p >> 8 | (q & 0x0F) << 4
        data[3 * i + 2] = q >> 4
    if pixels.size % 2:
        data[-2] = pixels[-1] & 0xFF
        data[-1] = pixels[-1] >> 8


def _pack_12_gige(pixels: Pixels, data: Bytes) -> None:
    for i in range(pixels.size // 2):
        p, q = pixels[2 * i], pixels[2 * i + 1]
        data[3 * i] = p >> 4
        data[3 * i + 1] = p & 0x0F | (q & 0x0F) << 4
        data[3 * i + 2] = q >> 4
    if pixels.size % 2:
        data[-2] = pixels[-1] >> 4
        data[-1] = pixels[-1] & 0x0F


def _pack_10_lsb(pixels: Pixels, data: Bytes) -> None:
    for i in range(pixels.size // 4):
        p, q, r, s = pixels[4 * i], pixels[4 * i + 1], pixels[4 * i + 2], pixels[4 * i + 3]
        data[5 * i] = p & 0xFF
        data[5 * i + 1] = p >> 8 | (q & 0x3F) << 2
        data[5 * i + 2] = q >> 6 | (r & 0x0F) << 4
        data[5 * i + 3] = r >> 4 | (s & 0x03) << 6
        data[5 * i + 4] = s >> 2
    first = pixels.size // 4 * 4
    data[first // 4 * 5 :] = 0
    for k in range(first, pixels.size):
        bit = 10 * k
        value = np.uint32(pixels[k]) << bit % 8
        data[bit // 8] |= value & 0xFF
        data[bit // 8 + 1] |= value >> 8


UNPACK: dict[tuple[str, int], Unpack] = {
    ("lsb", 12): _unpacks(_unpack_12_lsb),
    ("gige", 12): _unpacks(_unpack_12_gige),
    ("lsb", 10): _unpacks(_unpack_10_lsb),
}
"""By packing and bits: all of the bytes to all of the pixels, both contiguous."""

PACK: dict[tuple[str, int], Pack] = {
    ("lsb", 12): _packs(_pack_12_lsb),
    ("gige", 12): _packs(_pack_12_gige),
    ("lsb", 10): _packs(_pack_10_lsb),
}
"""The inverse of `UNPACK`."""
