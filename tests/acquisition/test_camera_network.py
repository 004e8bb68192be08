"""Cameras behind cards, cables and rights that are not as they should be, each in a network of its own."""

import json
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

pytestmark = pytest.mark.devices


def in_a_network_of_its_own(script: str, *prefix: str) -> str:
    """Runs a Python script in a network namespace that has nothing but loopback; returns what it prints.

    `prefix` is a command that takes the interpreter as its last arguments.
    """
    start = f'ip link set lo up && exec {" ".join(prefix)} "$0" -c "$1"'
    command = ["unshare", "--net", "sh", "-c", start, sys.executable, script]
    result = subprocess.run(command, capture_output=True, text=True, timeout=90)
    if "unshare failed" in result.stderr:
        pytest.skip("this machine does not permit network namespaces")
    assert result.returncode == 0, result.stderr
    return result.stdout


COMMON = """
import json, os, subprocess, sys
from dataclasses import asdict
from acquisition.camera import CameraConfig
from acquisition.cameras.aravis import AravisCamera
from acquisition.cameras.discovery import find_cameras
from acquisition.cameras.packet_test import largest_delivered, try_packet_sizes
from acquisition.simulation.camera import SimulatedCamera
from dataset.errors import DeviceError
SMALL = {"width": 256, "height": 192, "frame_rate": 50, "latency_s": 0.002}
found = {}
"""

# A cable between two namespaces; the card at our end takes packets of 1500 bytes, the camera sends 9000.
BEHIND_A_SMALL_MTU = (
    COMMON
    + """
far = subprocess.Popen(["unshare", "--net", "sh", "-c", "echo there; exec sleep 60"], stdout=subprocess.PIPE)
far.stdout.readline()
def ip(*words): subprocess.run(["ip", *words], check=True)
inside = ["nsenter", "-t", str(far.pid), "-n"]
ip("link", "add", "near", "mtu", "1500", "type", "veth",
   "peer", "name", "far", "mtu", "9000", "netns", str(far.pid))
ip("addr", "add", "10.77.0.1/24", "dev", "near")
ip("link", "set", "near", "up")
for words in (["addr", "add", "10.77.0.2/24", "dev", "far"], ["link", "set", "far", "up"]):
    subprocess.run([*inside, "ip", *words], check=True)
serve = [*inside, sys.executable, "-m", "acquisition.simulation.camera"]
camera = subprocess.Popen(
    [*serve, "--address=10.77.0.2", "--packet-size=9000"]
    + [f"--{name.replace('_', '-')}={value}" for name, value in SMALL.items()],
    stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)
assert camera.stdout.readline() == "ready\\n"
try:
    with AravisCamera(CameraConfig("10.77.0.2", packet_size=9000)) as tried:
        tried.start()
        try:
            tried.read(1.0)
        except DeviceError as error:
            found["too large"] = str(error)
    with AravisCamera(CameraConfig("10.77.0.2")) as tried:
        found["negotiated"] = tried.info.packet_size
        tried.start()
        found["frames"] = [tried.read().frame_id for _ in range(5)]
    trials = try_packet_sizes(CameraConfig("10.77.0.2"), seconds=0.5)
    found["trials"], found["largest"] = [asdict(t) for t in trials], largest_delivered(trials)
finally:
    camera.stdin.close()
    camera.wait(10)
    far.kill()
    print(json.dumps(found))
"""
)


def test_packets_larger_than_the_mtu_never_arrive_and_are_told_of() -> None:
    found = json.loads(in_a_network_of_its_own(BEHIND_A_SMALL_MTU))
    assert "frames came with packets missing; set packet_size to the MTU" in found["too large"]
    assert found["negotiated"] == 1500
    assert len(found["frames"]) == 5
    assert found["largest"] == 1500
    large, medium, small = found["trials"]
    assert (large["size"], large["whole"], medium["whole"]) == (9000, 0, 0)
    assert large["incomplete"] > 0
    assert small["whole"] >= 5


@pytest.mark.skipif(shutil.which("setpriv") is None, reason="needs setpriv, of util-linux")
def test_without_the_right_to_raw_sockets_frames_come_all_the_same() -> None:
    script = (
        COMMON
        + """
status = dict(line.split(":", 1) for line in open("/proc/self/status"))
found["raw"] = bool(int(status["CapEff"], 16) >> 13 & 1)
with SimulatedCamera(width=1024, height=768, frame_rate=40, latency_s=0.002):
    with AravisCamera(CameraConfig("127.0.0.1", packet_size=1500, timeout_s=5)) as camera:
        camera.start()
        frames = [camera.read() for _ in range(40)]
        found["ids"], found["incomplete"] = [frame.frame_id for frame in frames], camera.statistics.incomplete
print(json.dumps(found))
"""
    )
    found = json.loads(
        in_a_network_of_its_own(script, "setpriv", "--bounding-set", "-net_raw", "--inh-caps", "-net_raw")
    )
    assert not found["raw"]
    assert found["ids"] == sorted(set(found["ids"]))
    assert found["incomplete"] <= 5  # most frames are lost with a socket's usual buffer


