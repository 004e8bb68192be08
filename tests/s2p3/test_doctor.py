"""The doctor: it answers without devices, says the fix for what fails, and asks devices that are there."""

from __future__ import annotations

import time
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from acquisition.rig import CameraTable, Rig, RobotTable
from acquisition.robots.rtde import RtdeReader
from acquisition.simulation.camera import SimulatedCamera
from acquisition.simulation.robot import SimulatedRobot
from s2p3.doctor import Check, doctor

MACHINE = ["Python", "packages", "OpenCV", "Aravis", "ur_rtde", "CPU", "GPU", "disk space", "disk speed"]


def by_name(checks: list[Check]) -> dict[str, Check]:
    names = [check.name for check in checks]
    assert len(set(names)) == len(names)
    for check in checks:
        assert check.detail
        assert bool(check.fix) != check.ok, f"{check.name}: a failing line, and no other, says the fix"
        assert "\n" not in check.detail + check.fix
    return {check.name: check for check in checks}


def joints(host: str) -> NDArray[np.float64]:
    with RtdeReader(host, ["actual_q"], 500) as reader:
        return np.frombuffer(reader.packages()[-1], reader.dtype)["actual_q"].copy()


def test_a_machine_without_devices_is_examined(tmp_path: Path) -> None:
    checks = by_name(doctor(folder=tmp_path))
    assert list(checks) == MACHINE
    for name in ("Python", "packages", "OpenCV", "Aravis", "ur_rtde"):
        assert checks[name].ok, checks[name]
    assert "numpy 2." in checks["packages"].detail
    assert "MB/s" in checks["disk speed"].detail


def test_a_folder_that_does_not_exist_is_a_failing_line(tmp_path: Path) -> None:
    checks = by_name(doctor(folder=tmp_path / "nowhere"))
    for name in ("disk space", "disk speed"):
        assert not checks[name].ok
        assert "No such file" in checks[name].detail


def test_more_bits_and_frames_need_a_faster_disk(tmp_path: Path) -> None:
    def needed(camera: CameraTable) -> int:
        checks = by_name(doctor(Rig(camera, RobotTable("127.0.0.41")), tmp_path))
        return int(checks["disk speed"].detail.split()[-1])

    slow = needed(CameraTable("127.0.0.41", pixel_format="BayerRG8", frame_rate=10.0))
    fast = needed(CameraTable("127.0.0.41", pixel_format="BayerRG12p", frame_rate=20.0))
    assert fast == pytest.approx(4 * slow, rel=0.05)


@pytest.mark.parametrize("address", ["127.0.0.41", "no-such-device.invalid"])
def test_devices_that_do_not_answer_are_failing_lines(tmp_path: Path, address: str) -> None:
    rig = Rig(CameraTable(address), RobotTable(address))
    began = time.monotonic()
    without = doctor(folder=tmp_path)
    between = time.monotonic()
    checks = by_name(doctor(rig, tmp_path))
    assert (time.monotonic() - between) - (between - began) < 10.0  # two devices, 5 s each
    assert list(checks) == [*(check.name for check in without), "camera", "arm"]
    assert not checks["camera"].ok
    assert address in checks["camera"].detail
    assert not checks["arm"].ok
    assert "RTDE, script, dashboard" in checks["arm"].detail


@pytest.mark.devices
def test_devices_that_answer_are_described(tmp_path: Path, simulated_camera: SimulatedCamera) -> None:
    host = "127.0.0.42"
    rig = Rig(CameraTable("127.0.0.1", frame_rate=50.0), RobotTable(host))
    with SimulatedRobot(host):
        before = joints(host)
        checks = by_name(doctor(rig, tmp_path))
        after = joints(host)
    asked = ["camera", "network", "camera stream", "camera clock", "arm", "arm clock"]
    assert list(checks) == [*MACHINE, *asked]
    assert "PHX050S-Q SIM00001" in checks["camera"].detail
    assert "256x192 BayerRG8" in checks["camera"].detail
    assert "lo to 127.0.0.1, MTU" in checks["network"].detail
    assert float(checks["camera stream"].detail.split()[0]) == pytest.approx(50.0, rel=0.2)
    assert "samples/s" in checks["arm clock"].detail
    for name in ("camera", "network", "arm"):
        assert checks[name].ok, checks[name]
    np.testing.assert_array_equal(before, after)  # asked, not moved


@pytest.mark.devices
def test_a_stream_that_loses_frames_fails(tmp_path: Path, simulated_camera: SimulatedCamera) -> None:
    simulated_camera.set_lost_ratio(0.02)
    try:
        checks = by_name(doctor(Rig(CameraTable("127.0.0.1"), RobotTable("127.0.0.43")), tmp_path))
    finally:
        simulated_camera.set_lost_ratio(0.0)
    assert not checks["camera stream"].ok
    assert "rmem_max" in checks["camera stream"].fix
