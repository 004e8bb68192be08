"""Annotation of a recording whose truth is known: poses to the micrometre, masks to the pixel."""

from __future__ import annotations

import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from calibration import (
    Calibration,
    HandEyeRecord,
    IntrinsicsRecord,
    ObjectPoseRecord,
    TimeOffsetRecord,
    apply_calibration,
)
from calibration.records import FixedCameraRecord
from dataset import SE3, CameraInfo, ClockFit, Intrinsics, RawFrame, RobotTrace
from dataset.errors import CalibrationError, ToolkitWarning
from dataset.session import Session, SessionWriter
from dataset.transforms import rotation_error_deg, translation_error_mm
from dataset.validate import validate
from s2p3 import objects
from s2p3.annotation import annotate
from s2p3.cli import main
from s2p3.objects import ObjectModel
from s2p3.rendering import rasterize

HEIGHT, WIDTH = 512, 640
FRAMES, PERIOD_S, OFFSET_S = 6, 0.5, -0.045
HOST_NS, CAMERA_NS = 4_000_000_000_000, 88_000_000_000
CAMERA = CameraInfo("maker", "model", "1", "1.0", "BayerRG8", "colour", WIDTH, HEIGHT, 8, 9000)
LENS = Intrinsics(
    np.array([[900.0, 0, 322.0], [0, 903.0, 251.0], [0, 0, 1]]),
    np.array([-0.1, 0.06, 3e-4, -2e-4]),
    HEIGHT,
    WIDTH,
)
T_TCP_CAM = SE3.from_rotvec([0.03, -0.02, 3.1], [0.01, -0.07, 0.05])
T_BASE_CUP = SE3.from_rotvec([0.0, 0.0, 0.7], [0.45, 0.1, 0.0])


def camera_at(time_s: np.ndarray) -> SE3:
    """T_base_cam on a smooth way around the cup, at seconds (K,) after the trace began."""
    turn = 0.5 * time_s
    eye = np.stack([0.45 + 0.3 * np.sin(turn), 0.1 - 0.3 * np.cos(turn), 0.3 + 0.02 * turn], axis=1)
    forward = np.array([0.45, 0.1, 0.04]) - eye
    forward /= np.linalg.norm(forward, axis=1, keepdims=True)
    right = np.cross(forward, [0.0, 0.0, 1.0])
    right /= np.linalg.norm(right, axis=1, keepdims=True)
    return SE3(np.stack([right, np.cross(forward, right), forward], axis=2), eye)


@pytest.fixture
def recorded(tmp_path: Path) -> Path:
    """Frames at 2 Hz from a moving arm whose trace runs at 250 Hz; the frames report late by 45 ms."""
    path = tmp_path / "sequence.h5"
    with SessionWriter(path, "sequence", CAMERA) as writer:
        for index, start in enumerate(exposures()):
            times = round((start - 0.001) * 1e9), round((start - OFFSET_S + 0.002) * 1e9)
            pixels = np.full((HEIGHT, WIDTH), 90, np.uint8)
            frame = RawFrame(
                pixels, "BayerRG8", index, CAMERA_NS + times[0], HOST_NS + times[1], 2000.0, 0.0, 0
            )
            writer.add_frame(frame)
        times_s = np.arange(0, FRAMES * PERIOD_S + 1.0, 0.004)
        pose = (camera_at(times_s) @ T_TCP_CAM.inverse()).as_pose6()
        host = HOST_NS + np.rint(times_s * 1e9).astype(np.int64)
        zeros = np.zeros((len(times_s), 6))
        writer.add_robot_trace(
            RobotTrace(host, times_s, zeros, pose, np.ones(len(times_s), np.uint32)), np.zeros(6)
        )
        camera = ClockFit(HOST_NS - CAMERA_NS - OFFSET_S * 1e9, 1.0, 1e4)
        writer.set_clocks(camera=camera, robot=ClockFit(HOST_NS, 1.0, 1e4))
    return path


def exposures() -> np.ndarray:
    """Middle of every exposure, seconds after the trace began."""
    return 0.5 + PERIOD_S * np.arange(FRAMES)


def calibration(cup: ObjectModel) -> Calibration:
    return Calibration(
        intrinsics=IntrinsicsRecord(LENS, 1e-4 * np.eye(8), 0.1, 0.1, 20, ()),
        hand_eye=HandEyeRecord(
            T_TCP_CAM, SE3.identity(), 1e-10 * np.eye(12), 0.1, 0.1, 0.01, 1e-5, 1e-5, 20, ()
        ),
        time_offset=TimeOffsetRecord(OFFSET_S, 1e-4, 0.1, ()),
        objects={cup.name: ObjectPoseRecord(T_BASE_CUP, 1e-10 * np.eye(6), 1e-4, 40, (), ())},
    )


