"""The GigE Vision driver, on Aravis.

The camera is opened by its address, never by discovery: on a computer with several networks discovery may
pick the wrong one, and then not a single packet arrives. The whole sensor is read, all automatic functions
are off.
"""

from __future__ import annotations

import contextlib
import threading
import time
from collections.abc import Iterator
from typing import Any

from acquisition.aravis_library import load_aravis
from acquisition.camera import Camera, CameraConfig, CameraLost, CameraStatistics, Trigger
from acquisition.cameras import settings
from acquisition.cameras.aravis_features import AravisFeatures
from acquisition.cameras.aravis_stream import FrameGrabber
from acquisition.cameras.clock_epochs import ClockEpochs
from acquisition.cameras.frame_ids import FrameIds
from acquisition.cameras.frame_queue import FrameQueue
from acquisition.cameras.gvcp import path_mtu, probe, wait_for_control
from dataset.errors import DeviceError
from dataset.frames import CameraInfo, RawFrame

_PATIENCE_S = 0.5
"""Silence after which the camera is asked whether it is still there."""

_RETRY_S = 0.5


class AravisCamera(Camera):
    """A GigE Vision camera with a Polarsens sensor."""

    def __init__(self, config: CameraConfig) -> None:
        """Opens and configures the camera.

        Raises DeviceError within 5 s when no camera answers or another client controls it, and when it does
        not take a setting; when Aravis is not installed, the error names the packages.
        """
        self._config = config
        self._aravis, self._error = load_aravis()
        self._camera: Any = None
        self._features = AravisFeatures(self._name, self._error)
        self._grabber: FrameGrabber | None = None
        self._trigger: Trigger = config.trigger
        self._frames = FrameQueue()
        self._ids = FrameIds()
        self._epochs = ClockEpochs()
        self._underruns = 0
        self._lost = False
        self._open()

    @property
    def info(self) -> CameraInfo:
        """See `Camera.info`."""
        return self._info

    @property
    def statistics(self) -> CameraStatistics:
        """See `Camera.statistics`."""
        running = self._grabber.counted("n_underruns") if self._grabber is not None else 0
        return self._frames.statistics(self._underruns + running)

    def start(self, trigger: Trigger | None = None) -> None:
        """See `Camera.start`."""
        if self._grabber is not None:
            raise DeviceError(f"{self._name} is already started; stop it first")
        self._frames, self._ids, self._underruns = FrameQueue(), FrameIds(), 0
        self._trigger = trigger or self._config.trigger
        self._go()

    def trigger(self) -> None:
        """See `Camera.trigger`."""
        self._started()
        if self._trigger != "software":
            raise DeviceError(
                f"{self._name} does not wait for software triggers; start it with trigger 'software'"
            )
        self._frames.discard_until(time.monotonic_ns())
        self._features.execute("TriggerSoftware")

    def read(self, timeout_s: float | None = None) -> RawFrame:
        """See `Camera.read`; a camera that is gone is noticed within 2 s."""
        grabber = self._started()
        timeout_s = self._config.timeout_s if timeout_s is None else timeout_s
        deadline = time.monotonic() + timeout_s
        while True:
            remaining_s = deadline - time.monotonic()
            frame = self._frames.take(min(max(0.0, remaining_s), _PATIENCE_S))
            if frame is not None:
                self._lost = False
                return frame
            self._check_presence()
            if remaining_s <= _PATIENCE_S:
                raise self._explain_silence(grabber, timeout_s)

    def stop(self) -> None:
        """See `Camera.stop`."""
        if self._grabber is None:
            return
        grabber, self._grabber = self._grabber, None
        # Each word to a camera that is gone costs seconds; what remains then is to let go of our side.
        if not self._lost:
            with contextlib.suppress(self._error):
                self._camera.stop_acquisition()
        self._underruns += grabber.counted("n_underruns")
        self._let_go([grabber.stop()])

    def close(self) -> None:
        """See `Camera.close`. Aravis goes on for about 8 s to tell a camera that is gone: in a thread."""
        self.stop()
        objects = [self._camera, self._features.detach()]
        self._camera = None
        self._let_go(objects)

    def reconnect(self, timeout_s: float = 15.0) -> None:
        """See `Camera.reconnect`."""
        started, before = self._grabber is not None, self._info
        self.close()
        self._lost = False
        deadline = time.monotonic() + timeout_s
        while True:
            try:
                self._open()
                break
            except DeviceError:
                if time.monotonic() > deadline:
                    raise
                time.sleep(_RETRY_S)
        if (self._info.model, self._info.serial) != (before.model, before.serial):
            self.close()
            raise DeviceError(
                f"{self._name} is {self._info.model} {self._info.serial} now and was {before.model} "
                f"{before.serial}; give each camera an address of its own"
            )
        self._ids.resume()
        self._epochs.restart()
        if started:
            self._go()

    @property
    def _name(self) -> str:
        return f"the camera at {self._config.address}"

    def _open(self) -> None:
        config = self._config
        presence = wait_for_control(config.address)
        with self._explain("could not be opened", "check the cable and try again"):
            self._camera = self._aravis.Camera.new(presence.ip)
        try:
            self._claim()
            self._features.attach(self._camera.get_device())
            with self._explain("could not be stopped", "check the cable and try again"):
                self._camera.stop_acquisition()  # a client that died may have left it running
            image = settings.configure(self._features, config)
            if config.ptp:
                settings.synchronize(self._features, config.ptp_timeout_s)
            self._info = self._describe(image, self._set_packet_size(presence.ip))
        except BaseException:
            self.close()
            raise

    def _claim(self) -> None:
        device = self._camera.get_device()
        if not device.is_controller():
            raise DeviceError(f"another program controls {self._name}; close it, then try again")
        # Both are off by default, and then nonsense reaches the camera's registers.
        device.set_range_check_policy(self._aravis.RangeCheckPolicy.ENABLE)
        device.set_access_check_policy(self._aravis.AccessCheckPolicy.ENABLE)

    def _describe(self, image: settings.ImageSettings, packet_size: int) -> CameraInfo:
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

    def _go(self) -> None:
        """Starts the acquisition with the queue, ids and clock there are."""
        features, config = self._features, self._config
        settings.set_trigger(features, self._trigger, config.trigger_line)
        if self._trigger == "free":
            settings.set_frame_rate(features, config.frame_rate)
        image = settings.image_settings(features, config)
        with self._explain("could not be started", "check the cable and try again"):
            stream = self._camera.create_stream(None, None)
            # Without the right to raw sockets Aravis reads UDP, for which the usual buffer is too small.
            stream.set_property("socket-buffer", self._aravis.GvStreamSocketBuffer.AUTO)
            grabber = FrameGrabber(self._aravis, stream, image, self._frames, self._ids, self._epochs)
            self._camera.start_acquisition()
        self._grabber = grabber
        grabber.start()

    def _started(self) -> FrameGrabber:
        if self._grabber is None:
            raise DeviceError(f"{self._name} is not started; call start() first")
        return self._grabber

    def _let_go(self, objects: list[Any]) -> None:
        """Drops the last references to Aravis' objects, which then say goodbye to the camera: in a thread of
        its own where nobody listens."""
        if self._lost:
            threading.Thread(target=objects.clear, name="let-go-of-camera", daemon=True).start()

    def _check_presence(self) -> None:
        """Raises CameraLost when the camera does not answer or is not ours any more."""
        try:
            presence = probe(self._config.address)
        except DeviceError as error:
            self._lost = True
            raise CameraLost(
                f"{self._name} stopped answering; check its power and cable, then open it again ({error})"
            ) from error
        if not presence.controlled or not self._camera.get_device().is_controller():
            self._lost = True
            raise CameraLost(
                f"{self._name} was restarted, or lost sight of this computer for seconds; open it again"
            )

    def _explain_silence(self, grabber: FrameGrabber, timeout_s: float) -> DeviceError:
        """Why no frame came from a camera that is there."""
        statistics = self.statistics
        start = f"no whole frame from {self._name} within {timeout_s:g} s"
        if statistics.incomplete:
            return DeviceError(
                f"{start}: {statistics.incomplete} frames came with packets missing; set packet_size to the "
                "MTU (ip link), raise net.core.rmem_max, or lower the frame rate"
            )
        if statistics.underruns:
            return DeviceError(
                f"{start}: {statistics.underruns} frames found no free buffer; read more often, or lower the "
                "frame rate"
            )
        if grabber.counted("n_received_packets") == 0:
            return DeviceError(
                f"{start}: not one packet of the stream arrived; check that the firewall lets UDP through, "
                "that the MTU (ip link) is at least packet_size, and that a trigger came if it waits for one"
            )
        return DeviceError(f"{start}; lengthen timeout_s, or trigger it once for each read")

    @contextlib.contextmanager
    def _explain(self, what: str, remedy: str) -> Iterator[None]:
        try:
            yield
        except self._error as error:
            reason = getattr(error, "message", str(error))
            raise DeviceError(f"{self._name} {what} ({reason}); {remedy}") from error
