"""What a user sees when an arm fails: one test for each thing that goes wrong with a real one.

The arm is the simulated controller, the client the unmodified ur_rtde wheel behind our driver.
"""

from __future__ import annotations

import contextlib
import socket
import threading
import time
from collections.abc import Callable, Iterator

import numpy as np
import pytest

from acquisition.kinematics import forward
from acquisition.robot import EmergencyStop, ProtectiveStop, RobotConfig
from acquisition.robots.ur import UrRobot
from acquisition.robots.ur_receiver import UrReceiver
from acquisition.simulation.arm import HOME
from acquisition.simulation.robot import SimulatedRobot
from dataset.errors import DeviceError

pytest.importorskip("rtde_control")
pytestmark = pytest.mark.devices


def home_plus(*turns: float) -> np.ndarray:
    """The home configuration with its first joints turned further, radians."""
    return np.array(HOME) + np.pad(np.array(turns), (0, 6 - len(turns)))


FAR = home_plus(1.8)  # about two seconds away
TYPED_WITHIN_S = 0.2


def config(arm: SimulatedRobot, **changes: object) -> RobotConfig:
    """A patient configuration: the simulator may be held up where many tests run at once."""
    fast = {"joint_speed": 1.0, "joint_acceleration": 10.0, "speed": 0.8, "acceleration": 4.0}
    return RobotConfig(arm.host, **{**fast, "silence_s": 1.0, **changes})  # type: ignore[arg-type]


@pytest.fixture(scope="module")
def simulator() -> Iterator[SimulatedRobot]:
    with SimulatedRobot("127.0.0.35") as simulated:
        yield simulated


@pytest.fixture
def arm(simulator: SimulatedRobot) -> SimulatedRobot:
    """A sound arm at home."""
    if not simulator.running:  # the test before killed it
        simulator.start()
    for verb in ("restart", "unstall", "unhang", "unmute", "remote", f"guide {' '.join(map(str, HOME))}"):
        simulator.command(verb)
    with UrReceiver(config(simulator)) as reader:
        time.sleep(0.1)
        reader.wait_until_still()
    return simulator


def seconds_until_raised(
    error: type[DeviceError], message: str, act: Callable[[], object], cause: Callable[[], object]
) -> float:
    """How long after `cause`, a moment into `act`, the error is there."""
    stamps: list[float] = []

    def strike() -> None:
        stamps.append(time.monotonic())
        cause()

    timer = threading.Timer(0.4, strike)
    timer.start()
    with pytest.raises(error, match=message):
        act()
    caught = time.monotonic()
    timer.join()
    return caught - stamps[0]


def until(holds: Callable[[], bool]) -> bool:
    """Whether it holds within some seconds: the simulator may be held up."""
    deadline = time.monotonic() + 5
    while time.monotonic() < deadline:
        with contextlib.suppress(DeviceError):
            if holds():
                return True
        time.sleep(0.02)
    return False


def rests(arm: SimulatedRobot) -> bool:
    with UrReceiver(config(arm)) as reader:
        reader.wait_until_still(timeout_s=2.0)
        q = reader.sample().q
        time.sleep(0.3)
        return bool(np.abs(reader.sample().q - q).max() < 1e-4)


class TestServerKilled:
    def test_during_a_move(self, arm: SimulatedRobot) -> None:
        """The vendor's blocking move would hang for 300 s."""
        with UrRobot(config(arm)) as robot:
            took = seconds_until_raised(
                DeviceError, r"lost the arm at .*; check its power", lambda: robot.move_joints(FAR), arm.kill
            )
        assert took < 5

    def test_while_it_is_read(self, arm: SimulatedRobot) -> None:
        """The vendor's getters would return the last values for ever; ours keeps the trace and says so."""
        with UrReceiver(config(arm)) as reader:
            reader.start_trace()
            time.sleep(0.3)
            arm.kill()
            time.sleep(0.2)
            with pytest.raises(DeviceError, match="lost the arm"):
                reader.sample()
            assert len(reader.take_trace()) > 50
            with pytest.raises(DeviceError, match="incomplete after 0 samples"):
                reader.stop_trace()


