"""A recording that is watched, paused, resumed and stopped; what may be appended to it."""

from __future__ import annotations

import threading
import time
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import pytest

from acquisition.camera import CameraConfig
from acquisition.cameras.aravis import AravisCamera
from acquisition.recorder import Recorder, record_stream
from acquisition.robot import RobotConfig
from acquisition.robots.ur_receiver import UrReceiver
from acquisition.simulation.camera import SimulatedCamera
from acquisition.simulation.robot import SimulatedRobot
from dataset.errors import SessionError
from dataset.frames import RobotTrace
from dataset.session import Session, SessionWriter
from dataset.session.accounting import account
from dataset.validate import validate

pytestmark = pytest.mark.devices

CAMERA = CameraConfig("127.0.0.1", exposure_us=4_000)


@pytest.fixture
def camera(simulated_camera: SimulatedCamera) -> Iterator[AravisCamera]:
    with AravisCamera(CAMERA) as camera:
        yield camera


def wait_for(frames: int, recorder: Recorder) -> None:
    deadline = time.monotonic() + 20.0
    wanted = recorder.status.stored + frames
    while recorder.status.stored < wanted:
        assert time.monotonic() < deadline
        time.sleep(0.01)


def until_written(recorder: Recorder) -> None:
    """What was under way when it was paused."""
    deadline = time.monotonic() + 20.0
    while recorder.status.queued:
        assert time.monotonic() < deadline
        time.sleep(0.01)


def test_a_pause_is_declared_and_no_loss(tmp_path: Path, camera: AravisCamera) -> None:
    path = tmp_path / "s.h5"
    with SessionWriter(path, "sequence", camera.info) as writer, Recorder(camera, None, writer) as recorder:
        wait_for(30, recorder)
        recorder.pause("looking for the cup")
        assert recorder.status.pausing
        time.sleep(0.3)
        until_written(recorder)
        held, seen = recorder.status.stored, recorder.latest
        time.sleep(0.3)
        assert recorder.status.stored == held
        assert recorder.latest is not seen  # the preview goes on
        recorder.resume()
        wait_for(30, recorder)
        recorder.pause("again")
        time.sleep(0.2)
        status = recorder.status
        threading.Timer(0.1, recorder.stop).start()
        recorder.wait()
    assert status.paused > 20
    assert status.offered == status.stored + status.ledgered + status.queued
    assert 0.5 < status.seconds < 20
    assert recorder.progress.done == 1.0
    assert validate(path) == []
    with Session.open(path) as session:
        assert session.complete
        reasons = [row["reason"].decode() for row in session.pauses]
        assert reasons == ["looking for the cup", "again"]
        counted = account(session)
        assert (counted.silent, counted.stored) == (0, len(session))
        assert counted.paused >= 40
        first = session.pauses[0]
        assert 0.4e9 < first["resumed_ns"] - first["host_time_ns"] < 5e9
        within = (session.frame_ids >= first["first_id"]) & (session.frame_ids <= first["last_id"])
        assert not within.any()


def test_what_is_missing_within_a_pause_is_no_secret(tmp_path: Path, camera: AravisCamera) -> None:
    """A pause that claims fewer frames than are missing leaves the rest unexplained."""
    path = tmp_path / "s.h5"
    with SessionWriter(path, "sequence", camera.info) as writer:
        camera.start("free")
        frames = [camera.read() for _ in range(12)]
        camera.stop()
        for frame in (frames[0], frames[11]):
            writer.add_frame(frame)
        begin, end = frames[0].frame_id, frames[11].frame_id
        writer.add_pause(begin + 1, end - 4, "too short", 0, 0)
    with Session.open(path) as session:
        assert account(session).silent == 3
    assert any("3 frames between" in problem.what for problem in validate(path))


def test_another_camera_or_kind_is_refused(tmp_path: Path, camera: AravisCamera) -> None:
    path = tmp_path / "s.h5"
    with SessionWriter(path, "sequence", camera.info) as writer:
        record_stream(camera, None, writer, duration_s=0.3)
    before = path.read_bytes()
    with pytest.raises(SessionError, match=r"its camera has serial SIM00001, this one other; record"):
        SessionWriter.append(path, "sequence", replace(camera.info, serial="other"))
    with pytest.raises(SessionError, match="of kind sequence"):
        SessionWriter.append(path, "hand_eye", camera.info)
    assert path.read_bytes() == before


def test_another_tool_is_refused(tmp_path: Path, camera: AravisCamera) -> None:
    path = tmp_path / "s.h5"
    with SimulatedRobot("127.0.0.34"), UrReceiver(RobotConfig("127.0.0.34")) as arm:
        with SessionWriter(path, "sequence", camera.info) as writer:
            record_stream(camera, arm, writer, duration_s=0.3)
        with (
            pytest.raises(SessionError, match="tool offset is not the one"),
            SessionWriter.append(path, "sequence", camera.info) as writer,
        ):
            writer.add_robot_trace(arm_trace(arm), [0.0, 0.0, 0.1, 0.0, 0.0, 0.0])


def arm_trace(arm: UrReceiver) -> RobotTrace:
    arm.start_trace()
    time.sleep(0.1)
    return arm.stop_trace()
