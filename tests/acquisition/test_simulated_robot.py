"""The simulated controller, driven by the unmodified ur_rtde client and read by its bare protocol."""

from __future__ import annotations

import itertools
import re
import socket
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from acquisition.kinematics import forward
from acquisition.robots.rtde import RtdeReader
from acquisition.simulation.controller import TRUE_TIME_VARIABLE
from acquisition.simulation.motion import joint_path
from acquisition.simulation.robot import SimulatedRobot
from dataset.errors import DeviceError
from dataset.transforms import SE3, rotation_error_deg, translation_error_mm

rtde_control = pytest.importorskip("rtde_control")
rtde_receive = pytest.importorskip("rtde_receive")
dashboard_client = pytest.importorskip("dashboard_client")

HOME = np.array([3.14, -1.57, 1.57, -1.57, -1.57, 0.0])


def home_plus(*turns: float) -> np.ndarray:
    """The home configuration with each joint turned further, radians."""
    return HOME + np.array(turns)


@pytest.fixture(scope="module")
def arm() -> Iterator[SimulatedRobot]:
    with SimulatedRobot("127.0.0.21") as simulator:
        yield simulator


@pytest.fixture(scope="module")
def state(arm: SimulatedRobot) -> Iterator[Any]:
    interface = rtde_receive.RTDEReceiveInterface(arm.host, 125.0)
    yield interface
    interface.disconnect()


@pytest.fixture
def control(arm: SimulatedRobot) -> Iterator[Any]:
    arm.command("clear")
    interface = rtde_control.RTDEControlInterface(arm.host)
    interface.setTcp([0.0] * 6)
    assert interface.moveJ(HOME.tolist(), 3.0, 20.0)
    yield interface
    interface.stopScript()
    interface.disconnect()


def read(arm: SimulatedRobot, variables: list[str], count: int, frequency_hz: float = 500.0) -> np.ndarray:
    with RtdeReader(arm.host, variables, frequency_hz) as reader:
        packages: list[bytes] = []
        while len(packages) < count:
            packages += reader.packages()
        return np.frombuffer(b"".join(packages), reader.dtype)


def drain(reader: RtdeReader) -> np.ndarray:
    """Every package up to now."""
    packages = reader.packages()
    while len(more := reader.packages()) > 3:
        packages += more
    return np.frombuffer(b"".join(packages + more), reader.dtype)


