"""The UR driver against the simulated controller: limits, trace, tool and payload, connecting."""

from __future__ import annotations

import contextlib
import os
import re
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from acquisition.kinematics import forward
from acquisition.recorder import NO_CAMERA
from acquisition.robot import EmergencyStop, ProtectiveStop, Robot, RobotConfig
from acquisition.robots.limits import MotionLimits
from acquisition.robots.stream import safety_error
from acquisition.robots.ur import UrRobot
from acquisition.robots.ur_receiver import UrReceiver
from acquisition.simulation.robot import SimulatedRobot
from acquisition.trace_log import TraceLog
from dataset.errors import DeviceError, ToolkitError
from dataset.frames import RobotTrace
from dataset.session import Session, SessionWriter
from dataset.transforms import SE3, translation_error_mm

TCP = (0.0, 0.0, 0.1, 0.0, 0.3, 0.0)
HOME = np.array([3.14, -1.57, 1.57, -1.57, -1.57, 0.0])
PERIOD_S = 0.002  # of the simulated control loop, whatever the load of the host

pytest.importorskip("rtde_control")


CONNECT_AND_MOVE = """
import os, pathlib, threading
from acquisition.robot import RobotConfig
from acquisition.robots.ur import UrRobot
robot = UrRobot(RobotConfig("127.0.0.28", joint_speed=0.1))
tasks = pathlib.Path(f"/proc/{os.getpid()}/task").iterdir()
child = [pid for task in tasks for pid in (task / "children").read_text().split()]
threading.Timer(0.5, lambda: print(*child, flush=True)).start()
robot.move_joints(robot.sample().q + 0.5)
"""


def home_plus(*turns: float) -> np.ndarray:
    """The home configuration with each joint turned further, radians."""
    return HOME + np.array(turns)


def config(arm: SimulatedRobot, **changes: object) -> RobotConfig:
    fast = {"joint_speed": 2.0, "joint_acceleration": 10.0, "speed": 0.8, "acceleration": 4.0}
    calm = {"silence_s": 1.0, "tcp_offset": TCP}  # of a simulator on a busy host
    return RobotConfig(arm.host, **{**fast, **calm, **changes})  # type: ignore[arg-type]


def children() -> set[int]:
    """Process ids of this process's children."""
    found: set[int] = set()
    for task in Path(f"/proc/{os.getpid()}/task").iterdir():
        with contextlib.suppress(FileNotFoundError):  # a thread that has just ended
            found.update(int(pid) for pid in (task / "children").read_text().split())
    return found


def running(pid: int) -> bool:
    """Whether a process exists and is more than an entry that nobody has collected yet."""
    try:
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] != "Z"
    except FileNotFoundError:
        return False


def tool_speed(trace: RobotTrace) -> np.ndarray:
    return np.linalg.norm(np.diff(trace.pose[:, :3], axis=0), axis=1) / PERIOD_S


@pytest.fixture(scope="module")
def arm() -> Iterator[SimulatedRobot]:
    with SimulatedRobot("127.0.0.23") as simulator:
        yield simulator


@pytest.fixture(scope="module")
def shared(arm: SimulatedRobot) -> Iterator[UrRobot]:
    with UrRobot(config(arm)) as connected:
        yield connected


@pytest.fixture
def robot(arm: SimulatedRobot, shared: UrRobot) -> UrRobot:
    shared.move_joints(HOME)
    return shared


