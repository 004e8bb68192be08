"""Cameras that go away while they are in use, come back, stall, or find no buffer."""

import ctypes
import time
from collections.abc import Iterator
from itertools import pairwise

import numpy as np
import pytest

from acquisition.camera import CameraConfig, CameraLost
from acquisition.cameras.aravis import AravisCamera
from acquisition.simulation.camera import SimulatedCamera
from acquisition.simulation.patterns import MovingPattern
from dataset.errors import DeviceError

pytestmark = pytest.mark.devices

CONFIG = CameraConfig("127.0.0.1", timeout_s=30)


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


def read_until_it_is_lost(camera: AravisCamera) -> str:
    """Reads what had arrived before the fault, and on; returns what the user is told."""
    for _ in range(200):
        try:
            camera.read()
        except CameraLost as error:
            return str(error)
    pytest.fail("the fault went unnoticed")


def test_a_camera_that_loses_power_is_missed_at_once_and_holds_nobody_up(simulated: SimulatedCamera) -> None:
    camera = AravisCamera(CONFIG)
    camera.start()
    camera.read()
    simulated.kill()
    killed = time.monotonic()
    message = read_until_it_is_lost(camera)
    noticed = time.monotonic()
    assert "stopped answering; check its power and cable, then open it again" in message
    assert noticed - killed < 3  # not the time-out of 30 s
    with pytest.raises(CameraLost):
        camera.read()
    closing = time.monotonic()
    camera.close()
    assert time.monotonic() - closing < 1


def test_a_camera_that_was_restarted_goes_on_after_a_reconnection(simulated: SimulatedCamera) -> None:
    with AravisCamera(CONFIG) as camera:
        camera.start()
        before = [camera.read() for _ in range(3)]
        simulated.kill()
        simulated.start()
        assert "was restarted, or lost sight of this computer" in read_until_it_is_lost(camera)
        camera.reconnect()
        after = [camera.read() for _ in range(5)]
        statistics = camera.statistics
        clock = simulated.clock()
    assert all(a.frame_id < b.frame_id for a, b in pairwise([*before, *after]))
    # The clock began anew: its times are smaller, and the frames say that they do not compare.
    assert ({f.clock_epoch for f in before}, {f.clock_epoch for f in after}) == ({0}, {1})
    assert statistics.frames >= len(before) + len(after)
    for frame in after:
        start_ns = frame.camera_time_ns + clock.origin_ns
        expected = MovingPattern().frame("BayerRG8", 192, 256, 10_000.0, 0.0, start_ns)
        np.testing.assert_array_equal(frame.pixels, expected)


def test_a_camera_that_stays_away_is_waited_for_no_longer_than_told(simulated: SimulatedCamera) -> None:
    with AravisCamera(CONFIG) as camera:
        camera.start()
        simulated.kill()
        read_until_it_is_lost(camera)
        started = time.monotonic()
        with pytest.raises(DeviceError, match="no camera listens there"):
            camera.reconnect(timeout_s=1.0)
        assert time.monotonic() - started < 4
        with pytest.raises(DeviceError, match="not started"):
            camera.read()


def test_another_camera_in_its_place_is_not_taken_for_it(simulated: SimulatedCamera) -> None:
    with AravisCamera(CONFIG) as camera:
        simulated.stop()
        with (
            SimulatedCamera(width=256, height=192, serial="SECOND"),
            pytest.raises(DeviceError, match="is PHX050S-Q SECOND now and was PHX050S-Q SIM00001"),
        ):
            camera.reconnect()


def test_a_short_stall_costs_frames_and_no_error(simulated: SimulatedCamera) -> None:
    with AravisCamera(CONFIG) as camera:
        camera.start()
        times_ns = [camera.read().host_time_ns]
        simulated.stall(0.8)
        times_ns += [camera.read().host_time_ns for _ in range(50)]
    assert max(np.diff(times_ns)) > 700_000_000


def test_a_camera_that_stalls_for_long_is_called_lost_and_can_be_had_back(simulated: SimulatedCamera) -> None:
    with AravisCamera(CONFIG) as camera:
        camera.start()
        last = camera.read()
        simulated.stall(4.0)
        assert "open it again" in read_until_it_is_lost(camera)
        camera.reconnect()
        frame = camera.read()
    assert frame.frame_id > last.frame_id
    assert frame.clock_epoch == 1


def test_frames_that_find_no_buffer_are_counted(simulated: SimulatedCamera) -> None:
    with AravisCamera(CONFIG) as camera:
        camera.start()
        first = camera.read()
        # The whole interpreter stands still, the grab thread with it, while the library receives.
        ctypes.PyDLL(None).usleep(900_000)
        frames = [camera.read() for _ in range(60)]
        statistics = camera.statistics
    assert statistics.underruns > 0
    missing = frames[-1].frame_id - first.frame_id - len(frames)
    assert 0 < missing <= statistics.underruns + statistics.incomplete + statistics.discarded
