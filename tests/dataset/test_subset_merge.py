"""Parts of a session and sessions made of parts hold the same frames, and say where they come from."""

from __future__ import annotations

import shutil
import subprocess
import sys
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import h5py
import numpy as np
import pytest
from numpy.typing import NDArray

from dataset import CameraInfo, ClockFit, Intrinsics, RawFrame, RobotTrace, SessionError
from dataset.merge import merge
from dataset.session import ObjectRecord, Session, SessionWriter, write_calibration, write_object
from dataset.session.edit import write_depth
from dataset.session.seals import leave_open, seal
from dataset.subset import chosen_frames, subset
from dataset.validate import validate


def test_a_subset_holds_the_frames_asked_for(recorded: Path, tmp_path: Path) -> None:
    out = tmp_path / "part.h5"
    assert subset(recorded, out, [9, 2, 2, 10]) == 3
    assert validate(out) == []
    with Session.open(recorded) as whole, Session.open(out) as part:
        for new, old in enumerate([2, 9, 10]):
            np.testing.assert_array_equal(part.raw(new), whole.raw(old))
            assert part.camera_time_ns[new] == whole.camera_time_ns[old]
            assert part.frame_ids[new] == whole.frame_ids[old]
            np.testing.assert_array_equal(
                part.object_poses("tetra").mask(new), whole.object_poses("tetra").mask(old)
            )
        assert part.splits["test"].tolist() == [1, 2]
        assert len(part.drops) == 1 + 9
        assert whole.session_id in part.origin
        assert part.session_id != whole.session_id
        assert part.robot is not None
        np.testing.assert_array_equal(part.mid_exposure_host_ns, whole.mid_exposure_host_ns[[2, 9, 10]])


@pytest.mark.parametrize("indices", [[], [12], [-1, 3]])
def test_frames_that_do_not_exist_are_refused(recorded: Path, tmp_path: Path, indices: list[int]) -> None:
    with pytest.raises(SessionError, match="its frames are 0 to 11"):
        subset(recorded, tmp_path / "part.h5", indices)


def test_a_damaged_frame_is_not_copied(recorded: Path, tmp_path: Path) -> None:
    with h5py.File(recorded, "r+") as file:
        file["camera/raw"].id.write_direct_chunk((4, 0, 0), b"\0" * 40)
    with pytest.raises(SessionError, match="damaged"):
        subset(recorded, tmp_path / "part.h5", [3, 4])
    with pytest.raises(SessionError, match="already exists"):
        subset(recorded, recorded, [3])
    assert subset(recorded, tmp_path / "part.h5", [3, 5]) == 2
    assert sorted(path.name for path in tmp_path.iterdir()) == ["part.h5", "session.h5"]


@pytest.mark.parametrize(
    ("frames", "split", "expected"),
    [
        ("2:9:3", None, [2, 5, 8]),
        (":2", None, [0, 1]),
        ("-2:", None, [10, 11]),
        ("3, 7", None, [3, 7]),
        (None, "test", [9, 10, 11]),
    ],
)
def test_frames_are_named(recorded: Path, frames: str | None, split: str | None, expected: list[int]) -> None:
    with Session.open(recorded) as session:
        assert chosen_frames(session, frames, split).tolist() == expected


@pytest.mark.parametrize(
    ("frames", "split", "message"),
    [
        (None, None, "either by"),
        ("1", "test", "either by"),
        ("a:b", None, "slice"),
        ("0:5:0", None, "slice"),
        (None, "x", "no split"),
    ],
)
def test_frames_named_wrongly_are_refused(
    recorded: Path, frames: str | None, split: str | None, message: str
) -> None:
    with Session.open(recorded) as session, pytest.raises(SessionError, match=message):
        chosen_frames(session, frames, split)


