"""The doctor: it answers without devices, says the fix for what fails, and asks devices that are there."""

from __future__ import annotations

import time
from collections.abc import Iterable
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from acquisition.rig import CameraTable, Rig, RobotTable
from acquisition.robots.rtde import RtdeReader
from acquisition.simulation.camera import SimulatedCamera
from acquisition.simulation.robot import SimulatedRobot
from dataset.frames import RawFrame
from s2p3.doctor import doctor
from s2p3.doctor_check import Check
from s2p3.doctor_devices import stream_check

MACHINE = [
    *("Python", "packages", "OpenCV", "Aravis", "cameras in sight", "ur_rtde", "CPU", "GPU"),
    *("disk space", "disk speed"),
]

ASKED = [
    *("camera", "network", "camera stream", "camera clock", "packet test"),
    *("arm", "arm controller", "arm remote", "arm tool", "arm clock"),
]


def by_name(made: Iterable[Check]) -> dict[str, Check]:
    checks = list(made)
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
    without = list(doctor(folder=tmp_path))
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
    assert list(checks) == [*MACHINE, *ASKED]
    assert "PHX050S-Q SIM00001 at 127.0.0.1" in checks["cameras in sight"].detail
    assert "PHX050S-Q SIM00001" in checks["camera"].detail
    assert "256x192 BayerRG8" in checks["camera"].detail
    assert "lo to 127.0.0.1, MTU" in checks["network"].detail
    assert float(checks["camera stream"].detail.split()[0]) == pytest.approx(50.0, rel=0.2)
    assert "1500 bytes: 5 of 5 whole" in checks["packet test"].detail
    assert "RUNNING, safety NORMAL" in checks["arm controller"].detail
    assert checks["arm remote"].detail == "takes commands"
    assert "TCP [0.0, 0.0, 0.0, 0.0, 0.0, 0.0]" in checks["arm tool"].detail
    assert "samples/s" in checks["arm clock"].detail
    for name in ASKED:
        if "clock" not in name and "stream" not in name:  # those depend on how busy this computer is
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


@pytest.mark.devices
def test_an_arm_that_cannot_be_used_says_what_to_do(tmp_path: Path) -> None:
    host = "127.0.0.44"
    rig = Rig(CameraTable("127.0.0.44"), RobotTable(host, tcp_offset=(0.0, 0.0, 0.2, 0.0, 0.0, 0.0)))
    with SimulatedRobot(host) as arm:
        arm.command("local")
        arm.command("pstop")
        checks = by_name(doctor(rig, tmp_path))
    assert "PROTECTIVE_STOP" in checks["arm controller"].detail
    assert "clear the stop" in checks["arm controller"].fix
    assert "remote control" in checks["arm remote"].fix.lower()
    assert "the rig file says [0.0, 0.0, 0.2" in checks["arm tool"].detail
    assert "tcp_offset" in checks["arm tool"].fix


def test_a_frame_rate_that_is_not_reached_fails() -> None:
    pixels = np.zeros((2, 2), np.uint8)
    frames = [RawFrame(pixels, "Mono8", i, i * 150_000_000, i * 150_000_000, 1.0, 0.0, 0) for i in range(14)]
    assert stream_check(frames, None).ok
    assert stream_check(frames, 6.5).ok
    check = stream_check(frames, 10.0)
    assert not check.ok
    assert check.detail == "6.7 frames/s, 0 of 14 lost, 10 frames/s wanted"
    assert "exposure_us" in check.fix
