"""What the toolkit asks of a camera.

A camera hands over raw mosaics with measured times. It runs free, or it waits for `trigger()` and then gives
one frame. Frame ids only grow while an acquisition runs, so that a gap is a lost frame and nothing is lost
in silence.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass
from types import TracebackType
from typing import TYPE_CHECKING, Literal, get_args

from dataset.errors import ToolkitError
from dataset.frames import CameraInfo, RawFrame
from dataset.pixel_formats import pixel_format

if TYPE_CHECKING:
    from typing_extensions import Self

Trigger = Literal["free", "software"]


@dataclass(frozen=True)
class CameraConfig:
    """How to reach a camera and how it shall expose.

    Attributes:
        address: IP address or host name of the camera.
        pixel_format: PFNC name, such as "BayerRG8" or "BayerRG12p".
        exposure_us: exposure time, microseconds.
        gain_db: analogue gain, decibels.
        frame_rate: frames per second while it runs free; None leaves the camera's own.
        trigger: "free" or "software".
        packet_size: bytes of a stream packet, headers included; None negotiates it.
        timeout_s: the longest wait for one frame, seconds.

    Raises:
        ToolkitError: a value that no camera can take.
    """

    address: str
    pixel_format: str = "BayerRG8"
    exposure_us: float = 10_000.0
    gain_db: float = 0.0
    frame_rate: float | None = None
    trigger: Trigger = "free"
    packet_size: int | None = None
    timeout_s: float = 2.0

    def __post_init__(self) -> None:
        pixel_format(self.pixel_format)
        if self.trigger not in get_args(Trigger):
            raise ToolkitError(f"camera: trigger '{self.trigger}' is unknown; use 'free' or 'software'")
        if self.packet_size is not None and not 576 <= self.packet_size <= 16260:
            raise ToolkitError(
                f"camera: packet_size {self.packet_size} is impossible; use 1500, or 9000 with jumbo frames"
            )
        for name in ("exposure_us", "frame_rate", "timeout_s"):
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

        Raises DeviceError, saying what to check, when no whole frame arrives in time.
        """

    @abstractmethod
    def stop(self) -> None:
        """Stops the acquisition. Idempotent."""

    @abstractmethod
    def close(self) -> None:
        """Stops, and lets go of the camera. Idempotent."""
