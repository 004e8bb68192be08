"""Accidents: what a killed writer or a full disk leaves is opened, named and repaired."""

from __future__ import annotations

import os
import random
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path

import h5py
import numpy as np
import pytest
from numpy.typing import NDArray

from dataset import CameraInfo, RawFrame, SessionError
from dataset.session import Session, SessionWriter, write_split
from dataset.session.edit import write_depth
from dataset.session.superblock import lookup3
from dataset.validate import info, repair, validate

WRITER = """
import sys, time, itertools
import numpy as np
from dataset import CameraInfo, ClockFit, RawFrame, RobotTrace
from dataset.session import SessionWriter
path, period = sys.argv[1], float(sys.argv[2])
camera = CameraInfo("V", "M", "1", "1", "BayerRG12p", "colour", 48, 32, 12, 9000)
with SessionWriter(path, "sequence", camera) as writer:
    for i in itertools.count():
        pixels = np.random.default_rng(i).integers(100, 3000, (32, 48)).astype(np.uint16)
        writer.add_frame(RawFrame(pixels, "BayerRG12p", i, 10 * i + 7, 10 * i + 8, 2000.0, 3.5, 0))
        host = np.array([i], np.int64)
        zeros = np.zeros((1, 6))
        writer.add_robot_trace(RobotTrace(host, host / 500, zeros, zeros, host.astype("u4")), [0] * 6)
        writer.set_clocks(camera=ClockFit(1.0, 1.0, 2.0))
        print(i, flush=True)
        time.sleep(period)
"""

ANNOTATE = """
import os, resource, signal, sys
import numpy as np
from dataset import SE3, SessionError
from dataset.session import ObjectPoses, ObjectRecord, mask_box, write_object, write_poses
path, spare = sys.argv[1], int(sys.argv[2])
masks = np.random.default_rng(0).random((12, 8, 12)) > 0.5
poses = ObjectPoses(SE3.identity((12,)), np.ones(12), np.array([mask_box(m) for m in masks]), masks)
mesh = np.vstack([np.zeros(3), 0.1 * np.eye(3)]), np.array([[0, 2, 1], [0, 1, 3]], np.int32)
size = os.path.getsize(path) + spare
signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
resource.setrlimit(resource.RLIMIT_FSIZE, (size, size))
try:
    write_object(path, ObjectRecord("cup", *mesh, "plastic", 1.5, 0.0, "[]", 0.15))
    write_poses(path, SE3.identity((12,)), 1e-3, 1e-3, {"cup": poses})
    print("done", flush=True)
except SessionError as error:
    print(error, flush=True)
"""


def start_writer(path: Path, period: float) -> subprocess.Popen[str]:
    return subprocess.Popen(
        [sys.executable, "-c", WRITER, str(path), str(period)], stdout=subprocess.PIPE, text=True
    )


def kill_after(path: Path, frames: int, period: float, delay: float) -> int:
    """Kills a writer some time after so many frames; returns the frames it had reported."""
    process = start_writer(path, period)
    assert process.stdout is not None
    for _ in range(frames):
        process.stdout.readline()
    time.sleep(delay)
    process.send_signal(signal.SIGKILL)
    reported = frames + len(process.stdout.read().split())
    process.wait()
    return reported


@pytest.mark.parametrize("attempt", range(3))
def test_a_killed_writer_loses_no_frame(
    tmp_path: Path, attempt: int, make_frame: Callable[..., RawFrame]
) -> None:
    path = tmp_path / "s.h5"
    chance = random.Random(attempt)
    reported = kill_after(path, chance.randrange(1, 40), period=0.0, delay=chance.uniform(0, 0.05))

    with Session.open(path) as session:
        assert not session.complete
        assert len(session) >= reported
        np.testing.assert_array_equal(session.raw(reported - 1), make_frame(reported - 1).pixels)
    summary = info(path)
    assert not summary.complete
    assert f"s2p3 dataset repair {path}" in summary.advice
    assert "incomplete" in validate(path)[0].what
    with pytest.raises(SessionError, match="incomplete; run first: s2p3 dataset repair"):
        write_split(path, "train", [0])

    result = repair(path)
    assert result.changed
    assert result.frames >= reported
    assert result.lost == ()
    with Session.open(path) as session:
        assert session.complete
        assert len(session) == result.frames
        for i in range(result.frames):
            np.testing.assert_array_equal(session.raw(i), make_frame(i).pixels)
        assert session.robot is not None
        assert len(session.robot) >= reported - 1
    assert validate(path) == []
    assert info(path).repaired
    assert not list(tmp_path.glob("*.repairing"))
    with h5py.File(path, "r") as file:
        assert len(file["camera/raw"]) == result.frames
    write_split(path, "train", [0])
    assert not repair(path).changed