@pytest.mark.devices
class TestUnmodifiedClient:
    def test_reads_the_state(self, state: Any, control: Any) -> None:
        time.sleep(0.05)
        np.testing.assert_allclose(state.getActualQ(), HOME, atol=1e-9)
        np.testing.assert_allclose(state.getActualTCPPose(), forward(HOME).as_pose6(), atol=1e-9)
        assert state.getSafetyMode() == 1
        assert state.getRobotMode() == 7

    def test_joint_move_takes_the_time_of_its_trapezoid(self, arm: SimulatedRobot, control: Any) -> None:
        with RtdeReader(arm.host, ["actual_q"], 500.0) as reader:
            assert control.moveJ(home_plus(0.5, 0, 0, 0, 0, 0).tolist(), 1.0, 2.0)
            q = drain(reader)["actual_q"][:, 0]
        periods = np.count_nonzero(np.diff(q))
        assert 0.002 * periods == pytest.approx(0.5 / 1.0 + 1.0 / 2.0, abs=0.01)
        assert np.diff(q).max() / 0.002 == pytest.approx(1.0, rel=0.02)
        assert q[-1] == pytest.approx(HOME[0] + 0.5, abs=1e-6)

    def test_linear_move_keeps_to_the_line(self, arm: SimulatedRobot, control: Any, state: Any) -> None:
        start = np.array(state.getActualTCPPose())
        end = np.add(start, [0.05, 0.1, 0.05, 0, 0, 0])
        with RtdeReader(arm.host, ["actual_TCP_pose"], 500.0) as reader:
            assert control.moveL(end.tolist(), 0.25, 1.0, False)
            poses = drain(reader)["actual_TCP_pose"]
        along = (end - start)[:3] / np.linalg.norm((end - start)[:3])
        offset = poses[:, :3] - start[:3]
        assert len(poses) > 100
        assert np.linalg.norm(offset - np.outer(offset @ along, along), axis=1).max() < 1e-4
        speed = np.linalg.norm(np.diff(poses[:, :3], axis=0), axis=1) * 500
        assert speed.max() == pytest.approx(0.25, rel=0.02)

    def test_kinematic_questions(self, control: Any) -> None:
        offset = [0, 0, 0.1, 0, 0.2, 0]
        assert control.setTcp(offset)
        np.testing.assert_allclose(control.getTCPOffset(), offset)
        pose = forward(HOME) @ SE3.from_pose6(offset)
        np.testing.assert_allclose(
            control.getForwardKinematics(HOME.tolist(), offset), pose.as_pose6(), atol=1e-9
        )
        np.testing.assert_allclose(control.getInverseKinematics(pose.as_pose6().tolist()), HOME, atol=1e-6)
        assert not control.getInverseKinematicsHasSolution([3.0, 0, 0, 0, 0, 0])
        assert control.isJointsWithinSafetyLimits(HOME.tolist())
        assert not control.isJointsWithinSafetyLimits([7.0, 0, 0, 0, 0, 0])

    def test_path_with_blends_does_not_stop(self, arm: SimulatedRobot, control: Any) -> None:
        way = [[*home_plus(0.1 * i, 0.05 * np.sin(i), 0, 0, 0, 0), 0.8, 2.0, 0.02] for i in range(1, 8)]
        way[-1][-1] = 0.0
        with RtdeReader(arm.host, ["actual_q", "actual_qd"], 500.0) as reader:
            assert control.moveJ(way)
            records = drain(reader)
        q = records["actual_q"].astype(float)
        on_the_way = (q[:, 0] > HOME[0] + 0.1) & (q[:, 0] < HOME[0] + 0.6)
        assert np.abs(records["actual_qd"][on_the_way, 0]).min() > 0.4
        np.testing.assert_allclose(q[-1], way[-1][:6], atol=1e-5)

    def test_servo_speed_and_stop(self, control: Any, state: Any) -> None:
        for i in range(40):
            period = control.initPeriod()
            control.servoJ(home_plus(0.002 * i, 0, 0, 0, 0, 0).tolist(), 0, 0, 0.002, 0.1, 300)
            control.waitPeriod(period)
        assert control.servoStop()
        after_servo = state.getActualQ()[0]
        assert after_servo > HOME[0] + 0.01
        assert control.speedJ([-0.2, 0, 0, 0, 0, 0], 1.0, 0.0)
        time.sleep(0.4)
        assert control.speedStop()
        time.sleep(0.05)
        assert state.getActualQ()[0] < after_servo - 0.02
        assert np.abs(state.getActualQd()).max() < 1e-6

    def test_asynchronous_move_reports_progress_and_stops(self, control: Any, state: Any) -> None:
        assert control.moveJ(home_plus(1.5, 0, 0, 0, 0, 0).tolist(), 0.5, 1.0, True)
        time.sleep(0.4)
        assert control.getAsyncOperationProgressEx().isAsyncOperationRunning()
        control.stopJ(3.0)
        time.sleep(0.05)
        assert not control.getAsyncOperationProgressEx().isAsyncOperationRunning()
        assert HOME[0] < state.getActualQ()[0] < HOME[0] + 1.0

    def test_upper_register_range(self, arm: SimulatedRobot, state: Any) -> None:
        arm.command("clear")
        flags = rtde_control.RTDEControlInterface.FLAG_UPLOAD_SCRIPT
        flags |= rtde_control.RTDEControlInterface.FLAG_UPPER_RANGE_REGISTERS
        upper = rtde_control.RTDEControlInterface(arm.host, 500.0, flags)
        assert upper.moveJ((HOME + 0.05).tolist(), 3.0, 20.0)
        time.sleep(0.05)
        np.testing.assert_allclose(state.getActualQ(), HOME + 0.05, atol=1e-6)
        upper.stopScript()
        upper.disconnect()

    def test_protective_stop_is_unlocked_through_the_dashboard(
        self, arm: SimulatedRobot, control: Any
    ) -> None:
        dashboard = dashboard_client.DashboardClient(arm.host)
        dashboard.connect()
        arm.command("pstop")
        time.sleep(0.05)
        assert not control.moveJ((HOME + 0.1).tolist(), 1.0, 2.0)
        assert "PROTECTIVE_STOP" in dashboard.safetymode()
        dashboard.unlockProtectiveStop()
        assert control.reuploadScript()
        time.sleep(0.3)
        assert control.moveJ((HOME + 0.1).tolist(), 3.0, 20.0)
        dashboard.disconnect()

    def test_the_table_stops_the_arm(self, arm: SimulatedRobot, control: Any, state: Any) -> None:
        down = np.array(state.getActualTCPPose()) - [0, 0, 0.6, 0, 0, 0]
        assert not control.moveL(down.tolist(), 1.0, 3.0, False)
        time.sleep(0.2)
        assert state.isProtectiveStopped()
        assert "table" in arm.command("state")
        assert 0 <= state.getActualTCPPose()[2] < 0.02


