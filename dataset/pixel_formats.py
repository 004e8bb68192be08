"""Camera pixel formats: names, codes and bit layouts, as the GenICam Pixel Format Naming Convention has them.

Source: GenICam PFNC 2.1 and its table of 32-bit codes; bits 16-23 of a code are the bits a pixel occupies.

Polarization cameras also send what they computed themselves: several channels for each 2x2 polarizer cell.
A frame of such a format lies on the sensor's grid like any other: its cell of 2x2 pixels holds the channels,
so that one geometry serves all formats. `dataset.on_camera` says what the channels mean. Source of the codes:
LUCID's published PFNC.h; their geometry is inferred, so drivers hold it against the camera's payload size.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from dataset.errors import ToolkitError

Pixels = NDArray[np.uint8] | NDArray[np.uint16]

Packing = Literal["none", "lsb", "gige"]

Content = Literal["mosaic", "angles", "stokes", "dolp", "aolp", "dolp_aolp"]

_ROW_BY_ROW = ((0, 0), (0, 1), (1, 0), (1, 1))
_ANGLES = ((1, 1), (0, 1), (0, 0), (1, 0))
"""Where a raw mosaic has 0, 45, 90 and 135 degrees."""


@dataclass(frozen=True)
class PixelFormat:
    """One format.

    Attributes:
        name: PFNC name.
        code: PFNC 32-bit value, as a GigE Vision camera reports it.
        bits: significant bits of a pixel's (or a channel's) value.
        packing: "none" (bytes, or little-endian 16-bit words); "lsb" (PFNC's `p`: one bit stream, least
            significant bit first); "gige" (GigE Vision 1's `Packed`: high bytes around a shared low byte).
        colour: whether a Bayer pattern (red top left) lies over the pixels, or over each channel's.
        content: "mosaic", as the sensor sees it; else what the camera computed for each 2x2 cell.
        channels: values of a cell; 0 for a mosaic.
    """

    name: str
    code: int
    bits: int
    packing: Packing
    colour: bool
    content: Content = "mosaic"
    channels: int = 0

    @property
    def packed(self) -> bool:
        """Whether pixels share bytes."""
        return self.packing != "none"

    @property
    def bits_on_wire(self) -> int:
        """Bits a pixel occupies in a buffer; all channels of a cell together."""
        return (self.code >> 16) & 0xFF

    @property
    def dtype(self) -> np.dtype[np.uint8] | np.dtype[np.uint16]:
        """What unpacked pixels are held in."""
        return np.dtype(np.uint8) if self.bits == 8 else np.dtype("<u2")

    @property
    def cell(self) -> int:
        """Side of the block of the sensor's pixels that one pixel of the camera's own image stands for."""
        return 2 if self.channels else 1

    @property
    def places(self) -> tuple[tuple[int, int], ...]:
        """Row and column in the 2x2 cell of each channel; angles lie where the raw mosaic has them."""
        return _ANGLES if self.content == "angles" else _ROW_BY_ROW[: self.channels]

    @property
    def raw_name(self) -> str:
        """The format of the raw mosaic from which the camera computes this one; its own for a mosaic."""
        if self.content == "mosaic":
            return self.name
        return self.name.rsplit("_", 1)[1]

    def size(self, height: int, width: int) -> int:
        """Bytes of a buffer of height x width of the sensor's pixels."""
        return -(-(height // self.cell) * (width // self.cell) * self.bits_on_wire // 8)


_MOSAICS = (
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

_ON_CAMERA: tuple[tuple[str, Content, int, int, int], ...] = (
    # prefix, content, channels, code with Mono8, code with Mono12p
    ("PolarizedAngles_0d_45d_90d_135d", "angles", 4, 0x8220000F, 0x8230001F),
    ("PolarizedStokes_S0_S1_S2", "stokes", 3, 0x8218003F, 0x8224004F),
    ("PolarizedStokes_S0_S1_S2_S3", "stokes", 4, 0x8220006F, 0x8230007F),
    ("PolarizedDolpAolp", "dolp_aolp", 2, 0x8210009F, 0x821800AF),
    ("PolarizedDolp", "dolp", 1, 0x810800BF, 0x810C00CF),
    ("PolarizedAolp", "aolp", 1, 0x810800DF, 0x810C00EF),
)
_WITH_BAYER = 0x200  # what a colour camera's code has on top


def _depths(code_8: int, code_12: int) -> tuple[tuple[str, int, Packing, int], ...]:
    return ("8", 8, "none", code_8), ("12p", 12, "lsb", code_12)


PIXEL_FORMATS: tuple[PixelFormat, ...] = (
    *_MOSAICS,
    *(
        PixelFormat(
            f"{prefix}_{colours}{depth}", code | flag, bits, packing, colours != "Mono", content, channels
        )
        for prefix, content, channels, code_8, code_12 in _ON_CAMERA
        for colours, flag in (("Mono", 0), ("BayerRG", _WITH_BAYER))
        for depth, bits, packing, code in _depths(code_8, code_12)
    ),
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
    """A camera buffer as an image on the sensor's grid.

    Args:
        buffer: exactly `format_.size(height, width)` bytes.
        format_: how the bytes are laid out.
        height, width: of the image, the sensor's pixels.

    Returns:
        (H, W) uint8 or uint16, never sharing memory with `buffer`. Where the camera sends fewer than four
        channels a cell, the rest of its pixels are 0.

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
    if not format_.channels:
        return _unpack_values(data, format_, height * width).reshape(height, width)
    shape = (height // 2, width // 2, format_.channels)
    channels = _unpack_values(data, format_, shape[0] * shape[1] * shape[2]).reshape(shape)
    image: Pixels = np.zeros((height, width), format_.dtype)
    for channel, (row, column) in enumerate(format_.places):
        image[row::2, column::2] = channels[..., channel]
    return image


def pack(pixels: Pixels, format_: PixelFormat) -> NDArray[np.uint8]:
    """The inverse of `unpack`: an image (H, W) as the bytes a camera sends, (n,) uint8.

    Raises:
        ToolkitError: a value needs more bits than the format has.
    """
    if pixels.size and int(pixels.max()) >= 1 << format_.bits:
        raise ToolkitError(
            f"pack: the value {int(pixels.max())} does not fit the {format_.bits} bits of {format_.name}"
        )
    if format_.channels:
        pixels = _channels_side_by_side(pixels, format_)
    if not format_.packed:
        return np.ascontiguousarray(pixels, dtype=format_.dtype).reshape(-1).view(np.uint8).copy()
    from dataset.packing_kernels import PACK

    values: NDArray[np.uint16] = np.ascontiguousarray(pixels, dtype=np.uint16).reshape(-1)
    packed = np.empty(-(-values.size * _packed_bits(format_) // 8), np.uint8)
    PACK[format_.packing, format_.bits](values, packed)
    return packed


def _unpack_values(data: NDArray[np.uint8], format_: PixelFormat, count: int) -> Pixels:
    if not format_.packed:
        return data.view(format_.dtype).copy()
    # Compiling and loading them takes a moment, which naming a format need not cost.
    from dataset.packing_kernels import UNPACK

    values = np.empty(count, np.uint16)
    UNPACK[format_.packing, format_.bits](np.ascontiguousarray(data), values)
    return values


def _channels_side_by_side(pixels: Pixels, format_: PixelFormat) -> Pixels:
    """(H/2, W/2 * channels): the cells' values in the order in which they are sent."""
    cells: Pixels = np.empty((pixels.shape[0] // 2, pixels.shape[1] // 2, format_.channels), pixels.dtype)
    for channel, (row, column) in enumerate(format_.places):
        cells[..., channel] = pixels[row::2, column::2]
    return cells.reshape(cells.shape[0], -1)


def _packed_bits(format_: PixelFormat) -> int:
    return format_.bits_on_wire // max(1, format_.channels)
