"""What the driver sets, and what the camera then does: formats, triggers, locks, the network's clock."""

from __future__ import annotations

import time
from pathlib import Path

import numpy as np
import pytest

from acquisition.camera import CameraConfig
from acquisition.cameras.aravis import AravisCamera
from acquisition.cameras.gvcp import read_register
from acquisition.simulation.camera import SimulatedCamera
from acquisition.simulation.patterns import MovingPattern
from dataset.errors import DeviceError, ToolkitError
from dataset.on_camera import compute_on_camera
from dataset.pixel_formats import PIXEL_FORMATS, PixelFormat
from dataset.polarimetry import decode
from dataset.session import Session, SessionWriter

pytestmark = pytest.mark.devices

ADDRESS = "127.0.0.1"
ON_CAMERA = [format_ for format_ in PIXEL_FORMATS if format_.channels and format_.colour]


TRIGGER_SELECTOR, TRIGGER_MODE, TRIGGER_SOURCE, TRIGGER_ACTIVATION = 0xA008, 0x300, 0x304, 0x308
FRAME_RATE_ENABLE, FRAME_PERIOD_US = 0xA004, 0x138


def registers(*addresses: int) -> list[int]:
    """What the camera itself holds, as any bystander reads it."""
    return [read_register(ADDRESS, address) for address in addresses]


@pytest.mark.parametrize("format_", ON_CAMERA, ids=lambda format_: format_.name)
def test_what_the_camera_computes_comes_bit_for_bit_and_decodes(
    simulated_camera: SimulatedCamera, format_: PixelFormat, tmp_path: Path
) -> None:
    with AravisCamera(CameraConfig(ADDRESS, pixel_format=format_.name, exposure_us=8_000)) as camera:
        info = camera.info
        with SessionWriter(tmp_path / "session.h5", "sequence", info) as writer:
            camera.start()
            frame = camera.read()
            writer.add_frame(frame)
    assert (info.width, info.height, info.mosaic, info.bits) == (256, 192, "colour", format_.bits)
    start_ns = frame.camera_time_ns + simulated_camera.clock().origin_ns
    mosaic = MovingPattern().frame(format_.raw_name, 192, 256, 8_000.0, 0.0, start_ns)
    np.testing.assert_array_equal(frame.pixels, compute_on_camera(mosaic, format_))
    truth = decode(mosaic, "colour", format_.bits)
    with Session.open(tmp_path / "session.h5") as session:
        if format_.content in ("angles", "stokes"):
            stokes = session.stokes(0, undistort=False)
            assert np.abs(stokes.stack() - truth.stack()).max() < 2.01 / (1 << format_.bits)
            np.testing.assert_array_equal(stokes.valid, truth.valid)
            return
        with pytest.raises(ToolkitError, match=rf"holds no intensity.*record {format_.raw_name}"):
            session.stokes(0, undistort=False)
        found = session.polarization(0)
        strong = truth.dolp > 0.2
        if found.dolp is not None:
            # A mean of four colours' degrees is not the degree of their mean where it changes within a cell.
            assert np.abs(found.dolp - truth.dolp)[strong].max() < 0.1
            assert np.median(np.abs(found.dolp - truth.dolp)[strong]) < 0.003
        if found.aolp is not None:
            assert np.abs(np.sin(found.aolp - truth.aolp))[strong].max() < 0.05


def test_frames_of_another_geometry_are_refused(simulated_camera: SimulatedCamera) -> None:
    simulated_camera.command("payload-padding 64")
    try:
        with pytest.raises(DeviceError, match=r"sends 36928 bytes .* 36864 were .* pixel_format to Bay"):
            AravisCamera(CameraConfig(ADDRESS, pixel_format="PolarizedStokes_S0_S1_S2_BayerRG8"))
        # Of a raw mosaic only the beginning is read: cameras may fill up a raw buffer's end.
        with AravisCamera(CameraConfig(ADDRESS)) as camera:
            assert camera.info.pixel_format == "BayerRG8"
    finally:
        simulated_camera.command("payload-padding 0")


