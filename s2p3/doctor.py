"""What is installed, which device answers, whether disk and network keep up; a failing line says the fix."""

from __future__ import annotations

import importlib.util
import os
import platform
import re
import shutil
import sys
import tempfile
import time
from collections.abc import Iterator
from importlib import metadata
from pathlib import Path
from typing import TYPE_CHECKING

from dataset.errors import ToolkitError
from s2p3.doctor_check import Check, failed, unless

if TYPE_CHECKING:
    from acquisition.rig import Rig

_FRAME_RATE_HZ = 22.0
_FRAME_PIXELS = 2448 * 2048
_COMPRESSION = 1.4  # of noisy mosaics; a little less than measured
_TRIAL_BYTES = 128 << 20
_FEWEST_FREE_BYTES = 10e9


def doctor(rig: Rig | None = None, folder: Path | None = None) -> Iterator[Check]:
    """Checks this machine and, where a rig is given, its devices, one after another; the arm is not moved.

    Args:
        rig: whose devices to ask; a device that does not answer is given up after at most 5 s.
        folder: where sessions will be written; the current one by default.

    Yields:
        One check a line, as soon as it is made; nothing is raised for what is missing or does not answer.
    """
    yield from _machine_checks()
    yield from _disk_checks(rig, folder or Path.cwd())
    if rig is not None:
        from s2p3.doctor_devices import device_checks

        yield from device_checks(rig)


def _machine_checks() -> Iterator[Check]:
    yield _python()
    yield _packages()
    yield _opencv()
    yield _aravis()
    yield _cameras()
    yield _ur_rtde()
    yield _threads()
    yield _gpu()


def _disk_checks(rig: Rig | None, folder: Path) -> Iterator[Check]:
    needed = bytes_per_second(rig)
    yield _disk_space(folder, needed)
    yield _disk_speed(folder, needed)


def _python() -> Check:
    found = f"{platform.python_version()} on {platform.system()} {platform.machine()}"
    return Check(
        "Python", sys.version_info >= (3, 10), found, unless(sys.version_info >= (3, 10), "install 3.10+")
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
    return Check("OpenCV", ok, detail, unless(ok, "pip install 'opencv-python-headless<5'"))


def _aravis() -> Check:
    from acquisition.aravis_library import load_aravis

    try:
        load_aravis()
    except ToolkitError as error:
        return failed("Aravis", error)
    return Check("Aravis", True, f"0.8, PyGObject {_version('PyGObject')}")


def _cameras() -> Check:
    """The cameras that answer a call on every network: their addresses go into a rig file."""
    from acquisition.cameras.discovery import find_cameras

    try:
        found = find_cameras()
    except ToolkitError as error:
        return failed("cameras in sight", error)
    listed = ", ".join(f"{camera.model} {camera.serial} at {camera.address}" for camera in found)
    return Check("cameras in sight", True, listed or "none that speaks GigE Vision")


def _ur_rtde() -> Check:
    ok = importlib.util.find_spec("rtde_control") is not None
    return Check(
        "ur_rtde",
        ok,
        str(_version("ur_rtde")) if ok else "not installed",
        unless(ok, "pip install 's2p3[ur]'"),
    )


def _threads() -> Check:
    count = len(os.sched_getaffinity(0))
    fix = unless(
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
    return Check("disk space", ok, detail, unless(ok, "free some space, or record to another disk"))


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
        "disk speed", ok, detail, unless(ok, "record to a faster disk, or lower [camera] frame_rate")
    )


def bytes_per_second(rig: Rig | None) -> float:
    """What a recording at full rate writes, compressed."""
    from dataset.pixel_formats import pixel_format

    bits = pixel_format(rig.camera.pixel_format).bits if rig is not None else 8
    rate = (rig.camera.frame_rate if rig is not None else None) or _FRAME_RATE_HZ
    return _FRAME_PIXELS * (1 if bits <= 8 else 2) * rate / _COMPRESSION


def _version(name: str) -> str | None:
    try:
        return metadata.version(name)
    except metadata.PackageNotFoundError:
        return None
