"""From a running camera into a file: what is not stored is in the ledger, whatever the reason."""

from __future__ import annotations

import time
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import pytest

from acquisition.camera import CameraConfig
from acquisition.cameras.aravis import AravisCamera
from acquisition.frame_stream import NOT_RECEIVED, QUEUE_FULL, FrameLedger, FrameStream
from acquisition.recorder import Progress, record_stream
from acquisition.simulation.camera import SimulatedCamera
from dataset.errors import DeviceError
from dataset.frames import RawFrame
from dataset.session import Chunk, Session, SessionWriter
from dataset.validate import validate

pytestmark = pytest.mark.devices


@pytest.fixture
def camera(simulated_camera: SimulatedCamera) -> Iterator[AravisCamera]:
    with AravisCamera(CameraConfig("127.0.0.1", exposure_us=4_000)) as camera:
        yield camera


def test_incomplete_frames_are_ledgered(
    tmp_path: Path, simulated_camera: SimulatedCamera, camera: AravisCamera
) -> None:
    simulated_camera.set_lost_ratio(0.02)
    try:
        with SessionWriter(tmp_path / "s.h5", "sequence", camera.info) as writer:
            record_stream(camera, None, writer, duration_s=1.5)
    finally:
        simulated_camera.set_lost_ratio(0.0)
    statistics = camera.statistics
    assert validate(tmp_path / "s.h5") == []  # every gap is in the ledger
    with Session.open(tmp_path / "s.h5") as session:
        lost = session.drops[session.drops["reason"] == NOT_RECEIVED.encode()]
        assert 0 < len(lost) <= statistics.incomplete + statistics.discarded + statistics.underruns
        assert (lost["host_time_ns"] > session.host_time_ns[0]).all()


def test_a_stream_that_stops_is_told_as_such_and_ends_the_recording(
    tmp_path: Path, simulated_camera: SimulatedCamera, camera: AravisCamera
) -> None:
    def stop_it(progress: Progress) -> None:
        if progress.frames > 20:
            simulated_camera.set_lost_ratio(1.0)

    try:
        with (
            pytest.raises(
                DeviceError, match="within 2 s: its stream stopped although it answers; check the ca"
            ),
            SessionWriter(tmp_path / "s.h5", "sequence", camera.info) as writer,
        ):
            record_stream(camera, None, writer, duration_s=60.0, on_progress=stop_it)
    finally:
        simulated_camera.set_lost_ratio(0.0)
    with Session.open(tmp_path / "s.h5") as session:
        assert len(session) > 20
        assert not session.complete


class SlowDisk(SessionWriter):
    """A writer on a disk that is too slow for the camera."""

    def add_frame(self, frame: RawFrame, chunk: Chunk | None = None) -> int:
        time.sleep(0.05)
        return super().add_frame(frame, chunk)


def test_frames_that_the_disk_cannot_take_are_ledgered(tmp_path: Path, camera: AravisCamera) -> None:
    with SlowDisk(tmp_path / "s.h5", "sequence", camera.info) as writer:
        ledger = FrameLedger(writer)
        camera.start("free")
        with FrameStream(camera, ledger, depth=2):
            time.sleep(1.0)
        camera.stop()
    assert validate(tmp_path / "s.h5") == []  # every gap is in the ledger
    with Session.open(tmp_path / "s.h5") as session:
        assert (len(session), len(session.drops)) == (ledger.stored, ledger.dropped)
        assert QUEUE_FULL.encode() in session.drops["reason"]


def test_a_counter_that_jumps_wildly_is_an_error_and_no_endless_ledger(
    tmp_path: Path, camera: AravisCamera
) -> None:
    with SessionWriter(tmp_path / "s.h5", "sequence", camera.info) as writer:
        ledger = FrameLedger(writer)
        camera.start("free")
        frame = camera.read()
        camera.stop()
        ledger.store(frame)
        with pytest.raises(DeviceError, match=r"frame counter jumped from \d+ to \d+; restart the camera"):
            ledger.store(replace(frame, frame_id=frame.frame_id + 10**12))
        ledger.store(replace(frame, frame_id=frame.frame_id + 3))
    with Session.open(tmp_path / "s.h5") as session:
        assert (len(session), len(session.drops)) == (2, 2)
