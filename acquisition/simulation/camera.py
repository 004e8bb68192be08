"""The simulated polarization camera: a GigE Vision device of its own process, for any client.

Run as ``python -m acquisition.simulation.camera``; from Python, `SimulatedCamera` does. Commands on stdin:
``clock`` answers the origin (host monotonic ns) and drift (ppm) of the camera's clock, ``statistics`` the
frames sent and how many of them late. Faults: ``lost-ratio X`` of the packets, ``latency-s X`` of the frames,
``clock-jump S`` seconds forward (or back), ``stall S`` seconds in which it neither sends nor answers,
``stuck-auto yes`` for an exposure that stays automatic, ``payload-padding N`` for frames of another geometry,
``ptp-master yes`` for a network with a master clock. Any other command goes to the source.
"""

from __future__ import annotations

import argparse
import contextlib
import importlib
import json
import os
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from acquisition.process import ChildProcess, die_with_parent, serve_commands
from acquisition.simulation.fake_device import Exposure, FakeDevice
from dataset.errors import ToolkitError
from dataset.on_camera import compute_on_camera
from dataset.pixel_formats import pack, pixel_format
from dataset.polarimetry import Raw

if TYPE_CHECKING:
    from acquisition.simulation.patterns import FrameSource

Number = TypeVar("Number", int, float)

_PRIORITY = -5  # a camera keeps its time however busy the host is
DEFAULT_SOURCE = "acquisition.simulation.patterns:MovingPattern"


@dataclass(frozen=True)
class CameraClock:
    """The camera's clock: zero at `origin_ns` of the host's monotonic clock, and `drift_ppm` fast."""

    origin_ns: int
    drift_ppm: float

    def to_camera(self, host_ns: int) -> int:
        """Nanoseconds on the camera's clock at a host time."""
        elapsed = host_ns - self.origin_ns
        return elapsed + round(elapsed * self.drift_ppm * 1e-6)

    def jumped(self, seconds: float) -> CameraClock:
        """This clock after it was set forward, or back."""
        return replace(self, origin_ns=self.origin_ns - round(seconds * 1e9 / (1 + self.drift_ppm * 1e-6)))


class Sensor:
    """Exposes when the device asks, and delivers a constant latency later, whatever the rendering costs.

    Our delivery model: the exposure starts at T0, when the device asks for a frame; the camera stamps the
    frame with T0 on its own clock; its first packet leaves at T0 + latency. Rendering longer than that makes
    a late frame, which is counted. Latency and sending have to fit the frame period, else the frame rate
    falls: the device does one thing at a time.
    """

    def __init__(
        self, source: FrameSource, width: int, height: int, clock: CameraClock, latency_s: float
    ) -> None:
        self.latency_s = latency_s
        self.stall_s = 0.0
        self.clock = clock
        self.frames = 0
        self.late = 0
        self._source = source
        self._size = (height, width)

    def fill(self, exposure: Exposure, memory: NDArray[np.uint8]) -> int:
        """See `fake_device.Fill`."""
        stall_s, self.stall_s = self.stall_s, 0.0
        time.sleep(stall_s)
        start_ns, wall_ns = time.monotonic_ns(), time.time_ns()
        height, width = self._size
        mosaic = self._source.frame(
            exposure.format.raw_name, height, width, exposure.exposure_us, exposure.gain_db, start_ns
        )
        if mosaic.shape != self._size:
            raise ToolkitError(f"the source made a frame of {mosaic.shape}, the sensor has {self._size}")
        memory[:] = pack(_region(compute_on_camera(mosaic, exposure.format), exposure), exposure.format)
        self.frames += 1
        remaining_s = self.latency_s - (time.monotonic_ns() - start_ns) * 1e-9
        if remaining_s > 0:
            time.sleep(remaining_s)
        else:
            self.late += 1
        return wall_ns if exposure.synchronized else self.clock.to_camera(start_ns)


def _region(frame: Raw, exposure: Exposure) -> Raw:
    """What a client asked for of the sensor; dark where a careless one asked for more than there is."""
    seen = frame[exposure.y :, exposure.x :][: exposure.height, : exposure.width]
    region: Raw = np.zeros((exposure.height, exposure.width), frame.dtype)
    region[: seen.shape[0], : seen.shape[1]] = seen
    return region


class SimulatedCamera(ChildProcess):
    """Starts the simulated camera as a process; a context manager that ends it."""

    def __init__(
        self,
        address: str = "127.0.0.1",
        *,
        source: str = DEFAULT_SOURCE,
        source_args: Mapping[str, Any] | None = None,
        ready_timeout_s: float = 60.0,
        **options: str | int | float,
    ) -> None:
        """`source` is ``package.module:factory``, called with `source_args`; `options` are those of the
        command line, underscores for dashes, such as ``frame_rate=10`` or ``drift_ppm=80``."""
        self.address = address
        arguments = ["--address", address, "--source", source, "--source-args", json.dumps(source_args or {})]
        for name, value in options.items():
            arguments.append(f"--{name.replace('_', '-')}={value}")
        super().__init__("acquisition.simulation.camera", arguments, ready_timeout_s=ready_timeout_s)

    def clock(self) -> CameraClock:
        """The truth about the camera's clock, for tests."""
        origin_ns, drift_ppm = self.command("clock").split()
        return CameraClock(int(origin_ns), float(drift_ppm))

    def set_lost_ratio(self, ratio: float) -> None:
        """From now on loses this fraction of the stream's packets."""
        self.command(f"lost-ratio {ratio}")

    def jump_clock(self, seconds: float) -> None:
        """Sets the camera's clock forward, or back."""
        self.command(f"clock-jump {seconds}")

    def stall(self, seconds: float) -> None:
        """From the next frame on neither sends nor answers for so long."""
        self.command(f"stall {seconds}")


