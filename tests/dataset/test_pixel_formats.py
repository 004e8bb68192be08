"""Pixel formats: hand-made bit vectors, and every format round trips."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from dataset import ToolkitError
from dataset.pixel_formats import PIXEL_FORMATS, PixelFormat, pack, pixel_format, unpack

by_name = pytest.mark.parametrize("format_", PIXEL_FORMATS, ids=lambda f: f.name)


@pytest.mark.parametrize(
    ("name", "data", "pixels"),
    [
        ("Mono8", [0x00, 0x7F, 0xFF, 0x01], [0x00, 0x7F, 0xFF, 0x01]),
        ("Mono12", [0x34, 0x02, 0xFF, 0x0F], [0x234, 0xFFF]),
        ("BayerRG16", [0x34, 0x12, 0xCD, 0xAB], [0x1234, 0xABCD]),
        # PFNC lsb packed: the first pixel's low byte, then the two nibbles with the first pixel's below
        ("Mono12p", [0xBC, 0x3A, 0x12], [0xABC, 0x123]),
        ("BayerRG12p", [0xFF, 0x0F, 0x00], [0xFFF, 0x000]),
        # GigE Vision packed: the high bytes, with both low nibbles between them
        ("Mono12Packed", [0xAB, 0x3C, 0x12], [0xABC, 0x123]),
        ("BayerRG12Packed", [0xFF, 0x0F, 0x00], [0xFFF, 0x000]),
        # four pixels of 10 bits in a stream, least significant bit first
        ("Mono10p", [0x01, 0x08, 0x30, 0x00, 0x01], [0x001, 0x002, 0x003, 0x004]),
        ("BayerRG10p", [0xFF, 0x03, 0x00, 0xC0, 0xFF], [0x3FF, 0x000, 0x000, 0x3FF]),
    ],
)
def test_hand_made_vectors(name: str, data: list[int], pixels: list[int]) -> None:
    format_ = pixel_format(name)
    image = np.array([pixels], dtype=format_.dtype)
    np.testing.assert_array_equal(unpack(bytes(data), format_, 1, len(pixels)), image)
    np.testing.assert_array_equal(pack(image, format_), data)


@by_name
@settings(derandomize=True, deadline=None, max_examples=8)
@given(height=st.integers(1, 7), width=st.integers(1, 9), seed=st.integers(0, 1000))
def test_every_format_round_trips(format_: PixelFormat, height: int, width: int, seed: int) -> None:
    rng = np.random.default_rng(seed)
    height, width = height * format_.cell, width * format_.cell
    pixels = rng.integers(0, 1 << format_.bits, (height, width)).astype(format_.dtype)
    for row in range(format_.cell):
        for column in range(format_.cell):
            if format_.channels and (row, column) not in format_.places:
                pixels[row::2, column::2] = 0
    data = pack(pixels, format_)
    assert data.dtype == np.uint8
    assert len(data) == format_.size(height, width)
    found = unpack(data.tobytes(), format_, height, width)
    assert found.dtype == format_.dtype
    np.testing.assert_array_equal(found, pixels)


@by_name
def test_bits_on_the_wire_hold_the_pixel(format_: PixelFormat) -> None:
    bits = format_.bits_on_wire // max(1, format_.channels)
    assert bits >= format_.bits
    assert format_.packed == (bits not in (8, 16))
    assert format_.colour == ("BayerRG" in format_.name)
    assert len(set(format_.places)) == format_.channels
    assert (pixel_format(format_.raw_name).bits, pixel_format(format_.raw_name).channels) == (format_.bits, 0)
    assert pixel_format(format_.code) is format_ is pixel_format(format_.name)


@pytest.mark.parametrize(
    ("name", "code"),
    [
        ("PolarizedAngles_0d_45d_90d_135d_BayerRG8", 0x8220020F),
        ("PolarizedAngles_0d_45d_90d_135d_BayerRG12p", 0x8230021F),
        ("PolarizedStokes_S0_S1_S2_BayerRG8", 0x8218023F),
        ("PolarizedStokes_S0_S1_S2_BayerRG12p", 0x8224024F),
        ("PolarizedStokes_S0_S1_S2_S3_BayerRG8", 0x8220026F),
        ("PolarizedStokes_S0_S1_S2_S3_BayerRG12p", 0x8230027F),
        ("PolarizedAolp_BayerRG8", 0x810802DF),
        ("PolarizedAolp_BayerRG12p", 0x810C02EF),
        ("PolarizedDolp_BayerRG8", 0x810802BF),
        ("PolarizedDolp_BayerRG12p", 0x810C02CF),
        ("PolarizedDolpAolp_BayerRG8", 0x8210029F),
        ("PolarizedDolpAolp_BayerRG12p", 0x821802AF),
    ],
)
def test_codes_of_what_the_camera_computes(name: str, code: int) -> None:
    """As the vendor's header has them."""
    assert pixel_format(name).code == code


def test_lsb_packing_is_one_bit_stream() -> None:
    """Any `p` format read as one long little-endian number gives its pixels in turn."""
    for name in ("Mono10p", "Mono12p"):
        format_ = pixel_format(name)
        pixels = np.random.default_rng(0).integers(0, 1 << format_.bits, (3, 5)).astype(np.uint16)
        stream = int.from_bytes(pack(pixels, format_).tobytes(), "little")
        mask = (1 << format_.bits) - 1
        assert [stream >> (format_.bits * i) & mask for i in range(15)] == pixels.ravel().tolist()


def test_unpacked_pixels_are_a_copy() -> None:
    buffer = bytearray(8)
    pixels = unpack(buffer, pixel_format("Mono8"), 2, 4)
    buffer[0] = 9
    assert pixels[0, 0] == 0


@by_name
@pytest.mark.parametrize("extra", [-1, 1])
def test_a_buffer_of_another_size_is_refused(format_: PixelFormat, extra: int) -> None:
    with pytest.raises(ToolkitError, match=r"needs \d+ bytes"):
        unpack(bytes(format_.size(4, 6) + extra), format_, 4, 6)


def test_values_that_do_not_fit_are_refused() -> None:
    with pytest.raises(ToolkitError, match="4096 does not fit the 12 bits"):
        pack(np.array([[4096]], dtype=np.uint16), pixel_format("Mono12p"))


@pytest.mark.parametrize("unknown", ["RGB8", 0x02180014])
def test_unknown_formats_name_the_known_ones(unknown: str | int) -> None:
    with pytest.raises(ToolkitError, match=r"Mono8, .*BayerRG12p"):
        pixel_format(unknown)
