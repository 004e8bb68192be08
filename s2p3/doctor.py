"""What is installed, which device answers, whether disk and network keep up; a failing line says the fix."""

from __future__ import annotations

import importlib.util
import os
import platform
import re
import shutil
import socket
import sys
import tempfile
import time
from collections.abc import Iterator
from dataclasses import dataclass
from importlib import metadata
from pathlib import Path
from typing import TYPE_CHECKING

from dataset.errors import ToolkitError

if TYPE_CHECKING:
    from acquisition.camera import Camera
    from acquisition.rig import Rig

_FRAME_RATE_HZ = 22.0
_FRAME_PIXELS = 2448 * 2048
_COMPRESSION = 1.4  # of noisy mosaics; a little less than measured
_TRIAL_S = 2.0
_TRIAL_BYTES = 128 << 20
_FEWEST_FREE_BYTES = 10e9
_LOST_SHARE = 0.01
_LARGEST_CLOCK_SIGMA_MS = 1.0
_ARM_PORTS = {"RTDE": 30004, "script": 30003, "dashboard": 29999}


@dataclass(frozen=True)
class Check:
    """One line of the doctor's report.

    Attributes:
        name: what was checked.
        ok: whether it will do.
        detail: what was found.
        fix: what to do; empty where it will do.
    """

    name: str
    ok: bool
    detail: str
    fix: str = ""


def doctor(rig: Rig | None = None, folder: Path | None = None) -> list[Check]:
    """Checks this machine and, where a rig is given, its devices; the arm is not moved.

    Args:
        rig: whose devices to ask; a device that does not answer is given up after at most 5 s.
        folder: where sessions will be written; the current one by default.

    Returns:
        One check a line; nothing is raised for what is missing or does not answer.
    """
    return [*_machine_checks(rig, folder or Path.cwd()), *(() if rig is None else _device_checks(rig))]


def _machine_checks(rig: Rig | None, folder: Path) -> Iterator[Check]:
    yield _python()
    yield _packages()
    yield _opencv()
    yield _aravis()
    yield _ur_rtde()
    yield _threads()
    yield _gpu()
    needed = _bytes_per_second(rig)
    yield _disk_space(folder, needed)
    yield _disk_speed(folder, needed)


def _device_checks(rig: Rig) -> Iterator[Check]:
    yield from _camera(rig)
    closed = [name for name, port in _ARM_PORTS.items() if not _answers(rig.robot.host, port)]
    yield _arm_ports(rig.robot.host, closed)
    if "RTDE" not in closed:
        yield _arm_stream(rig)


def _python() -> Check:
    found = f"{platform.python_version()} on {platform.system()} {platform.machine()}"
    return Check(
        "Python", sys.version_info >= (3, 10), found, _unless(sys.version_info >= (3, 10), "install 3.10+")
    )


def _packages() -> Check:
    """The packages that a plain installation must have."""
    required = [line for line in metadata.requires("s2p3") or () if ";" not in line]
    names = [re.split(r"[^A-Za-z0-9_.-]", line)[0] for line in required]
    found = {name: _version(name) for name in names}
    missing = [name for name, version in found.items() if version is None]
    if missing:
        return Check("packages", False, f"missing: {', '.join(missing)}", "pip install s2p3")
    return Check("packages", True, ", ".join(f"{name} {version}" for name, version in found.items()))


def _opencv() -> Check:
    try:
        import cv2
    except ImportError as error:
        return Check("OpenCV", False, str(error), "pip install 'opencv-python-headless<5'")
    ok = hasattr(cv2, "calibrateHandEye")
    detail = cv2.__version__ if ok else f"{cv2.__version__} lacks calibrateHandEye"
    return Check("OpenCV", ok, detail, _unless(ok, "pip install 'opencv-python-headless<5'"))


def _aravis() -> Check:
    from acquisition.aravis_library import load_aravis

    try:
        load_aravis()
    except ToolkitError as error:
        return _failed("Aravis", error)
    return Check("Aravis", True, f"0.8, PyGObject {_version('PyGObject')}")


def _ur_rtde() -> Check:
    ok = importlib.util.find_spec("rtde_control") is not None
    return Check(
        "ur_rtde",
        ok,
        str(_version("ur_rtde")) if ok else "not installed",
        _unless(ok, "pip install 's2p3[ur]'"),
    )


def _threads() -> Check:
    count = len(os.sched_getaffinity(0))
    fix = _unless(
        count >= 2, "give this process two or more CPU threads: reading and compressing run side by side"
    )
    return Check("CPU", count >= 2, f"{count} threads", fix)


def _gpu() -> Check:
    import torch

    if not torch.cuda.is_available():
        return Check("GPU", True, "none: training runs on the CPU")
    return Check("GPU", True, torch.cuda.get_device_name(0))


def _disk_space(folder: Path, bytes_per_second: float) -> Check:
    try:
        free = shutil.disk_usage(folder).free
    except OSError as error:
        return Check("disk space", False, f"{folder}: {error.strerror}", "name a folder that exists")
    ok = free >= _FEWEST_FREE_BYTES
    detail = f"{free / 1e9:.0f} GB free in {folder}: {free / bytes_per_second / 60:.0f} min of recording"
    return Check("disk space", ok, detail, _unless(ok, "free some space, or record to another disk"))


