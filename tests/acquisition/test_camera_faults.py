"""Cameras that are not there, vanish, drift, or are asked by clients that are not ours."""

import socket
import subprocess
import sys
import time
from itertools import pairwise

import numpy as np
import pytest

from acquisition.camera import CameraConfig
from acquisition.cameras.aravis import AravisCamera
from acquisition.simulation.camera import SimulatedCamera
from dataset.errors import DeviceError

pytestmark = pytest.mark.devices

SMALL = {"width": 256, "height": 192, "frame_rate": 50, "latency_s": 0.002}


@pytest.mark.parametrize(
    ("address", "match"),
    [
        ("127.0.0.1", "answers, but no camera listens there"),
        ("nowhere.invalid", "neither an IPv4 address nor a known host name"),
        ("192.168.10..20", "neither an IPv4 address nor a known host name"),
    ],
)
def test_no_camera_at_the_address(address: str, match: str) -> None:
    started = time.monotonic()
    with pytest.raises(DeviceError, match=match):
        AravisCamera(CameraConfig(address))
    assert time.monotonic() - started < 5


def test_silence_at_the_address() -> None:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as deaf:
        deaf.bind(("127.0.0.1", 3956))
        started = time.monotonic()
        with pytest.raises(DeviceError, match=r"no camera answers at 127\.0\.0\.1 .*cable.*subnet.*firewall"):
            AravisCamera(CameraConfig("127.0.0.1"))
        assert time.monotonic() - started < 5


CLIENT = """
import time
from acquisition.camera import CameraConfig
from acquisition.cameras.aravis import AravisCamera
camera = AravisCamera(CameraConfig("127.0.0.1"))
camera.start()
camera.read()
print("streaming", flush=True)
time.sleep(60)
"""


def test_a_client_that_was_killed_gives_the_camera_back() -> None:
    with SimulatedCamera(**SMALL):
        with subprocess.Popen([sys.executable, "-c", CLIENT], stdout=subprocess.PIPE, text=True) as client:
            assert client.stdout is not None
            assert client.stdout.readline() == "streaming\n"
            client.kill()
        started = time.monotonic()
        with AravisCamera(CameraConfig("127.0.0.1")) as camera:
            camera.start()
            assert camera.read().missing_packets == 0
        assert time.monotonic() - started < 6  # the camera's heartbeat is 3 s


def test_missing_aravis_names_the_packages() -> None:
    script = (
        "import sys; sys.modules['gi'] = None\n"  # what Python does when a package is not there
        "from acquisition.camera import CameraConfig\n"
        "from acquisition.cameras.aravis import AravisCamera\n"
        "AravisCamera(CameraConfig('127.0.0.1'))"
    )
    result = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, timeout=60)
    assert "apt-get install gir1.2-aravis-0.8" in result.stderr.splitlines()[-1]


def test_a_source_that_fails_takes_the_camera_down_and_says_why(
    tmp_path_factory: pytest.TempPathFactory, monkeypatch: pytest.MonkeyPatch
) -> None:
    folder = tmp_path_factory.mktemp("sources")
    (folder / "failing_source.py").write_text(
        "import numpy as np\n"
        "class Failing:\n"
        "    calls = 0\n"
        "    def frame(self, pixel_format, height, width, exposure_us, gain_db, time_ns):\n"
        "        self.calls += 1\n"
        "        if self.calls > 3:\n"
        "            raise RuntimeError('the lamp broke')\n"
        "        return np.full((height, width), self.calls, np.uint8)\n"
        "    def command(self, line):\n"
        "        return line[::-1]\n"
    )
    monkeypatch.setenv("PYTHONPATH", str(folder))
    with SimulatedCamera(source="failing_source:Failing", **SMALL) as simulated:
        assert simulated.command("source's own") == "nwo s'ecruos"
        with AravisCamera(CameraConfig("127.0.0.1", timeout_s=0.5)) as camera:
            camera.start()
            assert [camera.read().pixels[0, 0] for _ in range(2)] == [2, 3]
            with pytest.raises(DeviceError, match="stopped answering; check its power and cable"):
                camera.read()
        with pytest.raises(DeviceError, match="the lamp broke"):
            simulated.command("statistics")


def test_ids_and_times_grow_over_the_wrap_of_the_counter() -> None:
    with (
        SimulatedCamera(**{**SMALL, "frame_rate": 250}),
        AravisCamera(CameraConfig("127.0.0.1")) as camera,
    ):
        camera.start()
        frames = [camera.read()]
        while len(frames) < 50 or frames[-1].frame_id < 65_600:
            frames.append(camera.read())
        statistics = camera.statistics
    ids = [frame.frame_id for frame in frames]
    assert ids[0] < 65_535  # the simulated counter of 16 bits begins at 65,401
    assert ids == sorted(set(ids))
    lost = statistics.incomplete + statistics.discarded
    assert len(ids) <= ids[-1] - ids[0] + 1 <= len(ids) + lost
    assert all(a.camera_time_ns < b.camera_time_ns for a, b in pairwise(frames))
    assert all(a.host_time_ns < b.host_time_ns for a, b in pairwise(frames))


def test_the_cameras_clock_drifts() -> None:
    with (
        SimulatedCamera(drift_ppm=100_000, **SMALL) as simulated,
        AravisCamera(CameraConfig("127.0.0.1")) as camera,
    ):
        camera.start()
        frames = [camera.read() for _ in range(60)]
        clock = simulated.clock()
    device_s = np.array([frame.camera_time_ns for frame in frames]) * 1e-9
    host_s = np.array([frame.host_time_ns - clock.origin_ns for frame in frames]) * 1e-9
    rate, _ = np.polyfit(host_s, device_s, 1)
    assert rate == pytest.approx(1.1, abs=0.03)