class TestStreamStalls:
    def test_during_a_move_stops_the_arm(self, arm: SimulatedRobot) -> None:
        """The vendor's client calls such a link alive for 2.5 s."""
        with UrRobot(config(arm, silence_s=0.3)) as robot:
            took = seconds_until_raised(
                DeviceError,
                r"sent nothing new for \d\.\d+ s although .* check the network",
                lambda: robot.move_joints(FAR),
                lambda: arm.command("stall"),
            )
            arm.command("unstall")
            assert rests(arm)
            assert robot.sample().q[0] < FAR[0] - 0.2
            robot.move_joints(robot.sample().q + 0.05)  # and goes on when the stream does
        assert took < 2

    def test_silence_is_not_taken_for_rest(self, arm: SimulatedRobot) -> None:
        with UrReceiver(config(arm, silence_s=0.3)) as reader:
            arm.command("stall")
            time.sleep(0.7)
            with pytest.raises(DeviceError, match="sent nothing new for"):
                reader.wait_until_still()
            arm.command("unstall")
            assert until(lambda: reader.sample().safety_bits == 1)

    def test_a_state_that_is_repeated_for_ever_is_no_new_state(self, arm: SimulatedRobot) -> None:
        with UrReceiver(config(arm, silence_s=0.3)) as reader:
            reader.start_trace()
            arm.command("hang")
            time.sleep(0.7)
            with pytest.raises(DeviceError, match="sent nothing new for"):
                reader.sample()
            assert (np.diff(reader.take_trace().robot_time_s) > 0).all()

    def test_for_good(self, arm: SimulatedRobot) -> None:
        with UrReceiver(config(arm)) as reader:
            arm.command("stall")
            time.sleep(2.0)
            arm.command("unstall")
            with pytest.raises(DeviceError, match=r"silent for 1.5 s.* connect again"):
                reader.sample()


class TestLinkDroppedAndBack:
    def test_during_a_move(self, arm: SimulatedRobot) -> None:
        """The vendor's reconnection crashes its process, which is not ours, and forgets the rate."""
        wanted = config(arm, frequency_hz=125.0)
        with UrRobot(wanted) as robot:
            robot.start_trace()
            seconds_until_raised(
                DeviceError, "lost the arm", lambda: robot.move_joints(FAR), lambda: arm.command("drop")
            )
            assert len(robot.take_trace()) > 20  # what came before is kept
        with UrRobot(wanted) as again:
            again.start_trace()
            again.move_joints(HOME)
            np.testing.assert_allclose(np.diff(again.stop_trace().robot_time_s), 1 / 125, atol=1e-6)


class TestSafetyStops:
    @pytest.mark.parametrize(("fault", "error"), [("pstop", ProtectiveStop), ("estop", EmergencyStop)])
    def test_during_a_move(self, arm: SimulatedRobot, fault: str, error: type[DeviceError]) -> None:
        """The vendor's move returns False and raises nothing."""
        with UrRobot(config(arm)) as robot:
            took = []
            for _ in range(2):
                took.append(
                    seconds_until_raised(
                        error, "start again", lambda: robot.move_joints(FAR), lambda: arm.command(fault)
                    )
                )
                with pytest.raises(error):  # and it stays so until somebody clears it
                    robot.move_joints(HOME)
                arm.command("clear")
                assert until(lambda: robot.sample().safety_bits == 1)
                assert rests(arm)  # it does not take its motion up again
                robot.move_joints(HOME)
        # The quickest: the others show what else this host has to do.
        assert min(took) < TYPED_WITHIN_S

    def test_on_a_path(self, arm: SimulatedRobot) -> None:
        with UrRobot(config(arm)) as robot:
            path = np.linspace(HOME, FAR, 20)
            seconds_until_raised(
                ProtectiveStop, "unlock", lambda: robot.follow(path), lambda: arm.command("pstop")
            )
            assert robot.sample().safety_bits & 1 << 2

    def test_a_link_at_the_table(self, arm: SimulatedRobot) -> None:
        """What the checks of the tool's workspace cannot see, the arm itself does."""
        with UrRobot(config(arm, workspace=((-2, -2, -1), (2, 2, 2)))) as robot:
            with pytest.raises(ProtectiveStop, match="clear what the arm touched"):
                robot.move_joints(home_plus(0, 1.4))
            assert "table" in arm.command("state")


