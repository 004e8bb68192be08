"""Sessions: what goes in comes out, through our reader and through plain h5py."""

from __future__ import annotations

import os
import pickle
import threading
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import h5py
import hdf5plugin  # noqa: F401  registers the Blosc2 filter with plain h5py
import numpy as np
import pytest

from dataset import SE3, CameraInfo, ClockFit, Intrinsics, RawFrame, RobotTrace, SessionError
from dataset.clocks import DeviceClock
from dataset.polarimetry import decode
from dataset.schema import DATASETS, VERSION
from dataset.session import (
    ObjectPoses,
    ObjectRecord,
    Session,
    SessionWriter,
    compress,
    write_calibration,
    write_object,
    write_poses,
    write_split,
)
from dataset.session.seals import leave_open, seal
from dataset.validate import validate


def test_a_session_round_trips(
    recorded: Path,
    camera: CameraInfo,
    intrinsics: Intrinsics,
    tetrahedron: ObjectRecord,
    make_frame: Callable[..., RawFrame],
    make_trace: Callable[..., RobotTrace],
    make_poses: Callable[[], tuple[SE3, ObjectPoses]],
) -> None:
    with Session.open(recorded) as session:
        assert (session.kind, session.complete, len(session)) == ("sequence", True, 12)
        assert session.camera == camera
        assert session.rig_toml == "[camera]\n"
        for i in range(12):
            expected = make_frame(i)
            np.testing.assert_array_equal(session.raw(i), expected.pixels)
            assert session.raw(i).dtype == np.uint16
            assert session.camera_time_ns[i] == expected.camera_time_ns
            assert session.host_time_ns[i] == expected.host_time_ns
        assert session.frame_ids.tolist() == [0, 1, 2, 3, 4, 5, 7, 8, 9, 10, 11, 12]
        assert session.drops.tolist() == [(6, b"queue full", 1_120_000_000)]
        assert session.exposures_us.tolist() == [2000.0] * 12
        assert session.robot is not None
        whole = make_trace(150)
        for name in ("host_time_ns", "robot_time_s", "q", "pose", "safety_bits"):
            np.testing.assert_array_equal(getattr(session.robot, name), getattr(whole, name))
        assert session.tcp_offset is not None
        assert session.tcp_offset.tolist() == [0, 0, 0.1, 0, 0, 0]
        assert session.clocks.camera == DeviceClock((0,), (ClockFit(-6e9, 1.0, 300.0),))
        assert session.clocks.robot == DeviceClock((0,), (ClockFit(-99e9, 1.0, 400.0),))
        np.testing.assert_array_equal(
            session.mid_exposure_host_ns, session.camera_time_ns - 6_000_000_000 + 1_000_000
        )
        assert session.intrinsics is not None
        np.testing.assert_array_equal(session.intrinsics.K, intrinsics.K)
        np.testing.assert_array_equal(session.intrinsics.distortion, intrinsics.distortion)
        assert session.calibration_json == '{"fx": 40}'
        assert session.objects == ("tetra",)
        stored = session.object("tetra")
        np.testing.assert_array_equal(stored.vertices, tetrahedron.vertices)
        np.testing.assert_array_equal(stored.faces, tetrahedron.faces)
        assert stored.sha256 == tetrahedron.sha256
        assert stored.diameter == tetrahedron.diameter
        T_base_cam, object_poses = make_poses()
        assert session.poses is not None
        np.testing.assert_array_equal(session.poses.as_matrix(), T_base_cam.as_matrix())
        found = session.object_poses("tetra")
        np.testing.assert_array_equal(found.T_cam_obj.as_matrix(), object_poses.T_cam_obj.as_matrix())
        np.testing.assert_array_equal(found.bbox_xywh, object_poses.bbox_xywh)
        for i in range(12):
            np.testing.assert_array_equal(found.mask(i), object_poses.mask(i))
        assert found.mask(0).dtype == bool
        assert {name: split.tolist() for name, split in session.splits.items()} == {
            "train": list(range(9)),
            "test": [9, 10, 11],
        }


