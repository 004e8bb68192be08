"""Recordings from both simulated devices, over their real protocols: what the file holds is what happened."""

from __future__ import annotations

import json
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from acquisition.camera import CameraConfig
from acquisition.cameras.aravis import AravisCamera
from acquisition.frame_stream import UNKNOWN_FRAME_ID
from acquisition.kinematics import forward
from acquisition.recorder import NO_CAMERA, Progress, record_stills, record_stream, record_touches
from acquisition.robot import RobotConfig
from acquisition.robots.rtde import RtdeReader
from acquisition.robots.ur import UrRobot
from acquisition.robots.ur_receiver import UrReceiver
from acquisition.simulation.camera import SimulatedCamera
from acquisition.simulation.patterns import MovingPattern
from acquisition.simulation.robot import SimulatedRobot
from calibration.touches import KnownTip, touched_points
from dataset.errors import DeviceError, SessionError, ToolkitError
from dataset.frames import RawFrame, RobotTrace
from dataset.rests import find_rests
from dataset.session import Chunk, Session, SessionWriter
from dataset.transforms import SE3, interpolate_poses, rotation_error_deg, translation_error_mm
from dataset.validate import repair, validate

pytestmark = pytest.mark.devices

CAMERA = CameraConfig("127.0.0.1", exposure_us=4_000)
ARM = RobotConfig(
    "127.0.0.31",
    silence_s=1.0,
    tcp_offset=(0.0, 0.0, 0.1, 0.0, 0.0, 0.0),
    joint_speed=1.0,
    joint_acceleration=4.0,
)
HOME = np.array([3.14, -1.57, 1.57, -1.57, -1.57, 0.0])
PATH = HOME + np.outer(np.arange(1, 7), [0.05, -0.03, 0.03, 0.02, 0.03, 0.05])
LATENCY_NS = 2_000_000  # of the shared simulated camera


@pytest.fixture(scope="module")
def simulated_arm() -> Iterator[SimulatedRobot]:
    with SimulatedRobot(ARM.host, drift_ppm=50.0) as arm:
        yield arm


@pytest.fixture
def camera(simulated_camera: SimulatedCamera) -> Iterator[AravisCamera]:
    with AravisCamera(CAMERA) as camera:
        yield camera


@pytest.fixture
def robot(simulated_arm: SimulatedRobot) -> Iterator[UrRobot]:
    with UrRobot(ARM) as robot:
        robot.move_joints(HOME)
        yield robot


def assert_accounted(session: Session) -> None:
    """Every id from the first frame to the last is stored once or ledgered once."""
    ids = np.sort(np.concatenate([session.frame_ids, session.drops["frame_id"]]))
    np.testing.assert_array_equal(ids, np.arange(session.frame_ids[0], ids[-1] + 1))


def true_mid_exposures(session: Session, camera: SimulatedCamera) -> NDArray[np.int64]:
    """(N,) host nanoseconds, from the simulator's own knowledge of its clock."""
    half_ns = (session.exposures_us * 500).astype(np.int64)
    return session.camera_time_ns + half_ns + camera.clock().origin_ns


def true_poses(trace: RobotTrace, host_ns: NDArray[np.int64]) -> SE3:
    """Where the arm was, by the host time that the simulated controller puts into its packages."""
    with RtdeReader(ARM.host, ["timestamp", "output_double_register_46"], 500) as reader:
        records = np.frombuffer(reader.packages()[-1], reader.dtype)[0]
    drift = 1 + 50e-6
    true_s = records["output_double_register_46"] + (trace.robot_time_s - records["timestamp"]) / drift
    return interpolate_poses(true_s, trace.poses, host_ns * 1e-9)


def measured_poses(session: Session) -> SE3:
    """Where the file says the arm was: both clocks by their fits."""
    trace = session.robot
    assert trace is not None
    assert session.clocks.robot is not None
    host_ns = session.clocks.robot.to_host(np.rint(trace.robot_time_s * 1e9).astype(np.int64))
    return interpolate_poses(host_ns * 1e-9, trace.poses, session.mid_exposure_host_ns * 1e-9)


