"""Bringing a camera into the state of its configuration, and proving that it is there.

Every setting is read back: a camera that was left with an automatic exposure, a region or a mirrored image
gives frames that look right and are not.
"""

from __future__ import annotations

import time
from dataclasses import dataclass

from acquisition.camera import CameraConfig, Trigger
from acquisition.cameras.features import Features
from dataset.errors import DeviceError
from dataset.pixel_formats import PixelFormat, pixel_format

_SAVE = "set it so in the maker's software, save that as the power-on setting, then try again"

_LOCKED: tuple[tuple[str, str | int | bool], ...] = (
    ("ExposureAuto", "Off"),
    ("GainAuto", "Off"),
    ("BalanceWhiteAuto", "Off"),
    # Stokes parameters are sums and differences of intensities: the response must be linear ...
    ("GammaEnable", False),
    ("LUTEnable", False),
    # ... and every pixel behind the polarizer that the mosaic says.
    ("ReverseX", False),
    ("ReverseY", False),
    ("BinningHorizontal", 1),
    ("BinningVertical", 1),
    ("DecimationHorizontal", 1),
    ("DecimationVertical", 1),
    # Nothing but the pixels is in a buffer.
    ("ChunkModeActive", False),
    ("AcquisitionMode", "Continuous"),
)

_PTP_POLL_S = 0.1
_SYNCHRONIZED = "Slave"
_PTP_NAMES = (("PtpEnable", "PtpStatus"), ("GevIEEE1588", "GevIEEE1588Status"))


@dataclass(frozen=True)
class ImageSettings:
    """What every frame has in common.

    Attributes:
        format: of its pixels.
        height, width: of the frame on the sensor's grid, pixels.
        payload: bytes that a buffer must hold.
        exposure_us, gain_db: as the camera reads them back; NaN where it has no such feature.
    """

    format: PixelFormat
    height: int
    width: int
    payload: int
    exposure_us: float
    gain_db: float


def configure(features: Features, config: CameraConfig) -> ImageSettings:
    """Format, whole sensor, no automatic functions, exposure, gain, frame rate.

    Raises DeviceError when the camera does not take a setting, naming what it takes instead.
    """
    _set_format(features, config.pixel_format)
    for feature, value in _LOCKED:
        if features.has(feature):
            features.require(feature, value, _SAVE)
    _read_whole_sensor(features)
    # A frame rate left by another client would bound the exposure.
    if config.frame_rate is not None and features.has("AcquisitionFrameRateEnable"):
        features.set("AcquisitionFrameRateEnable", False)
    if features.has("ExposureTime"):
        # The camera exposes whole lines; 50 us are a few of them.
        features.require_near(
            "ExposureTime", config.exposure_us, 50 + 0.02 * config.exposure_us, "exposure_us"
        )
    if features.has("Gain"):
        features.require_near("Gain", config.gain_db, 0.2, "gain_db")
    set_frame_rate(features, config.frame_rate)
    return image_settings(features, config)


def image_settings(features: Features, config: CameraConfig) -> ImageSettings:
    """What the frames will be, as the camera says.

    Raises DeviceError when its payload does not fit its image, as the toolkit understands the format.
    """
    format_ = pixel_format(config.pixel_format)
    width, height = (format_.cell * features.get(side, int) for side in ("Width", "Height"))
    payload, expected = features.get("PayloadSize", int), format_.size(height, width)
    # The geometry of what cameras compute is not standardized: only the very size proves it.
    if payload < expected or (format_.channels and payload != expected):
        raise DeviceError(
            f"{features.camera} sends {payload} bytes a frame of {format_.name}, {expected} were expected "
            f"for {width}x{height} pixels of its sensor; set pixel_format to {format_.raw_name}"
        )
    return ImageSettings(
        format=format_,
        height=height,
        width=width,
        payload=payload,
        exposure_us=features.read("ExposureTime", float, float("nan")),
        gain_db=features.read("Gain", float, float("nan")),
    )


def set_frame_rate(features: Features, rate: float | None) -> None:
    """Sets the rate of free run; None leaves the camera's own. Raises DeviceError when it is refused."""
    if rate is None:
        return
    # Cameras keep the rate read-only until it is enabled.
    if features.has("AcquisitionFrameRateEnable"):
        features.require("AcquisitionFrameRateEnable", True, _SAVE)
    features.require_near("AcquisitionFrameRate", rate, 0.05 * rate, "frame_rate")


def set_trigger(features: Features, trigger: Trigger, line: str) -> None:
    """Makes each frame wait for its trigger, or for none.

    Raises DeviceError when the camera has no such trigger.
    """
    if not features.has("TriggerMode"):
        if trigger == "free":
            return
        raise DeviceError(f'{features.camera} cannot be triggered; set trigger = "free"')
    for selector in features.choices("TriggerSelector") if features.has("TriggerSelector") else ():
        features.set("TriggerSelector", selector)
        features.require("TriggerMode", "Off", _SAVE)
    if trigger == "free":
        return
    if features.has("TriggerSelector"):
        features.require("TriggerSelector", "FrameStart", _SAVE)
    source = line if trigger == "line" else "Software"
    offered = features.choices("TriggerSource")
    if source not in offered:
        raise DeviceError(
            f"{features.camera} has no trigger source {source}; it offers {', '.join(offered)}: correct "
            "trigger_line in the rig file"
        )
    features.require("TriggerMode", "On", _SAVE)
    features.require("TriggerSource", source, _SAVE)
    if trigger == "line" and features.has("TriggerActivation"):
        features.require("TriggerActivation", "RisingEdge", _SAVE)


def synchronize(features: Features, timeout_s: float) -> None:
    """Lets the camera's clock follow an IEEE 1588 master, and waits until it does.

    Raises DeviceError when the camera cannot, or finds no master in time.
    """
    for enable, status in _PTP_NAMES:
        if features.has(enable) and features.has(status):
            break
    else:
        raise DeviceError(f"{features.camera} has no IEEE 1588 clock; set ptp = false in the rig file")
    features.require(enable, True, _SAVE)
    deadline = time.monotonic() + timeout_s
    while (found := features.get(status, str)) != _SYNCHRONIZED:
        if time.monotonic() > deadline:
            raise DeviceError(
                f"{features.camera} found no master clock within {timeout_s:g} s ({status} is {found}); "
                "run one on this computer (ptp4l -i CARD -m), or set ptp = false in the rig file"
            )
        time.sleep(_PTP_POLL_S)


def _set_format(features: Features, name: str) -> None:
    offered = features.choices("PixelFormat")
    if name not in offered:
        known = ", ".join(offered)
        raise DeviceError(f"{features.camera} has no pixel format {name}; it offers {known}")
    features.require("PixelFormat", name, "stop whatever else uses the camera, then try again")


def _read_whole_sensor(features: Features) -> None:
    """A region left by another client would shift the mosaic against the calibration."""
    for offset, size in (("OffsetX", "Width"), ("OffsetY", "Height")):
        if features.has(offset):
            features.require(offset, 0, _SAVE)
        features.require(size, int(features.bounds(size)[1]), _SAVE)
