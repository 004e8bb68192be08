"""Which packet sizes really reach this computer: the self-test of a GigE Vision connection.

A packet that is larger than what some card or switch on the way lets through is lost without a word: the
camera answers, announces its frames, and not one arrives whole. So the test streams, size after size.
"""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass, replace

from acquisition.camera import CameraConfig, CameraLost
from acquisition.cameras.aravis import AravisCamera
from dataset.errors import DeviceError

SIZES = (9000, 4000, 1500)
"""Jumbo frames, what a few cards stop at, and plain Ethernet; headers included."""

_FRAMES = 5


@dataclass(frozen=True)
class PacketTrial:
    """What became of the frames at one packet size.

    Attributes:
        size: bytes of a packet, headers included.
        whole: frames that arrived complete.
        incomplete: frames of which packets were missing.
        refused: why the camera does not send packets of this size; empty when it does.
    """

    size: int
    whole: int
    incomplete: int
    refused: str = ""

    @property
    def delivers(self) -> bool:
        """Whether frames arrive, and hardly any with gaps."""
        return self.whole > self.incomplete


def try_packet_sizes(
    config: CameraConfig, sizes: Sequence[int] = SIZES, *, seconds: float = 1.0
) -> list[PacketTrial]:
    """Streams a few frames at each packet size.

    Args:
        config: of a camera that nobody has opened; its packet size and trigger are disregarded.
        sizes: to try, in this order.
        seconds: the longest wait at each.

    Raises:
        DeviceError: the camera does not answer, or takes no setting at all.
    """
    AravisCamera(replace(config, packet_size=None, trigger="free")).close()
    return [_try(config, size, seconds) for size in sizes]


def largest_delivered(trials: Sequence[PacketTrial]) -> int | None:
    """The largest size that delivers frames; None when none does."""
    return max((trial.size for trial in trials if trial.delivers), default=None)


def _try(config: CameraConfig, size: int, seconds: float) -> PacketTrial:
    try:
        camera = AravisCamera(replace(config, packet_size=size, trigger="free"))
    except CameraLost:
        raise
    except DeviceError as error:
        return PacketTrial(size, 0, 0, refused=str(error))
    with camera:
        camera.start("free")
        deadline = time.monotonic() + seconds
        try:
            for _ in range(_FRAMES):
                camera.read(max(0.05, deadline - time.monotonic()))
        except CameraLost:
            raise
        except DeviceError:
            pass  # the statistics say it
        statistics = camera.statistics
        return PacketTrial(size, statistics.frames, statistics.incomplete)