def test_stills_are_exposed_at_rest_where_the_path_says(
    tmp_path: Path, simulated_camera: SimulatedCamera, camera: AravisCamera, robot: UrRobot
) -> None:
    told: list[Progress] = []
    with SessionWriter(tmp_path / "s.h5", "hand_eye", camera.info, rig_toml="# a rig") as writer:
        summary = record_stills(camera, robot, PATH, writer, settle_s=0.25, on_progress=told.append)
    assert [p.done for p in told] == pytest.approx([1 / 6, 2 / 6, 3 / 6, 4 / 6, 5 / 6, 1])
    assert summary == told[-1] == Progress(6, 0, 1.0)
    assert validate(tmp_path / "s.h5") == []
    with Session.open(tmp_path / "s.h5") as session:
        assert (len(session), session.complete, session.rig_toml) == (6, True, "# a rig")
        assert_accounted(session)
        assert session.tcp_offset == pytest.approx(ARM.tcp_offset)
        expected = forward(PATH) @ SE3.from_pose6(np.array(ARM.tcp_offset))
        trace = session.robot
        assert trace is not None
        mid_ns = true_mid_exposures(session, simulated_camera)
        for poses in (measured_poses(session), true_poses(trace, mid_ns)):
            assert translation_error_mm(poses, expected).max() < 0.05
            assert rotation_error_deg(poses, expected).max() < 0.01
        for i, at_ns in enumerate(mid_ns):
            settled = (trace.host_time_ns > at_ns - 250_000_000) & (trace.host_time_ns < at_ns)
            assert settled.sum() > 50
            assert np.ptp(trace.q[settled], axis=0).max() < 1e-6
            shown = MovingPattern().frame("BayerRG8", 192, 256, 4_000, 0.0, at_ns - 2_000_000)
            np.testing.assert_array_equal(session.raw(i), shown)


def test_stream_while_the_arm_moves(
    tmp_path: Path, simulated_camera: SimulatedCamera, camera: AravisCamera, robot: UrRobot
) -> None:
    with SessionWriter(tmp_path / "s.h5", "sequence", camera.info) as writer:
        path = np.concatenate([PATH, PATH[::-1], PATH])
        summary = record_stream(camera, robot, writer, motion=lambda: robot.follow(path))
    assert validate(tmp_path / "s.h5") == []
    with Session.open(tmp_path / "s.h5") as session:
        assert session.complete
        assert (len(session), len(session.drops)) == (summary.frames, summary.dropped)
        assert len(session) > 100
        assert_accounted(session)
        trace = session.robot
        assert trace is not None
        step_s = np.diff(trace.robot_time_s)
        # Not one sample is missing; but a simulated arm that its host starves for half a second skips some.
        assert np.logical_or(abs(step_s - 0.002) < 1e-6, step_s > 0.5).all()
        assert np.ptp(trace.poses.translation, axis=0).max() > 0.05
        # A constant latency is no clock's business: it is estimated from motion.
        truth = true_poses(trace, true_mid_exposures(session, simulated_camera) + LATENCY_NS)
        found = measured_poses(session)
        # As near as the clock fits say they are: their sigma tells how much the host was starved.
        within_s = 1e-3 + 4e-9 * sum(
            fit.sigma_ns for fit in (session.clocks.camera, session.clocks.robot) if fit
        )
        assert translation_error_mm(found, truth).max() < 1e3 * ARM.speed * 1.2 * within_s
        assert rotation_error_deg(found, truth).max() < np.rad2deg(2 * ARM.joint_speed * within_s)


def test_stream_without_an_arm_for_a_time(tmp_path: Path, camera: AravisCamera) -> None:
    told: list[Progress] = []
    with SessionWriter(tmp_path / "s.h5", "intrinsics", camera.info) as writer:
        record_stream(camera, None, writer, duration_s=0.5, on_progress=told.append)
    assert told[-1].done == 1.0
    with Session.open(tmp_path / "s.h5") as session:
        assert session.complete
        assert session.robot is None
        assert session.clocks.robot is None
        assert session.clocks.camera is not None
        assert len(session) > 10


def test_a_stream_has_an_end(tmp_path: Path, camera: AravisCamera) -> None:
    with (
        SessionWriter(tmp_path / "s.h5", "sequence", camera.info) as writer,
        pytest.raises(ToolkitError, match="motion or a duration"),
    ):
        record_stream(camera, None, writer)


def test_the_time_being_over_stops_every_move_of_a_motion(
    tmp_path: Path, camera: AravisCamera, robot: UrRobot
) -> None:
    def motion() -> None:
        for q in PATH:
            robot.move_joints(q)

    with SessionWriter(tmp_path / "s.h5", "sequence", camera.info) as writer:
        record_stream(camera, robot, writer, motion=motion, duration_s=0.2)
    assert np.abs(robot.sample().q - PATH[-1]).max() > 0.02
    with Session.open(tmp_path / "s.h5") as session:
        assert session.complete


