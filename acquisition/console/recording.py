"""One recording of the console: asked for by a button, run in the camera's thread, watched by the page."""

from __future__ import annotations

import threading
from collections.abc import Callable
from pathlib import Path
from typing import Literal

from acquisition.camera import Camera
from acquisition.console.feeds import ArmFeed
from acquisition.recorder import Progress, Recorder
from dataset.errors import DeviceError, ToolkitError
from dataset.frames import RawFrame
from dataset.session import SessionWriter

Kind = Literal["sequence", "intrinsics", "hand_eye"]
"""What can be recorded as a stream by hand."""

State = Literal["starting", "recording", "paused", "stopping", "complete", "failed"]


class Recording:
    """A session file that is about to grow, grows, or is done.

    Args:
        path: of the file.
        kind: of session.
        arm: that is lent to it.
        on_frame: called with the newest frame, ten times a second.

    Attributes:
        message: what went wrong or is doubtful; empty where nothing is.
    """

    def __init__(self, path: Path, kind: Kind, arm: ArmFeed, on_frame: Callable[[RawFrame], object]) -> None:
        self.path = path
        self.message = ""
        self._kind: Kind = kind
        self._arm = arm
        self._on_frame = on_frame
        self._recorder: Recorder | None = None
        self._stop = threading.Event()
        self._end: Literal["complete", "failed"] | None = None

    @property
    def state(self) -> State:
        """How far it is."""
        if self._end is not None:
            return self._end
        if self._stop.is_set():
            return "stopping"
        if self._recorder is None:
            return "starting"
        return "paused" if self._recorder.status.pausing else "recording"

    @property
    def live(self) -> bool:
        """Whether it goes on."""
        return self._end is None

    @property
    def stored(self) -> int:
        """Frames in the file."""
        return 0 if self._recorder is None else self._recorder.status.stored

    @property
    def dropped(self) -> int:
        """Frames in the file's ledger of drops."""
        return 0 if self._recorder is None else self._recorder.status.ledgered

    @property
    def seconds(self) -> float:
        """Recorded so far, without pauses."""
        return 0.0 if self._recorder is None else self._recorder.status.seconds

    def run(self, camera: Camera, rig_toml: str) -> None:
        """Records until `stop`, with a camera opened and not started.

        Raises DeviceError where a device was lost; that, and any other ToolkitError, is the `message`.
        """
        try:
            if not self._stop.is_set():
                self._record(camera, rig_toml)
            self._end = "complete"
        except ToolkitError as error:
            self.message, self._end = str(error), "failed"
            if isinstance(error, DeviceError):
                raise
        except BaseException:
            self._end = "failed"
            raise

    def pause(self) -> None:
        """Frames are no longer stored; the session declares the gap."""
        if self._recorder is not None:
            self._recorder.pause()

    def resume(self) -> None:
        """They are stored again."""
        if self._recorder is not None:
            self._recorder.resume()

    def stop(self) -> None:
        """Ends it; the file is complete a moment later. Idempotent."""
        self._stop.set()
        if self._recorder is not None:
            self._recorder.stop()

    def _record(self, camera: Camera, rig_toml: str) -> None:
        with (
            self._arm.lent() as arm,
            SessionWriter(self.path, self._kind, camera.info, rig_toml=rig_toml) as writer,
            Recorder(camera, arm, writer, on_progress=self._look) as recorder,
        ):
            self._recorder = recorder
            if self._stop.is_set():  # meanwhile
                recorder.stop()
            recorder.wait()
        self.message = "; ".join(recorder.progress.warnings)

    def _look(self, progress: Progress) -> None:
        del progress
        frame = None if self._recorder is None else self._recorder.latest
        if frame is not None:
            self._on_frame(frame)
