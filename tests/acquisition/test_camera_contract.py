"""What every camera driver promises, held against real peers: the simulated camera through Aravis and through
harvesters, and the producer that ships with genicam through harvesters."""

from __future__ import annotations

import signal
import time
from collections.abc import Callable, Iterator
from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest

from acquisition.camera import Camera, CameraConfig
from acquisition.cameras.aravis import AravisCamera
from acquisition.cameras.harvesters import HarvestersCamera
from acquisition.simulation.camera import SimulatedCamera
from dataset.errors import DeviceError
from dataset.pixel_formats import pixel_format
from dataset.session import Session, SessionWriter

Open = Callable[..., Camera]


@pytest.fixture(scope="module", params=["aravis", "harvesters", "viky"])
def opener(request: pytest.FixtureRequest, viky: CameraConfig, gige_producer: Path) -> Iterator[Open]:
    """Opens the peer's camera, with changes to its configuration."""
    if request.param == "viky":
        yield lambda **changes: HarvestersCamera(replace(viky, **changes))
        return
    with SimulatedCamera(width=256, height=192, frame_rate=100, latency_s=0.002):
        if request.param == "aravis":
            config = CameraConfig("127.0.0.1", frame_rate=100)
            yield lambda **changes: AravisCamera(replace(config, **changes))
        else:
            config = CameraConfig("SIM00001", frame_rate=100, producer=str(gige_producer))
            yield lambda **changes: HarvestersCamera(replace(config, **changes))


@pytest.mark.devices
class TestEveryCamera:
    def test_says_what_its_frames_are(self, opener: Open) -> None:
        with opener() as camera:
            info = camera.info
            camera.start()
            frame = camera.read()
        format_ = pixel_format(info.pixel_format)
        assert info.vendor
        assert info.model
        assert info.serial
        assert frame.pixels.shape == (info.height, info.width)
        assert frame.pixels.dtype == format_.dtype
        assert (frame.pixel_format, info.bits) == (format_.name, format_.bits)
        assert info.mosaic == ("colour" if format_.colour else "mono")
        assert frame.missing_packets == 0
        assert len(np.unique(frame.pixels)) > 1

    def test_ids_and_times_grow(self, opener: Open) -> None:
        with opener() as camera:
            camera.start()
            before_ns = time.monotonic_ns()
            frames = [camera.read() for _ in range(12)]
            after_ns = time.monotonic_ns()
            statistics = camera.statistics
        lost = statistics.incomplete + statistics.discarded + statistics.underruns
        ids = [frame.frame_id for frame in frames]
        assert all(a < b for a, b in pairwise(ids))
        assert ids[-1] - ids[0] < len(ids) + lost
        for times in ([f.camera_time_ns for f in frames], [f.host_time_ns for f in frames]):
            assert all(a < b for a, b in pairwise(times))
        assert before_ns < frames[0].host_time_ns < frames[-1].host_time_ns < after_ns
        assert statistics.frames >= len(frames)
        assert {frame.clock_epoch for frame in frames} == {0}

    def test_says_whose_clock_its_times_are_on(self, opener: Open) -> None:
        with opener() as camera:
            camera.start()
            frames = [camera.read() for _ in range(5)]
            clock = camera.info.clock
        same = [frame.camera_time_ns == frame.host_time_ns for frame in frames]
        assert all(same) if clock == "host" else not any(same)

    def test_frames_are_memory_of_their_own(self, opener: Open) -> None:
        with opener() as camera:
            camera.start()
            frames = [camera.read() for _ in range(20)]
            copies = [frame.pixels.copy() for frame in frames]
            for _ in range(20):
                camera.read()
        for frame, copy in zip(frames, copies, strict=True):
            np.testing.assert_array_equal(frame.pixels, copy)

    def test_unread_frames_are_counted(self, opener: Open) -> None:
        with opener() as camera:
            camera.start()
            first = camera.read()
            deadline = time.monotonic() + 10
            while camera.statistics.discarded < 5 and time.monotonic() < deadline:
                time.sleep(0.05)
            assert camera.read().frame_id - first.frame_id > 5

    def test_starts_again_and_refuses_what_is_out_of_order(self, opener: Open) -> None:
        camera = opener()
        with pytest.raises(DeviceError, match=r"not started; call start\(\) first"):
            camera.read()
        with pytest.raises(DeviceError, match="not started"):
            camera.trigger()
        for _ in range(2):
            camera.start()
            with pytest.raises(DeviceError, match="already started; stop it first"):
                camera.start()
            with pytest.raises(DeviceError, match="does not wait for software triggers"):
                camera.trigger()
            assert camera.read().pixels.size
            camera.stop()
            camera.stop()
        camera.close()
        camera.close()
        with pytest.raises(DeviceError, match="is closed; open it again"):
            camera.start()

    def test_refuses_a_format_and_a_rate_that_it_has_not(self, opener: Open) -> None:
        with pytest.raises(DeviceError, match=r"has no pixel format Mono12Packed; it offers .*Mono8"):
            opener(pixel_format="Mono12Packed")
        with pytest.raises(DeviceError, match=r"cannot take frame_rate = 1e\+06: its Acqu"):
            opener(frame_rate=1e6)
        opener().close()

    def test_reconnects_and_goes_on(self, opener: Open) -> None:
        with opener() as camera:
            camera.start()
            before = [camera.read() for _ in range(3)][-1]
            camera.reconnect()
            # What had arrived before is still there to be read.
            after = [camera.read() for _ in range(25)]
        ids = [frame.frame_id for frame in [before, *after]]
        epochs = [frame.clock_epoch for frame in after]
        assert all(a < b for a, b in pairwise(ids))
        assert epochs == sorted(epochs)
        assert epochs[-1] == 1

    def test_leaves_ctrl_c_alone(self, opener: Open) -> None:
        before = signal.getsignal(signal.SIGINT)
        opener().close()
        assert signal.getsignal(signal.SIGINT) is before

    def test_its_frames_go_into_a_session(self, opener: Open, tmp_path: Path) -> None:
        path = tmp_path / "session.h5"
        with opener() as camera, SessionWriter(path, "sequence", camera.info) as writer:
            camera.start()
            frames = [camera.read() for _ in range(3)]
            for frame in frames:
                writer.add_frame(frame)
        with Session.open(path) as session:
            assert session.camera == camera.info
            for index, frame in enumerate(frames):
                np.testing.assert_array_equal(session.raw(index), frame.pixels)