class TestMuteAndBlackHoledHosts:
    """The vendor's constructor would hold the interpreter's lock while it waits."""

    def test_a_host_that_accepts_and_says_nothing(self, arm: SimulatedRobot) -> None:
        arm.command("mute")
        for driver in (UrRobot, UrReceiver):
            started = time.monotonic()
            with pytest.raises(DeviceError, match=r"silent for .* check"):
                driver(config(arm))
            assert time.monotonic() - started < 5

    def test_a_host_that_swallows_every_packet(self) -> None:
        with socket.socket() as listener:
            listener.bind(("127.0.0.36", 30004))
            listener.listen(0)
            fillers = [socket.socket() for _ in range(8)]  # the queue is full: further calls go unanswered
            try:
                for filler in fillers:
                    filler.setblocking(False)
                    filler.connect_ex(("127.0.0.36", 30004))
                started = time.monotonic()
                with pytest.raises(DeviceError, match=r"no arm answers at .*timed out.* check"):
                    UrRobot(RobotConfig("127.0.0.36"))
                assert time.monotonic() - started < 5
            finally:
                for filler in fillers:
                    filler.close()

    def test_a_controller_that_falls_mute_between_two_moves(self, arm: SimulatedRobot) -> None:
        with UrRobot(config(arm)) as robot:
            arm.command("pstop")
            with pytest.raises(ProtectiveStop):
                robot.move_joints(FAR)
            arm.command("clear")
            assert until(lambda: robot.sample().safety_bits == 1)
            arm.command("mute")
            started = time.monotonic()
            with pytest.raises(DeviceError, match=r"dashboard of the arm .* does not answer .*enable"):
                robot.move_joints(FAR)
            assert time.monotonic() - started < 8
            arm.command("unmute")
            robot.move_joints(HOME)


class TestLocalMode:
    def test_the_arm_takes_no_commands(self, arm: SimulatedRobot) -> None:
        arm.command("local")
        with pytest.raises(DeviceError, match=r"in local mode .* switch it to remote control"):
            UrRobot(config(arm))
        arm.command("remote")
        with UrRobot(config(arm)) as robot:
            robot.move_joints(np.array(HOME) + 0.05)

    def test_chosen_in_the_middle_of_a_move(self, arm: SimulatedRobot) -> None:
        with UrRobot(config(arm)) as robot:
            seconds_until_raised(
                DeviceError,
                "before its target; check",
                lambda: robot.move_joints(FAR),
                lambda: arm.command("local"),
            )
            with pytest.raises(DeviceError, match="local mode"):
                robot.move_joints(HOME)


class TestControllerRestarted:
    def test_its_clock_goes_back(self, arm: SimulatedRobot) -> None:
        with UrReceiver(config(arm)) as reader:
            reader.start_trace()
            time.sleep(0.1)
            arm.command("jump -5")
            time.sleep(0.2)
            with pytest.raises(
                DeviceError, match=r"clock .* went back by \d\.\d+ s: its controller restarted"
            ):
                reader.sample()
            assert (np.diff(reader.take_trace().robot_time_s) > 0).all()

    def test_by_its_power_switch_during_a_move(self, arm: SimulatedRobot) -> None:
        wanted = config(arm, tcp_offset=(0.0, 0.0, 0.1, 0.0, 0.0, 0.0))
        with UrRobot(wanted) as robot:
            seconds_until_raised(
                DeviceError, "lost the arm", lambda: robot.move_joints(FAR), lambda: arm.command("restart")
            )
        with UrReceiver(config(arm)) as reader:
            assert reader.sample().robot_time_s < 1060  # it counts from its start again
            np.testing.assert_array_equal(reader.tcp_offset, np.zeros(6))  # and has forgotten its tool
        with UrRobot(wanted) as again:  # which a new connection sets
            again.move_joints(HOME)
            expected = forward(np.array(HOME)).translation
            assert np.linalg.norm(again.sample().T_base_tcp.translation - expected) == pytest.approx(
                0.1, abs=1e-4
            )


class TestSlowArm:
    def test_a_slow_arm_arrives_late(self, arm: SimulatedRobot) -> None:
        arm.command("slider 0.25")
        with UrRobot(config(arm)) as robot:
            robot.start_trace()
            robot.move_joints(home_plus(0.3))
            trace = robot.stop_trace()
        speed = np.abs(np.diff(trace.q[:, 0])) / np.diff(trace.robot_time_s)
        assert speed.max() == pytest.approx(0.25, rel=0.05)

    def test_an_arm_that_stands_still_on_its_way_is_given_up(self, arm: SimulatedRobot) -> None:
        """A program paused at the pendant, a speed slider at zero: the vendor's move would wait for ever."""
        with UrRobot(config(arm)) as robot:
            took = seconds_until_raised(
                DeviceError,
                "stands still in the middle of a motion.* speed slider",
                lambda: robot.move_joints(FAR),
                lambda: arm.command("slider 0"),
            )
            assert 2.5 < took < 10
            arm.command("slider 1")
            assert rests(arm)  # nobody is surprised by the rest of the motion
            robot.move_joints(HOME)