def test_two_cameras_on_two_addresses() -> None:
    script = (
        COMMON
        + """
try:
    SimulatedCamera("127.0.0.2", **SMALL).start()
except DeviceError as error:
    found["without the address"] = str(error)
subprocess.run(["ip", "addr", "add", "127.0.0.2/8", "dev", "lo"], check=True)
one = SimulatedCamera("127.0.0.1", serial="ONE", **SMALL)
two = SimulatedCamera("127.0.0.2", serial="TWO", **SMALL)
found["none in sight"] = find_cameras()
with one, two:
    found["in sight"] = [asdict(camera) for camera in find_cameras()]
    with AravisCamera(CameraConfig("127.0.0.1")) as first, AravisCamera(CameraConfig("127.0.0.2")) as second:
        first.start()
        second.start()
        found["serials"] = [first.info.serial, second.info.serial]
        found["frames"] = [len([camera.read() for _ in range(5)]) for camera in (first, second)]
print(json.dumps(found))
"""
    )
    found = json.loads(in_a_network_of_its_own(script))
    assert "no network card has; add it with: ip addr add 127.0.0.2/8 dev lo" in found["without the address"]
    assert found["none in sight"] == []
    seen = {"vendor": "Lucid Vision Labs", "model": "PHX050S-Q"}
    assert found["in sight"] == [
        {"address": "127.0.0.1", "serial": "ONE", **seen},
        {"address": "127.0.0.2", "serial": "TWO", **seen},
    ]
    assert found["serials"] == ["ONE", "TWO"]
    assert found["frames"] == [5, 5]


def test_a_missing_typelib_names_the_packages(tmp_path: Path) -> None:
    gi = pytest.importorskip("gi")
    gi.require_version("GIRepository", "2.0")
    from gi.repository import GIRepository

    folders = [Path(folder) for folder in GIRepository.Repository.get_search_path()]
    holders = [folder for folder in folders if (folder / "Aravis-0.8.typelib").exists()]
    hidden = []
    for number, folder in enumerate(holders):
        copy = tmp_path / str(number)
        shutil.copytree(folder, copy)
        (copy / "Aravis-0.8.typelib").unlink()
        hidden.append(f"mount --bind {copy} {folder}")
    script = "from acquisition.aravis_library import load_aravis; load_aravis()"
    command = ["unshare", "--mount", "sh", "-c", f'{" && ".join(hidden)} && exec "$0" -c "$1"']
    result = subprocess.run([*command, sys.executable, script], capture_output=True, text=True, timeout=60)
    if "unshare failed" in result.stderr or "mount:" in result.stderr:
        pytest.skip("this machine does not permit mount namespaces")
    last = result.stderr.splitlines()[-1]
    assert "the Aravis 0.8 typelib is missing" in last
    assert "apt-get install gir1.2-aravis-0.8" in last


TOOLS = """
import subprocess
from acquisition.simulation.camera import SimulatedCamera
def run(*command):
    print(subprocess.run(command, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True).stdout)
with SimulatedCamera(width=512, height=384):
"""


@pytest.mark.skipif(
    shutil.which("arv-tool-0.8") is None or shutil.which("arv-camera-test-0.8") is None,
    reason="needs Debian's aravis-tools and aravis-tools-cli",
)
def test_debians_tools_list_the_camera_and_stream_from_it() -> None:
    script = (
        TOOLS
        + "    run('arv-tool-0.8')\n"
        + "    run('arv-camera-test-0.8', '-n', '127.0.0.1', '--duration', '2')\n"
    )
    lines = in_a_network_of_its_own(script).splitlines()
    assert lines[0] == "Lucid Vision Labs-PHX050S-Q-SIM00001 (127.0.0.1)"
    report = dict((part.strip() for part in line.split("=")) for line in lines if line.count("=") == 1)
    assert report["model name"] == "PHX050S-Q"
    assert int(report["n_completed_buffers"]) > 10
    assert int(report["n_error_packets"]) == 0


@pytest.mark.skipif(shutil.which("arv-test-0.8") is None, reason="needs Debian's aravis-tools")
def test_aravis_conformance_suite_passes_but_for_chunks() -> None:
    report = in_a_network_of_its_own(TOOLS + "    run('arv-test-0.8', '--packet-socket')")
    failed = [line.split()[0] for line in report.splitlines() if "FAILURE" in line]
    assert report.count("SUCCESS") >= 14
    assert failed == ["Chunks:NoSupport"]
