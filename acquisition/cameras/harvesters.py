"""The driver for any camera with a GenTL producer (a .cti file from its maker), on harvesters.

Frames are fetched raw and unpacked by the toolkit, so that formats which harvesters does not know are read
too. A producer need not stamp frames; then the time is that of their arrival at this computer, and
`CameraInfo.clock` says so.
"""

from __future__ import annotations

import contextlib
import os
import threading
from collections.abc import Callable
from pathlib import Path
from typing import Any

from acquisition.camera import CameraConfig, CameraLost
from acquisition.cameras import settings
from acquisition.cameras.clock_epochs import ClockEpochs
from acquisition.cameras.frame_ids import FrameIds
from acquisition.cameras.frame_queue import FrameQueue
from acquisition.cameras.gentl import GenTLFeatures, GenTLGrabber, load_gentl
from acquisition.cameras.queued_camera import QueuedCamera
from dataset.errors import DeviceError
from dataset.frames import CameraInfo

PRODUCERS_VARIABLE = "GENICAM_GENTL64_PATH"
"""Where GenTL producers are by the standard: folders, separated by colons."""

_PRIVILEGE, _NOBODYS = "GevCCP", "OpenAccess"  # who controls a GigE Vision camera; one that restarted: nobody
_BUFFERS = 12
_OPEN_TIMEOUT_S = 20.0
_CLOSE_TIMEOUT_S = 20.0