class FullDisk(SessionWriter):
    """A writer whose disk is full after ten frames."""

    def add_frame(self, frame: RawFrame, chunk: Chunk | None = None) -> int:
        if len(self) == 10:
            raise SessionError(f"{self.path}: no space left on the disk")
        return super().add_frame(frame, chunk)


def test_a_full_disk_stops_the_arm_and_is_the_error(
    tmp_path: Path, camera: AravisCamera, robot: UrRobot
) -> None:
    with (
        pytest.raises(SessionError, match="no space left"),
        FullDisk(tmp_path / "s.h5", "sequence", camera.info) as writer,
    ):
        record_stream(camera, robot, writer, motion=lambda: robot.follow(PATH))
    assert np.abs(robot.sample().q - PATH[-1]).max() > 0.02
    with Session.open(tmp_path / "s.h5") as session:
        assert (len(session), session.complete) == (10, False)
        assert session.robot is not None
        assert session.clocks.camera is not None


class Recovering(AravisCamera):
    """Its packets are lost until it is triggered for the second time."""

    simulator: SimulatedCamera
    triggers = 0

    def trigger(self) -> None:
        self.triggers += 1
        self.simulator.set_lost_ratio(1.0 if self.triggers == 1 else 0.0)
        super().trigger()


def test_a_triggered_frame_that_was_lost_is_asked_for_once_more(
    tmp_path: Path, simulated_camera: SimulatedCamera, robot: UrRobot
) -> None:
    with Recovering(CAMERA) as camera:
        camera.simulator = simulated_camera
        with SessionWriter(tmp_path / "s.h5", "hand_eye", camera.info) as writer:
            record_stills(camera, robot, PATH[:2], writer, settle_s=0.0)
        assert camera.triggers == 3
    with Session.open(tmp_path / "s.h5") as session:
        assert (len(session), session.complete) == (2, True)


def test_a_triggered_frame_that_never_comes_is_ledgered_and_an_error(
    tmp_path: Path, simulated_camera: SimulatedCamera, camera: AravisCamera, robot: UrRobot
) -> None:
    def lose_all(progress: Progress) -> None:
        simulated_camera.set_lost_ratio(1.0)

    try:
        with (
            pytest.raises(DeviceError, match="nor did a second one"),
            SessionWriter(tmp_path / "s.h5", "hand_eye", camera.info) as writer,
        ):
            record_stills(camera, robot, PATH, writer, settle_s=0.0, on_progress=lose_all)
    finally:
        simulated_camera.set_lost_ratio(0.0)
    with Session.open(tmp_path / "s.h5") as session:
        assert (len(session), session.complete) == (1, False)
        assert session.drops["frame_id"].tolist() == [UNKNOWN_FRAME_ID]
        assert session.robot is not None


def test_a_motion_that_fails_leaves_an_incomplete_file_and_a_usable_camera(
    tmp_path: Path, camera: AravisCamera, robot: UrRobot
) -> None:
    below_the_table = SE3.from_pose6([0.4, 0.0, -0.3, 0.0, 3.0, 0.0])
    with (
        pytest.raises(ToolkitError, match="workspace"),
        SessionWriter(tmp_path / "s.h5", "sequence", camera.info) as writer,
    ):
        record_stream(camera, robot, writer, motion=lambda: robot.move_linear(below_the_table))
    with Session.open(tmp_path / "s.h5") as session:
        assert not session.complete
    camera.start("free")
    assert camera.read().missing_packets == 0
    robot.start_trace()
    assert len(robot.stop_trace()) >= 0


def test_a_lost_arm_keeps_frames_and_poses_until_then(tmp_path: Path, camera: AravisCamera) -> None:
    def lose_the_arm(progress: Progress) -> None:
        if progress.frames > 20 and arm.running:
            arm.kill()

    host = "127.0.0.32"
    with (
        SimulatedRobot(host) as arm,
        UrReceiver(RobotConfig(host, tcp_offset=(0.0,) * 6, silence_s=1.0)) as source,
        pytest.raises(DeviceError, match=host),
        SessionWriter(tmp_path / "s.h5", "sequence", camera.info) as writer,
    ):
        record_stream(camera, source, writer, duration_s=20.0, on_progress=lose_the_arm)
    with Session.open(tmp_path / "s.h5") as session:
        assert not session.complete
        assert len(session) > 20
        assert_accounted(session)
        assert session.robot is not None
        assert len(session.robot) > 50


