"""What every camera driver promises, held against real peers: the simulated camera through Aravis, and the
GenTL producer that ships with genicam through harvesters."""

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


def viky() -> CameraConfig:
    genicam = pytest.importorskip("genicam")
    producer = Path(genicam.__file__).with_name("viky.cti")
    return CameraConfig("1", pixel_format="Mono8", frame_rate=100, producer=str(producer))


@pytest.fixture(scope="module", params=["aravis", "harvesters"])
def opener(request: pytest.FixtureRequest) -> Iterator[Open]:
    """Opens the peer's camera, with changes to its configuration."""
    if request.param == "harvesters":
        yield lambda **changes: HarvestersCamera(replace(viky(), **changes))
        return
    with SimulatedCamera(width=256, height=192, frame_rate=100, latency_s=0.002):
        config = CameraConfig("127.0.0.1", frame_rate=100)
        yield lambda **changes: AravisCamera(replace(config, **changes))


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


class TestGenTL:
    """What only the harvesters driver does."""

    def test_times_of_arrival_are_called_the_hosts(self) -> None:
        with HarvestersCamera(viky()) as camera:
            assert camera.info.clock == "host"
            camera.start()
            frame = camera.read()
        assert np.isnan(frame.exposure_us)
        assert np.isnan(frame.gain_db)

    def test_the_producer_is_found_where_the_standard_says(self, monkeypatch: pytest.MonkeyPatch) -> None:
        config = viky()
        assert config.producer is not None
        monkeypatch.setenv("GENICAM_GENTL64_PATH", f"/nowhere:{Path(config.producer).parent}")
        with HarvestersCamera(replace(config, producer=None)) as camera:
            assert camera.info.model == "Viky"

    def test_what_is_missing_is_named(self, monkeypatch: pytest.MonkeyPatch) -> None:
        monkeypatch.delenv("GENICAM_GENTL64_PATH", raising=False)
        config = viky()
        with pytest.raises(DeviceError, match=r"GENICAM_GENTL64_PATH names no folder.*as producer"):
            HarvestersCamera(replace(config, producer=None))
        with pytest.raises(DeviceError, match=r"no GenTL producer /nowhere\.cti; correct producer"):
            HarvestersCamera(replace(config, producer="/nowhere.cti"))
        with pytest.raises(DeviceError, match=r"0 cameras are called 'nobody'.*id VikyTL_DEV_blue"):
            HarvestersCamera(replace(config, address="nobody"))
        with pytest.raises(DeviceError, match="3 cameras are called 'Viky'"):
            HarvestersCamera(replace(config, address="Viky"))

    def test_a_file_that_is_no_producer(self, tmp_path: Path) -> None:
        fake = tmp_path / "fake.cti"
        fake.write_text("not a library")
        with pytest.raises(DeviceError, match=r"fake\.cti lists none: check cable and power"):
            HarvestersCamera(replace(viky(), producer=str(fake)))

    @pytest.mark.parametrize("trigger", ["software", "line"])
    def test_a_camera_without_triggers_says_so(self, trigger: str) -> None:
        with HarvestersCamera(viky()) as camera, pytest.raises(DeviceError, match="cannot be triggered"):
            camera.start(trigger)

    def test_a_camera_that_another_program_has(self) -> None:
        with HarvestersCamera(viky()), pytest.raises(DeviceError, match="close others"):
            HarvestersCamera(viky())
