"""What the toolkit asks of a camera.

A camera hands over raw mosaics with measured times. It runs free, or each frame waits for `trigger()` or for
an edge on one of its lines. Frame ids only grow while an acquisition runs, so that a gap is a lost frame and
nothing is lost in silence.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass
from types import TracebackType
from typing import TYPE_CHECKING, Literal, get_args

from dataset.errors import DeviceError, ToolkitError
from dataset.frames import CameraInfo, RawFrame
from dataset.pixel_formats import pixel_format

if TYPE_CHECKING:
    from typing_extensions import Self

Trigger = Literal["free", "software", "line"]


class CameraLost(DeviceError):
    """The camera stopped answering, was restarted, or another program took it; see `Camera.reconnect`."""


@dataclass(frozen=True)
class CameraConfig:
    """How to reach a camera and how it shall expose.

    Attributes:
        address: which camera. Aravis: its IP address or host name. harvesters: its serial number, identifier,
            user-defined name or model, as the producer lists it.
        pixel_format: PFNC name, such as "BayerRG8" or "BayerRG12p".
        exposure_us: exposure time, microseconds.
        gain_db: analogue gain, decibels.
        frame_rate: frames per second while it runs free; None leaves the camera's own.
        trigger: "free", "software", or "line": a rising edge on `trigger_line` exposes a frame.
        trigger_line: GenICam name of the line.
        packet_size: bytes of a stream packet, headers included; None negotiates it. GigE Vision only.
        timeout_s: the longest wait for one frame, seconds.
        ptp: whether the camera's clock shall follow an IEEE 1588 master on the network.
        ptp_timeout_s: the longest wait for that, seconds.
        producer: path of a GenTL producer (.cti) for harvesters; None takes those in GENICAM_GENTL64_PATH.

    Raises:
        ToolkitError: a value that no camera can take.
    """

    address: str
    pixel_format: str = "BayerRG8"
    exposure_us: float = 10_000.0
    gain_db: float = 0.0
    frame_rate: float | None = None
    trigger: Trigger = "free"
    trigger_line: str = "Line0"
    packet_size: int | None = None
    timeout_s: float = 2.0
    ptp: bool = False
    ptp_timeout_s: float = 30.0
    producer: str | None = None

    def __post_init__(self) -> None:
        pixel_format(self.pixel_format)
        if self.trigger not in get_args(Trigger):
            known = ", ".join(repr(trigger) for trigger in get_args(Trigger))
            raise ToolkitError(f"camera: trigger '{self.trigger}' is unknown; use one of {known}")
        if self.packet_size is not None and not 576 <= self.packet_size <= 16260:
            raise ToolkitError(
                f"camera: packet_size {self.packet_size} is impossible; use 1500, or 9000 with jumbo frames"
            )
        for name in ("exposure_us", "frame_rate", "timeout_s", "ptp_timeout_s"):
            value = getattr(self, name)
            if value is not None and not value > 0:
                raise ToolkitError(f"camera: {name} is {value}; it must be positive")


@dataclass(frozen=True)
class CameraStatistics:
    """What became of the frames since `start`.

    Attributes:
        frames: handed over whole.
        incomplete: arrived with packets missing and were thrown away.
        discarded: arrived whole, but were not read in time.
        underruns: had no buffer to be received in.
    """

    frames: int = 0
    incomplete: int = 0
    discarded: int = 0
    underruns: int = 0


class Camera(ABC):
    """An opened camera; a context manager that stops and closes it."""

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        self.close()

    @property
    @abstractmethod
    def info(self) -> CameraInfo:
        """Which camera it is and how its pixels are laid out."""

    @property
    @abstractmethod
    def statistics(self) -> CameraStatistics:
        """Counts since the last `start`."""

    @abstractmethod
    def start(self, trigger: Trigger | None = None) -> None:
        """Starts the acquisition; `trigger` overrides the configuration. Frame ids and statistics restart.

        Raises DeviceError when the camera refuses or is already started.
        """

    @abstractmethod
    def trigger(self) -> None:
        """Asks for one frame; frames that were not read before are discarded. One trigger, one `read`.

        Raises DeviceError when the camera does not wait for software triggers or does not answer.
        """

    @abstractmethod
    def read(self, timeout_s: float | None = None) -> RawFrame:
        """The oldest frame not read yet; waits for it, `CameraConfig.timeout_s` unless told.

        Raises DeviceError, saying what to check, when no whole frame arrives in time, and CameraLost, without
        waiting for the time-out, when the camera is there no more.
        """

    @abstractmethod
    def stop(self) -> None:
        """Stops the acquisition. Idempotent."""

    @abstractmethod
    def close(self) -> None:
        """Stops, and lets go of the camera. Idempotent; a camera that is gone does not hold the caller up."""

    @abstractmethod
    def reconnect(self, timeout_s: float = 15.0) -> None:
        """Opens the same camera again, with the same settings, and goes on if it was started.

        Frame ids and statistics go on after those before: how many frames the camera would have exposed in
        between nobody knows. Its clock may have restarted, so `RawFrame.clock_epoch` is one more.

        Raises DeviceError when it does not answer in time, or another camera does in its place.
        """
