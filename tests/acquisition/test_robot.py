"""The arm's driver against the simulated controller: what works, and what a user sees when it does not."""

from __future__ import annotations

import contextlib
import os
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pytest

from acquisition.clocks import fit_clock
from acquisition.kinematics import forward
from acquisition.robot import EmergencyStop, MotionStopped, ProtectiveStop, RobotConfig
from acquisition.robots.stream import safety_error
from acquisition.robots.ur import UrReceiver, UrRobot
from acquisition.simulation.robot import SimulatedRobot
from dataset.errors import DeviceError, ToolkitError
from dataset.frames import RobotTrace
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
    return RobotConfig(arm.host, **{**fast, "tcp_offset": TCP, **changes})  # type: ignore[arg-type]


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


def soon(action: Callable[[], object], delay_s: float) -> threading.Timer:
    timer = threading.Timer(delay_s, action)
    timer.start()
    return timer


@pytest.fixture(scope="module")
def arm() -> Iterator[SimulatedRobot]:
    with SimulatedRobot("127.0.0.23") as simulator:
        yield simulator


@pytest.fixture(scope="module")
def other_arm() -> Iterator[SimulatedRobot]:
    """One whose connections may be broken."""
    with SimulatedRobot("127.0.0.24") as simulator:
        yield simulator


@pytest.fixture(scope="module")
def shared(arm: SimulatedRobot) -> Iterator[UrRobot]:
    with UrRobot(config(arm)) as connected:
        yield connected


@pytest.fixture
def robot(arm: SimulatedRobot, shared: UrRobot) -> UrRobot:
    arm.command("clear")
    arm.command("unstall")
    time.sleep(0.05)
    shared.move_joints(HOME)
    return shared


@pytest.mark.devices
class TestMotion:
    def test_joint_move_arrives_and_rests(self, robot: UrRobot) -> None:
        target = home_plus(0.3, -0.1, 0.1, 0, 0.2, -0.4)
        robot.move_joints(target)
        robot.wait_until_still()
        np.testing.assert_allclose(robot.sample().q, target, atol=1e-6)

    def test_pose_is_that_of_the_configured_tool(self, robot: UrRobot) -> None:
        np.testing.assert_allclose(robot.tcp_offset, TCP)
        sample = robot.sample()
        assert translation_error_mm(sample.T_base_tcp, forward(sample.q) @ SE3.from_pose6(TCP)) < 1e-6

    def test_linear_move_is_straight(self, robot: UrRobot) -> None:
        start = robot.sample().T_base_tcp
        target = SE3(start.rotation, np.add(start.translation, [0.05, -0.1, 0.08]))
        robot.start_trace()
        robot.move_linear(target)
        trace = robot.stop_trace()
        assert translation_error_mm(robot.sample().T_base_tcp, target) < 0.01
        offset = trace.pose[:, :3] - start.translation
        along = target.translation - start.translation
        along /= np.linalg.norm(along)
        assert np.linalg.norm(offset - np.outer(offset @ along, along), axis=1).max() < 1e-4

    def test_following_a_path_never_stops_and_passes_near_every_waypoint(self, robot: UrRobot) -> None:
        angle = np.linspace(0, 2 * np.pi, 25)
        path = HOME + np.stack([0.3 * np.sin(angle), 0.2 * (1 - np.cos(angle)), *np.zeros((4, 25))], axis=1)
        robot.move_joints(path[0])
        robot.start_trace()
        robot.follow(path[1:], blend=0.02)
        trace = robot.stop_trace()
        np.testing.assert_allclose(trace.q[-1], path[-1], atol=1e-4)
        away = np.abs(trace.q[None] - path[1:, None]).max(axis=-1).min(axis=1)
        assert away.max() < 0.03
        speed = np.abs(np.diff(trace.q, axis=0)).max(axis=1) / PERIOD_S
        moving = np.flatnonzero(speed > 0.05)
        assert speed[moving[0] : moving[-1]].min() > 0.02
        assert tool_speed(trace).max() < 0.8 * 1.1

    def test_path_respects_the_tool_speed(self, arm: SimulatedRobot) -> None:
        with UrRobot(config(arm, speed=0.1)) as slow:
            slow.move_joints(HOME)
            slow.start_trace()
            slow.follow([home_plus(0.1, 0, 0, 0, 0, 0), home_plus(0.2, 0.05, 0, 0, 0, 0)])
            trace = slow.stop_trace()
        assert 0.08 < tool_speed(trace).max() < 0.115

    def test_inverse_kinematics(self, robot: UrRobot) -> None:
        sample = robot.sample()
        q = robot.inverse_kinematics(sample.T_base_tcp, sample.q + 0.1)
        assert q is not None
        np.testing.assert_allclose(q, sample.q, atol=1e-5)
        assert (
            robot.inverse_kinematics(SE3(sample.T_base_tcp.rotation, np.array([2.0, 0, 0])), sample.q) is None
        )
        robot.move_joints(HOME + 0.01)  # the program survived the question

    def test_stop_from_another_thread(self, robot: UrRobot) -> None:
        stopper = soon(robot.stop, 0.3)
        with pytest.raises(MotionStopped):
            robot.move_joints(home_plus(1.8, 0, 0, 0, 0, 0))
        stopper.join()
        assert 0.01 < robot.sample().q[0] - HOME[0] < 1.7
        robot.wait_until_still()

    def test_targets_outside_the_workspace_move_nothing(self, robot: UrRobot) -> None:
        pose = robot.sample().T_base_tcp
        with pytest.raises(
            ToolkitError, match=r"outside the workspace .*workspace under \[robot\] in the rig file"
        ):
            robot.move_linear(SE3(pose.rotation, pose.translation - [0, 0, 0.6]))
        with pytest.raises(ToolkitError, match="outside the workspace"):
            robot.move_joints(home_plus(0, 1.0, 0.5, 0, 0, 0))
        with pytest.raises(
            ToolkitError, match="outside the workspace"
        ):  # both ends are inside, the way is not
            robot.follow([HOME, home_plus(0, 1.0, 0.5, 0, 0, 0), HOME])
        np.testing.assert_allclose(robot.sample().q, HOME, atol=1e-6)

    @pytest.mark.parametrize("q", [np.zeros(5), np.full(6, 90.0), np.full(6, np.nan)])
    def test_wrong_joint_angles(self, robot: UrRobot, q: np.ndarray) -> None:
        with pytest.raises(ToolkitError, match="joint angles"):
            robot.move_joints(q)