class HarvestersCamera(QueuedCamera):
    """A camera behind a GenTL producer."""

    def __init__(self, config: CameraConfig) -> None:
        """Opens and configures the camera, and looks at one frame to learn whether it is stamped.

        Raises DeviceError when there is no producer, none lists the camera, another program has it, it does
        not take a setting, or sends no frame; when harvesters is not installed, the error says how to.
        """
        self._gentl = load_gentl()
        self._harvester: Any = None
        self._acquirer: Any = None
        self._grabber: GenTLGrabber | None = None
        name = f"the camera '{config.address}'"
        self._nodes = GenTLFeatures(name, self._gentl)
        super().__init__(config, name, self._nodes)

    def _release(self) -> None:
        self._nodes.detach()
        acquirer, self._acquirer = self._acquirer, None
        harvester, self._harvester = self._harvester, None

        def let_go() -> None:
            with contextlib.suppress(*self._gentl.error):
                if acquirer is not None:
                    acquirer.destroy()
            with contextlib.suppress(*self._gentl.error):
                if harvester is not None:
                    harvester.reset()

        # A producer may wait for seconds for a camera that is gone, with Python's lock kept by genicam: to go
        # on in between would win nothing, and until it is done nobody can open the camera again.
        thread = threading.Thread(target=let_go, name="let-go-of-camera", daemon=True)
        thread.start()
        thread.join(_CLOSE_TIMEOUT_S)

    def _open(self) -> None:
        self._acquirer = self._connect(_producers(self._config.producer))
        self._nodes.attach(self._acquirer.remote_device.node_map)
        self._acquirer.num_buffers = max(_BUFFERS, self._acquirer.min_num_buffers)
        self._info = self._describe(self._configure())

    def _connect(self, producers: list[str]) -> Any:
        """Finds the camera in the producers' lists and opens it."""
        gentl, address = self._gentl, self._config.address
        self._harvester = gentl.harvester()
        for producer in producers:
            self._harvester.add_file(producer)
        try:
            self._harvester.update()
            listed = [(info, gentl.names_of(info)) for info in self._harvester.device_info_list]
            found = [info for info, names in listed if address in names.values()]
            if len(found) != 1:
                known = "; ".join(", ".join(f"{k} {v}" for k, v in names.items()) for _, names in listed)
                raise DeviceError(
                    f"{len(found)} cameras are called '{address}'; correct address in the rig file: "
                    f"{', '.join(producers)} lists {known or 'none: check cable and power, and close others'}"
                )
            # In the main thread harvesters would take over Ctrl-C.
            return _in_thread(lambda: self._harvester.create(found[0]), _OPEN_TIMEOUT_S, self._name)
        except gentl.error as error:
            raise DeviceError(
                f"{self._name} could not be opened ({error}); close other programs that use it, check the "
                "cable, then try again"
            ) from error

    def _describe(self, image: settings.ImageSettings) -> CameraInfo:
        features = self._features
        names = self._gentl.names_of(self._acquirer.device)
        return CameraInfo(
            vendor=features.read("DeviceVendorName", str, names.get("vendor", "")),
            model=features.read("DeviceModelName", str, names.get("model", "")),
            serial=features.read("DeviceSerialNumber", str, names.get("serial_number", "")),
            firmware=features.read("DeviceFirmwareVersion", str, features.read("DeviceVersion", str, "")),
            pixel_format=image.format.name,
            mosaic="colour" if image.format.colour else "mono",
            width=image.width,
            height=image.height,
            bits=image.format.bits,
            packet_size=features.read("GevSCPSPacketSize", int, 0),
            clock="camera" if self._stamps_frames(image) else "host",
        )

    def _stamps_frames(self, image: settings.ImageSettings) -> bool:
        """Whether the producer tells when the camera exposed: only a frame shows it."""
        settings.set_trigger(self._features, "free", self._config.trigger_line)
        frames = FrameQueue()
        grabber = GenTLGrabber(self._gentl, self._acquirer, image, frames, FrameIds(), ClockEpochs())
        grabber.start()
        try:
            frame = frames.take(self._config.timeout_s)
        finally:
            grabber.stop()
            self._stop_acquirer()
        if frame is None:
            raise DeviceError(
                f"{self._name} sends no frames: not one whole frame within {self._config.timeout_s:g} s; "
                "check the cable, and the packet size in the maker's software"
            )
        return grabber.stamped

    def _begin(self, image: settings.ImageSettings) -> None:
        grabber = GenTLGrabber(self._gentl, self._acquirer, image, self._frames, self._ids, self._epochs)
        grabber.start()
        self._grabber = grabber

    def _end(self) -> None:
        grabber, self._grabber = self._grabber, None
        assert grabber is not None
        grabber.stop()
        if not self._lost:
            self._stop_acquirer()

    def _stop_acquirer(self) -> None:
        # A camera that vanished this moment refuses; there is nothing to stop then.
        with contextlib.suppress(*self._gentl.error):
            self._acquirer.stop()

    def _count_underruns(self) -> int:
        return self._grabber.underruns if self._grabber is not None else 0

    def _check_presence(self) -> None:
        nodes = self._nodes
        try:
            nodes.reread("Width")
            privilege = nodes.reread(_PRIVILEGE) if nodes.has(_PRIVILEGE) else ""
        except DeviceError as error:
            raise CameraLost(
                f"{self._name} stopped answering; check its power and cable, then open it again ({error})"
            ) from error
        if privilege == _NOBODYS:
            raise CameraLost(
                f"{self._name} was restarted, or lost sight of this computer for seconds; open it again"
            )

    def _explain_silence(self) -> str:
        statistics = self.statistics
        return (
            f" ({statistics.incomplete} incomplete, {statistics.underruns} without a buffer); check the "
            "cable and the frame rate, and that a trigger came if it waits for one"
        )


def _producers(configured: str | None) -> list[str]:
    """Paths of the GenTL producers to ask."""
    if configured is not None:
        if not Path(configured).is_file():
            raise DeviceError(f"there is no GenTL producer {configured}; correct producer under [camera]")
        return [configured]
    folders = [Path(part) for part in os.environ.get(PRODUCERS_VARIABLE, "").split(":") if part]
    found = sorted(str(path) for folder in folders for path in folder.glob("*.cti"))
    if not found:
        raise DeviceError(
            f"no GenTL producer: {PRODUCERS_VARIABLE} names no folder with a .cti file; install the camera "
            "maker's software, or give its .cti as producer under [camera]"
        )
    return found


def _in_thread(call: Callable[[], Any], timeout_s: float, name: str) -> Any:
    """The call's result, made in another thread. Raises what it raises."""
    results: list[Any] = []
    errors: list[BaseException] = []

    def run() -> None:
        try:
            results.append(call())
        except BaseException as error:  # raised by the caller's thread
            errors.append(error)

    thread = threading.Thread(target=run, name="open-camera", daemon=True)
    thread.start()
    thread.join(timeout_s)
    if errors:
        raise errors[0]
    if not results:
        raise DeviceError(f"{name} could not be opened within {timeout_s:g} s; restart it, then try again")
    return results[0]
