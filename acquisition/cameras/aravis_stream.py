"""From Aravis' stream to frames: a pool of buffers that we own, and a thread that empties it."""

from __future__ import annotations

import threading
import time
from collections import deque
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from acquisition.camera import CameraStatistics
from acquisition.cameras.frame_ids import FrameIds
from dataset.errors import ToolkitError
from dataset.frames import RawFrame
from dataset.pixel_formats import PixelFormat, unpack

_BUFFERS = 12  # received while the grab thread waits for its turn: half a second at full rate
_QUEUE = 16
_POLL_US = 100_000
_CLOCK_READINGS = 3


@dataclass(frozen=True)
class StreamSettings:
    """What every frame of an acquisition has in common."""

    format: PixelFormat
    height: int
    width: int
    payload: int
    exposure_us: float
    gain_db: float


class FrameGrabber:
    """Pops finished buffers in a thread of its own, unpacks the whole ones, and counts the others.

    A frame that nobody reads is dropped when `_QUEUE` newer ones wait; its id is missing in what is read.
    """

    def __init__(self, aravis: Any, stream: Any, settings: StreamSettings) -> None:
        """Hands its buffers to `stream`, an Aravis.Stream whose acquisition has not started."""
        self._success = aravis.BufferStatus.SUCCESS
        self._stream = stream
        self._settings = settings
        self._ids = FrameIds()
        self._memory: dict[Any, NDArray[np.uint8]] = {}
        for _ in range(_BUFFERS):
            memory = np.empty(settings.payload, np.uint8)
            buffer = aravis.Buffer.new(memory.size, memory.ctypes.data)
            self._memory[buffer] = memory
            stream.push_buffer(buffer)
        self._frames: deque[RawFrame] = deque()
        self._arrived = threading.Condition()
        self._not_before_ns = 0
        self._good = self._incomplete = self._discarded = 0
        self._failure: ToolkitError | None = None
        self._stopping = threading.Event()
        self._thread = threading.Thread(target=self._run, name="camera-grabber", daemon=True)

    def start(self) -> None:
        """Starts the thread."""
        self._thread.start()

    def stop(self) -> None:
        """Ends the thread and lets go of the stream."""
        self._stopping.set()
        self._thread.join()
        self._stream = None
        self._memory.clear()

    @property
    def statistics(self) -> CameraStatistics:
        """Counts since the start."""
        return CameraStatistics(
            self._good, self._incomplete, self._discarded, underruns=self._counted("n_underruns")
        )

    @property
    def received_packets(self) -> int:
        """Packets of the stream that reached this computer."""
        return self._counted("n_received_packets")

    def discard_until(self, host_time_ns: int) -> None:
        """Drops every frame, waiting or on its way, whose first packet came before a host time."""
        with self._arrived:
            self._discarded += len(self._frames)
            self._frames.clear()
            self._not_before_ns = host_time_ns

    def take(self, timeout_s: float) -> RawFrame | None:
        """The oldest frame; None when there is none in time. Raises what went wrong in the thread."""
        with self._arrived:
            self._arrived.wait_for(lambda: self._frames or self._failure, timeout_s)
            if self._failure is not None:
                raise self._failure
            return self._frames.popleft() if self._frames else None

    def _counted(self, name: str) -> int:
        return int(self._stream.get_info_uint64_by_name(name))

    def _run(self) -> None:
        while not self._stopping.is_set():
            buffer = self._stream.timeout_pop_buffer(_POLL_US)
            if buffer is None:
                continue
            try:
                frame = self._decode(buffer)
            except ToolkitError as error:
                with self._arrived:
                    self._failure = error
                    self._arrived.notify_all()
                return
            self._stream.push_buffer(buffer)
            self._hand_over(frame)

    def _decode(self, buffer: Any) -> RawFrame | None:
        """The buffer's frame, copied out of it; None for an incomplete one."""
        if buffer.get_status() != self._success:
            return None
        settings = self._settings
        size = settings.format.size(settings.height, settings.width)
        pixels = unpack(self._memory[buffer][:size], settings.format, settings.height, settings.width)
        # Aravis stamps the arrival of the first packet on the wall clock, which may be set at any time.
        wall_to_monotonic_ns = _wall_to_monotonic_ns()
        return RawFrame(
            pixels=pixels,
            pixel_format=settings.format.name,
            frame_id=self._ids.unwrap(int(buffer.get_frame_id())),
            camera_time_ns=int(buffer.get_timestamp()),
            host_time_ns=int(buffer.get_system_timestamp()) + wall_to_monotonic_ns,
            exposure_us=settings.exposure_us,
            gain_db=settings.gain_db,
            missing_packets=0,
        )

    def _hand_over(self, frame: RawFrame | None) -> None:
        with self._arrived:
            if frame is None:
                self._incomplete += 1
                return
            self._good += 1
            if frame.host_time_ns < self._not_before_ns:
                self._discarded += 1
                return
            if len(self._frames) == _QUEUE:
                self._frames.popleft()
                self._discarded += 1
            self._frames.append(frame)
            self._arrived.notify_all()


def _wall_to_monotonic_ns() -> int:
    """Host monotonic time minus wall time, by the quickest of a few readings: a thread may be interrupted
    between two."""
    readings = []
    for _ in range(_CLOCK_READINGS):
        before_ns, wall_ns, after_ns = time.monotonic_ns(), time.time_ns(), time.monotonic_ns()
        readings.append((after_ns - before_ns, (before_ns + after_ns) // 2 - wall_ns))
    return min(readings)[1]