def test_poses_boxes_and_masks_are_the_truth(recorded: Path, cup: ObjectModel, tmp_path: Path) -> None:
    saved = tmp_path / "calibration.json"
    calibration(cup).save(saved)
    assert main(["annotate", str(recorded), "--calibration", str(saved), "--object", "cup"]) == 0
    assert validate(recorded) == []
    truth = camera_at(exposures())
    with Session.open(recorded) as session:
        assert session.poses is not None
        assert translation_error_mm(session.poses, truth).max() < 0.01
        assert rotation_error_deg(session.poses, truth).max() < 0.002
        poses = session.object_poses("cup")
        np.testing.assert_allclose(
            poses.T_cam_obj.as_matrix(), (truth.inverse() @ T_BASE_CUP).as_matrix(), atol=2e-5
        )
        assert session.calibration_json == saved.read_text(encoding="utf-8")
        camera = session.working_intrinsics
        assert (camera.height, camera.width) == (HEIGHT // 4, WIDTH // 4)
        for index in range(FRAMES):
            expected = drawn(cup, truth[index].inverse() @ T_BASE_CUP, camera)
            mask = poses.mask(index)
            assert expected.sum() > 500
            assert (mask & expected).sum() / (mask | expected).sum() > 0.99
            assert poses.visible_fraction[index] == pytest.approx(1.0)
            rows, columns = np.nonzero(expected)
            edges = [columns.min(), rows.min(), np.ptp(columns) + 1, np.ptp(rows) + 1]
            np.testing.assert_allclose(poses.bbox_xywh[index], edges, atol=1)


def drawn(cup: ObjectModel, T_cam_obj: SE3, camera: Intrinsics) -> np.ndarray:
    raster = rasterize(cup.mesh, T_cam_obj, camera)
    mask = np.zeros((camera.height, camera.width), bool)
    mask[raster.window] = raster.mask
    return mask


def test_a_second_object_leaves_the_first_where_it_is(recorded: Path, cup: ObjectModel) -> None:
    fork = objects.build("fork")
    beside = SE3.from_rotvec(np.zeros(3), [0.05, 0.0, 0.0]) @ T_BASE_CUP
    both = calibration(cup).merged(
        Calibration(objects={"fork": replace(calibration(cup).objects["cup"], T_base_obj=beside)})
    )
    annotate(recorded, calibration(cup), cup)
    with Session.open(recorded) as session:
        before = session.object_poses("cup")
    annotate(recorded, both, fork)
    assert validate(recorded) == []
    with Session.open(recorded) as session:
        assert session.annotated == ("cup", "fork")
        after = session.object_poses("cup")
        np.testing.assert_array_equal(after.T_cam_obj.as_matrix(), before.T_cam_obj.as_matrix())
        np.testing.assert_array_equal(after.bbox_xywh, before.bbox_xywh)
    with pytest.warns(ToolkitWarning, match="'fork' is no longer annotated"):
        annotate(recorded, calibration(cup), cup)
    with Session.open(recorded) as session:
        assert session.annotated == ("cup",)


def test_the_arms_tool_setting_moves_the_frame_not_the_camera(recorded: Path, cup: ObjectModel) -> None:
    longer = np.array([0.0, 0.01, 0.12, 0.0, 0.2, 0.0])  # the session's is zero
    known = calibration(cup)
    assert known.hand_eye is not None
    T_tcp_cam = SE3.from_pose6(longer).inverse() @ T_TCP_CAM
    with_gripper = replace(known.hand_eye, T_tcp_cam=T_tcp_cam, tcp_offset=longer)
    annotate(recorded, replace(known, hand_eye=with_gripper), cup)
    with Session.open(recorded) as session:
        assert session.poses is not None
        assert translation_error_mm(session.poses, camera_at(exposures())).max() < 0.01


def test_a_fixed_camera_needs_no_arm(cup_session: Path, cup: ObjectModel, tmp_path: Path) -> None:
    path = Path(shutil.copy(cup_session, tmp_path / "still.h5"))
    with Session.open(path) as session:
        lens, T_cam_obj = session.intrinsics, session.object_poses("cup").T_cam_obj[0]
    assert lens is not None
    stands = FixedCameraRecord(
        T_BASE_CUP @ T_cam_obj.inverse(),
        SE3.identity(),
        1e-10 * np.eye(12),
        0.1,
        0.1,
        0.01,
        1e-5,
        1e-5,
        20,
        (),
    )
    known = replace(calibration(cup), hand_eye=None, time_offset=None, fixed_camera=stands)
    assert known.intrinsics is not None
    known = replace(known, intrinsics=replace(known.intrinsics, intrinsics=lens))
    done = annotate(path, known, cup)
    assert done.visible == done.frames
    with Session.open(path) as session:
        found = session.object_poses("cup").T_cam_obj
        np.testing.assert_allclose(found.as_matrix(), [T_cam_obj.as_matrix()] * done.frames, atol=1e-12)


def test_what_another_calibration_had_placed_goes_with_it(recorded: Path, cup: ObjectModel) -> None:
    annotate(recorded, calibration(cup), cup)
    done = apply_calibration(recorded, replace(calibration(cup), hand_eye=None, time_offset=None))
    assert done.poses == 0
    with Session.open(recorded) as session:
        assert session.poses is None
        assert session.annotated == ()


def test_poses_that_no_arm_gave_are_not_thrown_away(
    cup_session: Path, cup: ObjectModel, tmp_path: Path
) -> None:
    path = Path(shutil.copy(cup_session, tmp_path / "imported.h5"))
    before = path.read_bytes()
    with pytest.raises(CalibrationError, match="no arm's trace gave"):
        apply_calibration(path, calibration(cup))
    assert path.read_bytes() == before


def test_without_the_time_offset_the_poses_lag(recorded: Path, cup: ObjectModel) -> None:
    annotate(recorded, replace(calibration(cup), time_offset=None), cup)
    with Session.open(recorded) as session:
        assert session.poses is not None
        assert translation_error_mm(session.poses, camera_at(exposures())).min() > 3


def test_annotating_again_replaces_what_was_there(recorded: Path, cup: ObjectModel) -> None:
    done = annotate(recorded, calibration(cup), cup)
    assert (done.frames, done.visible) == (FRAMES, FRAMES)
    away = SE3.from_rotvec(np.zeros(3), [0.0, 0.0, 5.0]) @ T_BASE_CUP
    moved = calibration(cup).merged(
        Calibration(objects={"cup": replace(calibration(cup).objects["cup"], T_base_obj=away)})
    )
    assert annotate(recorded, moved, cup).visible == 0
    assert validate(recorded) == []
    with Session.open(recorded) as session:
        assert not session.object_poses("cup").mask(0).any()


def test_an_object_half_out_of_view_is_half_visible(recorded: Path, cup: ObjectModel) -> None:
    beside = T_BASE_CUP.translation + camera_at(exposures()).rotation[0, :, 0] * 0.17
    known = calibration(cup)
    moved = known.merged(
        Calibration(
            objects={"cup": replace(known.objects["cup"], T_base_obj=SE3(T_BASE_CUP.rotation, beside))}
        )
    )
    annotate(recorded, moved, cup)
    with Session.open(recorded) as session:
        poses = session.object_poses("cup")
        assert 0.1 < poses.visible_fraction[0] < 0.95
        assert poses.mask(0)[:, -1].any()


def test_frames_outside_the_trace_have_no_pose(recorded: Path, cup: ObjectModel) -> None:
    late = replace(calibration(cup), time_offset=TimeOffsetRecord(OFFSET_S - 0.7, 1e-4, 0.1, ()))
    done = annotate(recorded, late, cup)
    assert done.visible == FRAMES - 1
    with Session.open(recorded) as session:
        assert session.poses is not None
        assert list(session.poses.finite) == [False] + [True] * (FRAMES - 1)
    assert validate(recorded) == []


def test_what_was_not_calibrated_is_named_and_nothing_is_written(recorded: Path, cup: ObjectModel) -> None:
    before = recorded.read_bytes()
    for part, verb in (("hand_eye", "hand-eye"), ("intrinsics", "intrinsics")):
        with pytest.raises(CalibrationError, match=f"s2p3 calibrate {verb}"):
            annotate(recorded, replace(calibration(cup), **{part: None}), cup)
    with pytest.raises(CalibrationError, match=r"no pose of 'cup' .*s2p3 calibrate object"):
        annotate(recorded, replace(calibration(cup), objects={}), cup)
    assert recorded.read_bytes() == before