def test_a_line_trigger_is_armed_and_frames_wait_for_its_edge(simulated_camera: SimulatedCamera) -> None:
    with AravisCamera(CameraConfig(ADDRESS, trigger="line", trigger_line="Line2")) as camera:
        camera.start()
        armed = registers(TRIGGER_SELECTOR, TRIGGER_MODE, TRIGGER_SOURCE, TRIGGER_ACTIVATION)
        assert armed == [0, 1, 2, 0]  # FrameStart, On, Line2, RisingEdge
        with pytest.raises(DeviceError, match="does not wait for software triggers"):
            camera.trigger()
        with pytest.raises(DeviceError, match="that a trigger came if it waits for one"):
            camera.read(0.2)
        camera.stop()
        camera.start("free")
        assert registers(TRIGGER_MODE) == [0]
        camera.read()


def test_a_line_that_the_camera_has_not(simulated_camera: SimulatedCamera) -> None:
    with (
        AravisCamera(CameraConfig(ADDRESS, trigger="line", trigger_line="Line9")) as camera,
        pytest.raises(DeviceError, match=r"no trigger source Line9; it offers Line0, .*trigger_line"),
    ):
        camera.start()


def test_an_automatic_exposure_that_stays_on_is_no_secret(simulated_camera: SimulatedCamera) -> None:
    simulated_camera.command("stuck-auto yes")
    try:
        with pytest.raises(
            DeviceError,
            match=r"keeps ExposureAuto at Continuous, not Off.*; set it so in the maker's",
        ):
            AravisCamera(CameraConfig(ADDRESS))
    finally:
        simulated_camera.command("stuck-auto no")


def test_the_frame_rate_is_enabled_first_and_bounds_no_exposure(simulated_camera: SimulatedCamera) -> None:
    with AravisCamera(CameraConfig(ADDRESS, frame_rate=40)) as camera:
        camera.start()
        frames = [camera.read() for _ in range(9)]
        assert registers(FRAME_RATE_ENABLE, FRAME_PERIOD_US) == [1, 25_000]
    period_s = np.median(np.diff([frame.camera_time_ns for frame in frames])) * 1e-9
    assert period_s == pytest.approx(1 / 40, rel=0.2)


def test_a_clock_without_a_master_is_an_error_that_says_what_to_run(
    simulated_camera: SimulatedCamera,
) -> None:
    started = time.monotonic()
    with pytest.raises(
        DeviceError, match=r"no master clock within 0\.3 s \(PtpStatus is Listening\); run.*ptp4l"
    ):
        AravisCamera(CameraConfig(ADDRESS, ptp=True, ptp_timeout_s=0.3))
    assert time.monotonic() - started < 5


def test_with_a_master_frames_carry_the_time_of_day(simulated_camera: SimulatedCamera) -> None:
    simulated_camera.command("ptp-master yes")
    try:
        with AravisCamera(CameraConfig(ADDRESS, ptp=True)) as camera:
            camera.start()
            before_ns = time.time_ns()
            frame = [camera.read() for _ in range(3)][-1]
            after_ns = time.time_ns()
        assert before_ns - 10**9 < frame.camera_time_ns < after_ns
    finally:
        simulated_camera.command("ptp-master no")


def test_frames_tell_when_the_cameras_clock_jumped(simulated_camera: SimulatedCamera) -> None:
    with AravisCamera(CameraConfig(ADDRESS, frame_rate=100)) as camera:
        camera.start()
        epochs = []
        for jump_s in (7200.0, -3600.0):
            epochs += [camera.read().clock_epoch for _ in range(5)]
            simulated_camera.jump_clock(jump_s)
            epochs += [camera.read().clock_epoch for _ in range(30)]
        assert epochs == sorted(epochs)
        assert (epochs[0], epochs[-1]) == (0, 2)
    simulated_camera.jump_clock(-3600.0)


@pytest.mark.parametrize(
    ("line", "match"),
    [
        ("clock-jump -1e6", "counts from 0"),
        ("stall -1", "must not be negative"),
        ("stall soon", "could not convert"),
        ("payload-padding -4", "must not be negative"),
        ("ptp-master maybe", "neither yes nor no"),
        ("explode", "use one of clock, statistics, lost-ratio"),
    ],
)
def test_a_command_that_makes_no_sense_is_refused_and_does_no_harm(
    simulated_camera: SimulatedCamera, line: str, match: str
) -> None:
    with pytest.raises(DeviceError, match=match):
        simulated_camera.command(line)
    assert simulated_camera.command("statistics").startswith("frames ")
