"""From Aravis' stream to frames: a pool of buffers that we own, and a thread that empties it."""

from __future__ import annotations

import threading
import time
from typing import Any

import numpy as np
from numpy.typing import NDArray

from acquisition.cameras.clock_epochs import ClockEpochs
from acquisition.cameras.frame_ids import FrameIds
from acquisition.cameras.frame_queue import FrameQueue
from acquisition.cameras.settings import ImageSettings
from dataset.errors import ToolkitError
from dataset.frames import RawFrame
from dataset.pixel_formats import unpack

_BUFFERS = 12  # received while the grab thread waits for its turn: half a second at full rate
_POLL_US = 100_000
_CLOCK_READINGS = 3


class FrameGrabber:
    """Pops finished buffers in a thread of its own, unpacks the whole ones, and counts the others.

    Aravis writes the packets straight into our buffers; a frame leaves them in the one copy that unpacks it.
    """

    def __init__(
        self,
        aravis: Any,
        stream: Any,
        settings: ImageSettings,
        frames: FrameQueue,
        ids: FrameIds,
        epochs: ClockEpochs,
    ) -> None:
        """Hands its buffers to `stream`, an Aravis.Stream whose acquisition has not started."""
        self._success = aravis.BufferStatus.SUCCESS
        self._stream = stream
        self._settings = settings
        self._frames = frames
        self._ids = ids
        self._epochs = epochs
        self._memory: dict[Any, NDArray[np.uint8]] = {}
        for _ in range(_BUFFERS):
            memory = np.empty(settings.payload, np.uint8)
            buffer = aravis.Buffer.new(memory.size, memory.ctypes.data)
            self._memory[buffer] = memory
            stream.push_buffer(buffer)
        self._stopping = threading.Event()
        self._thread = threading.Thread(target=self._run, name="camera-grabber", daemon=True)

    def start(self) -> None:
        """Starts the thread."""
        self._thread.start()

    def stop(self) -> tuple[Any, ...]:
        """Ends the thread; returns what the caller has to let go of: the buffers, and the stream that writes
        to them. A tuple is emptied from its end, so the stream goes first."""
        self._stopping.set()
        self._thread.join()
        self._stream.set_emit_signals(False)
        stream, self._stream = self._stream, None
        return (self._memory, stream)

    def counted(self, name: str) -> int:
        """One of the stream's own counters, such as "n_underruns"."""
        return int(self._stream.get_info_uint64_by_name(name))

    def _run(self) -> None:
        while not self._stopping.is_set():
            buffer = self._stream.timeout_pop_buffer(_POLL_US)
            if buffer is None:
                continue
            try:
                frame = self._decode(buffer)
            except ToolkitError as error:
                self._frames.fail(error)
                return
            self._stream.push_buffer(buffer)
            if frame is None:
                self._frames.count_incomplete()
            else:
                self._frames.put(frame)

    def _decode(self, buffer: Any) -> RawFrame | None:
        """The buffer's frame, copied out of it; None for an incomplete one."""
        if buffer.get_status() != self._success:
            return None
        settings = self._settings
        size = settings.format.size(settings.height, settings.width)
        pixels = unpack(self._memory[buffer][:size], settings.format, settings.height, settings.width)
        # Aravis stamps the arrival of the first packet on the wall clock, which may be set at any time.
        host_time_ns = int(buffer.get_system_timestamp()) + _wall_to_monotonic_ns()
        camera_time_ns = int(buffer.get_timestamp())
        return RawFrame(
            pixels=pixels,
            pixel_format=settings.format.name,
            frame_id=self._ids.unwrap(int(buffer.get_frame_id())),
            camera_time_ns=camera_time_ns,
            host_time_ns=host_time_ns,
            exposure_us=settings.exposure_us,
            gain_db=settings.gain_db,
            missing_packets=0,
            clock_epoch=self._epochs.of(camera_time_ns, host_time_ns),
        )


def _wall_to_monotonic_ns() -> int:
    """Host monotonic time minus wall time, by the quickest of a few readings: a thread may be interrupted
    between two."""
    readings = []
    for _ in range(_CLOCK_READINGS):
        before_ns, wall_ns, after_ns = time.monotonic_ns(), time.time_ns(), time.monotonic_ns()
        readings.append((after_ns - before_ns, (before_ns + after_ns) // 2 - wall_ns))
    return min(readings)[1]
