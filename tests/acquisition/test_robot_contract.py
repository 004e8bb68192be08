"""What every arm must do, whoever drives it: one class of tests, run on each driver.

A driver joins by a subclass of `RobotContract` whose fixture `robot` is connected, at rest at `home`, and may
be moved by two radians about it, at about 1 rad/s: slowly enough to be stopped on the way.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Iterator

import numpy as np
import pytest

from acquisition.robot import MotionStopped, Robot, RobotConfig
from acquisition.simulation.arm import HOME
from acquisition.simulation.robot import SimulatedRobot
from dataset.errors import DeviceError, ToolkitError
from dataset.transforms import SE3, rotation_error_deg, translation_error_mm


class RobotContract:
    """The promises of `acquisition.robot`."""

    home: np.ndarray

    @pytest.fixture
    def robot(self) -> Robot:
        raise NotImplementedError

    def away(self, *turns: float) -> np.ndarray:
        """Home with each joint turned further, radians."""
        return self.home + np.pad(np.array(turns, dtype=np.float64), (0, 6 - len(turns)))

    def test_sample_is_current_and_whole(self, robot: Robot) -> None:
        sample = robot.sample()
        assert abs(time.monotonic_ns() - sample.host_time_ns) < 1e9
        assert sample.q.shape == (6,)
        np.testing.assert_allclose(
            sample.T_base_tcp.rotation @ sample.T_base_tcp.rotation.T, np.eye(3), atol=1e-9
        )
        time.sleep(0.1)
        later = robot.sample()
        assert later.host_time_ns > sample.host_time_ns
        assert later.robot_time_s > sample.robot_time_s

    def test_tool_and_payload_are_told(self, robot: Robot) -> None:
        assert robot.tcp_offset.shape == (6,)
        assert np.isfinite(robot.tcp_offset).all()
        assert robot.payload.shape == (4,)
        robot.tcp_offset[:] = 7.0  # a copy: nobody changes the arm's tool by accident
        assert np.abs(robot.tcp_offset).max() < 7.0

    def test_joint_move_arrives_and_rests(self, robot: Robot) -> None:
        target = self.away(0.3, -0.1, 0.1, 0, 0.2, -0.4)
        robot.move_joints(target)
        robot.wait_until_still()
        np.testing.assert_allclose(robot.sample().q, target, atol=1e-3)

    def test_linear_move_is_straight(self, robot: Robot) -> None:
        start = robot.sample().T_base_tcp
        target = SE3(start.rotation, np.add(start.translation, [0.05, -0.1, 0.08]))
        robot.start_trace()
        robot.move_linear(target)
        trace = robot.stop_trace()
        assert translation_error_mm(robot.sample().T_base_tcp, target) < 1
        offset = trace.pose[:, :3] - start.translation
        along = target.translation - start.translation
        along /= np.linalg.norm(along)
        assert np.linalg.norm(offset - np.outer(offset @ along, along), axis=1).max() < 5e-4

    def test_following_a_path_never_stops_and_passes_near_every_waypoint(self, robot: Robot) -> None:
        angle = np.linspace(0, 2 * np.pi, 25)
        path = self.home + np.stack(
            [0.3 * np.sin(angle), 0.2 * (1 - np.cos(angle)), *np.zeros((4, 25))], axis=1
        )
        robot.move_joints(path[0])
        robot.start_trace()
        robot.follow(path[1:], blend=0.02)
        trace = robot.stop_trace()
        np.testing.assert_allclose(trace.q[-1], path[-1], atol=1e-3)
        away = np.abs(trace.q[None] - path[1:, None]).max(axis=-1).min(axis=1)
        assert away.max() < 0.03
        # A simulator that was held up skips time; then the arm has not stopped.
        period_s = np.median(np.diff(trace.robot_time_s))
        speed = np.abs(np.diff(trace.q, axis=0)).max(axis=1) / period_s
        moving = np.flatnonzero(speed > 0.05)
        assert speed[moving[0] : moving[-1]].min() > 0.02

    def test_inverse_kinematics(self, robot: Robot) -> None:
        sample = robot.sample()
        q = robot.inverse_kinematics(sample.T_base_tcp, sample.q + 0.1)
        assert q is not None
        np.testing.assert_allclose(q, sample.q, atol=1e-2)
        unreachable = SE3(sample.T_base_tcp.rotation, np.array([9.0, 0, 0]))
        assert robot.inverse_kinematics(unreachable, sample.q) is None
        robot.move_joints(self.away(0.01))  # the arm still moves after an impossible question

    def test_stop_from_another_thread(self, robot: Robot) -> None:
        stopper = threading.Timer(0.3, robot.stop)
        stopper.start()
        with pytest.raises(MotionStopped):
            robot.follow([self.away(1.8 * turn) for turn in (0.5, 1.0)])
        stopper.join()
        assert 0.005 < robot.sample().q[0] - self.home[0] < 1.7
        robot.wait_until_still()
        robot.move_joints(self.home)  # a stop is no fault: the next move is taken

    @pytest.mark.parametrize("verb", ["move_linear", "move_joints", "follow"])
    def test_targets_outside_the_workspace_move_nothing(self, robot: Robot, verb: str) -> None:
        before = robot.sample()
        below = SE3(before.T_base_tcp.rotation, before.T_base_tcp.translation - [0, 0, 0.6])
        reaching_down = self.away(0, 1.0, 0.5)
        targets = {
            "move_linear": below,
            "move_joints": reaching_down,
            "follow": [self.home, reaching_down, self.home],  # both ends are inside, the way is not
        }
        with pytest.raises(ToolkitError, match=r"outside the workspace .*\[robot\]"):
            getattr(robot, verb)(targets[verb])
        np.testing.assert_allclose(robot.sample().q, before.q, atol=1e-6)

    @pytest.mark.parametrize("q", [np.zeros(5), np.full(6, 90.0), np.full(6, np.nan)])
    def test_impossible_joint_angles(self, robot: Robot, q: np.ndarray) -> None:
        with pytest.raises(ToolkitError, match="joint angles"):
            robot.move_joints(q)

    def test_trace_holds_every_sample_of_a_move(self, robot: Robot) -> None:
        robot.start_trace()
        robot.move_joints(self.away(0.1, 0.1, 0.1, 0.1, 0.1, 0.1))
        first = robot.take_trace()
        robot.move_joints(self.home)
        rest = robot.stop_trace()
        times = np.concatenate([first.robot_time_s, rest.robot_time_s])
        period = np.median(np.diff(times))
        np.testing.assert_allclose(np.diff(times), period, atol=0.1 * period)  # nothing between the parts
        assert (np.diff(np.concatenate([first.host_time_ns, rest.host_time_ns])) >= 0).all()
        assert len(first) > 20
        np.testing.assert_allclose(first.poses[0].as_pose6(), first.pose[0], atol=1e-9)

    def test_pose_and_joints_of_a_sample_belong_together(self, robot: Robot) -> None:
        """Read one after the other they would be of different moments: at this speed millimetres apart."""
        robot.start_trace()
        robot.move_joints(self.away(0.4))
        trace = robot.stop_trace()
        turned = SE3.from_rotvec(
            np.outer(trace.q[:, 0] - trace.q[0, 0], [0, 0, 1.0]), np.zeros((len(trace), 3))
        )
        expected = turned @ trace.poses[:1]  # joint 1 turns about the base frame's z axis
        assert translation_error_mm(trace.poses, expected).max() < 0.2
        assert rotation_error_deg(trace.poses, expected).max() < 0.02

    def test_traces_are_started_once_and_stopped_once(self, robot: Robot) -> None:
        with pytest.raises(DeviceError, match="start one first"):
            robot.stop_trace()
        with pytest.raises(DeviceError, match="start one first"):
            robot.take_trace()
        robot.start_trace()
        with pytest.raises(DeviceError, match="already running"):
            robot.start_trace()
        robot.stop_trace()

    def test_waiting_for_an_arm_that_moves_on_ends(self, robot: Robot) -> None:
        mover = threading.Thread(target=lambda: robot.move_joints(self.away(0.5)))
        mover.start()
        time.sleep(0.2)
        with pytest.raises(DeviceError, match="still moves after"):
            robot.wait_until_still(timeout_s=0.05)
        mover.join()


@pytest.fixture(scope="module")
def ur_robot() -> Iterator[Robot]:
    pytest.importorskip("rtde_control")
    from acquisition.robots.ur import UrRobot

    config = RobotConfig(
        "127.0.0.29",
        silence_s=1.0,
        joint_speed=1.0,
        joint_acceleration=10.0,
        speed=0.8,
        acceleration=4.0,
        tcp_offset=(0.0, 0.0, 0.1, 0.0, 0.3, 0.0),
    )
    with SimulatedRobot(config.host), UrRobot(config) as robot:
        yield robot


@pytest.mark.devices
class TestUrRobot(RobotContract):
    home = np.array(HOME)

    @pytest.fixture
    def robot(self, ur_robot: Robot) -> Robot:
        ur_robot.move_joints(self.home)
        ur_robot.wait_until_still()
        return ur_robot