def _disk_speed(folder: Path, bytes_per_second: float) -> Check:
    block = os.urandom(_TRIAL_BYTES // 16)
    try:
        with tempfile.TemporaryFile(dir=folder) as file:
            started = time.perf_counter()
            for _ in range(16):
                file.write(block)
            file.flush()
            os.fsync(file.fileno())
            speed = _TRIAL_BYTES / (time.perf_counter() - started)
    except OSError as error:
        return Check("disk speed", False, f"{folder}: {error.strerror}", "name a folder you may write to")
    ok = speed >= bytes_per_second
    detail = f"{speed / 1e6:.0f} MB/s, a recording at full rate needs {bytes_per_second / 1e6:.0f}"
    return Check(
        "disk speed", ok, detail, _unless(ok, "record to a faster disk, or lower [camera] frame_rate")
    )


def _camera(rig: Rig) -> Iterator[Check]:
    from acquisition.rig import open_camera

    started = time.perf_counter()
    try:
        with open_camera(rig) as camera:
            info = camera.info
            yield Check(
                "camera",
                True,
                f"{info.vendor} {info.model} {info.serial}, firmware {info.firmware}, "
                f"{info.width}x{info.height} {info.pixel_format}, "
                f"opened in {time.perf_counter() - started:.1f} s",
            )
            yield _network(rig.camera.address, info.packet_size)
            yield from _camera_stream(camera)
    except ToolkitError as error:
        yield _failed("camera", error)


def _network(address: str, packet_size: int) -> Check:
    """Which card leads to the camera, and whether its packets may be large."""
    interface, mtu = _interface_to(address)
    detail = f"{interface} to {address}, MTU {mtu}, packets of {packet_size} bytes"
    if mtu < packet_size:
        return Check("network", False, detail, f"sudo ip link set {interface} mtu 9000, or lower packet_size")
    if packet_size < 8000:
        detail += (
            f"; larger ones take less CPU: sudo ip link set {interface} mtu 9000, where card and switch can"
        )
    return Check("network", True, detail)


def _camera_stream(camera: Camera) -> Iterator[Check]:
    """Two seconds of free run: what arrives, and how well the camera's clock can be followed."""
    from dataset.clocks import fit_clock

    frames = []
    camera.start("free")
    end = time.monotonic() + _TRIAL_S
    while time.monotonic() < end:
        frames.append(camera.read())
    camera.stop()
    offered = frames[-1].frame_id - frames[0].frame_id + 1
    lost = offered - len(frames)
    ok = lost <= _LOST_SHARE * offered
    span_s = (frames[-1].camera_time_ns - frames[0].camera_time_ns) * 1e-9
    rate = (offered - 1) / span_s if span_s > 0 else 0.0
    yield Check(
        "camera stream",
        ok,
        f"{rate:.1f} frames/s, {lost} of {offered} lost",
        _unless(ok, "sudo sysctl -w net.core.rmem_max=33554432, raise the MTU, or lower [camera] frame_rate"),
    )
    try:
        fit = fit_clock([f.camera_time_ns for f in frames], [f.host_time_ns for f in frames])
    except ToolkitError as error:
        yield _failed("camera clock", error)
    else:
        yield _clock("camera clock", fit.sigma_ns)


def _arm_ports(host: str, closed: list[str]) -> Check:
    ports = ", ".join(f"{name} {port}" for name, port in _ARM_PORTS.items())
    if not closed:
        return Check("arm", True, f"{host} answers on {ports}")
    fix = "check power, cable and address; enable the services under Settings > Security on the pendant"
    return Check("arm", False, f"{host} does not answer on {', '.join(closed)}", fix)


def _arm_stream(rig: Rig) -> Check:
    """Two seconds of the arm's state, and how well its clock can be followed."""
    import numpy as np

    from dataset.clocks import fit_clock
    from acquisition.robots.stream import RtdeStream

    try:
        stream = RtdeStream(rig.robot.host, rig.robot.frequency_hz)
        try:
            stream.start_trace()
            time.sleep(_TRIAL_S)
            trace = stream.stop_trace()
        finally:
            stream.close()
        fit = fit_clock(np.rint(trace.robot_time_s * 1e9).astype(np.int64), trace.host_time_ns)
    except ToolkitError as error:
        return _failed("arm clock", error)
    rate = (len(trace) - 1) / float(np.ptp(trace.robot_time_s))
    return _clock("arm clock", fit.sigma_ns, f"{rate:.0f} samples/s, ")


def _clock(name: str, sigma_ns: float, before: str = "") -> Check:
    sigma_ms = sigma_ns * 1e-6
    ok = sigma_ms <= _LARGEST_CLOCK_SIGMA_MS
    fix = _unless(ok, "close other programs, and connect the device without a switch or Wi-Fi between")
    return Check(name, ok, f"{before}follows the host's to {sigma_ms:.2f} ms", fix)


def _bytes_per_second(rig: Rig | None) -> float:
    """What a recording at full rate writes, compressed."""
    from dataset.pixel_formats import pixel_format

    bits = pixel_format(rig.camera.pixel_format).bits if rig is not None else 8
    rate = (rig.camera.frame_rate if rig is not None else None) or _FRAME_RATE_HZ
    return _FRAME_PIXELS * (1 if bits <= 8 else 2) * rate / _COMPRESSION


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


def _version(name: str) -> str | None:
    try:
        return metadata.version(name)
    except metadata.PackageNotFoundError:
        return None


def _unless(ok: bool, fix: str) -> str:
    return "" if ok else fix


def _failed(name: str, error: ToolkitError) -> Check:
    """An error of the toolkit says what happened and, after the first semicolon, what to do."""
    what, _, remedy = str(error).partition("; ")
    return Check(name, False, what, remedy or what)
