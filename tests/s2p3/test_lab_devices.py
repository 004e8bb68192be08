"""The simulated lab over the wire: what clients that are not ours see, and pictures that fit the truth."""

from __future__ import annotations

import json
import shutil
import subprocess
import sys
import time
from importlib.util import find_spec
from pathlib import Path

import numpy as np
import pytest

from acquisition.capture import capture_board
from acquisition.rig import Rig
from acquisition.robot import RobotConfig
from acquisition.robots.ur import UrRobot
from acquisition.simulation.robot import SimulatedRobot
from calibration.detection import detect_in_mosaic
from calibration.sessions import arm_trace, rest_pose
from dataset.errors import DeviceError
from dataset.session import Session
from dataset.transforms import SE3, rotation_error_deg, translation_error_mm
from s2p3.board import board_spec
from s2p3.lab import LabTruth, found_lab, running_lab
from s2p3.lab.arm_pose import ArmPose

pytestmark = pytest.mark.devices

ARM = "127.0.0.62"


@pytest.fixture(scope="module")
def lab(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    """truth.json and rig.toml of a lab."""
    folder = tmp_path_factory.mktemp("lab")
    truth_path, rig_path = found_lab(folder, "cup", 3)
    return truth_path, rig_path


def test_stills_taken_over_the_wire_show_the_board_where_the_truth_says(
    lab: tuple[Path, Path], tmp_path: Path
) -> None:
    truth, rig = LabTruth.load(lab[0]), Rig.load(lab[1])
    out = tmp_path / "board.h5"
    with running_lab(lab[0], rig):
        done = capture_board(rig, out, views=2)
    assert (done.frames, done.dropped) == (2, 0)
    spec = board_spec(rig.board)
    with Session.open(out) as session:
        times, trace = arm_trace(session)
        for index in range(len(session)):
            # Two stills do not relate the clocks; the arm rests long enough not to need that.
            reported = rest_pose(times, trace, int(session.host_time_ns[index]))
            assert reported is not None
            T_base_cam = truth.T_base_flange(reported) @ truth.T_tcp_cam
            found = detect_in_mosaic(session.raw(index), session.camera.mosaic, spec)
            assert found is not None
            points = (T_base_cam.inverse() @ truth.T_base_board).apply(spec.object_points(found.ids))
            error = found.pixels - truth.intrinsics.project(points)
            assert np.sqrt((error**2).sum(axis=1).mean()) < 0.3
            # The same corners, if the camera sat where the rig file guesses, are tens of pixels off.
            guessed = truth.T_base_flange(reported) @ SE3.from_pose6(np.array(rig.frames.T_tcp_cam_guess))
            points = (guessed.inverse() @ truth.T_base_board).apply(spec.object_points(found.ids))
            assert np.abs(found.pixels - truth.intrinsics.project(points)).mean() > 3.0


def test_arm_pose_is_exact_at_rest_and_at_a_past_moment_of_a_motion() -> None:
    config = RobotConfig(ARM, frequency_hz=125.0, joint_speed=0.9, joint_acceleration=1.2)
    with SimulatedRobot(ARM, 125.0), UrRobot(config) as robot:
        light = ArmPose(ARM, 125.0)
        robot.wait_until_still()
        assert translation_error_mm(light.at(time.monotonic() - 0.05), robot.sample().T_base_tcp) < 1e-3
        robot.start_trace()
        q = robot.sample().q
        robot.move_joints(q + np.array([0.3, 0.0, 0.1, 0.0, 0.0, 0.2]))
        trace = robot.stop_trace()
        middle = len(trace) // 2
        moment = int(trace.host_time_ns[middle]) * 1e-9
        # Where the arm was when its package arrived here, a little after it was sent.
        apart = translation_error_mm(light.at(moment), trace.poses[middle])
        speed = translation_error_mm(trace.poses[middle - 5], trace.poses[middle + 5]) / 0.08
        assert speed > 20  # mm/s: it was moving
        assert apart < 0.02 * speed
        assert rotation_error_deg(light.at(moment), trace.poses[middle]) < 1.0
    with pytest.raises(DeviceError, match="reported no pose for this exposure"):
        light.at(time.monotonic() + 60)


CLIENTS = """
import json, pathlib, signal, subprocess, sys
import rtde_receive

def children(pid):
    tasks = pathlib.Path(f"/proc/{pid}/task").glob("*/children")
    return [int(child) for task in tasks for child in task.read_text().split()]

signal.signal(signal.SIGINT, signal.SIG_DFL)  # a suite in the background ignores it, and its children too
command = [sys.executable, "-m", "s2p3.cli", "simulate", "--seed", "3", "--lab", sys.argv[1]]
simulate = subprocess.Popen(command, stderr=subprocess.PIPE, text=True)
said = [simulate.stderr.readline()]
devices = children(simulate.pid)
listing = subprocess.run(["arv-tool-0.8"], capture_output=True, text=True, timeout=20).stdout
receiver = rtde_receive.RTDEReceiveInterface("127.0.0.1")
pose = receiver.getActualTCPPose()
receiver.disconnect()
simulate.send_signal(signal.SIGINT)
code = simulate.wait(20)
said += simulate.stderr.readlines()
left = [pid for pid in devices if pathlib.Path(f"/proc/{pid}").exists()]
found = dict(said=said, listing=listing, pose=pose, devices=devices, code=code, left=left)
print(json.dumps(found))
"""


@pytest.mark.skipif(
    shutil.which("arv-tool-0.8") is None or find_spec("rtde_receive") is None,
    reason="needs Debian's aravis-tools-cli and ur_rtde",
)
def test_simulate_serves_clients_that_are_not_ours_and_leaves_nothing_behind(lab: tuple[Path, Path]) -> None:
    inside = 'ip link set lo up && exec "$0" -c "$1" "$2"'  # a network of its own, with its own ports
    command = ["unshare", "--net", "sh", "-c", inside, sys.executable, CLIENTS, str(lab[0].parent)]
    done = subprocess.run(command, capture_output=True, text=True, timeout=120, check=False)
    if "unshare failed" in done.stderr:
        pytest.skip("this machine does not permit network namespaces")
    assert done.returncode == 0, done.stderr
    found = json.loads(done.stdout.splitlines()[-1])
    assert "PHX050S-Q" in found["listing"]
    assert "127.0.0.1" in found["listing"]
    assert 0.2 < np.linalg.norm(found["pose"][:3]) < 1.3
    assert "camera PHX050S-Q at 127.0.0.1 (GigE Vision), UR5e at 127.0.0.1 (RTDE)" in found["said"][0]
    assert len(found["devices"]) == 2
    assert found["code"] == 0
    assert found["left"] == []
    assert "Traceback" not in "".join(found["said"])