@pytest.mark.devices
class TestLimits:
    @pytest.mark.parametrize("verb", ["move_joints", "follow"])
    def test_joint_motions_respect_the_speed_of_the_tool(self, arm: SimulatedRobot, verb: str) -> None:
        with UrRobot(config(arm, speed=0.1)) as slow:
            slow.move_joints(HOME)
            slow.start_trace()
            if verb == "move_joints":
                slow.move_joints(home_plus(0.2, 0.05, 0, 0, 0, 0))
            else:
                slow.follow([home_plus(0.1, 0, 0, 0, 0, 0), home_plus(0.2, 0.05, 0, 0, 0, 0)])
            trace = slow.stop_trace()
        assert 0.08 < tool_speed(trace).max() < 0.101

    def test_a_long_way_of_the_tool_counts_whole_not_as_the_chord(self) -> None:
        limits = MotionLimits(RobotConfig("127.0.0.1", speed=0.1, joint_speed=3.0), np.zeros(6))
        stretched = np.array([0, -0.1, 0, 0, 0, 0])
        (speed,) = limits.joint_speeds(stretched, np.array([[2 * np.pi, -0.1, 0, 0, 0, 0]]))
        radius = np.linalg.norm(forward(stretched).translation[:2])
        assert speed == pytest.approx(0.1 / radius, rel=0.01)  # the chord of a whole turn would be nothing

    def test_an_arm_outside_the_workspace_may_move_into_it(self) -> None:
        limits = MotionLimits(RobotConfig("127.0.0.1", workspace=((-1, -1, 0.3), (1, 1, 1))), np.zeros(6))
        low, high = home_plus(0, 0.5, 0, 0, 0, 0), HOME
        limits.check_joint_path(low, high[None])
        with pytest.raises(ToolkitError, match="outside the workspace"):
            limits.check_joint_path(high, low[None])

    def test_the_way_into_the_workspace_leads_nowhere_else(self) -> None:
        limits = MotionLimits(RobotConfig("127.0.0.1", workspace=((-1, -1, 0.3), (1, 1, 0.9))), np.zeros(6))
        upright, bent = np.array([3.14, -1.57, 0, -1.57, 0, 0]), HOME
        assert forward(upright).translation[2] > 0.9
        limits.check_joint_path(upright, bent[None])
        below = home_plus(0, 1.2, 0, 0, 0, 0)
        with pytest.raises(ToolkitError, match="outside the workspace"):
            limits.check_joint_path(upright, np.array([below, bent]))  # in, out at the bottom, and in again
        deep = home_plus(0, 0.6, 0, 0, 0, 0)
        with pytest.raises(ToolkitError, match="outside the workspace"):
            limits.check_joint_path(deep, np.array([below, bent]))  # down first


@pytest.mark.devices
class TestTrace:
    @pytest.mark.parametrize("frequency_hz", [125.0, 500.0])
    def test_every_sample_is_there(self, arm: SimulatedRobot, frequency_hz: float) -> None:
        with UrReceiver(config(arm, tcp_offset=None, frequency_hz=frequency_hz)) as reader:
            reader.start_trace()
            time.sleep(0.5)
            trace = reader.stop_trace()
        assert len(trace) > 0.3 * frequency_hz
        np.testing.assert_allclose(np.diff(trace.robot_time_s), 1 / frequency_hz, atol=1e-6)
        assert (trace.safety_bits == 1).all()