@pytest.mark.devices
def test_every_package_arrives_and_knows_its_true_time(arm: SimulatedRobot) -> None:
    before = time.monotonic()
    records = read(arm, ["timestamp", TRUE_TIME_VARIABLE], 400)
    np.testing.assert_allclose(np.diff(records["timestamp"]), 0.002, atol=1e-6)
    np.testing.assert_allclose(np.diff(records[TRUE_TIME_VARIABLE]), 0.002, atol=1e-6)
    assert (
        before - 0.6 < records[TRUE_TIME_VARIABLE][0] <= records[TRUE_TIME_VARIABLE][-1] <= time.monotonic()
    )


@pytest.mark.devices
def test_a_slower_client_gets_every_fourth_package(arm: SimulatedRobot) -> None:
    np.testing.assert_allclose(np.diff(read(arm, ["timestamp"], 50, 125.0)["timestamp"]), 0.008, atol=1e-6)


@pytest.mark.devices
def test_unknown_variable_is_named(arm: SimulatedRobot) -> None:
    with pytest.raises(DeviceError, match="does not offer joint_smell"):
        RtdeReader(arm.host, ["timestamp", "joint_smell"], 125.0)


@pytest.mark.devices
def test_drift_of_the_controllers_clock() -> None:
    with SimulatedRobot("127.0.0.22", rate_hz=250, drift_ppm=400) as drifting:
        records = read(drifting, ["timestamp", TRUE_TIME_VARIABLE], 250)
    rate = np.ptp(records["timestamp"]) / np.ptp(records[TRUE_TIME_VARIABLE])
    assert rate == pytest.approx(1 + 400e-6, abs=1e-7)


@pytest.mark.devices
def test_late_packages_stay_in_order(arm: SimulatedRobot) -> None:
    arm.command("slow 0.05")
    try:
        stamps = read(arm, ["timestamp"], 200)["timestamp"]
    finally:
        arm.command("slow 0")
    np.testing.assert_allclose(np.diff(stamps), 0.002, atol=1e-6)


@pytest.mark.devices
def test_second_arm_on_the_same_address_is_refused(arm: SimulatedRobot) -> None:
    with pytest.raises(DeviceError, match=r"Use another --host"), SimulatedRobot(arm.host):
        pass


@pytest.mark.devices
@pytest.mark.parametrize(
    ("line", "message"),
    [
        ("explode", "unknown command 'explode'"),
        ("guide 1 2 3", "'guide' takes 6 numbers, not 3"),
        ("drift fast", "could not convert"),
        ("slider 2", "from 0 to 1, not to 2"),
    ],
)
def test_a_fault_that_makes_no_sense_is_refused(arm: SimulatedRobot, line: str, message: str) -> None:
    with pytest.raises(DeviceError, match=message):
        arm.command(line)


