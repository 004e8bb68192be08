"""What the console does, without a page: devices kept open, one recording at a time, coverage counted."""

from __future__ import annotations

import re
from contextlib import ExitStack
from pathlib import Path
from types import TracebackType
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from acquisition.console.feeds import ArmFeed, CameraFeed
from acquisition.console.recording import Kind, Recording
from acquisition.rig import Rig
from dataset.errors import DeviceError, SessionError, ToolkitError
from dataset.frames import RawFrame
from dataset.transforms import SE3
from dataset.view_sphere import OUTSIDE, ViewSphere

if TYPE_CHECKING:
    from typing_extensions import Self

VIEWS = ViewSphere(cell_deg=10.0)
"""The directions above the table from which the object can be seen."""

_NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9._-]*")
_LOOKING_AT_RAD = np.deg2rad(20.0)
"""Farther off the optical axis the object is not counted as seen (our choice: near the image's border)."""


class Station:
    """The devices of a rig and the recorder. A context manager; leaving it ends a recording properly.

    Args:
        rig: whose devices.
        out: folder for the recordings.

    Attributes:
        camera, arm: the devices, kept open.
        recording: the newest one; None before the first.
        coverage: (C,) tenths of a second recorded from within each cell of `VIEWS`.
    """

    def __init__(self, rig: Rig, out: Path) -> None:
        self.out = out
        self.recording: Recording | None = None
        self.coverage: NDArray[np.int64] = np.zeros(len(VIEWS), np.int64)
        self.camera = CameraFeed(rig)
        self.arm = ArmFeed(rig)
        self._T_tcp_cam = SE3.from_pose6(np.array(rig.frames.T_tcp_cam_guess))
        self._centre = np.array(rig.frames.object_centre_guess)
        self._stack = ExitStack()

    def __enter__(self) -> Self:
        self._stack.enter_context(self.arm)
        self._stack.enter_context(self.camera)
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        self.stop()
        self._stack.close()

    @property
    def busy(self) -> bool:
        """Whether a recording goes on."""
        return self.recording is not None and self.recording.live

    def record(self, name: str, kind: Kind = "sequence") -> None:
        """Begins to record into `out`/`name`.h5.

        Raises ToolkitError while another recording goes on, for a name that is no plain file name, where the
        file exists, or where a device is not there.
        """
        if self.busy:
            raise ToolkitError("a recording is running; stop it first")
        stem = name.removesuffix(".h5")
        if not _NAME.fullmatch(stem):
            raise ToolkitError(f"{name!r} is no file name; use letters, digits, '.', '-' and '_'")
        path = self.out / f"{stem}.h5"
        if path.exists():
            raise SessionError(f"{path} exists, and recordings are never overwritten; give another name")
        if self.arm.problem is not None:
            raise DeviceError(f"the arm is not ready: {self.arm.problem}")
        recording = Recording(path, kind, self.arm, self._see)
        self.camera.lend(lambda camera: recording.run(camera, self.camera.rig.to_toml()))
        self.coverage = np.zeros(len(VIEWS), np.int64)
        self.recording = recording

    def pause(self) -> None:
        """Interrupts the recording, or goes on with it. Harmless where there is none."""
        if self.recording is None:
            return
        if self.recording.state == "paused":
            self.recording.resume()
        else:
            self.recording.pause()

    def stop(self) -> None:
        """Ends the recording; the file is complete a moment later. Harmless where there is none."""
        if self.recording is not None:
            self.recording.stop()

    def configure(self, exposure_us: float, gain_db: float) -> None:
        """Sets exposure time and gain. Raises ToolkitError while recording, or where no camera takes them."""
        if self.busy:
            raise ToolkitError("exposure and gain are locked while recording; stop it first")
        self.camera.configure(exposure_us, gain_db)

    def T_base_cam(self) -> SE3 | None:
        """Roughly where the camera is now: the arm, and the rig file's guess of the camera on it."""
        sample = self.arm.latest
        return None if sample is None else sample.T_base_tcp @ self._T_tcp_cam

    def _see(self, frame: RawFrame) -> None:
        """Takes note of a frame during a recording, and of where it was seen from if it is stored."""
        self.camera.see(frame)
        if self.recording is None or self.recording.state != "recording":
            return
        pose = self.T_base_cam()
        if pose is not None:
            cell = viewing_cell(pose, self._centre)
            if cell != OUTSIDE:
                self.coverage[cell] += 1


def viewing_cell(T_base_cam: SE3, centre: NDArray[np.float64]) -> int:
    """The cell of `VIEWS` from which a camera sees a point (3,) of the base frame; OUTSIDE where it looks
    elsewhere."""
    to_camera = T_base_cam.translation - centre
    distance = np.linalg.norm(to_camera)
    if distance == 0 or -to_camera @ T_base_cam.rotation[:, 2] < distance * np.cos(_LOOKING_AT_RAD):
        return OUTSIDE
    return int(VIEWS.cells(to_camera))
