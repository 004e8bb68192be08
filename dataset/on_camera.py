"""What polarization cameras compute themselves, decoded; and what such a camera computes, for simulation.

`dataset.pixel_formats` puts the channels into the 2x2 cells of the sensor's grid. What they mean:

- angles: the raw mosaic itself, sent in another order.
- Stokes: half of S0, S1 and S2 in counts of the raw mosaic, S1 and S2 in two's complement. The camera's
  material that is public does not say this: it is our choice, unverified on hardware. S3 is ignored: a sensor
  behind linear polarizers cannot see it.
- DoLP: full scale is 1. AoLP: 64 counts a radian at 8 bits, since LUCID's examples give 201 as its largest
  value; 16 times finer at 12 bits, which is inferred.

A colour camera computes each Bayer pixel by itself; the decoded image has one pixel per 4x4 super-pixel.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from dataset.errors import ToolkitError
from dataset.frames import CameraInfo
from dataset.pixel_formats import PIXEL_FORMATS, PixelFormat
from dataset.polarimetry import DARK, SATURATED, Image, Raw, Stokes, decode, split_angles, white_level
from dataset.polarizer_response import PolarizerResponse

_AOLP_COUNTS_PER_RADIAN = {8: 64.0, 12: 1024.0}

_ON_CAMERA = {format_.name: format_ for format_ in PIXEL_FORMATS if format_.channels}


@dataclass(frozen=True, eq=False)
class Polarization:
    """Degree and angle of linear polarization without an intensity.

    Attributes:
        dolp: (h, w) float32 in [0, 1]; None where the camera sent only angles.
        aolp: (h, w) float32 radians in [0, pi); None where the camera sent only degrees.
    """

    dolp: Image | None
    aolp: Image | None


def decode_frame(raw: Raw, camera: CameraInfo, response: PolarizerResponse | None = None) -> Stokes:
    """The Stokes image of a frame in any format that has one, a pixel per super-pixel.

    Args:
        raw: (H, W) as `RawFrame.pixels` holds it.
        camera: that took it.
        response: how its pixels really respond, see `polarimetry.decode`.

    Formats that are not a camera's own computation are decoded as raw mosaics. From Stokes channels the
    intensities behind the polarizers, and so what is saturated, are those of ideal linear polarization; a
    response is applied to them as if they had been measured.

    Raises:
        ToolkitError: the format holds no intensity, or the frame does not fit the camera's description.
    """
    format_ = _ON_CAMERA.get(camera.pixel_format)
    if format_ is None or format_.content == "angles":
        return decode(raw, camera.mosaic, camera.bits, response)
    if format_.content != "stokes":
        raise ToolkitError(
            f"{camera.pixel_format} holds no intensity, so it has no Stokes image, only its `polarization`; "
            f"record {format_.raw_name}, from which everything can be computed"
        )
    if response is not None:
        return decode(as_mosaic(raw, camera), camera.mosaic, camera.bits, response)
    white = white_level(format_.bits)
    half = _signed_stokes(raw, format_)
    peak = half[0] + np.maximum(np.abs(half[1]), np.abs(half[2]))
    s0, s1, s2 = (_per_superpixel(channel, camera) * np.float32(2 / white) for channel in half)
    lit = _largest_per_superpixel(peak, camera) < SATURATED * white
    return Stokes(s0, s1, s2, lit & (s0 >= DARK))


def decode_polarization(raw: Raw, camera: CameraInfo) -> Polarization:
    """Degree and angle of polarization of a frame in any format, as far as it holds them.

    Of the camera's own DoLP and AoLP, a colour camera has four in a super-pixel: their vectors are averaged,
    or the numbers where only one of the two was sent. That weighs the colours alike, whatever their
    brightness, unlike the DoLP of a raw mosaic.

    Raises:
        ToolkitError: the frame does not fit the camera's description.
    """
    format_ = _ON_CAMERA.get(camera.pixel_format)
    if format_ is None or format_.content in ("angles", "stokes"):
        stokes = decode_frame(raw, camera)
        return Polarization(stokes.dolp, stokes.aolp)
    dolp = aolp = None
    if format_.content != "aolp":
        dolp = _channel(raw, format_, 0) / np.float32(white_level(format_.bits))
    if format_.content != "dolp":
        aolp = _channel(raw, format_, format_.channels - 1) / _AOLP_COUNTS_PER_RADIAN[format_.bits]
    if aolp is None:
        return Polarization(None if dolp is None else _per_superpixel(dolp, camera), None)
    length = np.ones_like(aolp) if dolp is None else dolp
    along = _per_superpixel(length * np.cos(2 * aolp), camera)
    across = _per_superpixel(length * np.sin(2 * aolp), camera)
    mean = Stokes(np.ones_like(along), along, across, np.ones(along.shape, bool))
    return Polarization(None if dolp is None else mean.dolp, mean.aolp)


def as_mosaic(raw: Raw, camera: CameraInfo) -> Raw:
    """The raw mosaic (H, W) behind a frame: itself, or what ideal polarizers make of its Stokes channels.

    Raises:
        ToolkitError: the format holds no intensity.
    """
    format_ = _ON_CAMERA.get(camera.pixel_format)
    if format_ is None or format_.content == "angles":
        return raw
    if format_.content != "stokes":
        raise ToolkitError(
            f"{camera.pixel_format} holds no intensity, so nothing can be seen in it; "
            f"record {format_.raw_name}"
        )
    s0, s1, s2 = _signed_stokes(raw, format_)
    mosaic = np.empty_like(raw)
    for value, (row, column) in zip((s0 + s1, s0 + s2, s0 - s1, s0 - s2), _ANGLE_SITES, strict=True):
        mosaic[row::2, column::2] = np.clip(value, 0, white_level(format_.bits)).astype(raw.dtype)
    return mosaic


def compute_on_camera(mosaic: Raw, format_: PixelFormat) -> Raw:
    """What a camera sends in `format_` when its sensor sees `mosaic`, (H, W) of `format_.bits`.

    Returns:
        (H, W) frame as `pixel_formats.unpack` gives it; the mosaic itself where the format is one.
    """
    if not format_.channels:
        return mosaic
    i0, i45, i90, i135 = split_angles(mosaic).astype(np.float32)
    stokes = Stokes(0.5 * (i0 + i45 + i90 + i135), i0 - i90, i45 - i135, np.ones(i0.shape, bool))
    white = white_level(format_.bits)
    # Rounded down: half of 255 must not become 128, which would be negative.
    halves = [np.floor(channel / 2) for channel in stokes.stack()]
    channels: list[NDArray[np.float32]] = {
        "angles": [i0, i45, i90, i135],
        "stokes": [*halves, np.zeros_like(i0)][: format_.channels],
        "dolp": [np.rint(stokes.dolp * white)],
        "aolp": [np.floor(stokes.aolp * _AOLP_COUNTS_PER_RADIAN[format_.bits])],
        "dolp_aolp": [
            np.rint(stokes.dolp * white),
            np.floor(stokes.aolp * _AOLP_COUNTS_PER_RADIAN[format_.bits]),
        ],
    }[format_.content]
    frame: Raw = np.zeros(mosaic.shape, format_.dtype)
    for values, (row, column) in zip(channels, format_.places, strict=True):
        frame[row::2, column::2] = (values.astype(np.int32) & white).astype(format_.dtype)
    return frame


_ANGLE_SITES = _ON_CAMERA["PolarizedAngles_0d_45d_90d_135d_Mono8"].places


def _channel(raw: Raw, format_: PixelFormat, channel: int) -> Image:
    """(H/2, W/2) float32 counts of one channel."""
    row, column = format_.places[channel]
    return raw[row::2, column::2].astype(np.float32)


def _signed_stokes(raw: Raw, format_: PixelFormat) -> Image:
    """(3, H/2, W/2): half of S0, S1 and S2 in counts."""
    turn = np.float32(1 << format_.bits)
    s0, s1, s2 = (_channel(raw, format_, channel) for channel in range(3))
    return np.stack([s0, *(np.where(s >= turn / 2, s - turn, s) for s in (s1, s2))])


def _blocks(channel: Image, camera: CameraInfo) -> Image:
    """(h, 1 or 2, w, 1 or 2): the Bayer pixels of each super-pixel."""
    height, width = camera.working_size
    if channel.shape != (camera.height // 2, camera.width // 2):
        raise ToolkitError(
            f"a frame of {camera.pixel_format} must have {camera.height}x{camera.width} pixels, this one's "
            f"channels have {channel.shape[0]}x{channel.shape[1]}"
        )
    return channel.reshape(height, channel.shape[0] // height, width, channel.shape[1] // width)


def _per_superpixel(channel: Image, camera: CameraInfo) -> Image:
    mean: Image = _blocks(channel, camera).mean(axis=(1, 3), dtype=np.float32)
    return mean


def _largest_per_superpixel(channel: Image, camera: CameraInfo) -> Image:
    largest: Image = _blocks(channel, camera).max(axis=(1, 3))
    return largest