@pytest.mark.devices
def test_every_fault_is_in_the_guide(arm: SimulatedRobot) -> None:
    guide = (Path(__file__).parents[2] / "docs" / "simulated-lab.md").read_text(encoding="utf-8")
    with pytest.raises(DeviceError) as refusal:
        arm.command("?")
    verbs = str(refusal.value).partition("; use ")[2].replace("or ", "").split(", ")
    assert len(verbs) > 15
    assert [verb for verb in verbs if not re.search(rf"`{verb}[ `]", guide)] == []


@pytest.mark.devices
def test_drift_begins_when_it_is_told_to(arm: SimulatedRobot) -> None:
    arm.command("drift 2000")
    try:
        records = read(arm, ["timestamp", TRUE_TIME_VARIABLE], 200)
    finally:
        arm.command("drift 0")
    rate = np.ptp(records["timestamp"]) / np.ptp(records[TRUE_TIME_VARIABLE])
    assert rate == pytest.approx(1.002, abs=1e-6)


@pytest.mark.devices
def test_a_restart_forgets_everything_but_the_joints(arm: SimulatedRobot) -> None:
    arm.command("tcp 0 0 0.1 0 0 0")
    arm.command("restart")
    (record, *_) = read(arm, ["timestamp", "tcp_offset", "actual_q", "runtime_state"], 1)
    assert record["timestamp"] < 1010
    np.testing.assert_array_equal(record["tcp_offset"], np.zeros(6))
    assert record["runtime_state"] == 1


@pytest.mark.devices
def test_the_unmodified_client_is_refused_in_local_mode(arm: SimulatedRobot) -> None:
    arm.command("local")
    try:
        with pytest.raises(RuntimeError, match="remote control"):
            rtde_control.RTDEControlInterface(arm.host)
    finally:
        arm.command("remote")


@pytest.mark.devices
def test_a_client_that_does_not_read_holds_nobody_up(arm: SimulatedRobot) -> None:
    lazy = RtdeReader(arm.host, ["timestamp"] + [f"output_double_register_{i}" for i in range(48)], 500.0)
    try:
        stamps = read(arm, ["timestamp"], 500)["timestamp"]
        np.testing.assert_allclose(np.diff(stamps), 0.002, atol=1e-6)
    finally:
        lazy.close()


@pytest.mark.devices
def test_garbage_on_a_port_does_not_hurt(arm: SimulatedRobot) -> None:
    for port in (30004, 30003, 29999):
        with socket.create_connection((arm.host, port), 1.0) as connection:
            connection.sendall(b"\x00\x01nonsense\n" * 20)
    assert len(read(arm, ["timestamp"], 20)) >= 20


def test_blended_path_rounds_corners_within_the_blend() -> None:
    corner, end = home_plus(0.4, 0, 0, 0, 0, 0), home_plus(0.4, 0.3, 0, 0, 0, 0)
    motion = joint_path(HOME, [corner, end], [0.5, 0.5], [1.0, 1.0], [0.03, 0.0])
    assert motion is not None
    q, qd = HOME, np.zeros(6)
    steps = []
    for _ in itertools.count():
        q, qd, ended = motion.advance(q, qd, 0.002)
        steps.append(q)
        if ended:
            break
    path = np.array(steps)
    nearest = translation_error_mm(forward(path), forward(corner)).min()
    assert 0.5 < nearest < 30
    assert rotation_error_deg(forward(path[-1]), forward(end)) < 1e-6
    assert np.abs(np.diff(path, axis=0)).max() / 0.002 < 0.5 * 1.01
    leading = np.abs(np.diff(path, axis=0)).max(axis=1)[150:-300]
    assert leading.min() / 0.002 > 0.05  # it never stops on the way