@pytest.mark.devices
class TestToolAndPayload:
    def test_pose_is_that_of_the_configured_tool(self, robot: UrRobot) -> None:
        np.testing.assert_allclose(robot.tcp_offset, TCP)
        sample = robot.sample()
        assert translation_error_mm(sample.T_base_tcp, forward(sample.q) @ SE3.from_pose6(TCP)) < 1e-6

    def test_the_flange_is_right_whatever_was_asked_before(self, robot: UrRobot) -> None:
        """The vendor's own question for the flange answers with the question before; ours is computed."""
        for turn in np.linspace(0, 0.1, 5):
            asked = robot.inverse_kinematics(robot.sample().T_base_tcp, robot.sample().q + turn)
            assert asked is not None
            sample = robot.sample()
            flange = sample.T_base_tcp @ SE3.from_pose6(robot.tcp_offset).inverse()
            assert translation_error_mm(flange, forward(sample.q)) < 1e-6

    def test_the_active_tool_is_learned(self, arm: SimulatedRobot, robot: UrRobot) -> None:
        with UrRobot(config(arm, tcp_offset=None)) as second:
            np.testing.assert_allclose(second.tcp_offset, TCP)
        with UrReceiver(config(arm, tcp_offset=None)) as reader:
            np.testing.assert_allclose(reader.tcp_offset, TCP)

    def test_payload_is_that_of_the_pendant(self, arm: SimulatedRobot, robot: UrRobot) -> None:
        arm.command("payload 1.25 0.01 -0.02 0.05")
        time.sleep(0.05)
        np.testing.assert_allclose(robot.payload, [1.25, 0.01, -0.02, 0.05])
        arm.command("payload 0 0 0 0")

    def test_a_session_holds_tool_and_payload(
        self, arm: SimulatedRobot, robot: UrRobot, tmp_path: Path
    ) -> None:
        arm.command("payload 0.8 0 0 0.04")
        with (
            UrReceiver(config(arm)) as reader,
            SessionWriter(tmp_path / "s.h5", "tool_tip", NO_CAMERA) as writer,
            TraceLog(reader, writer),
        ):
            time.sleep(0.2)
        with Session.open(tmp_path / "s.h5") as session:
            assert session.payload is not None
            np.testing.assert_allclose(session.payload, [0.8, 0, 0, 0.04])
            np.testing.assert_allclose(session.tcp_offset, TCP)
        arm.command("payload 0 0 0 0")

    def test_an_arm_lost_at_the_very_end_leaves_its_samples(
        self, arm: SimulatedRobot, robot: UrRobot, tmp_path: Path
    ) -> None:
        def record() -> None:
            with (
                UrReceiver(config(arm)) as reader,
                SessionWriter(tmp_path / "s.h5", "tool_tip", NO_CAMERA) as writer,
                TraceLog(reader, writer),
            ):
                time.sleep(0.3)
                arm.command("tcp 0 0 0.2 0 0.3 0")
                time.sleep(0.1)

        with pytest.raises(DeviceError, match="incomplete after"):
            record()
        arm.command(f"tcp {' '.join(map(str, TCP))}")
        with Session.open(tmp_path / "s.h5") as session:
            assert not session.complete
            assert session.robot is not None
            assert len(session.robot) > 100

    def test_a_wrong_tool_is_noticed(self, arm: SimulatedRobot, robot: UrRobot) -> None:
        with pytest.raises(DeviceError, match=r"the rig file says .*; check tcp_offset"):
            UrReceiver(config(arm, tcp_offset=(0.0, 0.0, 0.101, 0.0, 0.3, 0.0)))

    def test_a_tool_changed_during_a_recording_ends_it(self, arm: SimulatedRobot, robot: UrRobot) -> None:
        with UrReceiver(config(arm)) as reader:
            reader.start_trace()
            time.sleep(0.1)
            arm.command("tcp 0 0 0.1001 0 0.3 0")
            time.sleep(0.1)
            with pytest.raises(DeviceError, match=r"changed from .* 0\.1,.* to .* 0\.1001,.* record again"):
                reader.sample()
            trace = reader.take_trace()  # what came before is kept, and nothing of the other tool
        assert len(trace) > 20
        tool = np.linalg.norm(trace.pose[:, :3] - forward(trace.q).translation, axis=1)
        assert np.ptp(tool) < 1e-9

    def test_a_tool_changed_while_nothing_is_recorded_is_noticed(
        self, arm: SimulatedRobot, robot: UrRobot
    ) -> None:
        with UrReceiver(config(arm)) as reader:
            arm.command("tcp 0 0 0.2 0 0.3 0")
            time.sleep(0.1)
            with pytest.raises(DeviceError, match=r"was changed from .* connect again, and calibrate"):
                reader.sample()
        arm.command(f"tcp {' '.join(map(str, TCP))}")

    def test_a_tool_changed_between_moves_stops_the_next(self, arm: SimulatedRobot, robot: UrRobot) -> None:
        arm.command("tcp 0 0 0.2 0 0.3 0")
        with pytest.raises(DeviceError, match=r"was changed from .* connect again, and calibrate"):
            robot.move_joints(HOME + 0.1)
        arm.command(f"tcp {' '.join(map(str, TCP))}")
        robot.move_joints(HOME)

    def test_a_tool_changed_while_no_program_ran_stops_the_next_move(self, arm: SimulatedRobot) -> None:
        with UrRobot(config(arm, tcp_offset=None)) as robot:  # the tool is whatever is active
            before = robot.tcp_offset
            arm.command("local")  # which ends the program
            arm.command("tcp 0 0 0.2 0 0.3 0")
            arm.command("remote")
            with pytest.raises(DeviceError, match=r"was changed from .* connect again, and calibrate"):
                robot.move_joints(HOME + 0.1)
            np.testing.assert_array_equal(robot.tcp_offset, before)
        arm.command(f"tcp {' '.join(map(str, TCP))}")

    def test_software_that_tells_neither_tool_nor_payload(self) -> None:
        with SimulatedRobot("127.0.0.24", software=(5, 4, 0)) as old:
            with pytest.raises(ToolkitError, match="tcp_offset is missing, and this controller's software"):
                UrReceiver(config(old, tcp_offset=None))
            with pytest.raises(DeviceError, match=r"100 mm .* check tcp_offset"):
                UrReceiver(config(old))  # the pose contradicts it
            with UrRobot(config(old)) as robot:  # which makes the tool of the rig file active
                assert np.isnan(robot.payload).all()
                with UrReceiver(config(old)) as reader:
                    old.command("tcp 0 0 0.15 0 0.3 0")
                    time.sleep(0.1)
                    with pytest.raises(DeviceError, match=r"50 mm .* check tcp_offset"):
                        reader.sample()
                with pytest.raises(DeviceError, match="was changed"):
                    robot.move_joints(HOME + 0.1)