def test_plain_h5py_reads_everything(recorded: Path, make_frame: Callable[..., RawFrame]) -> None:
    with h5py.File(recorded, "r") as file:
        assert file.attrs["format"] == "s2p3-session"
        assert file.attrs["schema"] == VERSION
        assert bool(file.attrs["complete"])
        np.testing.assert_array_equal(file["camera/raw"][5], make_frame(5).pixels)
        assert file["camera/raw"].chunks == (1, 32, 48)
        assert file["poses/objects/tetra/mask"][3].sum() == 16
        paths: list[str] = []
        file.visit(paths.append)
        datasets = [file[path] for path in paths if isinstance(file[path], h5py.Dataset)]
        assert len(datasets) >= len([d for d in DATASETS if d.required])
        for dataset in datasets:
            assert dataset.attrs["units"], dataset.name
            assert dataset.attrs["description"], dataset.name


def test_a_frame_is_read_when_asked(recorded: Path, intrinsics: Intrinsics) -> None:
    with Session.open(recorded) as session:
        frame = session[-1]
        assert frame.index == 11
        np.testing.assert_array_equal(frame.raw, session.raw(11))
        assert frame.stokes.shape == (8, 12)
        assert frame.T_base_cam is not None
        np.testing.assert_allclose(
            (frame.T_base_cam @ frame.T_cam_obj("tetra")).as_matrix(), np.eye(4), atol=1e-12
        )
        assert frame.mask("tetra").shape == (8, 12)
        assert [f.index for f in session] == list(range(12))
        with pytest.raises(IndexError):
            session[12]
        with pytest.raises(IndexError):
            session.raw(12)
        assert session.working_intrinsics.distortion.size == 0
        np.testing.assert_allclose(session.working_intrinsics.K, intrinsics.at(4).K)


def test_stokes_are_undistorted_on_request(recorded: Path) -> None:
    with Session.open(recorded) as session:
        plain = decode(session.raw(0), "colour", 12)
        np.testing.assert_array_equal(session.stokes(0, undistort=False).stack(), plain.stack())
        undistorted = session.stokes(0)
        centre = (slice(3, 5), slice(5, 7))
        np.testing.assert_allclose(undistorted.s0[centre], plain.s0[centre], atol=0.1)
        assert not np.array_equal(undistorted.s0, plain.s0)


def test_undistortion_puts_the_image_where_the_pinhole_projects(tmp_path: Path, camera: CameraInfo) -> None:
    """A bright dot at a 3-D point's distorted pixel appears at its undistorted one."""
    camera = replace(camera, mosaic="mono", height=256, width=256)
    matrix = np.array([[200.0, 0, 127.5], [0, 200, 127.5], [0, 0, 1]])
    intrinsics = Intrinsics(matrix, np.array([-0.3, 0.1, 0.0, 0.0]), 256, 256)
    point = np.array([0.45, -0.35, 1.0])
    working = intrinsics.at(2)
    rows, columns = np.indices((128, 128))
    distorted = working.project(point)
    blob = np.exp(-((columns - distorted[0]) ** 2 + (rows - distorted[1]) ** 2) / 8)
    pixels = np.kron(2000 * blob + 100, np.ones((2, 2))).astype(np.uint16)
    path = tmp_path / "dot.h5"
    with SessionWriter(path, "synthetic", camera, intrinsics=intrinsics) as writer:
        writer.add_frame(RawFrame(pixels, "Mono12", 0, 0, 0, 100.0, 0.0, 0))
    with Session.open(path) as session:
        found = session.stokes(0).s0
        weight = np.where(found > found.max() / 2, found, 0)
        centroid = [(weight * columns).sum() / weight.sum(), (weight * rows).sum() / weight.sum()]
        expected = session.working_intrinsics.project(point)
    assert np.linalg.norm(expected - distorted) > 4
    np.testing.assert_allclose(centroid, expected, atol=0.3)


