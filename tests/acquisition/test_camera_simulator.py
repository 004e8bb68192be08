"""The simulated sensor and its test pattern, without a wire; and how the simulator fails."""

import socket
import time
from pathlib import Path

import numpy as np
import pytest

from acquisition.camera import CameraConfig
from acquisition.simulation.camera import CameraClock, Sensor, SimulatedCamera
from acquisition.simulation.fake_device import Exposure
from acquisition.simulation.patterns import MovingPattern
from dataset.errors import DeviceError, ToolkitError
from dataset.pixel_formats import PixelFormat, pixel_format, unpack
from dataset.polarimetry import decode

HEIGHT, WIDTH = 96, 128


def exposure(
    format_: PixelFormat, x: int = 0, y: int = 0, width: int = WIDTH, height: int = HEIGHT
) -> Exposure:
    return Exposure(format_, x, y, width, height, exposure_us=10_000.0, gain_db=0.0)


def test_sensor_crops_the_region_and_packs_it() -> None:
    format_ = pixel_format("BayerRG12p")
    sensor = Sensor(MovingPattern(speed_px_s=0.0), WIDTH, HEIGHT, CameraClock(0, 0.0), latency_s=0.0)
    memory = np.zeros(format_.size(40, 64), np.uint8)
    sensor.fill(exposure(format_, x=16, y=8, width=64, height=40), memory)
    whole = MovingPattern(speed_px_s=0.0).frame("BayerRG12p", HEIGHT, WIDTH, 10_000.0, 0.0, 0)
    np.testing.assert_array_equal(unpack(memory, format_, 40, 64), whole[8:48, 16:80])


def test_sensor_holds_a_frame_back_for_the_latency_and_stamps_its_start() -> None:
    format_ = pixel_format("Mono8")
    sensor = Sensor(MovingPattern(), WIDTH, HEIGHT, CameraClock(0, 0.0), latency_s=0.05)
    before_ns = time.monotonic_ns()
    stamp_ns = sensor.fill(exposure(format_), np.zeros(HEIGHT * WIDTH, np.uint8))
    after_ns = time.monotonic_ns()
    assert before_ns <= stamp_ns <= after_ns - 50_000_000


def test_sensor_counts_frames_that_were_rendered_too_slowly() -> None:
    sensor = Sensor(MovingPattern(), WIDTH, HEIGHT, CameraClock(0, 0.0), latency_s=0.0)
    sensor.fill(exposure(pixel_format("Mono8")), np.zeros(HEIGHT * WIDTH, np.uint8))
    assert (sensor.frames, sensor.late) == (1, 1)


def test_clock_has_its_own_origin_and_drift() -> None:
    clock = CameraClock(origin_ns=1_000, drift_ppm=100.0)
    assert clock.to_camera(1_000) == 0
    assert clock.to_camera(1_000 + 10**9) == 10**9 + 100_000


@pytest.mark.parametrize("name", ["Mono8", "Mono12", "BayerRG8", "BayerRG12p", "BayerRG16"])
def test_pattern_decodes_to_rings_of_polarization(name: str) -> None:
    format_ = pixel_format(name)
    raw = MovingPattern(speed_px_s=0.0).frame(name, HEIGHT, WIDTH, 10_000.0, 0.0, 0)
    stokes = decode(raw, "colour" if format_.colour else "mono", format_.bits)
    assert stokes.valid.all()
    assert stokes.dolp.max() > 0.3
    # The angle is half the azimuth around the centre, counter-clockwise as displayed.
    h, w = stokes.shape
    y, x = np.mgrid[0:h, 0:w]
    azimuth = np.arctan2((h - 1) / 2 - y, x - (w - 1) / 2)
    polarized = (stokes.dolp > 0.2) & (np.hypot(y - h / 2, x - w / 2) > h / 4)
    assert polarized.sum() > 0.1 * h * w
    error = np.angle(np.exp(2j * stokes.aolp) / np.exp(1j * azimuth)) / 2
    assert np.abs(error[polarized]).max() < np.radians(10)
    assert np.median(np.abs(error[polarized])) < np.radians(2)


def test_pattern_moves_and_scales_with_exposure_and_gain() -> None:
    pattern = MovingPattern(speed_px_s=40.0)

    def frame(exposure_us: float, gain_db: float, time_ns: int) -> np.ndarray:
        return pattern.frame("Mono12", HEIGHT, WIDTH, exposure_us, gain_db, time_ns).astype(float)

    still = frame(5_000.0, 0.0, 0)
    np.testing.assert_array_equal(frame(5_000.0, 0.0, 10**8)[:, :-4], still[:, 4:])
    np.testing.assert_allclose(frame(2_500.0, 20 * np.log10(2), 0), still, atol=0.51)
    np.testing.assert_allclose(frame(10_000.0, 0.0, 0), 2 * still, atol=1.01)


@pytest.mark.parametrize(
    ("options", "match"),
    [
        ({"source": "no.such:thing"}, "package.module:factory"),
        ({"source_args": {"spede_px_s": 1.0}}, "spede_px_s"),
        ({"pixel_format": "BayerRG9"}, "BayerRG9 is not supported"),
        ({"frame_rate": "many"}, "invalid float value"),
    ],
)
def test_simulator_refuses_bad_options(options: dict, match: str) -> None:
    with pytest.raises(DeviceError, match=match), SimulatedCamera(**options):
        pass


@pytest.mark.devices
def test_simulator_reports_a_taken_port() -> None:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as taker:
        taker.bind(("127.0.0.1", 3956))
        with pytest.raises(DeviceError, match="another camera is simulated there"), SimulatedCamera():
            pass


def test_simulator_reports_an_address_of_another_machine() -> None:
    with pytest.raises(DeviceError, match=r"ip addr add 192\.0\.2\.1"), SimulatedCamera("192.0.2.1"):
        pass


@pytest.mark.parametrize(
    "values",
    [
        {"trigger": "hardware"},
        {"pixel_format": "Mono7"},
        {"exposure_us": 0.0},
        {"frame_rate": -1.0},
        {"packet_size": 100},
    ],
)
def test_impossible_configurations_are_refused(values: dict) -> None:
    with pytest.raises(ToolkitError, match=str(next(iter(values.values())))):
        CameraConfig("127.0.0.1", **values)


def test_genicam_description_ships_with_the_package() -> None:
    import acquisition.simulation

    assert (Path(acquisition.simulation.__file__).parent / "genicam.xml").is_file()