@pytest.fixture
def make_part(
    tmp_path: Path,
    camera: CameraInfo,
    intrinsics: Intrinsics,
    make_frame: Callable[..., RawFrame],
    make_trace: Callable[..., RobotTrace],
) -> Callable[..., Path]:
    """A calibrated recording of four frames that begins at some second on the host's clock."""

    def make(
        name: str,
        second: int,
        camera: CameraInfo = camera,
        offset: float = 0.1,
        payload: tuple[float, ...] | None = None,
    ) -> Path:
        path = tmp_path / name
        with SessionWriter(path, "sequence", camera) as writer:
            for index in range(4):
                frame = make_frame(second + index, 3 + index)
                shift = 1_000_000_000 * second
                writer.add_frame(
                    replace(frame, camera_time_ns=7 * 10**9 + index, host_time_ns=frame.host_time_ns + shift)
                )
            writer.add_drop(7, "queue full", 1_200_000_000 + 1_000_000_000 * second)
            trace = make_trace(20, start=500 * second)
            writer.add_robot_trace(trace, [0, 0, offset, 0, 0, 0], payload)
            writer.set_clocks(camera=ClockFit(1e9 * second, 1.0, 300.0), robot=ClockFit(-99e9, 1.0, 400.0))
        write_calibration(path, "{}", intrinsics)
        return path

    return make


def test_parts_keep_their_clocks(make_part: Callable[..., Path], tmp_path: Path) -> None:
    early, late = make_part("early.h5", 0), make_part("late.h5", 5)
    out = tmp_path / "both.h5"
    assert merge([late, early], out) == 8
    assert validate(out) == []
    with Session.open(out) as both, Session.open(early) as one, Session.open(late) as two:
        for index in range(4):
            np.testing.assert_array_equal(both.raw(index), one.raw(index))
            np.testing.assert_array_equal(both.raw(4 + index), two.raw(index))
        expected = np.concatenate([one.mid_exposure_host_ns, two.mid_exposure_host_ns])
        np.testing.assert_array_equal(both.mid_exposure_host_ns, expected)
        assert both.frame_ids.tolist() == [0, 1, 2, 3, 5, 6, 7, 8]
        assert both.drops["frame_id"].tolist() == [4, 9]
        assert both.segments["first_frame"].tolist() == [0, 4]
        assert both.robot is not None
        assert len(both.robot) == 40
        assert one.session_id in both.origin
        assert two.session_id in both.origin


@pytest.mark.parametrize(
    ("other", "expected"), [((1.2, 0, 0, 0.05), [1.2, 0, 0, 0.05]), ((0.9, 0, 0, 0.05), None), (None, None)]
)
def test_the_payload_is_kept_where_the_parts_agree(
    make_part: Callable[..., Path],
    tmp_path: Path,
    other: tuple[float, ...] | None,
    expected: list[float] | None,
) -> None:
    parts = [make_part("a.h5", 0, payload=(1.2, 0, 0, 0.05)), make_part("b.h5", 5, payload=other)]
    merge(parts, tmp_path / "both.h5")
    assert validate(tmp_path / "both.h5") == []
    with Session.open(tmp_path / "both.h5") as both:
        assert (None if both.payload is None else both.payload.tolist()) == expected


def test_a_part_without_an_arm_leaves_the_arm_of_the_others_its_clock(
    make_part: Callable[..., Path], camera: CameraInfo, intrinsics: Intrinsics, tmp_path: Path
) -> None:
    bare, early, late = tmp_path / "bare.h5", make_part("early.h5", 0), make_part("late.h5", 5)
    with Session.open(late) as session, SessionWriter(bare, "sequence", camera) as writer:
        host = int(session.host_time_ns[-1]) + 10**9
        writer.add_frame(RawFrame(session.raw(0), "BayerRG12p", 0, 0, host, 2000.0, 3.5, 0))
        writer.set_clocks(camera=ClockFit(float(host), 1.0, 300.0))
    write_calibration(bare, "{}", intrinsics)
    merge([bare, early, late], tmp_path / "all.h5")
    assert validate(tmp_path / "all.h5") == []
    with Session.open(tmp_path / "all.h5") as whole, Session.open(early) as one:
        assert whole.clocks.robot is not None
        assert one.clocks.robot is not None
        assert whole.clocks.robot.first == (0, 20)
        assert whole.clocks.robot.fits[0] == one.clocks.robot.fits[0]


def test_overlapping_parts_need_their_clocks_forgotten(
    make_part: Callable[..., Path], tmp_path: Path
) -> None:
    one, other, out = make_part("a.h5", 0), make_part("b.h5", 0), tmp_path / "both.h5"
    with pytest.raises(SessionError, match=r"overlap in time.*--forget-clocks"):
        merge([one, other], out)
    assert merge([one, other], out, forget_clocks=True) == 8
    assert validate(out) == []
    with Session.open(out) as both:
        assert set(both.host_time_ns) == {-1}
        assert both.robot is None
        assert both.clocks.camera is None