def test_why_a_time_is_not_known_is_said(
    tmp_path: Path, camera: CameraInfo, make_frame: Callable[..., RawFrame]
) -> None:
    path = tmp_path / "unknown.h5"
    with SessionWriter(path, "sequence", camera) as writer:
        for index in range(60):
            frame = make_frame(index)
            writer.add_frame(replace(frame, exposure_us=np.nan))
        assert writer.fit_clocks().problems == (
            "the camera does not tell how long it exposes: the middle of an exposure is not known",
        )
    with (
        Session.open(path) as session,
        pytest.raises(SessionError, match="did not tell how long it exposed"),
    ):
        _ = session.mid_exposure_host_ns
    with SessionWriter(tmp_path / "microseconds.h5", "sequence", camera) as writer:
        for index in range(60):
            frame = make_frame(index)
            writer.add_frame(replace(frame, camera_time_ns=frame.camera_time_ns // 1000))
        clocks = writer.fit_clocks()
    assert clocks.camera is None
    (problem,) = clocks.problems
    assert "not in nanoseconds" in problem


def test_what_was_not_recorded_is_none_or_a_clear_error(
    tmp_path: Path, camera: CameraInfo, make_frame: Callable[..., RawFrame]
) -> None:
    path = tmp_path / "bare.h5"
    with SessionWriter(path, "intrinsics", camera) as writer:
        writer.add_frame(make_frame(0))
    with Session.open(path) as session:
        assert session.robot is None
        assert session.tcp_offset is None
        assert session.intrinsics is None
        assert session.poses is None
        assert session.calibration_json is None
        assert session.objects == ()
        assert session.splits == {}
        assert session.clocks.camera is None
        assert session[0].T_base_cam is None
        for call, message in (
            (lambda: session.mid_exposure_host_ns, "clock was not related"),
            (lambda: session.stokes(0), "not calibrated"),
            (lambda: session.object("cup"), "no object 'cup'; its objects: none"),
            (lambda: session.object_poses("cup"), "has no poses"),
        ):
            with pytest.raises(SessionError, match=message):
                call()
    with pytest.raises(SessionError, match="is closed"):
        session.raw(0)


def test_a_session_travels_to_another_process_as_its_path(recorded: Path) -> None:
    with Session.open(recorded) as session:
        copy = pickle.loads(pickle.dumps(session))
        with copy:
            np.testing.assert_array_equal(copy.raw(3), session.raw(3))


def test_objects_may_come_while_recording(
    tmp_path: Path, camera: CameraInfo, tetrahedron: ObjectRecord, make_frame: Callable[..., RawFrame]
) -> None:
    path = tmp_path / "s.h5"
    with SessionWriter(path, "synthetic", camera) as writer:
        writer.add_frame(make_frame(0))
        writer.add_object(tetrahedron)
        with pytest.raises(SessionError, match="letters"):
            writer.add_object(replace(tetrahedron, name="a/b"))
        writer.add_frame(make_frame(1))
    with Session.open(path) as session:
        assert session.complete
        assert session.objects == ("tetra",)
        np.testing.assert_array_equal(session.raw(1), make_frame(1).pixels)


def test_a_growing_file_can_be_watched(
    tmp_path: Path, camera: CameraInfo, make_frame: Callable[..., RawFrame]
) -> None:
    path = tmp_path / "s.h5"
    with SessionWriter(path, "sequence", camera) as writer:
        for i in range(3):
            writer.add_frame(make_frame(i))
            with Session.open(path) as session:
                assert len(session) == i + 1
                assert not session.complete
                np.testing.assert_array_equal(session.raw(i), make_frame(i).pixels)
        with pytest.raises(SessionError, match="in use by another program"):
            write_split(path, "train", [0])


def test_threads_may_share_a_writer(
    tmp_path: Path, camera: CameraInfo, make_frame: Callable[..., RawFrame]
) -> None:
    path = tmp_path / "s.h5"
    with SessionWriter(path, "sequence", camera) as writer:

        def drop() -> None:
            for i in range(100, 150):
                writer.add_drop(i, "queue full", i)

        thread = threading.Thread(target=drop)
        thread.start()
        for i in range(50):
            writer.add_frame(make_frame(i), compress(make_frame(i).pixels))
        thread.join()
    with Session.open(path) as session:
        assert len(session) == 50
        assert session.drops["frame_id"].tolist() == list(range(100, 150))
        for i in range(50):
            np.testing.assert_array_equal(session.raw(i), make_frame(i).pixels)


def test_an_exception_leaves_a_closed_incomplete_file(
    tmp_path: Path, camera: CameraInfo, make_frame: Callable[..., RawFrame]
) -> None:
    path = tmp_path / "s.h5"

    def record_until_interrupted() -> None:
        with SessionWriter(path, "sequence", camera) as writer:
            writer.add_frame(make_frame(0))
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        record_until_interrupted()
    with Session.open(path) as session:
        assert not session.complete
        np.testing.assert_array_equal(session.raw(0), make_frame(0).pixels)
    with pytest.raises(SessionError, match="incomplete; run first: s2p3 dataset repair"):
        write_split(path, "train", [0])


def test_an_exception_before_anything_was_recorded_leaves_the_name_free(
    tmp_path: Path, camera: CameraInfo
) -> None:
    path = tmp_path / "s.h5"
    for _ in range(2):
        with pytest.raises(KeyboardInterrupt), SessionWriter(path, "sequence", camera):
            raise KeyboardInterrupt
        assert not path.exists()


def test_a_place_where_no_file_can_be_is_refused_in_one_line(camera: CameraInfo) -> None:
    with pytest.raises(SessionError) as caught:
        SessionWriter("/proc/s.h5", "sequence", camera)
    assert str(caught.value) == (
        "/proc/s.h5 cannot be created (No such file or directory); check the folder and its permissions"
    )


def test_the_writer_refuses_what_does_not_fit(
    tmp_path: Path, camera: CameraInfo, make_frame: Callable[..., RawFrame]
) -> None:
    path = tmp_path / "s.h5"
    with pytest.raises(SessionError, match="kind 'video' is unknown; use one of sequence"):
        SessionWriter(path, "video", camera)  # type: ignore[arg-type]
    with pytest.raises(SessionError, match="whole super-pixels; set the camera's"):
        SessionWriter(path, "sequence", replace(camera, width=50))
    with SessionWriter(path, "sequence", camera) as writer:
        writer.add_frame(make_frame(5))
        with pytest.raises(SessionError, match="frame id 5 follows 5"):
            writer.add_frame(make_frame(5))
        with pytest.raises(SessionError, match="uint8, the camera was described"):
            writer.add_frame(replace(make_frame(6), pixels=np.zeros((32, 48), np.uint8)))
        with pytest.raises(SessionError, match=r"\(32, 44\)"):
            writer.add_frame(replace(make_frame(6), pixels=np.zeros((32, 44), np.uint16)))
        writer.add_frame(make_frame(6))
    with pytest.raises(SessionError, match="closed already"):
        writer.add_frame(make_frame(7))
    with pytest.raises(SessionError, match="already exists"):
        SessionWriter(path, "sequence", camera)
    with Session.open(path) as session:
        assert session.frame_ids.tolist() == [5, 6]


def test_a_later_write_replaces_an_earlier_one(
    recorded: Path, tetrahedron: ObjectRecord, make_poses: Callable[[], tuple[SE3, ObjectPoses]]
) -> None:
    T_base_cam, _ = make_poses()
    write_split(recorded, "test", [11])
    write_object(recorded, replace(tetrahedron, material="glass"))
    write_poses(recorded, T_base_cam.inverse(), 0.0, 0.0, {})
    with Session.open(recorded) as session:
        assert session.splits["test"].tolist() == session.frames_in("test").tolist() == [11]
        with pytest.raises(SessionError, match=r"no split 'noon' \(its splits: .*test.*s2p3 dataset split"):
            session.frames_in("noon")
        assert session.object("tetra").material == "glass"
        assert session.poses is not None
        np.testing.assert_allclose((session.poses @ T_base_cam).as_matrix()[0], np.eye(4), atol=1e-12)
        with pytest.raises(SessionError, match="no poses"):
            session.object_poses("tetra")


def test_edits_refuse_what_does_not_fit(
    recorded: Path,
    intrinsics: Intrinsics,
    tetrahedron: ObjectRecord,
    make_poses: Callable[[], tuple[SE3, ObjectPoses]],
) -> None:
    T_base_cam, found = make_poses()
    with pytest.raises(SessionError, match="calibrate at the mosaic's resolution"):
        write_calibration(recorded, "{}", intrinsics.at(4))
    with pytest.raises(SessionError, match="no triangle mesh"):
        write_object(recorded, replace(tetrahedron, faces=np.zeros((2, 4), np.int32)))
    with pytest.raises(SessionError, match=r"T_base_cam has shape \(5,\), the session needs \(12,\)"):
        write_poses(recorded, T_base_cam[:5], 0, 0, {})
    with pytest.raises(SessionError, match="no object 'cup'"):
        write_poses(recorded, T_base_cam, 0, 0, {"cup": found})
    with pytest.raises(SessionError, match="visible_fraction"):
        write_poses(recorded, T_base_cam, 0, 0, {"tetra": replace(found, visible_fraction=np.ones(3))})
    with pytest.raises(SessionError, match=r"outside 0\.\.11"):
        write_split(recorded, "train", [3, 12])
    with pytest.raises(SessionError, match="twice"):
        write_split(recorded, "train", [3, 3])
    with pytest.raises(SessionError, match="letters"):
        write_split(recorded, "../x", [3])
    with Session.open(recorded) as session:
        assert session.object_poses("tetra").mask(0).any()


def test_files_that_are_no_session_are_refused(tmp_path: Path, recorded: Path) -> None:
    text, foreign, newer = tmp_path / "a.txt", tmp_path / "b.h5", tmp_path / "c.h5"
    text.write_text("hello" * 100)
    with h5py.File(foreign, "w") as file:
        file["x"] = 1
    with h5py.File(newer, "w") as file:
        file.attrs.update({"format": "s2p3-session", "schema": "2.3"})
    os.mkfifo(tmp_path / "e.h5")
    truncated = tmp_path / "d.h5"
    truncated.write_bytes(recorded.read_bytes()[:20_000])
    for path, message in (
        (tmp_path / "missing.h5", "does not exist"),
        (tmp_path, "is a folder"),
        (tmp_path / "e.h5", "is a pipe"),
        (text, "not an HDF5 file"),
        (foreign, "no session: its format attribute is None"),
        (newer, "has schema 2.3, this toolkit reads up to 1.1"),
        (truncated, "damaged or truncated"),
    ):
        with pytest.raises(SessionError, match=message) as caught:
            Session.open(path)
        assert "\n" not in str(caught.value)


def test_a_newer_minor_version_opens(recorded: Path) -> None:
    with h5py.File(recorded, "r+") as file:
        file.attrs["schema"] = "1.7"
        file.attrs["weather"] = "fair"
        file["camera/temperature"] = np.zeros(12)
        file["lidar/points"] = np.zeros((12, 3))
        leave_open(file)
        seal(file)
    with Session.open(recorded) as session:
        assert session.raw(0).shape == (32, 48)
    assert validate(recorded) == []


def test_a_damaged_frame_is_never_handed_out(recorded: Path, make_frame: Callable[..., RawFrame]) -> None:
    with h5py.File(recorded, "r+") as file:
        wrong = make_frame(4).pixels.copy()
        wrong[0, 0] ^= 1
        file["camera/raw"].id.write_direct_chunk((4, 0, 0), compress(wrong).data)
        file["camera/raw"].id.write_direct_chunk((7, 0, 0), b"\0" * 100)
    with Session.open(recorded) as session:
        for i in (4, 7):
            with pytest.raises(SessionError, match=rf"(frame {i}|raw\[{i}\]) is damaged"):
                session.raw(i)
        np.testing.assert_array_equal(session.raw(5), make_frame(5).pixels)