@pytest.mark.devices
class TestTrace:
    def test_every_sample_is_there(self, robot: UrRobot) -> None:
        robot.start_trace()
        robot.move_joints(HOME + 0.1)
        trace = robot.stop_trace()
        assert len(trace) > 50
        np.testing.assert_allclose(np.diff(trace.robot_time_s), 0.002, atol=1e-6)
        assert (np.diff(trace.host_time_ns) >= 0).all()
        assert (trace.safety_bits == 1).all()
        np.testing.assert_allclose(trace.poses[0].as_pose6(), trace.pose[0], atol=1e-9)

    def test_clock_of_the_trace(self, robot: UrRobot) -> None:
        robot.start_trace()
        time.sleep(1.0)
        trace = robot.stop_trace()
        fit = fit_clock(np.rint(1e9 * trace.robot_time_s).astype(np.int64), trace.host_time_ns)
        assert fit.sigma_ns < 5e6

    def test_misuse(self, robot: UrRobot) -> None:
        with pytest.raises(DeviceError, match="start one first"):
            robot.stop_trace()
        robot.start_trace()
        with pytest.raises(DeviceError, match="already running"):
            robot.start_trace()
        robot.stop_trace()


@pytest.mark.devices
class TestFaults:
    @pytest.mark.parametrize(("fault", "error"), [("pstop", ProtectiveStop), ("estop", EmergencyStop)])
    def test_stop_during_a_move(
        self, arm: SimulatedRobot, robot: UrRobot, fault: str, error: type[DeviceError]
    ) -> None:
        timer = soon(lambda: arm.command(fault), 0.3)
        with pytest.raises(error, match="start again"):
            robot.move_joints(home_plus(1.8, 0, 0, 0, 0, 0))
        timer.join()
        with pytest.raises(error):  # and it stays so until somebody clears it
            robot.move_joints(HOME)
        assert robot.sample().safety_bits != 1
        arm.command("clear")
        time.sleep(0.05)
        robot.move_joints(HOME)

    def test_silence_is_not_taken_for_rest(self, arm: SimulatedRobot, robot: UrRobot) -> None:
        arm.command("stall")
        time.sleep(0.7)
        with pytest.raises(DeviceError, match="sent nothing for"):
            robot.sample()
        arm.command("unstall")
        time.sleep(0.1)
        assert robot.sample().safety_bits == 1

    def test_interrupted_link_ends_the_trace_with_an_error(self, other_arm: SimulatedRobot) -> None:
        with UrReceiver(config(other_arm, tcp_offset=(0.0,) * 6)) as reader:
            reader.start_trace()
            other_arm.command("drop")
            time.sleep(0.2)
            with pytest.raises(DeviceError, match="lost the arm"):
                reader.sample()
            with pytest.raises(DeviceError, match="incomplete after"):
                reader.stop_trace()

    def test_restarted_controller(self, other_arm: SimulatedRobot) -> None:
        with UrReceiver(config(other_arm, tcp_offset=(0.0,) * 6)) as reader:
            other_arm.command("jump -5")
            time.sleep(0.2)
            with pytest.raises(DeviceError, match="controller restarted"):
                reader.sample()

    def test_killed_during_a_move(self) -> None:
        before = children()
        with SimulatedRobot("127.0.0.25") as doomed, UrRobot(config(doomed)) as robot:
            timer = soon(doomed.kill, 0.3)
            started = time.monotonic()
            with pytest.raises(DeviceError, match="lost the arm"):
                robot.move_joints(home_plus(1.8, 0, 0, 0, 0, 0))
            assert time.monotonic() - started < 5
            timer.join()
        assert children() == before