@pytest.mark.devices
class TestConnecting:
    def test_nobody_there(self) -> None:
        with pytest.raises(DeviceError, match=r"no arm answers at 127\.0\.0\.99:30004 .*check"):
            UrRobot(RobotConfig("127.0.0.99"))
        with pytest.raises(DeviceError, match=r"no arm answers at 127\.0\.\.99"):
            UrRobot(RobotConfig("127.0..99"))

    def test_somebody_who_is_no_controller(self) -> None:
        with socket.create_server(("127.0.0.27", 30004)) as server:

            def chatter() -> None:
                connection, _ = server.accept()
                connection.sendall(bytes(64))
                connection.recv(1024)
                connection.close()

            thread = threading.Thread(target=chatter)
            thread.start()
            with pytest.raises(DeviceError, match="Universal Robots"):
                UrRobot(RobotConfig("127.0.0.27"))
            thread.join()

    def test_closing_leaves_nothing_behind_and_can_be_repeated(self, arm: SimulatedRobot) -> None:
        processes, threads = children(), threading.active_count()
        robot = UrRobot(config(arm))
        assert children() > processes
        robot.close()
        robot.close()
        assert children() == processes
        assert threading.active_count() <= threads

    @pytest.mark.parametrize("controller_dies_too", [False, True])
    def test_killing_the_toolkit_leaves_no_process(self, controller_dies_too: bool) -> None:
        with SimulatedRobot("127.0.0.28") as simulator:
            toolkit = subprocess.Popen(
                [sys.executable, "-c", CONNECT_AND_MOVE], stdout=subprocess.PIPE, text=True
            )
            assert toolkit.stdout is not None
            motion = int(toolkit.stdout.readline())
            if controller_dies_too:
                simulator.kill()
            toolkit.kill()
            toolkit.wait()
            toolkit.stdout.close()
            deadline = time.monotonic() + 10
            while running(motion) and time.monotonic() < deadline:
                time.sleep(0.1)
            assert not running(motion)

    def test_hand_guided_reading_works_in_local_mode_and_controls_nothing(
        self, arm: SimulatedRobot, robot: UrRobot
    ) -> None:
        def control_connections() -> str:
            return re.findall(r" connections=\d+ control_connections=(\d+)", arm.command("state"))[0]

        arm.command("local")
        arm.command(f"tcp {' '.join(map(str, TCP))}")
        before, processes = control_connections(), children()
        with UrReceiver(config(arm)) as reader:
            assert not isinstance(reader, Robot)  # it has no verb that could move anything
            reader.start_trace()
            arm.command(f"guide {' '.join(map(str, HOME + 0.1))}")
            time.sleep(0.2)
            reader.wait_until_still()
            assert np.ptp(reader.stop_trace().q, axis=0).min() == pytest.approx(0.1, abs=1e-3)
            assert children() == processes
        assert control_connections() == before
        arm.command("remote")


@pytest.mark.parametrize(
    ("bits", "kind"),
    [
        (0b1, None),
        (0b11, None),  # reduced mode
        (1 << 2 | 1 << 10, ProtectiveStop),
        (1 << 4 | 1 << 10, ProtectiveStop),
        (1 << 5, EmergencyStop),
        (1 << 6 | 1 << 7 | 1 << 10, EmergencyStop),
        (1 << 9, DeviceError),
    ],
)
def test_safety_words(bits: int, kind: type[DeviceError] | None) -> None:
    error = safety_error(bits, "the arm")
    assert type(error) is (type(None) if kind is None else kind)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"joint_speed": 4.0}, "joint_speed = 4"),
        ({"speed": 0.0}, "speed = 0"),
        ({"frequency_hz": 1000.0}, "frequency_hz = 1000"),
        ({"silence_s": 0.0}, "silence_s = 0"),
        ({"tcp_offset": (0.0, 0.1)}, "tcp_offset has 2 numbers"),
        ({"workspace": ((0, 0, 0), (1, 1, 0))}, "workspace"),
    ],
)
def test_impossible_configurations(changes: dict[str, object], message: str) -> None:
    with pytest.raises(ToolkitError, match=message):
        RobotConfig("127.0.0.1", **changes)  # type: ignore[arg-type]
