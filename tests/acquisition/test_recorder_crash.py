"""Recorders that are killed, disks that fill up: what had been flushed is there, and nothing is silent."""

from __future__ import annotations

import os
import random
import shlex
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from dataset.session import Session
from dataset.session.accounting import account
from dataset.validate import repair, validate

RECORDER = """
import os, resource, signal, sys, time
import numpy as np
from acquisition.camera import Camera, CameraStatistics
from acquisition.recorder import record_stream
from dataset.frames import CameraInfo, RawFrame
from dataset.session import SessionWriter

INFO = CameraInfo("V", "M", "1", "1", "BayerRG8", "colour", 64, 48, 8, 9000)

class Metronome(Camera):
    '''A camera of 400 frames/s whose clock starts with it, which loses every 37th frame.'''
    info, statistics = INFO, CameraStatistics()
    def start(self, trigger=None): self.began, self.number = time.monotonic_ns(), 0
    def trigger(self): pass
    def stop(self): pass
    def close(self): pass
    def reconnect(self, timeout_s=15.0): pass
    def read(self, timeout_s=None):
        self.number += 2 if self.number % 37 == 36 else 1
        due = self.number * 2_500_000
        time.sleep(max(0.0, 1e-9 * (self.began + due - time.monotonic_ns())))
        pixels = np.random.default_rng(self.number).integers(0, 255, (48, 64)).astype(np.uint8)
        return RawFrame(pixels, "BayerRG8", self.number, due, time.monotonic_ns(), 100.0, 0.0, 0)

def record(path, how, largest):
    if largest:
        signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
        resource.setrlimit(resource.RLIMIT_FSIZE, (largest, resource.RLIM_INFINITY))
    writer = SessionWriter.append(path, "sequence", INFO) if how == "append" else \\
        SessionWriter(path, "sequence", INFO)
    with writer, Metronome() as camera:
        record_stream(camera, None, writer, duration_s=60.0, on_progress=lambda p: told(p.frames))

def told(frames):
    print(frames, flush=True)

for line in sys.stdin:  # one recorder a line, each a process of its own, forked before any thread exists
    path, how, largest = line.split()
    child = os.fork()
    if child == 0:
        print("started", os.getpid(), flush=True)
        try:
            record(path, how, int(largest))
        except Exception as error:
            print("error", type(error).__name__, " ".join(str(error).split()), flush=True)
        os._exit(1)
    os.waitpid(child, 0)
    print("ended", flush=True)
"""


class Recorders:
    """A process that has imported everything and forks one recorder after another."""

    def __init__(self) -> None:
        self.process = subprocess.Popen(
            [sys.executable, "-c", RECORDER], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
        )

    def start(self, path: Path, how: str = "new", largest: int = 0) -> int:
        assert self.process.stdin is not None
        self.process.stdin.write(f"{path} {how} {largest}\n")
        self.process.stdin.flush()
        return int(self.line().split()[1])

    def line(self) -> str:
        assert self.process.stdout is not None
        return self.process.stdout.readline().strip()

    def first_count(self) -> str:
        """Of frames, as soon as there are any."""
        while (said := self.line()) == "0":
            continue
        return said

    def until_ended(self) -> list[str]:
        lines = list(iter(self.line, "ended"))
        assert self.process.poll() is None
        return lines


@pytest.fixture(scope="module")
def recorders() -> Iterator[Recorders]:
    running = Recorders()
    yield running
    running.process.kill()
    running.process.communicate()


def assert_whole(path: Path, segments: int) -> None:
    assert validate(path) == []
    with Session.open(path) as session:
        counted = account(session)
        assert counted.silent == 0
        assert counted.offered == counted.stored + counted.ledgered
        assert len(session.segments) == segments
        for i in range(0, len(session), 7):
            assert session.raw(i).shape == (48, 64)
        assert np.abs(session.mid_exposure_host_ns - session.host_time_ns).max() < 1_000_000_000


def test_a_recorder_killed_at_any_moment_loses_nothing_that_was_flushed(
    tmp_path: Path, recorders: Recorders
) -> None:
    """Twenty kills: ten new recordings, each repaired, gone on with, killed again and repaired again."""
    chance = random.Random(20)
    for attempt in range(10):
        path = tmp_path / f"{attempt}.h5"
        before = 0
        for segment, how in enumerate(("new", "append"), start=1):
            child = recorders.start(path, how)
            said = recorders.first_count()
            time.sleep(chance.uniform(0.0, 0.35))
            os.kill(child, signal.SIGKILL)
            counts = [int(line) for line in (said, *recorders.until_ended()) if line.isdigit()]
            with Session.open(path) as session:
                assert not session.complete
                assert len(session) >= before + counts[-1]
            result = repair(path)
            assert result.frames >= before + counts[-1]
            assert (result.damaged_ids, result.lost) == ((), ())
            assert_whole(path, segment)
            before = result.frames


@pytest.mark.parametrize("kilobytes", [150, 230, 310, 390])
def test_a_disk_that_fills_up_is_the_error_and_costs_no_stored_frame(
    tmp_path: Path, recorders: Recorders, kilobytes: int
) -> None:
    path = tmp_path / "full.h5"
    recorders.start(path, "new", 1000 * kilobytes)
    *counts, error = recorders.until_ended()
    assert error.startswith("error SessionError")
    assert "check the free disk space" in error
    result = repair(path)
    assert result.frames >= max(map(int, counts), default=1)
    assert_whole(path, 1)


FULL_DISK = """
mount -t tmpfs -o size=17m tmpfs {mount} || exit 77
cd {mount} && echo "full.h5 new 0" | {python} -c {code} && cp full.h5 {out}
"""


def test_a_full_disk_leaves_a_file_that_was_closed_in_good_order(tmp_path: Path) -> None:
    """A real one: a small file system in memory, in a mount namespace of its own."""
    mount, out = tmp_path / "disk", tmp_path / "full.h5"
    mount.mkdir()
    script = FULL_DISK.format(mount=mount, python=sys.executable, code=shlex.quote(RECORDER), out=out)
    command = ["unshare", "--mount", "sh", "-c", script]
    ended = subprocess.run(command, capture_output=True, text=True, timeout=60, check=False)
    if ended.returncode == 77 or "unshare failed" in ended.stderr:
        pytest.skip("mounting a file system is not permitted here")
    assert ended.returncode == 0, ended.stderr
    error = next(line for line in ended.stdout.splitlines() if line.startswith("error"))
    assert "16 MB are left on the disk" in error
    with Session.open(out) as session:
        assert not session.complete
        assert session.clocks.camera is not None
        stored = len(session)
    assert stored > 50
    result = repair(out)
    assert (result.frames, result.damaged_ids, result.lost) == (stored, (), ())
    assert_whole(out, 1)


def test_what_cannot_go_on_says_why(tmp_path: Path, recorders: Recorders) -> None:
    path = tmp_path / "s.h5"
    child = recorders.start(path)
    recorders.line()
    os.kill(child, signal.SIGKILL)
    recorders.until_ended()
    recorders.start(path, "append")
    (error,) = recorders.until_ended()
    assert "incomplete; run first: s2p3 dataset repair" in error
    repair(path)
    recorders.start(tmp_path / "nowhere.h5", "append")
    assert "does not exist" in recorders.until_ended()[0]
    recorders.start(path)
    assert "already exists" in recorders.until_ended()[0]
