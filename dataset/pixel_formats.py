"""Camera pixel formats: names, codes and bit layouts, as the GenICam Pixel Format Naming Convention has them.

Source: GenICam PFNC 2.1 and its table of 32-bit codes; bits 16-23 of a code are the bits a pixel occupies.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from dataset.errors import ToolkitError

Pixels = NDArray[np.uint8] | NDArray[np.uint16]

Packing = Literal["none", "lsb", "gige"]


@dataclass(frozen=True)
class PixelFormat:
    """One format.

    Attributes:
        name: PFNC name.
        code: PFNC 32-bit value, as a GigE Vision camera reports it.
        bits: significant bits of a pixel value.
        packing: "none" (bytes, or little-endian 16-bit words); "lsb" (PFNC's `p`: one bit stream, least
            significant bit first); "gige" (GigE Vision 1's `Packed`: high bytes around a shared low byte).
        colour: whether a Bayer pattern (red top left) lies over the pixels.
    """

    name: str
    code: int
    bits: int
    packing: Packing
    colour: bool

    @property
    def packed(self) -> bool:
        """Whether pixels share bytes."""
        return self.packing != "none"

    @property
    def bits_on_wire(self) -> int:
        """Bits a pixel occupies in a buffer."""
        return (self.code >> 16) & 0xFF

    @property
    def dtype(self) -> np.dtype[np.uint8] | np.dtype[np.uint16]:
        """What unpacked pixels are held in."""
        return np.dtype(np.uint8) if self.bits == 8 else np.dtype("<u2")

    def size(self, height: int, width: int) -> int:
        """Bytes of a buffer of height x width pixels."""
        return -(-height * width * self.bits_on_wire // 8)


PIXEL_FORMATS: tuple[PixelFormat, ...] = (
    PixelFormat("Mono8", 0x01080001, 8, "none", False),
    PixelFormat("Mono10", 0x01100003, 10, "none", False),
    PixelFormat("Mono10p", 0x010A0046, 10, "lsb", False),
    PixelFormat("Mono12", 0x01100005, 12, "none", False),
    PixelFormat("Mono12p", 0x010C0047, 12, "lsb", False),
    PixelFormat("Mono12Packed", 0x010C0006, 12, "gige", False),
    PixelFormat("Mono16", 0x01100007, 16, "none", False),
    PixelFormat("BayerRG8", 0x01080009, 8, "none", True),
    PixelFormat("BayerRG10", 0x0110000D, 10, "none", True),
    PixelFormat("BayerRG10p", 0x010A0058, 10, "lsb", True),
    PixelFormat("BayerRG12", 0x01100011, 12, "none", True),
    PixelFormat("BayerRG12p", 0x010C0059, 12, "lsb", True),
    PixelFormat("BayerRG12Packed", 0x010C002B, 12, "gige", True),
    PixelFormat("BayerRG16", 0x0110002F, 16, "none", True),
)

_BY_KEY: dict[str | int, PixelFormat] = {
    **{format_.name: format_ for format_ in PIXEL_FORMATS},
    **{format_.code: format_ for format_ in PIXEL_FORMATS},
}


def pixel_format(name_or_code: str | int) -> PixelFormat:
    """Looks a format up by PFNC name or 32-bit code.

    Raises:
        ToolkitError: not one of `PIXEL_FORMATS`.
    """
    found = _BY_KEY.get(name_or_code)
    if found is None:
        shown = name_or_code if isinstance(name_or_code, str) else f"0x{name_or_code:08X}"
        known = ", ".join(format_.name for format_ in PIXEL_FORMATS)
        raise ToolkitError(f"pixel format {shown} is not supported; set the camera to one of {known}")
    return found


def unpack(
    buffer: bytes | bytearray | memoryview | NDArray[np.uint8], format_: PixelFormat, height: int, width: int
) -> Pixels:
    """A camera buffer as an image.

    Args:
        buffer: exactly `format_.size(height, width)` bytes.
        format_: how the bytes are laid out.
        height, width: of the image, pixels.

    Returns:
        (H, W) uint8 or uint16, never sharing memory with `buffer`.

    Raises:
        ToolkitError: the buffer's size does not fit the format.
    """
    data = np.frombuffer(buffer, np.uint8) if not isinstance(buffer, np.ndarray) else buffer.reshape(-1)
    expected = format_.size(height, width)
    if data.dtype != np.uint8 or data.size != expected:
        raise ToolkitError(
            f"{format_.name} {width}x{height} needs {expected} bytes, the buffer holds {data.nbytes} "
            f"({data.dtype}); check the image size and the pixel format the camera really sends"
        )
    count = height * width
    if format_.packing == "lsb" and format_.bits == 12:
        pixels = _unpack_12_lsb(_padded(data, 3), count)
    elif format_.packing == "lsb":
        pixels = _unpack_10_lsb(_padded(data, 5), count)
    elif format_.packing == "gige":
        pixels = _unpack_12_gige(_padded(data, 3), count)
    else:
        pixels = data.view(format_.dtype).copy()
    return pixels.reshape(height, width)


def pack(pixels: Pixels, format_: PixelFormat) -> NDArray[np.uint8]:
    """The inverse of `unpack`: an image (H, W) as the bytes a camera sends, (n,) uint8.

    Raises:
        ToolkitError: a value needs more bits than the format has.
    """
    if pixels.size and int(pixels.max()) >= 1 << format_.bits:
        raise ToolkitError(
            f"pack: the value {int(pixels.max())} does not fit the {format_.bits} bits of {format_.name}"
        )
    size = format_.size(*pixels.shape)
    if not format_.packed:
        return np.ascontiguousarray(pixels, dtype=format_.dtype).reshape(-1).view(np.uint8).copy()
    group = 4 if format_.bits == 10 else 2
    values = np.zeros(-(-pixels.size // group) * group, np.uint16)
    values[: pixels.size] = pixels.reshape(-1)
    columns = values.reshape(-1, group).T
    if format_.packing == "gige":
        packed = _pack_12_gige(columns)
    elif format_.bits == 12:
        packed = _pack_12_lsb(columns)
    else:
        packed = _pack_10_lsb(columns)
    return packed.reshape(-1)[:size]


def _padded(data: NDArray[np.uint8], group: int) -> NDArray[np.uint16]:
    """The bytes as columns of whole groups, widened; an odd pixel count leaves the last group short."""
    missing = -data.size % group
    whole = np.pad(data, (0, missing)) if missing else data
    return whole.reshape(-1, group).T.astype(np.uint16)


def _interleave(columns: list[NDArray[np.uint16]], count: int) -> NDArray[np.uint16]:
    out = np.empty((columns[0].size, len(columns)), np.uint16)
    for i, column in enumerate(columns):
        out[:, i] = column
    return out.reshape(-1)[:count]


def _unpack_12_lsb(b: NDArray[np.uint16], count: int) -> NDArray[np.uint16]:
    return _interleave([b[0] | (b[1] & 0x0F) << 8, b[1] >> 4 | b[2] << 4], count)


def _unpack_12_gige(b: NDArray[np.uint16], count: int) -> NDArray[np.uint16]:
    return _interleave([b[0] << 4 | b[1] & 0x0F, b[2] << 4 | b[1] >> 4], count)


def _unpack_10_lsb(b: NDArray[np.uint16], count: int) -> NDArray[np.uint16]:
    columns = [
        b[0] | (b[1] & 0x03) << 8,
        b[1] >> 2 | (b[2] & 0x0F) << 6,
        b[2] >> 4 | (b[3] & 0x3F) << 4,
        b[3] >> 6 | b[4] << 2,
    ]
    return _interleave(columns, count)


def _pack_12_lsb(p: NDArray[np.uint16]) -> NDArray[np.uint8]:
    return np.stack([p[0] & 0xFF, p[0] >> 8 | (p[1] & 0x0F) << 4, p[1] >> 4], axis=-1).astype(np.uint8)


def _pack_12_gige(p: NDArray[np.uint16]) -> NDArray[np.uint8]:
    return np.stack([p[0] >> 4, p[0] & 0x0F | (p[1] & 0x0F) << 4, p[1] >> 4], axis=-1).astype(np.uint8)


def _pack_10_lsb(p: NDArray[np.uint16]) -> NDArray[np.uint8]:
    columns = [
        p[0] & 0xFF,
        p[0] >> 8 | (p[1] & 0x3F) << 2,
        p[1] >> 6 | (p[2] & 0x0F) << 4,
        p[2] >> 4 | (p[3] & 0x03) << 6,
        p[3] >> 2,
    ]
    return np.stack(columns, axis=-1).astype(np.uint8)
