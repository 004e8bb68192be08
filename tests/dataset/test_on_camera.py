"""What a polarization camera computes itself, against what the raw mosaic of the same moment gives."""

from __future__ import annotations

import numpy as np
import pytest

from dataset import CameraInfo, ToolkitError
from dataset.on_camera import as_mosaic, compute_on_camera, decode_frame, decode_polarization
from dataset.pixel_formats import PIXEL_FORMATS, PixelFormat, pack, pixel_format, unpack
from dataset.polarimetry import Stokes, decode, encode

HEIGHT, WIDTH = 32, 48
ON_CAMERA = [format_ for format_ in PIXEL_FORMATS if format_.channels]


def ids(format_: PixelFormat) -> str:
    return format_.name.removeprefix("Polarized")


def described(format_: PixelFormat) -> CameraInfo:
    layout = "colour" if format_.colour else "mono"
    return CameraInfo("v", "m", "s", "f", format_.name, layout, WIDTH, HEIGHT, format_.bits, 0)


def seen(format_: PixelFormat) -> np.ndarray:
    """A raw mosaic of all angles and degrees of polarization, with a dark and a saturated corner."""
    size = 4 if format_.colour else 2
    y, x = np.mgrid[0 : HEIGHT // size, 0 : WIDTH // size]
    angle, degree = x / (WIDTH // size) * np.pi, 0.05 + 0.9 * y / (HEIGHT // size)
    s0 = np.full(x.shape, 0.9, np.float32)
    s0[0, 0], s0[-1, -1] = 0.004, 2.4
    s1, s2 = (s0 * degree * f(2 * angle) for f in (np.cos, np.sin))
    stokes = Stokes(s0, s1.astype(np.float32), s2.astype(np.float32), np.ones(x.shape, bool))
    return encode(stokes, "colour" if format_.colour else "mono", format_.bits)


def sent(format_: PixelFormat, mosaic: np.ndarray) -> np.ndarray:
    """The frame after a way over the wire."""
    data = pack(compute_on_camera(mosaic, format_), format_)
    assert data.size == format_.size(HEIGHT, WIDTH)
    return unpack(data, format_, HEIGHT, WIDTH)


def truth(format_: PixelFormat, mosaic: np.ndarray) -> Stokes:
    return decode(mosaic, "colour" if format_.colour else "mono", format_.bits)


@pytest.mark.parametrize("format_", [f for f in ON_CAMERA if f.content == "angles"], ids=ids)
def test_angles_are_the_raw_mosaic_in_another_order(format_: PixelFormat) -> None:
    mosaic = seen(format_)
    frame = sent(format_, mosaic)
    np.testing.assert_array_equal(frame, mosaic)
    np.testing.assert_array_equal(
        decode_frame(frame, described(format_)).stack(), truth(format_, mosaic).stack()
    )


def test_angles_travel_cell_by_cell_from_0_to_135_degrees() -> None:
    format_ = pixel_format("PolarizedAngles_0d_45d_90d_135d_Mono8")
    np.testing.assert_array_equal(pack(np.array([[90, 45], [135, 0]], np.uint8), format_), [0, 45, 90, 135])


@pytest.mark.parametrize("format_", [f for f in ON_CAMERA if f.content == "stokes"], ids=ids)
def test_stokes_channels_give_the_frame_of_the_raw_mosaic(format_: PixelFormat) -> None:
    mosaic = seen(format_)
    expected = truth(format_, mosaic)
    camera = described(format_)
    found = decode_frame(sent(format_, mosaic), camera)
    # Half of a count at most is lost of half of a Stokes parameter, always downwards.
    step = 2 / ((1 << format_.bits) - 1)
    lost = expected.stack() - found.stack()
    lit = expected.valid
    assert lost[:, lit].min() > -1e-6
    assert lost[:, lit].max() < step
    np.testing.assert_array_equal(found.valid, expected.valid)
    assert not found.valid[0, 0]
    assert not found.valid[-1, -1]


@pytest.mark.parametrize("format_", [f for f in ON_CAMERA if f.content == "stokes"], ids=ids)
def test_the_board_is_seen_in_stokes_channels_too(format_: PixelFormat) -> None:
    mosaic = seen(format_)
    rebuilt = as_mosaic(sent(format_, mosaic), described(format_))
    assert rebuilt.dtype == mosaic.dtype
    assert np.abs(rebuilt[:-4].astype(int) - mosaic[:-4]).max() <= 2


@pytest.mark.parametrize("format_", [f for f in ON_CAMERA if "olp" in f.name], ids=ids)
def test_degree_and_angle_come_as_they_are_and_no_stokes_image_is_made_up(format_: PixelFormat) -> None:
    mosaic = seen(format_)
    expected = truth(format_, mosaic)
    camera = described(format_)
    frame = sent(format_, mosaic)
    found = decode_polarization(frame, camera)
    lit = expected.valid
    assert (found.dolp is None) == (format_.content == "aolp")
    assert (found.aolp is None) == (format_.content == "dolp")
    if found.dolp is not None:
        assert np.abs(found.dolp - expected.dolp)[lit].max() < 6 / (1 << format_.bits)
    if found.aolp is not None:
        turn = np.angle(np.exp(2j * (found.aolp - expected.aolp))) / 2
        assert np.abs(turn)[lit & (expected.dolp > 0.1)].max() < 5.0 / (1 << format_.bits)
        assert frame[format_.places[-1][0] :: 2, format_.places[-1][1] :: 2].max() <= 201 * (
            16 if format_.bits == 12 else 1
        )
    for refused in (decode_frame, as_mosaic):
        with pytest.raises(ToolkitError, match=f"no intensity.*record {format_.raw_name}"):
            refused(frame, camera)


@pytest.mark.parametrize("name", ["BayerRG8", "Mono12p", "PolarizedStokes_S0_S1_S2_Mono12p"])
def test_every_format_with_an_intensity_has_a_degree_and_an_angle(name: str) -> None:
    format_ = pixel_format(name)
    mosaic = seen(format_)
    frame = sent(format_, mosaic) if format_.channels else mosaic
    stokes, found = (
        decode_frame(frame, described(format_)),
        decode_polarization(frame, described(format_)),
    )
    np.testing.assert_array_equal(found.dolp, stokes.dolp)
    np.testing.assert_array_equal(found.aolp, stokes.aolp)


def test_a_frame_of_another_size_is_refused() -> None:
    format_ = pixel_format("PolarizedStokes_S0_S1_S2_BayerRG8")
    with pytest.raises(ToolkitError, match="must have 32x48 pixels"):
        decode_frame(np.zeros((16, 48), np.uint8), described(format_))