RECORD = """
import json, signal, sys
import numpy as np
from acquisition.camera import CameraConfig
from acquisition.cameras.aravis import AravisCamera
from acquisition.recorder import record_stream
from acquisition.robot import RobotConfig
from acquisition.robots.ur import UrRobot
from dataset.session import SessionWriter

signal.signal(signal.SIGINT, signal.default_int_handler)  # ignored where the suite runs in the background
arguments = json.loads(sys.argv[1])
path = np.tile(np.array(arguments["path"]), (20, 1))
robot_config = RobotConfig(arguments["host"], tcp_offset=(0.0,) * 6, silence_s=1.0, joint_acceleration=4.0)

def tell(progress):
    if progress.frames > 150:
        print("recording", flush=True)

with AravisCamera(CameraConfig("127.0.0.1")) as camera, UrRobot(robot_config) as robot:
    with SessionWriter(arguments["out"], "sequence", camera.info) as writer:
        record_stream(camera, robot, writer, motion=lambda: robot.follow(path), on_progress=tell)
"""


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGKILL])
def test_an_interrupted_stream_opens_with_all_until_then(
    tmp_path: Path,
    simulated_camera: SimulatedCamera,
    simulated_arm: SimulatedRobot,
    number: signal.Signals,
) -> None:
    out = tmp_path / "s.h5"
    path = np.stack([HOME, PATH[-1]]).tolist()
    arguments = json.dumps({"out": str(out), "host": ARM.host, "path": path})
    command = [sys.executable, "-c", RECORD, arguments]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as process:
        assert process.stdout is not None
        assert process.stdout.readline() == "recording\n"
        process.send_signal(number)
        _, errors = process.communicate(timeout=30)
    assert process.returncode not in (0, None)
    if number == signal.SIGINT:
        assert errors.strip().splitlines()[-1] == "KeyboardInterrupt"
        with UrReceiver(RobotConfig(ARM.host, tcp_offset=(0.0,) * 6, silence_s=1.0)) as receiver:
            receiver.wait_until_still(timeout_s=2.0)
    with Session.open(out) as session:
        assert not session.complete
        assert len(session) > 150
        assert_accounted(session)
        for i in (0, len(session) - 1):
            assert session.raw(i).shape == (192, 256)
        trace = session.robot
        assert trace is not None
        # Killed: what the last tenths of a second brought may be missing.
        assert trace.host_time_ns[-1] > session.host_time_ns[-1] - 1_000_000_000
        assert session.clocks.camera is not None
        assert session.clocks.robot is not None
        frames = len(session)
    assert repair(out).frames == frames
    assert validate(out) == []


def test_touches_are_taken_while_a_hand_guides_the_arm(tmp_path: Path, simulated_arm: SimulatedRobot) -> None:
    points = PATH[[0, 2, 4]]
    with UrRobot(ARM) as hand, UrReceiver(ARM) as receiver:
        hand.move_joints(HOME)

        def guide() -> None:
            for q in points:
                hand.move_joints(q)
                time.sleep(0.8)

        guiding = threading.Thread(target=guide)
        told: list[Progress] = []
        with SessionWriter(tmp_path / "t.h5", "touches", NO_CAMERA) as writer:
            guiding.start()
            touches = record_touches(receiver, writer, 3, on_progress=told.append)
        guiding.join()
    assert [p.frames for p in told] == [1, 2, 3]
    expected = forward(points) @ SE3.from_pose6(np.array(ARM.tcp_offset))
    found = SE3.stack([touch.T_base_tcp for touch in touches])
    assert translation_error_mm(found, expected).max() < 0.1
    assert validate(tmp_path / "t.h5") == []
    with Session.open(tmp_path / "t.h5") as session:
        assert (session.kind, session.complete, len(session)) == ("touches", True, 0)
        assert session.robot is not None
        again = find_rests(session.robot)
        assert [(r.begin, r.end) for r in again] == [(t.begin, t.end) for t in touches]
        tips = touched_points(session, KnownTip.exactly([0.0, 0.0, 0.05]))
    np.testing.assert_allclose(tips.points, expected.apply([0.0, 0.0, 0.05]), atol=2e-4)
