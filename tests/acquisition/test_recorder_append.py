"""An interrupted recording that goes on, with other clocks than before: its poses are right in both parts."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from acquisition.camera import CameraConfig
from acquisition.cameras.aravis import AravisCamera
from acquisition.recorder import Progress, record_stream
from acquisition.robot import RobotConfig
from acquisition.robots.rtde import RtdeReader
from acquisition.robots.ur import UrRobot
from acquisition.simulation.camera import SimulatedCamera
from acquisition.simulation.robot import SimulatedRobot
from dataset.errors import ToolkitError
from dataset.session import Session, SessionWriter
from dataset.session.accounting import account
from dataset.transforms import SE3, interpolate_poses, translation_error_mm
from dataset.validate import repair, validate

pytestmark = pytest.mark.devices

CAMERA = CameraConfig("127.0.0.1", exposure_us=4_000)
ARM = RobotConfig("127.0.0.34", tcp_offset=(0.0, 0.0, 0.1, 0.0, 0.0, 0.0), joint_acceleration=4.0)
HOME = np.array([3.14, -1.57, 1.57, -1.57, -1.57, 0.0])
SWING = np.tile([HOME, HOME + np.eye(6)[0] * 0.4], (8, 1))
LATENCY_S = 0.002
DRIFT_PPM = 60.0
SPEED_MM_S = 1e3 * ARM.joint_speed * 0.9  # at the end of a stretched arm


def fast_camera(**options: float) -> SimulatedCamera:
    return SimulatedCamera(width=256, height=192, frame_rate=100, latency_s=LATENCY_S, **options)


def true_poses(session: Session, camera: SimulatedCamera) -> SE3:
    """Where the arm was at the middle of the last segment's exposures, by what the simulators know."""
    clock, trace, last = camera.clock(), session.robot, session.segments[-1]
    assert trace is not None
    frames, samples = slice(last["first_frame"], None), slice(last["first_sample"], None)
    camera_ns = session.camera_time_ns[frames] + 500 * session.exposures_us[frames]
    mid_s = 1e-9 * clock.origin_ns + 1e-9 * camera_ns / (1 + 1e-6 * clock.drift_ppm)
    with RtdeReader(ARM.host, ["timestamp", "output_double_register_46"], 500) as reader:
        now = np.frombuffer(reader.packages()[-1], reader.dtype)[0]
    elapsed_s = (trace.robot_time_s[samples] - now["timestamp"]) / (1 + 1e-6 * DRIFT_PPM)
    true_s = now["output_double_register_46"] + elapsed_s
    return interpolate_poses(true_s, trace.poses[samples], mid_s)


def measured_poses(session: Session) -> tuple[SE3, NDArray[np.float64]]:
    """Where the file says the arm was, and the sigma of the time, seconds; the delay is the camera's."""
    trace, clock = session.robot, session.clocks.robot
    assert trace is not None
    assert clock is not None
    times_s = 1e-9 * clock.to_host(np.rint(1e9 * trace.robot_time_s).astype(np.int64))
    at_s = 1e-9 * session.mid_exposure_host_ns - LATENCY_S
    return interpolate_poses(times_s, trace.poses, at_s), session.time_sigma_s


def test_an_interrupted_recording_goes_on_with_devices_that_were_restarted(tmp_path: Path) -> None:
    path = tmp_path / "s.h5"
    truth: list[SE3] = []

    def interrupt(progress: Progress) -> None:
        if progress.frames > 120:
            raise ToolkitError("interrupted")

    def film(begin: Callable[..., SessionWriter], drift_ppm: float) -> None:
        """Until it is interrupted, with a camera and an arm that were just switched on."""
        with fast_camera(drift_ppm=drift_ppm) as simulator, SimulatedRobot(ARM.host, drift_ppm=DRIFT_PPM):
            with AravisCamera(CAMERA) as camera, UrRobot(ARM) as robot:
                robot.move_joints(SWING[0])
                with (
                    pytest.raises(ToolkitError, match="interrupted"),
                    begin(path, "sequence", camera.info) as writer,
                ):
                    record_stream(
                        camera, robot, writer, motion=lambda: robot.follow(SWING), on_progress=interrupt
                    )
            result = repair(path)
            assert (result.damaged_ids, result.lost) == ((), ())
            with Session.open(path) as session:
                truth.append(true_poses(session, simulator))

    film(SessionWriter, 80.0)
    with Session.open(path) as session:
        count, first = len(session), [session.raw(i) for i in range(3)]
    film(SessionWriter.append, -40.0)
    assert validate(path) == []
    with Session.open(path) as session:
        assert session.segments["first_frame"].tolist() == [0, count]
        assert len(session) == count + len(truth[1].translation)
        for i, pixels in enumerate(first):
            np.testing.assert_array_equal(session.raw(i), pixels)
        assert account(session).silent == 0
        assert np.diff(session.camera_time_ns).min() < 0  # the second camera's clock began anew
        found, sigma_s = measured_poses(session)
        error_mm = translation_error_mm(found, SE3.stack([pose for part in truth for pose in part]))
        assert np.ptp(found.translation[count:], axis=0).max() > 0.02
        assert (error_mm < 0.02 + 3 * sigma_s * SPEED_MM_S).all()
