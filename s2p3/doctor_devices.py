"""Whether the devices of a rig answer, keep up, and are set as the rig file says; the arm is not moved."""

from __future__ import annotations

import socket
import time
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from dataset.clocks import fit_clock
from dataset.errors import ToolkitError
from s2p3.doctor_check import Check, failed, unless

if TYPE_CHECKING:
    from acquisition.camera import Camera
    from acquisition.rig import Rig
    from dataset.frames import RawFrame

_TRIAL_S = 2.0
_TRIAL_FRAMES = 8  # of a slow camera, whose clock fewer would not tell
_LOST_SHARE = 0.01
_RATE_SHARE = 0.95
_LARGEST_CLOCK_SIGMA_MS = 1.0
_LARGE_PACKET = 8000
_ARM_PORTS = {"RTDE": 30004, "script": 30003, "dashboard": 29999}


def device_checks(rig: Rig) -> Iterator[Check]:
    """Asks camera and arm; a device that does not answer is given up after at most 5 s."""
    yield from _camera(rig)
    host = rig.robot.host
    closed = [name for name, port in _ARM_PORTS.items() if not _answers(host, port)]
    yield _arm_ports(host, closed)
    if "dashboard" not in closed:
        yield from _arm_controller(host)
    if "RTDE" not in closed:
        yield _arm_tool(rig)
        yield _arm_stream(rig)


def _camera(rig: Rig) -> Iterator[Check]:
    from acquisition.rig import open_camera

    started = time.perf_counter()
    try:
        with open_camera(rig) as camera:
            info = camera.info
            yield Check(
                "camera",
                True,
                f"{info.vendor} {info.model} {info.serial}, firmware {info.firmware or 'unknown'}, "
                f"{info.width}x{info.height} {info.pixel_format}, "
                f"opened in {time.perf_counter() - started:.1f} s",
            )
            if rig.camera.driver == "aravis":
                yield _network(rig.camera.address, info.packet_size)
            frames = _free_run(camera)
            yield stream_check(frames, rig.camera.frame_rate)
            yield _camera_clock(frames, info.clock)
        if rig.camera.driver == "aravis":
            yield _packets(rig)
    except ToolkitError as error:
        yield failed("camera", error)


def _network(address: str, packet_size: int) -> Check:
    """Which card leads to the camera, and whether its packets may be large."""
    interface, mtu = _interface_to(address)
    detail = f"{interface} to {address}, MTU {mtu}, packets of {packet_size} bytes"
    fix = f"sudo ip link set {interface} mtu 9000, or lower packet_size"
    return Check("network", mtu >= packet_size, detail, unless(mtu >= packet_size, fix))


def _packets(rig: Rig) -> Check:
    """Which packet sizes really arrive."""
    from acquisition.cameras.packet_test import largest_delivered, try_packet_sizes

    trials = try_packet_sizes(rig.camera)
    largest = largest_delivered(trials)
    counts = [f"{t.whole} of {t.whole + t.incomplete} whole" if not t.refused else "refused" for t in trials]
    detail = ", ".join(f"{t.size} bytes: {count}" for t, count in zip(trials, counts, strict=True))
    if largest is not None and largest < _LARGE_PACKET:
        detail += "; larger ones take less CPU, where card and switch can: sudo ip link set CARD mtu 9000"
    fix = "let UDP from port 3956 through the firewall, and sudo sysctl -w net.core.rmem_max=33554432"
    return Check("packet test", largest is not None, detail, unless(largest is not None, fix))


def _free_run(camera: Camera) -> list[RawFrame]:
    """Two seconds of frames, longer where they come slowly."""
    frames: list[RawFrame] = []
    camera.start("free")
    end = time.monotonic() + _TRIAL_S
    while time.monotonic() < end or len(frames) < _TRIAL_FRAMES:
        frames.append(camera.read())
    camera.stop()
    return frames


def stream_check(frames: list[RawFrame], wanted: float | None) -> Check:
    """How many of a free run's frames arrived, by the camera's own count and clock; at least two came.

    Args:
        frames: in order.
        wanted: frames per second; None where any rate will do.
    """
    offered = frames[-1].frame_id - frames[0].frame_id + 1
    lost = offered - len(frames)
    span_s = (frames[-1].camera_time_ns - frames[0].camera_time_ns) * 1e-9
    rate = (offered - 1) / span_s if span_s > 0 else 0.0
    detail = f"{rate:.1f} frames/s, {lost} of {offered} lost"
    if lost > _LOST_SHARE * offered:
        fix = "sudo sysctl -w net.core.rmem_max=33554432, raise the MTU, or lower [camera] frame_rate"
    elif wanted is not None and rate < _RATE_SHARE * wanted:
        detail += f", {wanted:g} frames/s wanted"
        fix = "shorten [camera] exposure_us, lower frame_rate, or lift the camera's link throughput limit"
    else:
        fix = ""
    return Check("camera stream", not fix, detail, fix)


