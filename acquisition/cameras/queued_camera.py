"""What every driver does alike: a thread grabs frames into a queue, from which they are read."""

from __future__ import annotations

import time
from abc import abstractmethod

from acquisition.camera import Camera, CameraConfig, CameraLost, CameraStatistics, Trigger
from acquisition.cameras import settings
from acquisition.cameras.clock_epochs import ClockEpochs
from acquisition.cameras.features import Features
from acquisition.cameras.frame_ids import FrameIds
from acquisition.cameras.frame_queue import FrameQueue
from dataset.errors import DeviceError
from dataset.frames import CameraInfo, RawFrame

_PATIENCE_S = 0.5
"""Silence after which the camera is asked whether it is still there."""

_RETRY_S = 0.5


class QueuedCamera(Camera):
    """A camera whose driver opens it in `_open` and starts it in `_begin`."""

    def __init__(self, config: CameraConfig, name: str, features: Features) -> None:
        """Opens the camera.

        Args:
            config: of the camera.
            name: what messages call it.
            features: of the camera, once it is open.
        """
        self._config = config
        self._name = name
        self._features: Features = features
        self._info: CameraInfo
        self._opened = self._running = self._lost = False
        self._trigger: Trigger = config.trigger
        self._frames = FrameQueue()
        self._ids = FrameIds()
        self._epochs = ClockEpochs()
        self._underruns = 0
        self._try_to_open()

    @property
    def info(self) -> CameraInfo:
        """See `Camera.info`."""
        return self._info

    @property
    def statistics(self) -> CameraStatistics:
        """See `Camera.statistics`; underruns are 0 where the producer does not count them."""
        running = self._count_underruns() if self._running else 0
        return self._frames.statistics(self._underruns + running)

    def start(self, trigger: Trigger | None = None) -> None:
        """See `Camera.start`."""
        if not self._opened:
            raise DeviceError(f"{self._name} is closed; open it again")
        if self._running:
            raise DeviceError(f"{self._name} is already started; stop it first")
        self._frames, self._ids, self._underruns = FrameQueue(), FrameIds(), 0
        self._trigger = trigger or self._config.trigger
        self._go()

    def trigger(self) -> None:
        """See `Camera.trigger`."""
        self._require_running()
        if self._trigger != "software":
            raise DeviceError(
                f"{self._name} does not wait for software triggers; start it with trigger 'software'"
            )
        self._frames.discard_until(time.monotonic_ns())
        self._features.execute("TriggerSoftware")

    def read(self, timeout_s: float | None = None) -> RawFrame:
        """See `Camera.read`; a camera that is gone is noticed within some seconds, whatever the time-out."""
        self._require_running()
        timeout_s = self._config.timeout_s if timeout_s is None else timeout_s
        deadline = time.monotonic() + timeout_s
        while True:
            remaining_s = max(0.0, deadline - time.monotonic())
            frame = self._frames.take(min(remaining_s, _PATIENCE_S))
            if frame is not None:
                self._lost = False
                return frame
            try:
                self._check_presence()
            except CameraLost:
                self._lost = True
                raise
            if remaining_s <= _PATIENCE_S:
                raise DeviceError(
                    f"no whole frame from {self._name} within {timeout_s:g} s{self._explain_silence()}"
                )

    def stop(self) -> None:
        """See `Camera.stop`."""
        if self._running:
            self._running = False
            self._underruns += self._count_underruns()
            self._end()

    def close(self) -> None:
        """See `Camera.close`."""
        self.stop()
        self._opened = False
        self._release()

    def reconnect(self, timeout_s: float = 15.0) -> None:
        """See `Camera.reconnect`."""
        running, before = self._running, self._info
        self.close()
        self._lost = False
        self._open_again(time.monotonic() + timeout_s)
        if (self._info.model, self._info.serial) != (before.model, before.serial):
            self.close()
            raise DeviceError(
                f"{self._name} is {self._info.model} {self._info.serial} now and was {before.model} "
                f"{before.serial}; give each camera an address of its own"
            )
        self._frames.recover()
        self._ids.resume()
        self._epochs.restart()
        if running:
            self._go()

    def _open_again(self, deadline: float) -> None:
        while True:
            try:
                self._try_to_open()
                return
            except DeviceError:
                if time.monotonic() > deadline:
                    raise
                time.sleep(_RETRY_S)

    def _try_to_open(self) -> None:
        try:
            self._open()
        except BaseException:
            self.close()
            raise
        self._opened = True

    def _go(self) -> None:
        """Starts the acquisition with the queue, ids and clock there are."""
        settings.set_trigger(self._features, self._trigger, self._config.trigger_line)
        if self._trigger == "free":
            settings.set_frame_rate(self._features, self._config.frame_rate)
        self._begin(settings.image_settings(self._features, self._config))
        self._running = True

    def _require_running(self) -> None:
        if not self._running:
            raise DeviceError(f"{self._name} is not started; call start() first")

    def _configure(self) -> settings.ImageSettings:
        """For `_open`: brings the camera into the state of its configuration."""
        image = settings.configure(self._features, self._config)
        if self._config.ptp:
            settings.synchronize(self._features, self._config.ptp_timeout_s)
        return image

    @abstractmethod
    def _open(self) -> None:
        """Connects, configures and describes the camera in `_info`; `_release` follows where it raises."""

    @abstractmethod
    def _release(self) -> None:
        """Lets go of whatever `_open` got hold of, however far it came. Idempotent."""

    @abstractmethod
    def _begin(self, image: settings.ImageSettings) -> None:
        """Starts the acquisition and the thread that puts its frames into `_frames`."""

    @abstractmethod
    def _end(self) -> None:
        """Ends both; says nothing to the camera where it is `_lost`."""

    @abstractmethod
    def _count_underruns(self) -> int:
        """Frames since `_begin` that found no buffer."""

    @abstractmethod
    def _check_presence(self) -> None:
        """Raises CameraLost when the camera does not answer, or is not ours any more."""

    @abstractmethod
    def _explain_silence(self) -> str:
        """Why no frame came from a camera that is there, and what to do: what follows in the message."""
