"""From a rendered recording to calibrated camera poses: mosaics in, transforms out."""

import numpy as np
import pytest

from calibration import (
    BoardSpec,
    Calibration,
    HandEyeRecord,
    IntrinsicsRecord,
    Source,
    TimeOffsetRecord,
    camera_poses,
    detect_session,
    hand_eye_from_session,
    html,
    intrinsics_from_session,
)
from calibration.report import ViewPicture, hand_eye_section, intrinsics_section
from calibration.sessions import arm_trace, rest_pose
from calibration.touches import KnownTip, read_points, touched_points
from dataset.errors import CalibrationError
from dataset.session import Session
from dataset.transforms import rotation_error_deg, translation_error_mm


@pytest.fixture(scope="module")
def detected(world, stills):
    with Session.open(stills[0]) as session:
        return detect_session(session, world.spec)


@pytest.fixture(scope="module")
def calibrated(world, stills, detected):
    with Session.open(stills[0]) as session:
        camera = intrinsics_from_session(session, world.spec, detected)
        record = IntrinsicsRecord.of(camera, session.camera, (Source.of(stills[0]),))
        return camera, record, hand_eye_from_session(session, world.spec, record, detected)


def test_corners_of_a_colour_mosaic_are_found_to_a_twentieth_of_a_pixel(world, stills, detected):
    views = (stills[1] @ world.T_tcp_cam).inverse() @ world.T_base_board
    assert [index for index, _ in detected] == list(range(len(views)))
    for index, detection in detected:
        expected = world.intrinsics.project(views[index].apply(world.spec.object_points(detection.ids)))
        error = detection.pixels - expected
        assert len(detection) > 25
        assert np.sqrt(np.mean(error**2)) < 0.1
        # A half-pixel mistake between mosaic and polarization image would shift every corner alike.
        assert np.abs(error.mean(axis=0)).max() < 0.05


def test_intrinsics_from_pictures(world, calibrated):
    camera, _, _ = calibrated
    assert abs(camera.intrinsics.K[0, 0] / world.intrinsics.K[0, 0] - 1) < 2e-3
    assert camera.rms_px < 0.15
    assert (camera.intrinsics.height, camera.intrinsics.width) == (2048, 2448)


def test_hand_eye_from_pictures(world, calibrated):
    _, _, hand_eye = calibrated
    assert rotation_error_deg(hand_eye.T_tcp_cam, world.T_tcp_cam) < 0.05
    assert translation_error_mm(hand_eye.T_tcp_cam, world.T_tcp_cam) < 0.5


def test_a_still_is_looked_up_in_the_rest_before_it(stills):
    path, true_arm = stills
    with Session.open(path) as session:
        times, trace = arm_trace(session)
        for index, pose in enumerate(true_arm):
            late = rest_pose(times, trace, int(session.mid_exposure_host_ns[index]) + 100_000_000)
            assert late is not None
            assert translation_error_mm(late, pose) < 0.3
        assert rest_pose(times, trace, int(times[0] + 1_800_000_000)) is None


def test_camera_poses_carry_their_uncertainty(world, stills, calibrated):
    path, true_arm = stills
    _, intrinsics, hand_eye = calibrated
    calibration = Calibration(
        intrinsics=intrinsics,
        hand_eye=HandEyeRecord.of(hand_eye, None, ()),
        time_offset=TimeOffsetRecord(-0.06, 1e-4, 0.2, ()),
    )
    with Session.open(path) as session:
        found = camera_poses(session, calibration)
        assert translation_error_mm(found.T_base_cam, true_arm @ world.T_tcp_cam).max() < 1.0
        assert (found.sigma_m >= hand_eye.sigma_m).all()
        beyond = calibration.merged(Calibration(time_offset=TimeOffsetRecord(-5.0, 1e-4, 0.2, ())))
        assert list(camera_poses(session, beyond).T_base_cam.finite[:2]) == [False, False]


def test_touches_are_the_tips_place_at_rest(stills):
    path, true_arm = stills
    with Session.open(path) as session:
        points = touched_points(session, KnownTip.exactly([0.0, 0.0, 0.1])).points
    np.testing.assert_allclose(points, true_arm.apply(np.tile([0, 0, 0.1], (len(true_arm), 1))), atol=3e-4)


def test_a_wrong_board_is_explained(stills):
    other = BoardSpec(8, 11, 0.030, 0.022, "DICT_7X7_100")
    with Session.open(stills[0]) as session, pytest.raises(CalibrationError, match="DICT_5X5_"):
        detect_session(session, other)


@pytest.mark.parametrize("text", ["1 2\n", "x y z\n", ""])
def test_a_bad_points_file_is_refused(tmp_path, text):
    path = tmp_path / "points.txt"
    path.write_text(text)
    with pytest.raises(CalibrationError, match="metres"):
        read_points(path)


def test_points_may_be_separated_by_commas_and_carry_comments(tmp_path):
    path = tmp_path / "points.csv"
    path.write_text("# probe 3\n0.1, 0.2, 0.3\n\n1 2 3 # rim\n")
    np.testing.assert_allclose(read_points(path), [[0.1, 0.2, 0.3], [1, 2, 3]])


def test_the_report_is_one_file_with_pictures_first(stills, calibrated):
    camera, _, hand_eye = calibrated
    with Session.open(stills[0]) as session:
        shown = [ViewPicture(session.raw(0), session.camera.mosaic, 0)]
    frames = range(len(stills[1]))
    for section in (
        intrinsics_section(camera, frames, shown),
        hand_eye_section(hand_eye, frames, shown),
    ):
        page = html.page("Calibration report", "", [section])
        assert "data:image/" in page
        assert "http" not in page.replace("http://www.w3.org/2000/svg", "")
        first_picture, first_number = page.index("<svg"), page.index('<div class="tiles"')
        assert first_picture < first_number
