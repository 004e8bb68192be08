"""The harvesters driver: with the producer of the genicam wheel, and the simulated camera over the wire."""

from __future__ import annotations

import time
from collections.abc import Iterator
from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest

from acquisition.camera import CameraConfig, CameraLost
from acquisition.cameras.aravis import AravisCamera
from acquisition.cameras.harvesters import HarvestersCamera
from acquisition.simulation.camera import SimulatedCamera
from acquisition.simulation.patterns import MovingPattern
from dataset.errors import DeviceError
from dataset.frames import RawFrame
from dataset.on_camera import compute_on_camera
from dataset.pixel_formats import pixel_format


class TestProducers:
    """Which producer is asked, and what a camera without clock, exposure and triggers is to us."""

    def test_times_of_arrival_are_called_the_hosts(self, viky: CameraConfig) -> None:
        with HarvestersCamera(viky) as camera:
            assert camera.info.clock == "host"
            camera.start()
            frame = camera.read()
        assert np.isnan(frame.exposure_us)
        assert np.isnan(frame.gain_db)

    def test_the_producer_is_found_where_the_standard_says(
        self, viky: CameraConfig, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        assert viky.producer is not None
        monkeypatch.setenv("GENICAM_GENTL64_PATH", f"/nowhere:{Path(viky.producer).parent}")
        with HarvestersCamera(replace(viky, producer=None)) as camera:
            assert camera.info.model == "Viky"

    def test_what_is_missing_is_named(self, viky: CameraConfig, monkeypatch: pytest.MonkeyPatch) -> None:
        monkeypatch.delenv("GENICAM_GENTL64_PATH", raising=False)
        with pytest.raises(DeviceError, match=r"GENICAM_GENTL64_PATH names no folder.*as producer"):
            HarvestersCamera(replace(viky, producer=None))
        with pytest.raises(DeviceError, match=r"no GenTL producer /nowhere\.cti; correct producer"):
            HarvestersCamera(replace(viky, producer="/nowhere.cti"))
        with pytest.raises(DeviceError, match=r"0 cameras are called 'nobody'.*id VikyTL_DEV_blue"):
            HarvestersCamera(replace(viky, address="nobody"))
        with pytest.raises(DeviceError, match="3 cameras are called 'Viky'"):
            HarvestersCamera(replace(viky, address="Viky"))

    def test_a_file_that_is_no_producer(self, viky: CameraConfig, tmp_path: Path) -> None:
        fake = tmp_path / "fake.cti"
        fake.write_text("not a library")
        with pytest.raises(DeviceError, match=r"fake\.cti lists none: check cable and power"):
            HarvestersCamera(replace(viky, producer=str(fake)))

    @pytest.mark.parametrize("trigger", ["software", "line"])
    def test_a_camera_without_triggers_says_so(self, viky: CameraConfig, trigger: str) -> None:
        with HarvestersCamera(viky) as camera, pytest.raises(DeviceError, match="cannot be triggered"):
            camera.start(trigger)

    def test_a_camera_that_another_program_has(self, viky: CameraConfig) -> None:
        with HarvestersCamera(viky), pytest.raises(DeviceError, match="close others"):
            HarvestersCamera(viky)


@pytest.fixture(scope="module")
def running() -> Iterator[SimulatedCamera]:
    with SimulatedCamera(width=256, height=192, frame_rate=50, latency_s=0.002) as camera:
        yield camera


@pytest.fixture
def simulated(running: SimulatedCamera) -> Iterator[SimulatedCamera]:
    """The camera of the module, back from whatever the test did to it."""
    yield running
    if not running.running:
        running.start()


@pytest.fixture
def config(simulated: SimulatedCamera, gige_producer: Path) -> CameraConfig:
    del simulated
    return CameraConfig("SIM00001", exposure_us=8_000, gain_db=1.5, timeout_s=30, producer=str(gige_producer))


def assert_true_to(frame: RawFrame, simulated: SimulatedCamera) -> None:
    """The frame is bit for bit what the camera computes of the source at the time that the frame carries."""
    format_ = pixel_format(frame.pixel_format)
    start_ns = frame.camera_time_ns + simulated.clock().origin_ns
    mosaic = MovingPattern().frame(format_.raw_name, 192, 256, 8_000.0, 1.5, start_ns)
    np.testing.assert_array_equal(frame.pixels, compute_on_camera(mosaic, format_))


def read_until_it_is_lost(camera: HarvestersCamera) -> str:
    for _ in range(200):
        try:
            camera.read()
        except CameraLost as error:
            return str(error)
    pytest.fail("the fault went unnoticed")


@pytest.mark.devices
class TestOverTheWire:
    """A camera with everything, by way of a producer for GigE Vision."""

    @pytest.mark.parametrize(
        "name",
        [
            *("Mono12p", "BayerRG8", "BayerRG10p", "BayerRG12p", "BayerRG16"),
            # harvesters has never heard of these.
            "PolarizedAngles_0d_45d_90d_135d_BayerRG8",
            "PolarizedStokes_S0_S1_S2_BayerRG12p",
            "PolarizedDolpAolp_BayerRG8",
        ],
    )
    def test_frames_are_bit_exact(self, config: CameraConfig, simulated: SimulatedCamera, name: str) -> None:
        with HarvestersCamera(replace(config, pixel_format=name)) as camera:
            assert (camera.info.pixel_format, camera.info.clock) == (name, "camera")
            camera.start()
            frames = [camera.read() for _ in range(3)]
        for frame in frames:
            assert (frame.exposure_us, frame.gain_db) == (8_000, 1.5)
            assert_true_to(frame, simulated)

    def test_each_software_trigger_gives_one_frame(
        self, config: CameraConfig, simulated: SimulatedCamera
    ) -> None:
        with HarvestersCamera(replace(config, trigger="software")) as camera:
            camera.start()
            frames = []
            for _ in range(4):
                triggered_ns = time.monotonic_ns()
                camera.trigger()
                frames.append(camera.read())
                assert frames[-1].camera_time_ns + simulated.clock().origin_ns > triggered_ns
            with pytest.raises(DeviceError, match="that a trigger came if it waits for one"):
                camera.read(timeout_s=0.3)
        assert [b.frame_id - a.frame_id for a, b in pairwise(frames)] == [1, 1, 1]

    def test_settings_out_of_range_are_refused_with_the_range(self, config: CameraConfig) -> None:
        with pytest.raises(DeviceError, match=r"gain_db = 99: its Gain goes from 0 to 48"):
            HarvestersCamera(replace(config, gain_db=99))

    def test_a_camera_that_another_program_controls(
        self, config: CameraConfig, simulated: SimulatedCamera
    ) -> None:
        with (
            AravisCamera(CameraConfig(simulated.address)),
            pytest.raises(DeviceError, match=r"could not be opened .*; close other programs that use it"),
        ):
            HarvestersCamera(config)

    def test_incomplete_frames_are_counted_and_never_returned(
        self, config: CameraConfig, simulated: SimulatedCamera
    ) -> None:
        with HarvestersCamera(replace(config, frame_rate=100)) as camera:
            simulated.set_lost_ratio(0.05)
            try:
                camera.start()
                for _ in range(15):
                    assert_true_to(camera.read(), simulated)
                statistics = camera.statistics
            finally:
                simulated.set_lost_ratio(0.0)
        assert statistics.incomplete > 0
        assert statistics.frames >= 15

    def test_a_camera_that_loses_power_is_missed_at_once(
        self, config: CameraConfig, simulated: SimulatedCamera
    ) -> None:
        with HarvestersCamera(config) as camera:
            camera.start()
            camera.read()
            simulated.kill()
            killed = time.monotonic()
            assert "stopped answering; check its power and cable" in read_until_it_is_lost(camera)
            assert time.monotonic() - killed < 10  # not the time-out of 30 s
        simulated.start()
        HarvestersCamera(config).close()

    def test_a_camera_that_was_restarted_goes_on_after_a_reconnection(
        self, config: CameraConfig, simulated: SimulatedCamera
    ) -> None:
        with HarvestersCamera(config) as camera:
            camera.start()
            before = [camera.read() for _ in range(3)]
            simulated.kill()
            simulated.start()
            assert "was restarted, or lost sight of this computer" in read_until_it_is_lost(camera)
            camera.reconnect()
            after = [camera.read() for _ in range(5)]
            assert_true_to(after[-1], simulated)
        assert all(a.frame_id < b.frame_id for a, b in pairwise([*before, *after]))
        assert ({f.clock_epoch for f in before}, {f.clock_epoch for f in after}) == ({0}, {1})