@pytest.mark.devices
class TestConnecting:
    def test_nobody_there(self) -> None:
        with pytest.raises(DeviceError, match=r"no arm answers at 127\.0\.0\.99:30004 .*check"):
            UrRobot(RobotConfig("127.0.0.99"))

    def test_somebody_who_says_nothing(self) -> None:
        with socket.create_server(("127.0.0.26", 30004)):
            started = time.monotonic()
            with pytest.raises(DeviceError, match=r"silent for .* check"):
                UrRobot(RobotConfig("127.0.0.26"))
            assert time.monotonic() - started < 5

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

    def test_hand_guided_reading_starts_no_process(self, arm: SimulatedRobot, robot: UrRobot) -> None:
        processes = children()
        with UrReceiver(config(arm)) as reader:
            assert children() == processes
            reader.start_trace()
            robot.move_joints(HOME + 0.1)  # somebody else moves it
            reader.wait_until_still()
            assert np.ptp(reader.stop_trace().q, axis=0).min() == pytest.approx(0.1, abs=1e-3)

    def test_a_wrong_tool_is_noticed(self, arm: SimulatedRobot, robot: UrRobot) -> None:
        with pytest.raises(DeviceError, match=r"50 mm .* check tcp_offset"):
            UrReceiver(config(arm, tcp_offset=(0.0, 0.0, 0.15, 0.0, 0.3, 0.0)))

    def test_hand_guided_reading_needs_the_tool(self, arm: SimulatedRobot) -> None:
        with pytest.raises(ToolkitError, match="tcp_offset is missing"):
            UrReceiver(config(arm, tcp_offset=None))

    def test_the_active_tool_is_learned(self, arm: SimulatedRobot, robot: UrRobot) -> None:
        with UrRobot(config(arm, tcp_offset=None)) as second:
            np.testing.assert_allclose(second.tcp_offset, TCP)


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
        ({"tcp_offset": (0.0, 0.1)}, "tcp_offset has 2 numbers"),
        ({"workspace": ((0, 0, 0), (1, 1, 0))}, "workspace"),
    ],
)
def test_impossible_configurations(changes: dict[str, object], message: str) -> None:
    with pytest.raises(ToolkitError, match=message):
        RobotConfig("127.0.0.1", **changes)  # type: ignore[arg-type]
