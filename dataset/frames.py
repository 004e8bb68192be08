"""What devices hand over: frames, robot samples, and the clocks that relate them."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from dataset.transforms import SE3

Mosaic = Literal["mono", "colour"]

SUPERPIXEL: dict[Mosaic, int] = {"mono": 2, "colour": 4}
"""Side of the smallest block that holds every polarizer angle (and colour) once, pixels."""


@dataclass(frozen=True)
class CameraInfo:
    """Which camera, and how its pixels are laid out.

    Attributes:
        pixel_format: PFNC name on the wire, such as "BayerRG8".
        mosaic: "mono" (2x2 polarizer cell) or "colour" (4x4 polarizer and Bayer super-pixel).
        width, height: of the raw mosaic, pixels.
        bits: significant bits of a pixel value (12 for a 12-bit format held in uint16).
        packet_size: GigE Vision packet size, bytes; 0 where the transport has none.
        clock: whose clock the frames' `camera_time_ns` is on: "camera", or "host" where the camera stamps
            nothing and all there is to know is when a frame arrived.
    """

    vendor: str
    model: str
    serial: str
    firmware: str
    pixel_format: str
    mosaic: Mosaic
    width: int
    height: int
    bits: int
    packet_size: int
    clock: Literal["camera", "host"] = "camera"

    @property
    def working_size(self) -> tuple[int, int]:
        """(h, w) of the polarization image, one pixel per super-pixel."""
        size = SUPERPIXEL[self.mosaic]
        return self.height // size, self.width // size


@dataclass(frozen=True, eq=False)
class RawFrame:
    """One exposure as the camera sent it.

    Attributes:
        pixels: (H, W) uint8 or uint16, the raw mosaic; of a format that the camera computes, its channels in
            the cells of the mosaic, see `dataset.pixel_formats`.
        pixel_format: PFNC name.
        frame_id: the camera's counter, unwrapped: it only grows, and a gap is a lost frame.
        camera_time_ns: START of the exposure on the camera's own clock; `host_time_ns` where it has none, see
            `CameraInfo.clock`.
        host_time_ns: host monotonic clock when the first packet was seen.
        exposure_us: exposure time, microseconds; NaN where the camera does not tell.
        gain_db: analogue gain, decibels; NaN where the camera does not tell.
        missing_packets: packets that never arrived; 0 for a good frame.
        clock_epoch: how often the camera's clock was found to be set or restarted since the camera was
            opened; times of different epochs do not compare.
    """

    pixels: NDArray[np.uint8] | NDArray[np.uint16]
    pixel_format: str
    frame_id: int
    camera_time_ns: int
    host_time_ns: int
    exposure_us: float
    gain_db: float
    missing_packets: int
    clock_epoch: int = 0


@dataclass(frozen=True, eq=False)
class RobotSample:
    """One state of the arm.

    Attributes:
        host_time_ns: host monotonic clock when the sample was first seen.
        robot_time_s: seconds on the controller's own clock.
        q: (6,) joint angles, radians.
        T_base_tcp: pose of the active tool centre point in the base frame.
        safety_bits: the controller's safety status word.
    """

    host_time_ns: int
    robot_time_s: float
    q: NDArray[np.float64]
    T_base_tcp: SE3
    safety_bits: int


@dataclass(frozen=True, eq=False)
class RobotTrace:
    """Every sample of the arm during a recording, at the controller's rate, as arrays.

    Attributes:
        host_time_ns: (M,) int64, host monotonic clock.
        robot_time_s: (M,) float64, controller's clock, strictly increasing.
        q: (M, 6) float64 joint angles, radians.
        pose: (M, 6) float64 base<-tcp as [x y z rx ry rz], metres and rotation vector.
        safety_bits: (M,) uint32.
    """

    host_time_ns: NDArray[np.int64]
    robot_time_s: NDArray[np.float64]
    q: NDArray[np.float64]
    pose: NDArray[np.float64]
    safety_bits: NDArray[np.uint32]

    @property
    def poses(self) -> SE3:
        """T_base_tcp, a batch of M."""
        return SE3.from_pose6(self.pose)

    def __len__(self) -> int:
        return len(self.host_time_ns)


@dataclass(frozen=True)
class ClockFit:
    """A device's clock on the host's: `host_ns = a_ns + b * device_ns`.

    Attributes:
        a_ns: offset, nanoseconds.
        b: rate, host seconds per device second; close to 1.
        sigma_ns: standard deviation of the fit, nanoseconds.
    """

    a_ns: float
    b: float
    sigma_ns: float

    def to_host(self, device_ns: NDArray[np.int64] | int) -> NDArray[np.int64]:
        """Device times (...) in nanoseconds on the host clock, int64 nanoseconds.

        Device times may be epoch nanoseconds (1e18), which a float64 holds only to 256 ns: the product is
        formed from `b - 1` so that only the small correction is rounded.
        """
        device = np.asarray(device_ns, dtype=np.int64)
        correction = np.rint((self.b - 1.0) * device).astype(np.int64)
        return device + correction + np.int64(round(self.a_ns))
