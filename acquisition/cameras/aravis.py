"""The GigE Vision driver, on Aravis.

The camera is opened by its address, never by discovery: on a computer with several networks discovery may
pick the wrong one, and then not a single packet arrives. The whole sensor is read, all automatic functions
are off.
"""

from __future__ import annotations

import contextlib
import threading
from collections.abc import Iterator
from typing import Any

from acquisition.aravis_library import load_aravis
from acquisition.camera import CameraConfig, CameraLost
from acquisition.cameras.aravis_features import AravisFeatures
from acquisition.cameras.aravis_stream import FrameGrabber
from acquisition.cameras.gvcp import path_mtu, probe, wait_for_control
from acquisition.cameras.queued_camera import QueuedCamera
from acquisition.cameras.settings import ImageSettings
from dataset.errors import DeviceError
from dataset.frames import CameraInfo


class AravisCamera(QueuedCamera):
    """A GigE Vision camera with a Polarsens sensor."""

    def __init__(self, config: CameraConfig) -> None:
        """Opens and configures the camera.

        Raises DeviceError within 5 s when no camera answers or another client controls it, and when it does
        not take a setting; when Aravis is not installed, the error names the packages.
        """
        self._aravis, self._error = load_aravis()
        self._camera: Any = None
        self._grabber: FrameGrabber | None = None
        name = f"the camera at {config.address}"
        self._device_features = AravisFeatures(name, self._error)
        super().__init__(config, name, self._device_features)

    def _release(self) -> None:
        objects = [self._camera, self._device_features.detach()]
        self._camera = None
        self._let_go(objects)

    def _open(self) -> None:
        presence = wait_for_control(self._config.address)
        with self._explain("could not be opened", "check the cable and try again"):
            self._camera = self._aravis.Camera.new(presence.ip)
        self._claim()
        self._device_features.attach(self._camera.get_device())
        with self._explain("could not be stopped", "check the cable and try again"):
            self._camera.stop_acquisition()  # a client that died may have left it running
        image = self._configure()
        self._info = self._describe(image, self._set_packet_size(presence.ip))

    def _claim(self) -> None:
        device = self._camera.get_device()
        if not device.is_controller():
            raise DeviceError(f"another program controls {self._name}; close it, then try again")
        # Both are off by default, and then nonsense reaches the camera's registers.
        device.set_range_check_policy(self._aravis.RangeCheckPolicy.ENABLE)
        device.set_access_check_policy(self._aravis.AccessCheckPolicy.ENABLE)

    def _describe(self, image: ImageSettings, packet_size: int) -> CameraInfo:
        features = self._features
        firmware = "DeviceFirmwareVersion" if features.has("DeviceFirmwareVersion") else "DeviceVersion"
        with self._explain("did not say which it is", "check the cable and try again"):
            return CameraInfo(
                vendor=self._camera.get_vendor_name(),
                model=self._camera.get_model_name(),
                serial=self._camera.get_device_serial_number(),
                firmware=features.get(firmware, str),
                pixel_format=image.format.name,
                mosaic="colour" if image.format.colour else "mono",
                width=image.width,
                height=image.height,
                bits=image.format.bits,
                packet_size=packet_size,
            )

    def _set_packet_size(self, ip: str) -> int:
        """Sets the configured size, or the largest that test packets show to arrive."""
        config = self._config
        with self._explain("did not take the packet size", "set packet_size in the rig file"):
            if config.packet_size is not None:
                self._camera.gv_set_packet_size_adjustment(self._aravis.GvPacketSizeAdjustment.NEVER)
                self._camera.gv_set_packet_size(config.packet_size)
            elif self._features.has("GevSCPSFireTestPacket"):
                self._camera.gv_auto_packet_size()
            else:
                # A camera without test packets: no packet can be larger than the way to it lets through.
                mtu = path_mtu(ip) // 4 * 4
                self._camera.gv_set_packet_size(min(self._camera.gv_get_packet_size(), mtu))
            return int(self._camera.gv_get_packet_size())

    def _begin(self, image: ImageSettings) -> None:
        with self._explain("could not be started", "check the cable and try again"):
            stream = self._camera.create_stream(None, None)
            # Without the right to raw sockets Aravis reads UDP, for which the usual buffer is too small.
            stream.set_property("socket-buffer", self._aravis.GvStreamSocketBuffer.AUTO)
            grabber = FrameGrabber(self._aravis, stream, image, self._frames, self._ids, self._epochs)
            self._camera.start_acquisition()
        self._grabber = grabber
        grabber.start()

    def _end(self) -> None:
        # Each word to a camera that is gone costs seconds; what remains then is to let go of our side.
        if not self._lost:
            with contextlib.suppress(self._error):
                self._camera.stop_acquisition()
        grabber, self._grabber = self._grabber, None
        assert grabber is not None
        self._let_go([grabber.stop()])

    def _let_go(self, objects: list[Any]) -> None:
        """Drops the last references to Aravis' objects, which then say goodbye to the camera. Where nobody
        listens that takes about 8 s: in a thread, for which only the end of the whole process waits."""
        if self._lost:
            threading.Thread(target=objects.clear, name="let-go-of-camera", daemon=True).start()

    def _count_underruns(self) -> int:
        return self._grabber.counted("n_underruns") if self._grabber is not None else 0

    def _check_presence(self) -> None:
        try:
            presence = probe(self._config.address)
        except DeviceError as error:
            raise CameraLost(
                f"{self._name} stopped answering; check its power and cable, then open it again ({error})"
            ) from error
        if not presence.controlled or not self._camera.get_device().is_controller():
            raise CameraLost(
                f"{self._name} was restarted, or lost sight of this computer for seconds; open it again"
            )

    def _explain_silence(self) -> str:
        statistics = self.statistics
        if statistics.incomplete:
            return (
                f": {statistics.incomplete} frames came with packets missing; set packet_size to the MTU "
                "(ip link), raise net.core.rmem_max, or lower the frame rate"
            )
        if statistics.underruns:
            return (
                f": {statistics.underruns} frames found no free buffer; close other programs that keep this "
                "computer busy, or lower the frame rate"
            )
        if self._grabber is not None and self._grabber.counted("n_received_packets") == 0:
            return (
                ": not one packet of the stream arrived; check that the firewall lets UDP through, that the "
                "MTU (ip link) is at least packet_size, and that a trigger came if it waits for one"
            )
        if self._trigger == "free":
            return (
                ": its stream stopped although it answers; check the cable, the switch and the firewall, and "
                "that timeout_s is longer than the exposure"
            )
        return "; lengthen timeout_s, or trigger it once for each read"

    @contextlib.contextmanager
    def _explain(self, what: str, remedy: str) -> Iterator[None]:
        try:
            yield
        except self._error as error:
            reason = getattr(error, "message", str(error))
            raise DeviceError(f"{self._name} {what} ({reason}); {remedy}") from error