def _camera_clock(frames: list[RawFrame], kind: str) -> Check:
    if kind == "host":
        fix = "use a producer that stamps frames, or move the arm only between stills"
        return Check("camera clock", False, "this camera does not stamp its frames", fix)
    try:
        fit = fit_clock([f.camera_time_ns for f in frames], [f.host_time_ns for f in frames])
    except ToolkitError as error:
        return failed("camera clock", error)
    return _clock("camera clock", fit.sigma_ns)


def _arm_controller(host: str) -> Iterator[Check]:
    """Software, mode and safety of the controller, and whether it takes commands."""
    from acquisition.robots.motion_client import dashboard_request

    try:
        software = dashboard_request(host, "PolyscopeVersion")
        mode = dashboard_request(host, "robotmode").removeprefix("Robotmode: ")
        safety = dashboard_request(host, "safetymode").removeprefix("Safetymode: ")
        remote = dashboard_request(host, "is in remote control")
    except ToolkitError as error:
        yield failed("arm controller", error)
        return
    ok = (mode, safety) == ("RUNNING", "NORMAL")
    fix = "clear the stop at the pendant" if safety != "NORMAL" else "power the arm on and release the brakes"
    yield Check("arm controller", ok, f"{software}, {mode}, safety {safety}", unless(ok, fix))
    ok = remote != "false"
    detail = {"true": "takes commands", "false": "local mode: can be read, not moved"}.get(remote, remote)
    fix = "enable it under Settings > System > Remote Control, then choose it at the pendant's top right"
    yield Check("arm remote", ok, detail, unless(ok, fix))


def _arm_tool(rig: Rig) -> Check:
    """The active tool centre point against the rig file's, and the payload."""
    from acquisition.rig import open_pose_source

    try:
        with open_pose_source(rig) as arm:
            tool = np.round(arm.tcp_offset, 4).tolist()
            mass = float(arm.payload[0])
    except ToolkitError as error:
        return failed("arm tool", error)
    carries = "" if np.isnan(mass) else f", payload {mass:.2f} kg"
    return Check("arm tool", True, f"TCP {tool} in the flange frame (m, rad){carries}")


def _arm_ports(host: str, closed: list[str]) -> Check:
    ports = ", ".join(f"{name} {port}" for name, port in _ARM_PORTS.items())
    if not closed:
        return Check("arm", True, f"{host} answers on {ports}")
    fix = "check power, cable and address; enable the services under Settings > Security on the pendant"
    return Check("arm", False, f"{host} does not answer on {', '.join(closed)}", fix)


def _arm_stream(rig: Rig) -> Check:
    """Two seconds of the arm's state, and how well its clock can be followed."""
    from acquisition.robots.stream import RtdeStream

    try:
        stream = RtdeStream(rig.robot.host, rig.robot.frequency_hz, rig.robot.silence_s)
        try:
            stream.start_trace()
            time.sleep(_TRIAL_S)
            trace = stream.stop_trace()
        finally:
            stream.close()
        fit = fit_clock(np.rint(trace.robot_time_s * 1e9).astype(np.int64), trace.host_time_ns)
    except ToolkitError as error:
        return failed("arm clock", error)
    rate = (len(trace) - 1) / float(np.ptp(trace.robot_time_s))
    return _clock("arm clock", fit.sigma_ns, f"{rate:.0f} samples/s, ")


def _clock(name: str, sigma_ns: float, before: str = "") -> Check:
    sigma_ms = sigma_ns * 1e-6
    ok = sigma_ms <= _LARGEST_CLOCK_SIGMA_MS
    fix = unless(ok, "close other programs, and connect the device without a switch or Wi-Fi between")
    return Check(name, ok, f"{before}follows the host's to {sigma_ms:.2f} ms", fix)


def _interface_to(address: str) -> tuple[str, int]:
    """The network interface that leads to an address, by the kernel's routing table, and its MTU."""
    packed = socket.inet_aton(socket.gethostbyname(address))
    target = int.from_bytes(packed, "little")  # as the table writes addresses
    routes = [line.split() for line in Path("/proc/net/route").read_text().splitlines()[1:]]
    masks = {
        int(mask, 16): name for name, to, *_, mask, _, _, _ in routes if target & int(mask, 16) == int(to, 16)
    }
    name = "lo" if packed[0] == 127 else masks[max(masks, key=int.bit_count)] if masks else "no interface"
    mtu = Path(f"/sys/class/net/{name}/mtu")
    return name, int(mtu.read_text()) if mtu.exists() else 0


def _answers(host: str, port: int) -> bool:
    try:
        socket.create_connection((host, port), timeout=1.0).close()
    except OSError:
        return False
    return True