def test_a_writer_killed_while_waiting_keeps_its_only_frame(tmp_path: Path) -> None:
    path = tmp_path / "s.h5"
    process = start_writer(path, period=60.0)
    assert process.stdout is not None
    process.stdout.readline()
    process.kill()
    process.wait()
    assert repair(path).frames == 1
    assert validate(path) == []


def test_a_recording_in_progress_is_not_repaired(tmp_path: Path) -> None:
    path = tmp_path / "s.h5"
    process = start_writer(path, period=0.01)
    assert process.stdout is not None
    process.stdout.readline()
    try:
        with pytest.raises(SessionError, match="in use by another program"):
            repair(path)
        assert process.poll() is None
    finally:
        process.kill()
        process.wait()


def test_a_full_disk_is_reported_and_costs_no_stored_frame(
    tmp_path: Path, make_frame: Callable[..., RawFrame]
) -> None:
    path = tmp_path / "s.h5"
    limited = f"""
import resource, signal
signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
resource.setrlimit(resource.RLIMIT_FSIZE, (400_000, resource.RLIM_INFINITY))
{WRITER}"""
    process = subprocess.run(
        [sys.executable, "-c", limited, str(path), "0"],
        capture_output=True,
        text=True,
        timeout=60,
        check=False,
    )
    assert "SessionError" in process.stderr
    assert "check the free disk space" in process.stderr
    stored = len(process.stdout.split())
    assert stored > 5
    assert repair(path).frames >= stored
    with Session.open(path) as session:
        for i in range(stored):
            np.testing.assert_array_equal(session.raw(i), make_frame(i).pixels)
    assert validate(path) == []


def test_a_disk_that_refuses_the_end_leaves_the_file_to_be_repaired(
    tmp_path: Path, camera: CameraInfo, make_frame: Callable[..., RawFrame], monkeypatch: pytest.MonkeyPatch
) -> None:
    def refuse(file: h5py.File) -> None:
        raise OSError("No space left on device")

    path = tmp_path / "s.h5"
    writer = SessionWriter(path, "sequence", camera)
    writer.add_frame(make_frame(0))
    monkeypatch.setattr("dataset.session.writer.seal", refuse)
    with pytest.raises(SessionError, match=r"end of the file could not be written \(No space left"):
        writer.finish()
    assert repair(path).frames == 1
    assert validate(path) == []


@pytest.mark.parametrize("spare", [0, 4000, 12000])
def test_a_disk_that_fills_during_an_edit_costs_no_frame(
    tmp_path: Path, camera: CameraInfo, make_frame: Callable[..., RawFrame], spare: int
) -> None:
    path = tmp_path / "s.h5"
    with SessionWriter(path, "sequence", camera) as writer:
        for i in range(12):
            writer.add_frame(make_frame(i))

    assert "s.h5 could not be written" in annotate(path, spare)
    repair(path)
    with Session.open(path) as session:
        assert len(session) == 12
        for i in range(12):
            np.testing.assert_array_equal(session.raw(i), make_frame(i).pixels)
    assert annotate(path, 1_000_000) == "done\n"
    assert validate(path) == []


def annotate(path: Path, spare: int) -> str:
    """Adds an object and its poses in a process whose files may grow by so many bytes; what it says."""
    command = [sys.executable, "-c", ANNOTATE, str(path), str(spare)]
    return subprocess.run(command, capture_output=True, text=True, timeout=60, check=False).stdout


