"""The GigE Vision driver against the simulated camera: every frame crosses the real protocol."""

import shutil
import subprocess
import time
from itertools import pairwise

import numpy as np
import pytest

from acquisition.camera import CameraConfig
from acquisition.cameras.aravis import AravisCamera
from acquisition.simulation.camera import SimulatedCamera
from acquisition.simulation.patterns import MovingPattern
from dataset.errors import DeviceError
from dataset.frames import RawFrame

pytestmark = pytest.mark.devices

ADDRESS = "127.0.0.1"
FORMATS = ["Mono8", "Mono10p", "Mono12p", "Mono16", "BayerRG8", "BayerRG10p", "BayerRG12p", "BayerRG16"]


def assert_true_to(frame: RawFrame, camera: SimulatedCamera, speed_px_s: float = 200.0) -> None:
    """The frame is bit for bit what the source shows at the time that the frame carries."""
    start_ns = frame.camera_time_ns + camera.clock().origin_ns
    expected = MovingPattern(speed_px_s).frame(
        frame.pixel_format, 192, 256, frame.exposure_us, frame.gain_db, start_ns
    )
    np.testing.assert_array_equal(frame.pixels, expected)
    assert frame.pixels.dtype == expected.dtype


@pytest.mark.parametrize("name", FORMATS)
def test_frames_are_bit_exact(simulated_camera: SimulatedCamera, name: str) -> None:
    config = CameraConfig(ADDRESS, pixel_format=name, exposure_us=8_000, gain_db=1.5)
    with AravisCamera(config) as camera:
        camera.start()
        frames = [camera.read() for _ in range(5)]
    for frame in frames:
        assert (frame.pixel_format, frame.exposure_us, frame.gain_db) == (name, 8_000, 1.5)
        assert frame.missing_packets == 0
        assert_true_to(frame, simulated_camera)


def test_info_names_the_camera(simulated_camera: SimulatedCamera) -> None:
    with AravisCamera(CameraConfig(ADDRESS, pixel_format="BayerRG12p", packet_size=1500)) as camera:
        info = camera.info
    assert (info.vendor, info.model, info.serial) == ("Lucid Vision Labs", "PHX050S-Q", "SIM00001")
    assert (info.mosaic, info.bits, info.pixel_format) == ("colour", 12, "BayerRG12p")
    assert (info.width, info.height, info.packet_size) == (256, 192, 1500)


def test_host_time_is_the_first_packets_and_comes_after_the_latency(
    simulated_camera: SimulatedCamera,
) -> None:
    with AravisCamera(CameraConfig(ADDRESS)) as camera:
        camera.start()
        frames = [camera.read() for _ in range(5)]
        now_ns = time.monotonic_ns()
    origin_ns = simulated_camera.clock().origin_ns
    for frame in frames:
        start_ns = frame.camera_time_ns + origin_ns
        # Aravis counts the arrival in microseconds.
        assert start_ns + 2_000_000 - 2_000 <= frame.host_time_ns < now_ns


def test_each_software_trigger_gives_one_frame(simulated_camera: SimulatedCamera) -> None:
    with AravisCamera(CameraConfig(ADDRESS, trigger="software")) as camera:
        camera.start()
        frames = []
        for _ in range(5):
            triggered_ns = time.monotonic_ns()
            camera.trigger()
            frames.append(camera.read())
            start_ns = frames[-1].camera_time_ns + simulated_camera.clock().origin_ns
            assert start_ns > triggered_ns
        with pytest.raises(DeviceError, match="trigger"):
            camera.read(timeout_s=0.3)
    assert [b.frame_id - a.frame_id for a, b in pairwise(frames)] == [1, 1, 1, 1]


def test_trigger_discards_what_was_not_read(simulated_camera: SimulatedCamera) -> None:
    with AravisCamera(CameraConfig(ADDRESS)) as camera:
        camera.start("software")
        camera.trigger()
        deadline = time.monotonic() + 5
        while camera.statistics.frames == 0 and time.monotonic() < deadline:
            time.sleep(0.01)
        triggered_ns = time.monotonic_ns()
        camera.trigger()
        frame = camera.read()
        assert camera.statistics.discarded == 1
    assert frame.camera_time_ns + simulated_camera.clock().origin_ns > triggered_ns


def test_settings_out_of_range_are_refused_with_the_range(simulated_camera: SimulatedCamera) -> None:
    with pytest.raises(DeviceError, match=r"gain_db = 99: its Gain goes from 0 to 48"):
        AravisCamera(CameraConfig(ADDRESS, gain_db=99))
    with pytest.raises(DeviceError, match=r"exposure_us = 1e\+12: its ExposureTime goes from 20 to 1e\+07"):
        AravisCamera(CameraConfig(ADDRESS, exposure_us=1e12))
    with pytest.raises(DeviceError, match="no pixel format Mono12Packed; it offers Mono8"):
        AravisCamera(CameraConfig(ADDRESS, pixel_format="Mono12Packed"))
    # Each of them let go of the camera.
    AravisCamera(CameraConfig(ADDRESS)).close()


@pytest.mark.skipif(shutil.which("arv-tool-0.8") is None, reason="needs Debian's aravis-tools-cli")
def test_a_camera_left_automatic_cropped_mirrored_and_bent_is_set_right(
    simulated_camera: SimulatedCamera,
) -> None:
    def control(*features: str) -> str:
        command = ["arv-tool-0.8", "-a", ADDRESS, "control", *features]
        return subprocess.run(command, capture_output=True, text=True, timeout=20, check=True).stdout

    control("Width=64", "OffsetX=32", "ReverseX=1", "GammaEnable=1")
    control("ExposureAuto=Continuous", "GainAuto=Continuous", "BalanceWhiteAuto=Continuous")
    with AravisCamera(CameraConfig(ADDRESS)) as camera:
        assert (camera.info.width, camera.info.height) == (256, 192)
    after = control("OffsetX", "ExposureAuto", "GainAuto", "BalanceWhiteAuto", "ReverseX", "GammaEnable")
    assert "OffsetX = 0" in after
    assert after.count("= Off") == 3
    assert after.count("= false") == 2


def test_second_client_is_told_why(simulated_camera: SimulatedCamera) -> None:
    with AravisCamera(CameraConfig(ADDRESS)) as first:
        first.start()
        started = time.monotonic()
        with pytest.raises(DeviceError, match="another program controls the camera"):
            AravisCamera(CameraConfig(ADDRESS))
        assert time.monotonic() - started < 5
        assert_true_to(first.read(), simulated_camera)


def test_incomplete_frames_are_counted_and_never_returned(simulated_camera: SimulatedCamera) -> None:
    with AravisCamera(CameraConfig(ADDRESS, frame_rate=100, packet_size=576)) as camera:
        simulated_camera.set_lost_ratio(0.01)
        try:
            camera.start()
            for _ in range(15):
                assert_true_to(camera.read(timeout_s=10), simulated_camera)
            statistics = camera.statistics
        finally:
            simulated_camera.set_lost_ratio(0.0)
    assert statistics.incomplete > 0
    assert statistics.frames >= 15


def test_a_stream_that_never_arrives_says_what_to_check(simulated_camera: SimulatedCamera) -> None:
    with AravisCamera(CameraConfig(ADDRESS)) as camera:
        simulated_camera.set_lost_ratio(1.0)
        try:
            camera.start()
            with pytest.raises(
                DeviceError, match="not one packet of the stream arrived; check that the fire"
            ):
                camera.read(timeout_s=0.5)
        finally:
            simulated_camera.set_lost_ratio(0.0)
