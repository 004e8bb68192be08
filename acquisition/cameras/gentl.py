"""The one place that loads harvesters and genicam: a GenTL camera's features, and its frames."""

from __future__ import annotations

import contextlib
import threading
import time
from collections.abc import Iterator
from typing import Any

import numpy as np

from acquisition.camera import CameraLost
from acquisition.cameras.clock_epochs import ClockEpochs
from acquisition.cameras.features import Features, Value
from acquisition.cameras.frame_ids import FrameIds
from acquisition.cameras.frame_queue import FrameQueue
from acquisition.cameras.settings import ImageSettings
from dataset.errors import DeviceError, ToolkitError
from dataset.frames import RawFrame
from dataset.pixel_formats import pixel_format, unpack

_POLL_S = 0.001
_AT_ONCE_S = 1e-6  # 0 would mean for ever
_NAMES = ("serial_number", "id_", "user_defined_name", "model", "vendor")


class Incomplete(Exception):
    """Ends a fetch that found a frame with gaps: harvesters would go on fetching for ever."""


class GenTLLibrary:
    """harvesters, and what its calls and those of genicam raise."""

    def __init__(self, core: Any, gentl: Any, genapi: Any) -> None:
        self.harvester = core.Harvester
        self.error: tuple[type[Exception], ...] = (gentl.GenericException, genapi.GenericException)
        self.timeout: type[Exception] = gentl.TimeoutException
        self.readable = (genapi.EAccessMode.RO, genapi.EAccessMode.RW)
        self.usable = (*self.readable, genapi.EAccessMode.WO)
        self._core = core

    def names_of(self, device: Any) -> dict[str, str]:
        """What a producer calls a device, by the kind of name; those it does not tell are left out."""
        names = {}
        for name in _NAMES:
            with contextlib.suppress(*self.error):
                if value := getattr(device, name):
                    names[name.rstrip("_")] = str(value)
        return names

    def on_incomplete(self, acquirer: Any) -> None:
        """Makes `fetch` raise Incomplete at a frame with gaps."""

        class Raise(self._core.Callback):  # type: ignore[name-defined]
            def emit(self, context: Any) -> None:
                raise Incomplete

        acquirer.add_callback(acquirer.Events.INCOMPLETE_BUFFER, Raise())


def load_gentl() -> GenTLLibrary:
    """Loads harvesters. Raises DeviceError saying how to install it."""
    try:
        from genicam import genapi, gentl
        from harvesters import core
    except ImportError as error:
        raise DeviceError(
            f"harvesters, which GenTL cameras need, is missing ({error}); install it with: "
            "pip install 's2p3[harvesters]'"
        ) from error
    return GenTLLibrary(core, gentl, genapi)


class GenTLFeatures(Features):
    """The features of the genicam node map that is attached."""

    def __init__(self, camera: str, library: GenTLLibrary) -> None:
        super().__init__(camera)
        self._library = library
        self._nodes: Any = None

    def attach(self, nodes: Any) -> None:
        """From now on speaks of this node map."""
        self._nodes = nodes

    def detach(self) -> None:
        """Lets the node map go."""
        self._nodes = None

    def has(self, feature: str) -> bool:
        """See `Features.has`."""
        with self._explain(feature, "look at"):
            if not self._nodes.has_node(feature):
                return False
            return self._nodes.get_node(feature).get_access_mode() in self._library.usable

    def get(self, feature: str, kind: type[Value]) -> Value:
        """See `Features.get`."""
        with self._explain(feature, "read"):
            return kind(self._nodes.get_node(feature).value)

    def set(self, feature: str, value: str | float | bool) -> None:
        """See `Features.set`."""
        with self._explain(feature, f"take {value} as"):
            self._nodes.get_node(feature).value = value

    def bounds(self, feature: str) -> tuple[float, float]:
        """See `Features.bounds`."""
        with self._explain(feature, "tell the bounds of"):
            node = self._nodes.get_node(feature)
            return node.min, node.max

    def choices(self, feature: str) -> tuple[str, ...]:
        """See `Features.choices`."""
        with self._explain(feature, "list the choices of"):
            entries = self._nodes.get_node(feature).entries
            return tuple(e.symbolic for e in entries if e.get_access_mode() in self._library.readable)

    def execute(self, command: str) -> None:
        """See `Features.execute`."""
        with self._explain(command, "execute"):
            self._nodes.get_node(command).execute()

    def reread(self, feature: str) -> str:
        """Its value as text, from the camera and not from memory."""
        with self._explain(feature, "read"):
            return str(self._nodes.get_node(feature).to_string(False, True))

    @contextlib.contextmanager
    def _explain(self, feature: str, verb: str) -> Iterator[None]:
        try:
            yield
        except self._library.error as error:
            reason = " ".join(str(error).split())
            raise DeviceError(
                f"{self.camera} did not {verb} {feature} ({reason}); check the cable and try again"
            ) from error