def test_poses_of_one_part_are_unknown_in_the_other(
    recorded: Path,
    camera: CameraInfo,
    intrinsics: Intrinsics,
    tmp_path: Path,
    make_frame: Callable[..., RawFrame],
    make_depth: Callable[[int], NDArray[np.uint16]],
) -> None:
    bare, out = tmp_path / "bare.h5", tmp_path / "both.h5"
    with SessionWriter(bare, "sequence", camera) as writer:
        writer.add_frame(make_frame(50))
    write_calibration(bare, '{"fx": 40}', intrinsics)
    with pytest.raises(SessionError, match="only one of them has depth"):
        merge([recorded, bare], out, forget_clocks=True)
    write_depth(bare, make_depth(1))
    assert merge([recorded, bare], out, forget_clocks=True) == 13
    assert validate(out) == []
    with Session.open(out) as both, Session.open(recorded) as whole:
        poses = both.object_poses("tetra")
        assert poses.T_cam_obj.finite.tolist() == [True] * 12 + [False]
        assert not poses.mask(12).any()
        np.testing.assert_array_equal(poses.mask(5), whole.object_poses("tetra").mask(5))
        assert both.splits["test"].tolist() == [9, 10, 11]


def test_sessions_that_differ_are_refused(
    make_part: Callable[..., Path],
    camera: CameraInfo,
    intrinsics: Intrinsics,
    tetrahedron: ObjectRecord,
    tmp_path: Path,
) -> None:
    out, one = tmp_path / "both.h5", make_part("a.h5", 0)

    def refused(other: Path, message: str) -> None:
        with pytest.raises(SessionError, match=message):
            merge([one, other], out)
        assert not out.exists()

    refused(make_part("camera.h5", 9, camera=replace(camera, serial="43")), "cameras differ in serial")
    refused(make_part("offset.h5", 9, offset=0.2), "different tool offsets")
    moved = make_part("moved.h5", 9)
    write_calibration(moved, "{}", replace(intrinsics, K=intrinsics.K * [[1.01], [1], [1]]))
    refused(moved, "calibration/K differs")
    refused(Path(shutil.copy(one, tmp_path / "again.h5")), "same recording")
    scaled = make_part("mesh.h5", 9)
    write_object(one, tetrahedron)
    write_object(scaled, replace(tetrahedron, vertices=2 * tetrahedron.vertices))
    refused(scaled, "meshes of 'tetra' differ")
    with pytest.raises(SessionError, match="at least two"):
        merge([one], out)


def test_a_disk_that_refuses_leaves_nothing(recorded: Path, tmp_path: Path) -> None:
    """In a process of its own: HDF5 cannot close a file on a full disk."""
    code = f"""
import resource
from dataset import SessionError
from dataset.subset import subset
resource.setrlimit(resource.RLIMIT_FSIZE, (65536, resource.RLIM_INFINITY))
try:
    subset({str(recorded)!r}, {str(tmp_path / "part.h5")!r}, [1, 2])
except SessionError as error:
    print(error)
"""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert "part.h5 cannot be written" in done.stdout, done
    assert sorted(path.name for path in tmp_path.iterdir()) == ["session.h5"]


def test_a_frame_that_never_came_keeps_having_no_id(make_part: Callable[..., Path], tmp_path: Path) -> None:
    one, other = make_part("one.h5", 0), make_part("other.h5", 9)
    with h5py.File(other, "r+") as file:
        drops = file["camera/drops"]
        drops.resize(2, axis=0)
        drops[1] = (-1, b"triggered twice, never came", 10**10)
        leave_open(drops)
        seal(file)
    merge([one, other], tmp_path / "both.h5")
    assert validate(tmp_path / "both.h5") == []
    with Session.open(tmp_path / "both.h5") as session:
        assert sorted(session.drops["frame_id"])[0] == -1


@pytest.mark.parametrize("frames", ["5:-", "-:", "-:-:2", "a:b"])
def test_half_a_number_is_no_slice(recorded: Path, frames: str) -> None:
    with Session.open(recorded) as session, pytest.raises(SessionError, match="give a slice such as"):
        chosen_frames(session, frames, None)
