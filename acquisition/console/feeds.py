"""A device that is kept open whatever happens to it: opened, watched, closed and opened again."""

from __future__ import annotations

import threading
import time
from abc import ABC, abstractmethod
from collections import deque
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from types import TracebackType
from typing import TYPE_CHECKING

from acquisition.camera import Camera
from acquisition.console.clock_watch import ClockWatch
from acquisition.rig import Rig, open_camera, open_pose_source
from acquisition.robot import PoseSource
from dataset.errors import DeviceError, ToolkitError
from dataset.frames import CameraInfo, RawFrame, RobotSample

if TYPE_CHECKING:
    from typing_extensions import Self

_RETRY_S = 2.0
_ARM_PERIOD_S = 0.04
_RATE_FRAMES = 30
_SILENT_NS = 3_000_000_000


class Feed(ABC):
    """One device with a thread of its own. A context manager.

    Attributes:
        problem: why the device is not there, as one line; None while it is.
        clock: how its clock runs.
    """

    def __init__(self, name: str) -> None:
        self.problem: str | None = "connecting"
        self.clock = ClockWatch()
        self._closing = threading.Event()
        self._thread = threading.Thread(target=self._run, name=name)

    def __enter__(self) -> Self:
        self._thread.start()
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        self._closing.set()
        self._interrupt()
        self._thread.join()

    def _run(self) -> None:
        while not self._closing.is_set():
            self.clock.clear()
            try:
                self._use()
            except ToolkitError as error:
                self.problem = str(error)
                self._closing.wait(_RETRY_S)
            except Exception as error:  # a fault of ours: the page says so and goes on serving the device
                self.problem = f"{self._thread.name}: {type(error).__name__}: {error}"
                self._closing.wait(_RETRY_S)

    @abstractmethod
    def _interrupt(self) -> None:
        """Makes `_use` look soon whether it shall end."""

    @abstractmethod
    def _use(self) -> None:
        """Opens the device and serves it until the feed closes. Raises ToolkitError where it is lost."""


class CameraFeed(Feed):
    """The rig's camera, running free; lent to a recording and taken back.

    Args:
        rig: whose camera.

    Attributes:
        latest: the newest frame; None before the first.
        info: of the camera that was opened last.
        refused: why the last change of settings was not taken; None where it was.
    """

    def __init__(self, rig: Rig) -> None:
        super().__init__("camera")
        self.rig = rig
        self.latest: RawFrame | None = None
        self.info: CameraInfo | None = None
        self.refused: str | None = None
        self._good: Rig | None = None
        self._reopen = threading.Event()
        self._job: Callable[[Camera], None] | None = None
        self._wanted = threading.Event()
        self._arrivals: deque[tuple[int, int]] = deque(maxlen=_RATE_FRAMES)

    @property
    def rate(self) -> float:
        """Frames per second of late, lost ones included; 0 where none come."""
        arrivals = list(self._arrivals)
        if len(arrivals) < 2 or time.monotonic_ns() - arrivals[-1][1] > _SILENT_NS:
            return 0.0
        (first_id, first_ns), (last_id, last_ns) = arrivals[0], arrivals[-1]
        return (last_id - first_id) / max((last_ns - first_ns) * 1e-9, 1e-3)

    def configure(self, exposure_us: float, gain_db: float) -> None:
        """Opens the camera anew with another exposure time and gain; where it refuses them, with the old.

        Raises ToolkitError for values that no camera takes.
        """
        camera = replace(self.rig.camera, exposure_us=exposure_us, gain_db=gain_db)
        self.refused = None
        self.rig = replace(self.rig, camera=camera)
        self._reopen.set()
        self._interrupt()

    def lend(self, job: Callable[[Camera], None]) -> None:
        """Runs `job` in the camera's thread, with the camera opened and not started.

        Raises DeviceError where there is no camera at the moment.
        """
        if self.problem is not None:
            raise DeviceError(f"the camera is not ready: {self.problem}")
        self._job = job
        self._interrupt()

    def see(self, frame: RawFrame) -> None:
        """Takes note of a frame; whom the camera is lent to calls it."""
        before = self.latest
        if before is not None and frame.frame_id <= before.frame_id:
            if frame.frame_id == before.frame_id and frame.camera_time_ns == before.camera_time_ns:
                return
            self._arrivals.clear()  # started anew
        self.clock.add(frame.camera_time_ns, frame.host_time_ns)
        self._arrivals.append((frame.frame_id, frame.host_time_ns))
        self.latest = frame

    def _interrupt(self) -> None:
        self._wanted.set()

    def _use(self) -> None:
        self._reopen.clear()
        rig = self.rig
        try:
            with open_camera(rig) as camera:
                self.info, self.problem, self._good = camera.info, None, rig
                self._serve_while_it_answers(camera)
        except DeviceError as error:
            # Settings are refused when the camera is opened; what worked before still does.
            if self._good is None or self._good is rig:
                raise
            self.rig, self.refused = self._good, str(error)

    def _serve_while_it_answers(self, camera: Camera) -> None:
        try:
            self._serve(camera)
        except DeviceError as error:
            self.problem = str(error)  # now: to close a camera that has vanished takes seconds
            raise

    def _serve(self, camera: Camera) -> None:
        while not (self._closing.is_set() or self._reopen.is_set()):
            job, self._job = self._job, None
            if job is not None:
                job(camera)
                continue
            self._wanted.clear()
            if self._job is None and not (self._closing.is_set() or self._reopen.is_set()):
                self._preview(camera)

    def _preview(self, camera: Camera) -> None:
        camera.start("free")
        try:
            while not self._wanted.is_set():
                self.see(camera.read())
        finally:
            camera.stop()


class ArmFeed(Feed):
    """The rig's arm, read only; lent to a recording and taken back.

    Attributes:
        latest: the newest state; None before the first and while the arm is lost.
    """

    def __init__(self, rig: Rig) -> None:
        super().__init__("arm")
        self.latest: RobotSample | None = None
        self._rig = rig
        self._source: PoseSource | None = None
        self._lent = threading.Lock()

    @contextmanager
    def lent(self) -> Iterator[PoseSource]:
        """The arm, kept open for the length of the `with` block.

        Raises DeviceError where there is none at the moment.
        """
        with self._lent:
            if self._source is None:
                raise DeviceError(f"the arm is not ready: {self.problem}")
            yield self._source

    def _interrupt(self) -> None:
        """It looks often enough."""

    def _use(self) -> None:
        source = open_pose_source(self._rig)
        try:
            self._source, self.problem = source, None
            while not self._closing.wait(_ARM_PERIOD_S):
                sample = source.sample()
                self.clock.add(round(sample.robot_time_s * 1e9), sample.host_time_ns)
                self.latest = sample
        finally:
            self.latest = None
            with self._lent:
                self._source = None
            source.close()
