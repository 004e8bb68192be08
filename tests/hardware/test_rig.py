"""A lab's own devices: `S2P3_RIG=rig.toml pytest tests/hardware`. Nothing here moves the arm.

What the suite shows with simulated devices, shown again with real ones: they answer as the rig file says,
neither a frame nor a sample goes missing in silence, and a recording holds what happened.
"""

from __future__ import annotations

import os
import time
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest

from acquisition.recorder import record_stream
from acquisition.rig import Rig, open_camera, open_pose_source
from dataset.session import Session, SessionWriter
from dataset.session.accounting import account
from dataset.validate import validate
from s2p3.doctor import doctor

SECONDS = 10.0


@pytest.fixture(scope="module")
def rig() -> Rig:
    if "S2P3_RIG" not in os.environ:
        pytest.skip("S2P3_RIG names no rig file")
    return Rig.load(os.environ["S2P3_RIG"])


def test_the_doctor_finds_nothing_to_mend(rig: Rig) -> None:
    assert [f"{check.name}: {check.detail}; {check.fix}" for check in doctor(rig) if not check.ok] == []


def test_every_frame_is_received_or_counted(rig: Rig) -> None:
    with open_camera(rig) as camera:
        camera.start("free")
        frames = [camera.read()]
        while frames[-1].host_time_ns - frames[0].host_time_ns < 1e9 * SECONDS:
            frames.append(camera.read())
        statistics = camera.statistics
    missing = frames[-1].frame_id - frames[0].frame_id + 1 - len(frames)
    assert missing <= statistics.incomplete + statistics.discarded + statistics.underruns
    assert all(a.camera_time_ns < b.camera_time_ns for a, b in pairwise(frames))
    assert {frame.clock_epoch for frame in frames} == {0}
    assert len(np.unique(frames[-1].pixels)) > 1


def test_each_software_trigger_gives_one_frame(rig: Rig) -> None:
    with open_camera(rig) as camera:
        camera.start("software")
        ids = []
        for _ in range(5):
            camera.trigger()
            ids.append(camera.read().frame_id)
    assert np.diff(ids).tolist() == [1, 1, 1, 1]


def test_the_trace_of_the_arm_has_no_hole(rig: Rig) -> None:
    with open_pose_source(rig) as arm:
        arm.start_trace()
        time.sleep(SECONDS)
        trace = arm.stop_trace()
    steps_s = np.diff(trace.robot_time_s)
    np.testing.assert_allclose(steps_s, 1 / rig.robot.frequency_hz, rtol=0.5)
    assert len(trace) > 0.9 * SECONDS * rig.robot.frequency_hz


def test_a_recording_accounts_for_every_frame_and_follows_both_clocks(rig: Rig, tmp_path: Path) -> None:
    path = tmp_path / "rig.h5"
    with (
        open_camera(rig) as camera,
        open_pose_source(rig) as arm,
        SessionWriter(path, "sequence", camera.info, rig_toml=rig.to_toml()) as writer,
    ):
        done = record_stream(camera, arm, writer, duration_s=SECONDS)
    assert done.warnings == ()
    assert validate(path) == []
    with Session.open(path) as session:
        counted = account(session)
        assert counted.silent == 0
        assert counted.ledgered < 0.01 * counted.offered
        trace = session.robot
        assert trace is not None
        assert trace.host_time_ns[0] < session.mid_exposure_host_ns[0]
        assert trace.host_time_ns[-1] > session.mid_exposure_host_ns[-1]
