"""The GigE Vision driver, on Aravis.

The camera is opened by its address, never by discovery: on a computer with several networks discovery may
pick the wrong one, and then not a single packet arrives. The whole sensor is read, all automatic functions
are off.
"""

from __future__ import annotations

import contextlib
import time
from collections.abc import Iterator
from typing import Any

from acquisition.aravis_library import load_aravis
from acquisition.camera import Camera, CameraConfig, CameraStatistics, Trigger
from acquisition.cameras.aravis_stream import FrameGrabber, StreamSettings
from acquisition.cameras.gvcp import probe, wait_for_control
from dataset.errors import DeviceError
from dataset.frames import CameraInfo, RawFrame
from dataset.pixel_formats import pixel_format

_AUTOMATIC = ("ExposureAuto", "GainAuto", "BalanceWhiteAuto")


class AravisCamera(Camera):
    """A GigE Vision camera with a Polarsens sensor."""

    def __init__(self, config: CameraConfig) -> None:
        """Opens and configures the camera.

        Raises DeviceError within 5 s when no camera answers or another client controls it, and when it does
        not take a setting; when Aravis is not installed, the error names the packages.
        """
        self._config = config
        self._aravis, self._error = load_aravis()
        self._grabber: FrameGrabber | None = None
        self._stream: Any = None
        self._trigger: Trigger = config.trigger
        self._final = CameraStatistics()
        self._gone = False
        presence = wait_for_control(config.address)
        with self._explain("could not be opened", "check the cable and try again"):
            self._camera = self._aravis.Camera.new(presence.ip)
        try:
            self._claim()
            self._info = self._configure()
        except BaseException:
            self.close()
            raise

    @property
    def info(self) -> CameraInfo:
        """See `Camera.info`."""
        return self._info

    @property
    def statistics(self) -> CameraStatistics:
        """See `Camera.statistics`."""
        return self._grabber.statistics if self._grabber is not None else self._final

    def start(self, trigger: Trigger | None = None) -> None:
        """See `Camera.start`."""
        if self._grabber is not None:
            raise DeviceError(f"{self._name} is already started; stop it first")
        self._trigger = trigger or self._config.trigger
        with self._explain("could not be started", "check the cable and try again"):
            if self._trigger == "software":
                self._camera.set_trigger("Software")
            else:
                self._camera.clear_triggers()
                self._set_frame_rate()
            settings = StreamSettings(
                format=pixel_format(self._config.pixel_format),
                height=self._info.height,
                width=self._info.width,
                payload=self._camera.get_payload(),
                exposure_us=self._camera.get_exposure_time(),
                gain_db=self._camera.get_gain(),
            )
            self._stream = self._camera.create_stream(None, None)
            # Without the right to raw sockets Aravis reads UDP, for which the usual buffer is too small.
            self._stream.set_property("socket-buffer", self._aravis.GvStreamSocketBuffer.AUTO)
            grabber = FrameGrabber(self._aravis, self._stream, settings)
            self._camera.start_acquisition()
        self._grabber = grabber
        grabber.start()

    def trigger(self) -> None:
        """See `Camera.trigger`."""
        grabber = self._started()
        if self._trigger != "software":
            raise DeviceError(f"{self._name} runs free; start it with trigger 'software' to trigger it")
        grabber.discard_until(time.monotonic_ns())
        with self._explain("did not take the trigger", "check the cable, then open it again"):
            self._camera.software_trigger()

    def read(self, timeout_s: float | None = None) -> RawFrame:
        """See `Camera.read`."""
        grabber = self._started()
        timeout_s = self._config.timeout_s if timeout_s is None else timeout_s
        frame = grabber.take(timeout_s)
        if frame is None:
            raise self._explain_silence(grabber, timeout_s)
        return frame

    def stop(self) -> None:
        """See `Camera.stop`."""
        if self._grabber is None:
            return
        grabber, self._grabber = self._grabber, None
        # Each word to a camera that is gone costs seconds; what remains then is to let go of our side.
        if not self._gone:
            with contextlib.suppress(self._error):
                self._camera.stop_acquisition()
        self._final = grabber.statistics
        grabber.stop()
        self._stream.set_emit_signals(False)
        self._stream = None

    def close(self) -> None:
        """See `Camera.close`; takes about 8 s when the camera has vanished: Aravis tries to tell it."""
        self.stop()
        self._camera = None

    @property
    def _name(self) -> str:
        return f"the camera at {self._config.address}"

    def _started(self) -> FrameGrabber:
        if self._grabber is None:
            raise DeviceError(f"{self._name} is not started; call start() first")
        return self._grabber

    def _claim(self) -> None:
        device = self._camera.get_device()
        if not device.is_controller():
            raise DeviceError(f"another program controls {self._name}; close it, then try again")
        # Both are off by default, and then nonsense reaches the camera's registers.
        device.set_range_check_policy(self._aravis.RangeCheckPolicy.ENABLE)
        device.set_access_check_policy(self._aravis.AccessCheckPolicy.ENABLE)

    def _configure(self) -> CameraInfo:
        config, camera = self._config, self._camera
        format_ = pixel_format(config.pixel_format)
        with self._explain("did not take its settings", "check the cable and try again"):
            camera.stop_acquisition()  # a client that died may have left it running
            if config.pixel_format not in camera.dup_available_pixel_formats_as_strings():
                offered = ", ".join(camera.dup_available_pixel_formats_as_strings())
                raise DeviceError(
                    f"{self._name} has no pixel format {config.pixel_format}; it offers {offered}"
                )
            camera.set_pixel_format_from_string(config.pixel_format)
            self._read_whole_sensor()
            self._lock_automatic()
            self._set_within("exposure_us", config.exposure_us, "ExposureTime")
            self._set_within("gain_db", config.gain_db, "Gain")
            self._set_frame_rate()
            packet_size = self._set_packet_size()
            device = camera.get_device()
            firmware = "DeviceFirmwareVersion"
            if not device.is_feature_available(firmware):
                firmware = "DeviceVersion"
            return CameraInfo(
                vendor=camera.get_vendor_name(),
                model=camera.get_model_name(),
                serial=camera.get_device_serial_number(),
                firmware=device.get_string_feature_value(firmware),
                pixel_format=format_.name,
                mosaic="colour" if format_.colour else "mono",
                width=camera.get_integer("Width"),
                height=camera.get_integer("Height"),
                bits=format_.bits,
                packet_size=packet_size,
            )

    def _read_whole_sensor(self) -> None:
        """A region left by another client would shift the mosaic against the calibration."""
        for offset, size in (("OffsetX", "Width"), ("OffsetY", "Height")):
            if self._camera.get_device().is_feature_available(offset):
                self._camera.set_integer(offset, 0)
            _, largest = self._camera.get_integer_bounds(size)
            self._camera.set_integer(size, largest)

    def _lock_automatic(self) -> None:
        for feature in _AUTOMATIC:
            if not self._camera.get_device().is_feature_available(feature):
                continue
            self._camera.set_string(feature, "Off")
            if self._camera.get_string(feature) != "Off":
                raise DeviceError(
                    f"{self._name} does not let go of {feature}; set it to Off in the maker's software, save "
                    "that as the power-on setting, then try again"
                )

    def _set_frame_rate(self) -> None:
        rate = self._config.frame_rate
        if rate is None:
            return
        # Cameras keep the rate read-only until it is enabled.
        if self._camera.get_device().is_feature_available("AcquisitionFrameRateEnable"):
            self._camera.set_boolean("AcquisitionFrameRateEnable", True)
        self._set_within("frame_rate", rate, "AcquisitionFrameRate")

    def _set_within(self, name: str, value: float, feature: str) -> None:
        lowest, highest = self._camera.get_float_bounds(feature)
        if not lowest <= value <= highest:
            raise DeviceError(
                f"{self._name} cannot take {name} = {value:g}: its {feature} goes from {lowest:g} to "
                f"{highest:g}; correct [camera] in the rig file"
            )
        self._camera.set_float(feature, value)

    def _set_packet_size(self) -> int:
        if self._config.packet_size is None:
            return int(self._camera.gv_auto_packet_size())
        never = self._aravis.GvPacketSizeAdjustment.NEVER
        self._camera.gv_set_packet_size_adjustment(never)
        self._camera.gv_set_packet_size(self._config.packet_size)
        return int(self._camera.gv_get_packet_size())

    def _explain_silence(self, grabber: FrameGrabber, timeout_s: float) -> DeviceError:
        """Why no frame came."""
        try:
            presence = probe(self._config.address)
        except DeviceError as error:
            self._gone = True
            return DeviceError(
                f"{self._name} stopped answering; check its power and cable, then open it again ({error})"
            )
        if not presence.controlled:
            return DeviceError(
                f"{self._name} was restarted, or lost sight of this computer for seconds; open it again"
            )
        statistics = grabber.statistics
        start = f"no whole frame from {self._name} within {timeout_s:g} s"
        if statistics.incomplete:
            return DeviceError(
                f"{start}: {statistics.incomplete} frames came with packets missing; set packet_size to the "
                "MTU (ip link), raise net.core.rmem_max, or lower the frame rate"
            )
        if grabber.received_packets == 0:
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
