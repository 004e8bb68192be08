"""Validation: a good session has no problem, a bad one has all of them at once."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import h5py
import numpy as np
import pytest
from numpy.typing import NDArray

from dataset import CameraInfo, Intrinsics, RawFrame
from dataset.schema import VERSION
from dataset.session import SessionWriter, compress, mask_box
from dataset.validate import info, validate


def test_a_good_session_has_no_problem(recorded: Path) -> None:
    assert validate(recorded) == []


def test_an_empty_session_has_no_problem(tmp_path: Path, camera: CameraInfo) -> None:
    path = tmp_path / "s.h5"
    with SessionWriter(path, "hand_eye", camera):
        pass
    assert validate(path) == []


def test_intrinsics_known_from_the_start_need_no_calibration_file(
    tmp_path: Path, camera: CameraInfo, intrinsics: Intrinsics
) -> None:
    path = tmp_path / "s.h5"
    with SessionWriter(path, "synthetic", camera, intrinsics=intrinsics):
        pass
    assert validate(path) == []


def spoil(file: h5py.File, path: str, index: object, value: object) -> None:
    file[path][index] = value


def dented(file: h5py.File) -> NDArray[np.uint8]:
    """The mask of frame 3 without one of its inner pixels: its box is the same."""
    mask: NDArray[np.uint8] = file["poses/objects/tetra/mask"][3]
    mask[3, 4] = 0
    return mask


DAMAGES: dict[str, tuple[Callable[[h5py.File], None], str, str]] = {
    "missing dataset": (lambda f: f.__delitem__("camera/gain_db"), "camera/gain_db", "is missing"),
    "missing attribute": (lambda f: f.attrs.__delitem__("toolkit"), "/@toolkit", "is missing"),
    "wrong kind": (lambda f: f.attrs.update(kind="film"), "/@kind", "expected one of sequence"),
    "wrong attribute type": (
        lambda f: f["camera"].attrs.update(bits="twelve"),
        "/camera/@bits",
        "expected int",
    ),
    "wrong mosaic": (lambda f: f["camera"].attrs.update(mosaic="quad"), "/camera/@mosaic", "mono, colour"),
    "wrong dtype": (
        lambda f: (f.__delitem__("robot/q"), f.create_dataset("robot/q", data=np.zeros((150, 6), "f4"))),
        "robot/q",
        "has type float32",
    ),
    "wrong shape": (
        lambda f: (f.__delitem__("poses/sigma_t"), f.create_dataset("poses/sigma_t", data=np.zeros(5))),
        "poses/sigma_t",
        "has shape (5,), expected (12)",
    ),
    "group for a dataset": (
        lambda f: (f.__delitem__("clocks/robot"), f.create_group("clocks/robot")),
        "clocks/robot",
        "is a group",
    ),
    "units": (lambda f: f["robot/q"].attrs.update(units="deg"), "robot/q", "units attribute is 'deg'"),
    "description": (lambda f: f["robot/q"].attrs.__delitem__("description"), "robot/q", "no description"),
    "frame ids": (lambda f: spoil(f, "camera/frame_id", 3, 1), "camera/frame_id", "not increase at frame 3"),
    "camera clock": (
        lambda f: spoil(f, "camera/camera_time_ns", 8, 0),
        "camera/camera_time_ns",
        "not increase at frame 8",
    ),
    "host clock": (
        lambda f: spoil(f, "camera/host_time_ns", 8, 0),
        "camera/host_time_ns",
        "not increase at frame 8",
    ),
    "silent loss": (
        lambda f: spoil(f, "camera/frame_id", 11, 15),
        "camera/frame_id[11]",
        "3 frames between ids 11 and 15",
    ),
    "ledgered and stored": (
        lambda f: spoil(f, "camera/drops", 0, (7, b"x", 0)),
        "camera/drops",
        "frame id 7 is in the ledger and stored",
    ),
    "exposure": (lambda f: spoil(f, "camera/exposure_us", 2, 0), "camera/exposure_us", "positive at frame 2"),
    "gain": (lambda f: spoil(f, "camera/gain_db", 2, np.nan), "camera/gain_db", "finite at frame 2"),
    "packets": (lambda f: spoil(f, "camera/missing_packets", 2, 4), "camera/missing_packets", "frame 2"),
    "flipped pixel": (
        lambda f: f["camera/raw"].id.write_direct_chunk((4, 0, 0), compress(f["camera/raw"][4] ^ 1).data),
        "camera/raw[4]",
        "do not match their checksum",
    ),
    "flipped mask": (
        lambda f: f["poses/objects/tetra/mask"].id.write_direct_chunk((3, 0, 0), compress(dented(f)).data),
        "poses/objects/tetra/mask[3]",
        "do not match their checksum",
    ),
    "broken mask": (
        lambda f: f["poses/objects/tetra/mask"].id.write_direct_chunk((3, 0, 0), b"\0" * 40),
        "poses/objects/tetra/mask[3]",
        "cannot be decompressed",
    ),
    "broken depth": (
        lambda f: f["depth"].id.write_direct_chunk((3, 0, 0), b"\0" * 40),
        "depth[3]",
        "cannot be decompressed",
    ),
    "flipped depth": (
        lambda f: f["depth"].id.write_direct_chunk((3, 0, 0), compress(f["depth"][3] ^ 1).data),
        "depth[3]",
        "do not match their checksum",
    ),
    "broken chunk": (
        lambda f: f["camera/raw"].id.write_direct_chunk((4, 0, 0), b"\0" * 40),
        "camera/raw[4]",
        "cannot be decompressed",
    ),
    "too many bits": (lambda f: f["camera"].attrs.update(bits=8), "camera/raw[0]", "more than 8 bits"),
    "robot clock": (
        lambda f: spoil(f, "robot/robot_time_s", 9, 0),
        "robot/robot_time_s",
        "not increase at sample 9",
    ),
    "robot pose": (lambda f: spoil(f, "robot/pose", (9, 2), np.inf), "robot/pose", "finite at sample 9"),
    "tool offset": (lambda f: spoil(f, "robot/tcp_offset", 0, np.nan), "robot/tcp_offset", "unknown"),
    "clock rate": (lambda f: spoil(f, "clocks/camera", 1, 1.5), "clocks/camera", "describe no clock"),
    "focal length": (lambda f: spoil(f, "calibration/K", (0, 0), -1), "calibration", "not a pinhole"),
    "calibration text": (
        lambda f: spoil(f, "calibration/json", (), "{}"),
        "calibration/json",
        "does not match its sha256",
    ),
    "mesh changed": (
        lambda f: spoil(f, "objects/tetra/vertices", (1, 0), 0.1001),
        "objects/tetra",
        "mesh does not match",
    ),
    "mesh faces": (lambda f: spoil(f, "objects/tetra/faces", (0, 0), 9), "objects/tetra", "do not exist"),
    "mesh in millimetres": (
        lambda f: f["objects/tetra"].attrs.update(diameter=141.4),
        "objects/tetra",
        "does not fit a mesh",
    ),
    "symmetry": (
        lambda f: f["objects/tetra"].attrs.update(symmetry="{"),
        "objects/tetra/@symmetry",
        "is not JSON",
    ),
    "scaled rotation": (
        lambda f: spoil(f, "poses/T_base_cam", (5, 0), [2, 0, 0, 0]),
        "poses/T_base_cam",
        "no rotation at frame 5",
    ),
    "huge rotation": (
        lambda f: spoil(f, "poses/T_base_cam", (5, slice(0, 2)), [[1e200, 1e200, -1e200, 0]] * 2),
        "poses/T_base_cam",
        "no rotation at frame 5",
    ),
    "partly known pose": (
        lambda f: spoil(f, "poses/objects/tetra/T_cam_obj", (5, 0, 3), np.nan),
        "poses/objects/tetra/T_cam_obj",
        "partly known at frame 5",
    ),
    "last row": (
        lambda f: spoil(f, "poses/T_base_cam", (5, 3), [0, 0, 1, 1]),
        "poses/T_base_cam",
        "last row",
    ),
    "sigma": (lambda f: spoil(f, "poses/sigma_r", 1, -1), "poses/sigma_r", "negative or infinite at frame 1"),
    "visibility": (
        lambda f: spoil(f, "poses/objects/tetra/visible_fraction", 1, 1.5),
        "poses/objects/tetra/visible_fraction",
        "within 0 and 1",
    ),
    "box": (
        lambda f: spoil(f, "poses/objects/tetra/bbox_xywh", 1, [0, 0, 3, 3]),
        "poses/objects/tetra/bbox_xywh[1]",
        "is not the box",
    ),
    "poses of no object": (
        lambda f: f.move("objects/tetra", "objects/cube"),
        "poses/objects/tetra",
        "no mesh",
    ),
    "split range": (lambda f: spoil(f, "splits/test", 2, 40), "splits/test", "outside 0..11"),
    "split order": (lambda f: spoil(f, "splits/test", 2, 9), "splits/test", "increasing order"),
    "split overlap": (lambda f: spoil(f, "splits/train", 8, 9), "splits/train", "shares 1 frames with test"),
    "incomplete": (lambda f: f.attrs.update(complete=False), "/", "s2p3 dataset repair"),
}


@pytest.mark.parametrize("damage", DAMAGES)
def test_each_problem_is_found(recorded: Path, damage: str) -> None:
    change, where, what = DAMAGES[damage]
    with h5py.File(recorded, "r+") as file:
        change(file)
    problems = validate(recorded)
    assert any(p.where == where and what in str(p) for p in problems), [str(p) for p in problems]
    assert all(p.hint for p in problems)
    assert all("\n" not in str(p) for p in problems)


def test_every_problem_is_reported_at_once(recorded: Path) -> None:
    chosen = ["missing attribute", "units", "exposure", "silent loss", "flipped pixel", "robot pose"]
    chosen += ["clock rate", "calibration text", "scaled rotation", "box", "split range", "incomplete"]
    with h5py.File(recorded, "r+") as file:
        for damage in chosen:
            DAMAGES[damage][0](file)
    problems = [str(p) for p in validate(recorded)]
    for damage in chosen:
        _, where, what = DAMAGES[damage]
        assert any(p.startswith(where + ":") and what in p for p in problems), damage


def test_info_summarises(recorded: Path, camera: CameraInfo) -> None:
    summary = info(recorded)
    assert summary.complete
    assert summary.advice == summary.repaired == ""
    assert (summary.frames, summary.drops, summary.robot_samples) == (12, 1, 150)
    assert summary.duration_s == pytest.approx(0.22)
    assert summary.camera == camera
    assert summary.clocks == ("camera", "robot")
    assert summary.calibrated
    assert summary.posed
    assert summary.objects == summary.annotated == ("tetra",)
    assert summary.splits == {"train": 9, "test": 3}
    assert summary.size_bytes == recorded.stat().st_size
    assert summary.schema == VERSION


def test_unexplained_gaps_count_only_what_the_ledger_lacks(
    tmp_path: Path, camera: CameraInfo, make_frame: Callable[..., RawFrame]
) -> None:
    path = tmp_path / "s.h5"
    with SessionWriter(path, "sequence", camera) as writer:
        writer.add_frame(make_frame(0, 10))
        writer.add_frame(make_frame(1, 15))
        for lost in (12, 13):
            writer.add_drop(lost, "incomplete", 0)
    (problem,) = validate(path)
    assert "2 frames between ids 10 and 15" in problem.what


def test_the_box_of_a_mask_spans_its_pixels() -> None:
    mask = np.zeros((6, 8), dtype=bool)
    assert mask_box(mask).tolist() == [0, 0, 0, 0]
    mask[2:4, 5] = True
    assert mask_box(mask).tolist() == [5, 2, 1, 2]