class GenTLGrabber:
    """Fetches raw buffers in a thread of its own and unpacks them; made with an acquirer that is stopped.

    Attributes:
        stamped: whether the producer stamped the latest frame with the camera's time.
    """

    def __init__(
        self,
        library: GenTLLibrary,
        acquirer: Any,
        settings: ImageSettings,
        frames: FrameQueue,
        ids: FrameIds,
        epochs: ClockEpochs,
    ) -> None:
        self.stamped = False
        self._library = library
        self._acquirer = acquirer
        self._settings = settings
        self._frames = frames
        self._ids = ids
        self._epochs = epochs
        self._stopping = threading.Event()
        self._thread = threading.Thread(target=self._run, name="camera-grabber", daemon=True)

    def start(self) -> None:
        """Starts the acquisition and the thread. Raises DeviceError when the camera refuses."""
        self._library.on_incomplete(self._acquirer)
        self._acquirer.timeout_period_on_update_event_data_call = 0
        try:
            self._acquirer.start()
        except self._library.error as error:
            raise DeviceError(f"the camera could not be started ({error}); open it again") from error
        self._thread.start()

    def stop(self) -> None:
        """Ends the thread; the acquirer is left to the caller."""
        self._stopping.set()
        self._thread.join()

    @property
    def underruns(self) -> int:
        """Frames that found no buffer; 0 where the producer does not count them."""
        with contextlib.suppress(*self._library.error, AttributeError):
            return int(self._acquirer.data_streams[0].num_underrun)
        return 0

    def _run(self) -> None:
        while not self._stopping.is_set():
            try:
                buffer = self._acquirer.fetch(timeout=_AT_ONCE_S, is_raw=True)
                arrived_ns = time.monotonic_ns()
                try:
                    frame = self._decode(buffer, arrived_ns)
                finally:
                    buffer.parent.queue_buffer(buffer)
            except self._library.timeout:
                # genicam waits with Python's lock held: nobody else could work. So the waiting is ours.
                time.sleep(_POLL_S)
                continue
            except Incomplete:
                self._frames.count_incomplete()
                continue
            except ToolkitError as error:
                self._frames.fail(error)
                return
            except self._library.error as error:
                reason = " ".join(str(error).split())
                self._frames.fail(
                    CameraLost(f"the GenTL producer gave up ({reason}); check the cable, then open it again")
                )
                return
            self._frames.put(frame)

    def _decode(self, buffer: Any, arrived_ns: int) -> RawFrame:
        """The buffer's frame, copied out of it."""
        settings = self._settings
        size = settings.format.size(settings.height, settings.width)
        if buffer.size_filled < size:
            raise DeviceError(
                f"a frame holds {buffer.size_filled} bytes, {settings.format.name} of "
                f"{settings.width}x{settings.height} needs {size}; open the camera again"
            )
        if buffer.pixel_format != settings.format.code:
            raise DeviceError(
                f"a frame came as {pixel_format(buffer.pixel_format).name}, not {settings.format.name}; "
                "open the camera again"
            )
        data = np.frombuffer(buffer.raw_buffer, np.uint8, count=size, offset=buffer.image_offset)
        camera_time_ns = self._camera_time_ns(buffer)
        self.stamped = camera_time_ns is not None
        if camera_time_ns is None:
            camera_time_ns = arrived_ns
        return RawFrame(
            pixels=unpack(data, settings.format, settings.height, settings.width),
            pixel_format=settings.format.name,
            frame_id=self._ids.unwrap(int(buffer.frame_id)),
            camera_time_ns=camera_time_ns,
            host_time_ns=arrived_ns,
            exposure_us=settings.exposure_us,
            gain_db=settings.gain_db,
            missing_packets=0,
            clock_epoch=self._epochs.of(camera_time_ns, arrived_ns),
        )

    def _camera_time_ns(self, buffer: Any) -> int | None:
        """When the camera says it exposed; None where the producer does not tell."""
        with contextlib.suppress(*self._library.error):
            return int(buffer.timestamp_ns) or None
        with contextlib.suppress(*self._library.error):
            ticks, per_second = int(buffer.timestamp), int(self._acquirer.device.timestamp_frequency)
            return ticks * 10**9 // per_second if ticks and per_second else None
        return None