def test_a_full_disk_is_noticed_before_an_edit(recorded: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    before = recorded.read_bytes()
    monkeypatch.setattr("dataset.session.files.room", lambda path: 1 << 20)
    with pytest.raises(SessionError, match=r"needs 0\.02 GB of free disk space; make room and repeat"):
        write_split(recorded, "train", [0])
    assert recorded.read_bytes() == before


def test_a_full_disk_is_noticed_before_a_recording(
    tmp_path: Path, camera: CameraInfo, make_frame: Callable[..., RawFrame], monkeypatch: pytest.MonkeyPatch
) -> None:
    begun = tmp_path / "begun.h5"
    writer = SessionWriter(begun, "sequence", camera)
    writer.add_frame(make_frame(0))
    writer.close()  # incomplete, and whole: repair only marks it
    monkeypatch.setattr("dataset.session.files.room", lambda path: 1 << 20)
    with pytest.raises(SessionError, match=r"new\.h5 needs 0\.02 GB of free disk space"):
        SessionWriter(tmp_path / "new.h5", "sequence", camera)
    with pytest.raises(SessionError, match=r"begun\.h5 needs 0\.02 GB of free disk space"):
        repair(begun)
    monkeypatch.undo()
    assert repair(begun).frames == 1
    monkeypatch.setattr("dataset.session.files.room", lambda path: 1 << 20)
    with pytest.raises(SessionError, match=r"begun\.h5 needs 0\.02 GB of free disk space"):
        SessionWriter.append(begun, "sequence", camera)
    monkeypatch.undo()
    with SessionWriter.append(begun, "sequence", camera) as writer:
        writer.add_frame(make_frame(1))
    assert validate(begun) == []


def test_a_disk_that_refuses_the_beginning_leaves_no_file(
    tmp_path: Path, camera: CameraInfo, monkeypatch: pytest.MonkeyPatch
) -> None:
    def refuse(*_: object) -> None:
        raise OSError("No space left on device")

    for step in ("_lay_out", "begin_segment"):
        monkeypatch.setattr(f"dataset.session.writer.{step}", refuse)
        with pytest.raises(SessionError, match=r"new\.h5.* written \(No space left on device\); check"):
            SessionWriter(tmp_path / "new.h5", "sequence", camera)
        monkeypatch.undo()
        assert not list(tmp_path.iterdir())
    with SessionWriter(tmp_path / "new.h5", "sequence", camera):
        pass


def test_images_of_an_edit_cut_short_do_not_read_as_black(
    recorded: Path, make_depth: Callable[[int], NDArray[np.uint16]], monkeypatch: pytest.MonkeyPatch
) -> None:
    left = iter([1 << 30] * 6)
    monkeypatch.setattr("dataset.session.files.room", lambda path: next(left, 0))
    with pytest.raises(SessionError, match=r"16 MB are left on the disk.*costs no frame.*repair"):
        write_depth(recorded, make_depth(12))
    assert repair(recorded).frames == 12
    with Session.open(recorded) as session, pytest.raises(SessionError, match="damaged"):
        session.depth(8)
    monkeypatch.undo()
    write_depth(recorded, make_depth(12))
    assert validate(recorded) == []


def test_a_killed_edit_is_named_and_undone(recorded: Path, make_frame: Callable[..., RawFrame]) -> None:
    edit = f"""
import h5py, os, numpy
file = h5py.File({str(recorded)!r}, "r+", libver=("v110", "v110"))
file["poses/objects/tetra/extra"] = numpy.zeros(10_000)
os.kill(os.getpid(), 9)
"""
    subprocess.run([sys.executable, "-c", edit], check=False)
    with Session.open(recorded) as session:
        assert not session.complete
        np.testing.assert_array_equal(session.raw(11), make_frame(11).pixels)
    assert repair(recorded).frames == 12
    with Session.open(recorded) as session:
        assert session.complete
        np.testing.assert_array_equal(session.raw(11), make_frame(11).pixels)
        assert session.object_poses("tetra").mask(3).sum() == 16
    assert validate(recorded) == []


@pytest.mark.parametrize("share", [0.4, 0.7, 0.95, 0.999])
def test_a_truncated_file_gives_a_clear_error_or_its_intact_frames(
    recorded: Path, share: float, make_frame: Callable[..., RawFrame]
) -> None:
    whole = recorded.read_bytes()
    recorded.write_bytes(whole[: int(share * len(whole))])
    before = recorded.read_bytes()
    with pytest.raises(SessionError):
        Session.open(recorded)
    try:
        result = repair(recorded)
    except SessionError:
        assert recorded.read_bytes() == before
        return
    with Session.open(recorded) as session:
        assert len(session) == result.frames
        assert result.frames + len(result.damaged_ids) == 12
        for i, frame_id in enumerate(session.frame_ids):
            original = frame_id if frame_id < 6 else frame_id - 1
            np.testing.assert_array_equal(session.raw(i), make_frame(original).pixels)


def test_damaged_frames_move_to_the_ledger(recorded: Path, make_frame: Callable[..., RawFrame]) -> None:
    with h5py.File(recorded, "r+") as file:
        for i in (2, 9):
            file["camera/raw"].id.write_direct_chunk((i, 0, 0), b"\1" * 64)
    result = repair(recorded)
    assert result.frames == 10
    assert result.damaged_ids == (2, 10)
    assert str(result) == f"{recorded}: repaired, 10 frames; 2 damaged ones are in the ledger now: 2, 10"
    assert str(repair(recorded)) == f"{recorded}: nothing to repair, 10 frames"
    with Session.open(recorded) as session:
        assert session.frame_ids.tolist() == [0, 1, 3, 4, 5, 7, 8, 9, 11, 12]
        assert sorted(session.drops["frame_id"].tolist()) == [2, 6, 10]
        np.testing.assert_array_equal(session.raw(2), make_frame(3).pixels)
        assert session.poses is not None
        assert len(session.poses) == 10
        assert session.object_poses("tetra").bbox_xywh[2].tolist() == [3, 2, 4, 4]
        assert session.object_poses("tetra").mask(2)[:, 3].any()
        assert session.splits["train"].tolist() == list(range(8))
        assert session.splits["test"].tolist() == [8, 9]
    assert validate(recorded) == []


def test_a_damaged_mask_costs_no_other(recorded: Path) -> None:
    with h5py.File(recorded, "r+") as file:
        file["poses/objects/tetra/mask"].id.write_direct_chunk((4, 0, 0), b"\1" * 40)
        file["depth"].id.write_direct_chunk((6, 0, 0), b"\1" * 40)
        file["camera/raw"].id.write_direct_chunk((2, 0, 0), b"\1" * 64)
    result = repair(recorded)
    assert result.lost == ("depth[6]", "poses/objects/tetra/mask[4]")
    assert str(result).endswith("lost: depth[6], poses/objects/tetra/mask[4]")
    with Session.open(recorded) as session:
        poses = session.object_poses("tetra")
        for index in (i for i in range(11) if i != 3):
            assert poses.mask(index).sum() == 16
        for read in (lambda: poses.mask(3), lambda: session.depth(5)):
            with pytest.raises(SessionError, match="damaged"):
                read()
    assert [problem.where for problem in validate(recorded)] == ["depth[5]", "poses/objects/tetra/mask[3]"]


def test_an_interrupted_repair_leaves_the_original(recorded: Path) -> None:
    with h5py.File(recorded, "r+") as file:
        file["camera/raw"].id.write_direct_chunk((2, 0, 0), b"\1" * 64)
    before = recorded.read_bytes()

    def interrupt(done: int, total: int) -> None:
        if done == total - 1:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        repair(recorded, interrupt)
    assert recorded.read_bytes() == before
    assert os.listdir(recorded.parent) == [recorded.name]


def test_what_is_beyond_repair_says_so(tmp_path: Path) -> None:
    path = tmp_path / "s.h5"
    path.write_bytes(os.urandom(10_000))
    before = path.read_bytes()
    with pytest.raises(SessionError, match=r"beyond repair|cannot be repaired"):
        repair(path)
    assert path.read_bytes() == before
    with pytest.raises(SessionError, match="does not exist"):
        repair(tmp_path / "missing.h5")


@pytest.mark.parametrize(
    ("data", "expected"),
    [(b"", 0xDEADBEEF), (b"Four score and seven years ago", 0x17770551)],
)
def test_the_checksum_is_the_published_one(data: bytes, expected: int) -> None:
    """Values from the self-test in Bob Jenkins' lookup3.c."""
    assert lookup3(data) == expected


def test_random_damage_never_yields_a_wrong_frame(
    recorded: Path, make_frame: Callable[..., RawFrame]
) -> None:
    """Single bytes flipped anywhere: a clear error, or frames that are exactly what was recorded."""
    whole = recorded.read_bytes()
    chance = random.Random(7)
    frames = [make_frame(i).pixels for i in range(12)]
    for _ in range(60):
        damaged = bytearray(whole)
        damaged[chance.randrange(len(damaged))] ^= 1 << chance.randrange(8)
        recorded.write_bytes(damaged)
        with suppress(SessionError), Session.open(recorded) as session:
            for i in range(len(session)):
                np.testing.assert_array_equal(session.raw(i), frames[i])