def load_source(specification: str, arguments: Mapping[str, Any]) -> FrameSource:
    """Calls the factory that ``package.module:factory`` names.

    Raises ToolkitError when there is no such module or factory, or it does not take the arguments.
    """
    module_name, _, factory_name = specification.partition(":")
    try:
        source: FrameSource = getattr(importlib.import_module(module_name), factory_name)(**arguments)
    except (ImportError, AttributeError, TypeError, ValueError) as error:
        raise ToolkitError(
            f"--source {specification} with {json.dumps(dict(arguments))} failed: {error}; it must be "
            "package.module:factory, --source-args its keyword arguments as JSON"
        ) from error
    return source


def main() -> None:
    """Serves until stdin ends or the parent dies."""
    die_with_parent()
    with contextlib.suppress(PermissionError):
        os.nice(_PRIORITY)
    options = _parse()
    try:
        _serve(options)
    except ToolkitError as error:
        raise SystemExit(str(error)) from error


def _serve(options: argparse.Namespace) -> None:
    source = load_source(options.source, options.source_args)
    format_ = pixel_format(options.pixel_format)
    # The first frame may compile or load something, and the device cannot answer meanwhile.
    source.frame(format_.raw_name, options.height, options.width, 10_000.0, 0.0, time.monotonic_ns())
    pack(np.zeros((4, 4), np.uint16), pixel_format("BayerRG12p"))
    clock = CameraClock(time.monotonic_ns(), options.drift_ppm)
    sensor = Sensor(source, options.width, options.height, clock, options.latency_s)
    device = FakeDevice(
        options.address,
        sensor.fill,
        serial=options.serial,
        model=options.model,
        width=options.width,
        height=options.height,
        format_=format_,
        frame_rate=options.frame_rate,
        packet_size=options.packet_size,
        trigger_poll_hz=options.trigger_poll_hz,
        lost_ratio=options.lost_ratio,
    )

    device.set_ptp_master(_yes(options.ptp_master))

    def jump(seconds: float) -> None:
        clock = sensor.clock.jumped(seconds)
        if clock.to_camera(time.monotonic_ns()) < 0:
            raise ValueError(f"a camera's clock counts from 0; it has not yet run {-seconds:g} s")
        sensor.clock = clock

    def set_on_sensor(name: str) -> Callable[[str], None]:
        return lambda value: setattr(sensor, name, _not_negative(float(value)))

    faults: dict[str, Callable[[str], None]] = {
        "lost-ratio": lambda value: device.set_lost_ratio(float(value)),
        "latency-s": set_on_sensor("latency_s"),
        "stall": set_on_sensor("stall_s"),
        "clock-jump": lambda value: jump(float(value)),
        "stuck-auto": lambda value: device.stick_exposure_auto(_yes(value)),
        "payload-padding": lambda value: device.pad_payload(_not_negative(int(value))),
        "ptp-master": lambda value: device.set_ptp_master(_yes(value)),
    }

    def handle(line: str) -> str:
        verb, _, value = line.partition(" ")
        if verb == "clock":
            return f"{sensor.clock.origin_ns} {sensor.clock.drift_ppm}"
        if verb == "statistics":
            return f"frames {sensor.frames} late {sensor.late}"
        if verb in faults:
            faults[verb](value)
            return ""
        command = getattr(source, "command", None)
        if command is None:
            raise ValueError(f"unknown command '{line}'; use one of clock, statistics, {', '.join(faults)}")
        return str(command(line))

    with contextlib.closing(device):
        serve_commands(handle)


def _not_negative(value: Number) -> Number:
    if not value >= 0:
        raise ValueError(f"{value} must not be negative")
    return value


def _yes(value: str) -> bool:
    if value not in ("yes", "no"):
        raise ValueError(f"'{value}' is neither yes nor no")
    return value == "yes"


def _parse() -> argparse.Namespace:
    parser = argparse.ArgumentParser(
        prog="python -m acquisition.simulation.camera",
        description="Serves a simulated polarization camera over GigE Vision until stdin ends.",
        formatter_class=argparse.ArgumentDefaultsHelpFormatter,
    )
    add = parser.add_argument
    add("--address", default="127.0.0.1", help="address of this machine to serve on, UDP port 3956")
    add("--source", default=DEFAULT_SOURCE, help="package.module:factory of the frames")
    add("--source-args", type=json.loads, default={}, help="the factory's keyword arguments, as JSON")
    add("--serial", default="SIM00001", help="serial number")
    add("--model", default="PHX050S-Q", help="model name")
    add("--width", type=int, default=2448, help="columns of the sensor, a multiple of 4")
    add("--height", type=int, default=2048, help="rows of the sensor, a multiple of 4")
    add("--pixel-format", default="BayerRG8", help="PFNC name of the format at power-on")
    add("--frame-rate", type=float, default=22.0, help="frames per second at power-on")
    # The largest that GigE Vision has, nearly: a socket's buffer holds more in fewer, larger packets.
    add("--packet-size", type=int, default=16000, help="bytes of a stream packet at power-on")
    add("--latency-s", type=float, default=0.02, help="from the start of the exposure to the first packet")
    add("--drift-ppm", type=float, default=0.0, help="how much too fast the camera's clock runs")
    add("--trigger-poll-hz", type=float, default=100.0, help="how often the device looks for a trigger")
    add("--lost-ratio", type=float, default=0.0, help="fraction of stream packets to lose")
    add("--ptp-master", choices=("yes", "no"), default="no", help="whether the network has a master clock")
    return parser.parse_args()


if __name__ == "__main__":
    main()
