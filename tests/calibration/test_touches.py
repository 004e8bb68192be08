"""Tips and touches as sessions hold them: from the arm's trace to calibration.json, its report, and a session
that carries what was applied."""

from pathlib import Path

import numpy as np
import pytest
import trimesh

from calibration import Calibration, apply_calibration
from calibration.polarizer_steps import add_polarizer
from calibration.touch_steps import add_object, add_tool_tip, known_tip
from calibration.touches import KnownTip
from dataset.errors import CalibrationError
from dataset.frames import CameraInfo, RawFrame, RobotTrace
from dataset.polarimetry import quantize
from dataset.polarizer_response import PolarizerResponse, nominal_orientation
from dataset.session import Session, SessionWriter
from dataset.transforms import SE3

NO_CAMERA = CameraInfo("none", "none", "", "", "Mono8", "mono", width=2, height=2, bits=8, packet_size=0)
TIP = np.array([0.002, -0.001, 0.181])
TOOL = np.array([0.0, 0.0, 0.01, 0.0, 0.0, 0.0])
HZ = 50.0


def guided(path, kind, stops, tool=TOOL, rest_s=0.9, swing_s=0.4):
    """A session of an arm that is guided from above to stop after stop and held still at each."""
    above = SE3(stops.rotation[0], stops.translation[0] + [0, 0, 0.1])
    poses = []
    for before, after in zip([above, *stops[:-1]], stops, strict=True):
        poses += [before.interpolate(after, a) for a in np.linspace(0, 1, int(swing_s * HZ))]
        poses += [after] * int(rest_s * HZ)
    count = len(poses)
    times = np.arange(count) / HZ
    pose6 = SE3.stack(poses).as_pose6()
    pose6[:, :3] += np.random.default_rng(0).normal(0, 1e-5, (count, 3))
    host = (times * 1e9).astype(np.int64) + 10**12
    with SessionWriter(path, kind, NO_CAMERA) as writer:
        writer.add_robot_trace(
            RobotTrace(host, times, np.zeros((count, 6)), pose6, np.ones(count, np.uint32)), tool
        )
    return path


def down(rotvecs):
    return (
        SE3.from_rotvec([np.pi, 0, 0], np.zeros(3)).rotation
        @ SE3.from_rotvec(rotvecs, np.zeros((len(rotvecs), 3))).rotation
    )


@pytest.fixture
def tilted(tmp_path):
    """The tip on one point, the tool tilted to all sides."""
    azimuth = np.arange(10) * 2.4
    rotation = down(
        np.column_stack([0.45 * np.cos(azimuth), 0.45 * np.sin(azimuth), 0.4 * np.sin(7 * azimuth)])
    )
    return guided(tmp_path / "tilts.h5", "tool_tip", SE3(rotation, [0.4, 0.0, 0.05] - rotation @ TIP))


BOX = trimesh.creation.box([0.09, 0.06, 0.04])
T_BASE_BOX = SE3.from_rotvec([0, 0, 0.4], [0.45, 0.1, 0.02])


def touched(path, seed, tool=TOOL, shift=(0, 0, 0)):
    points = trimesh.sample.sample_surface(BOX, 200, seed=seed)[0]
    points = T_BASE_BOX.apply(points[points[:, 2] > -0.015][:24]) + shift
    rotation = down(np.random.default_rng(seed).normal(0, 0.2, (24, 3)))
    return guided(path, "touches", SE3(rotation, points - rotation @ TIP), tool)


def test_tip_then_object_from_recordings(tilted, tmp_path):
    calibration = tmp_path / "calibration.json"
    record = add_tool_tip(tilted, calibration)
    assert np.linalg.norm(record.tip_in_tcp - TIP) < 5e-5
    assert (record.poses, record.slipped) == (10, 0)
    np.testing.assert_array_equal(record.tcp_offset, TOOL)
    sessions = [touched(tmp_path / f"touches{seed}.h5", seed) for seed in (1, 2)]
    found = add_object(sessions, "box", BOX.vertices, BOX.faces, calibration)
    assert found.points == 48
    assert [source.file for source in found.sources] == ["touches1.h5", "touches2.h5"]
    aligned = T_BASE_BOX.inverse().apply(found.T_base_obj.translation)
    assert np.linalg.norm(aligned) < 3e-4
    assert "tool tip".lower() in (tmp_path / "calibration-tool-tip.html").read_text().lower()
    assert "<svg" in (tmp_path / "calibration-object-box.html").read_text()
    loaded = Calibration.load(calibration)
    np.testing.assert_allclose(loaded.tool_tip.covariance, record.covariance)


def test_sessions_of_a_symmetric_object_are_fused_whichever_copy_each_finds(tmp_path):
    prism = trimesh.creation.cylinder(radius=0.04, height=0.1, sections=6)
    turns = SE3.from_rotvec(np.pi / 3 * np.arange(1, 6)[:, None] * [0, 0, 1.0], np.zeros(3))
    flip = SE3.from_rotvec([np.pi, 0, 0], np.zeros(3))
    turns = SE3.stack([*turns, flip, *(turn @ flip for turn in turns)])
    files = []
    for seed in (1, 3):  # the second is found 60 degrees from the first
        points = trimesh.sample.sample_surface(prism, 24, seed=seed)[0]
        points = points + np.random.default_rng(seed).normal(0, 4e-4, points.shape)
        files.append(tmp_path / f"{seed}.txt")
        np.savetxt(files[-1], SE3.from_rotvec([0.1, 0.2, 0.3], [0.4, 0.1, 0.1]).apply(points))
    found = add_object(
        files, "nut", prism.vertices, prism.faces, tmp_path / "calibration.json", symmetry_turns=turns
    )
    assert np.linalg.norm(found.T_base_obj.translation - [0.4, 0.1, 0.1]) < 5e-4


def test_a_trace_without_rests_is_swung_about_the_tip_too(tmp_path):
    azimuth = np.linspace(0, 12, 60)
    rotation = down(
        np.column_stack([0.4 * np.cos(azimuth), 0.4 * np.sin(azimuth), 0.3 * np.sin(2.1 * azimuth)])
    )
    path = guided(
        tmp_path / "swing.h5",
        "tool_tip",
        SE3(rotation, [0.4, 0, 0.05] - rotation @ TIP),
        rest_s=0.02,
        swing_s=0.06,
    )
    record = add_tool_tip(path, tmp_path / "calibration.json")
    assert np.linalg.norm(record.tip_in_tcp - TIP) < 5e-4
    assert record.poses > 10


def test_too_few_tilts_are_counted(tmp_path):
    rotation = down(np.array([[0.4, 0, 0], [0, 0.4, 0], [-0.4, 0, 0.2], [0, -0.4, 0]]))
    path = guided(tmp_path / "few.h5", "tool_tip", SE3(rotation, [0.4, 0, 0.05] - rotation @ TIP))
    with pytest.raises(CalibrationError, match="held still 4 times, fewer than 6"):
        add_tool_tip(path, tmp_path / "calibration.json")


def test_sessions_that_are_something_else_are_refused(tilted, tmp_path):
    calibration = tmp_path / "calibration.json"
    touches = touched(tmp_path / "touches.h5", 1)
    with pytest.raises(CalibrationError, match="points touched on an object"):
        add_tool_tip(touches, calibration)
    with pytest.raises(CalibrationError, match="tool tip is not calibrated; run `s2p3 calibrate tool-tip`"):
        add_object(touches, "box", BOX.vertices, BOX.faces, calibration)
    with pytest.raises(CalibrationError, match="one spot"):
        add_object(tilted, "box", BOX.vertices, BOX.faces, calibration, tip=KnownTip.exactly(TIP))
    add_tool_tip(tilted, calibration)
    other = touched(tmp_path / "other.h5", 1, tool=np.array([0, 0, 0.05, 0, 0, 0.0]))
    with pytest.raises(CalibrationError, match="another tool setting"):
        add_object(other, "box", BOX.vertices, BOX.faces, calibration)
    moved = touched(tmp_path / "moved.h5", 2, shift=(0.004, 0, 0))
    with pytest.raises(CalibrationError, match="moved in between"):
        add_object([touches, moved], "box", BOX.vertices, BOX.faces, calibration)


def test_a_guess_of_the_tip_is_taken_only_until_it_is_calibrated(tilted, tmp_path):
    calibration = tmp_path / "calibration.json"
    np.testing.assert_array_equal(known_tip(calibration, (0, 0, 0.1)).in_tcp, [0, 0, 0.1])
    add_tool_tip(tilted, calibration)
    assert np.linalg.norm(known_tip(calibration, (0, 0, 0.1)).in_tcp - TIP) < 1e-4


@pytest.fixture
def turned(tmp_path) -> Path:
    """A session of a polarizer that was turned before 32 x 48 pixels."""
    rng = np.random.default_rng(0)
    size = (32, 48)
    orientation = nominal_orientation(*size) + rng.normal(0, 0.02, size)
    sensor = PolarizerResponse.of(rng.normal(1, 0.02, size), 100.0, orientation)
    info = CameraInfo("LUCID", "PHX", "1", "1", "Mono16", "mono", 48, 32, 16, 1500)
    with SessionWriter(tmp_path / "turned.h5", "polarizer", info) as writer:
        for index, angle in enumerate(np.arange(0, np.pi, 0.2)):
            light = sensor.analysis @ np.array(
                [0.8, 0.8 * np.cos(2 * angle), 0.8 * np.sin(2 * angle)], np.float32
            )
            pixels = quantize(light.astype(np.float32), 16)
            writer.add_frame(RawFrame(pixels, "Mono16", index, index, index, 1000.0, 0.0, 0))
            writer.add_polarizer_angle(angle)
    return tmp_path / "turned.h5"


def test_polarizers_are_kept_beside_the_calibration_and_applied_to_a_session(turned, tmp_path):
    folder = tmp_path / "rig"
    folder.mkdir()
    record = add_polarizer(turned, folder / "calibration.json")
    assert (record.file, record.frames) == ("calibration-polarizer.npz", 16)
    assert "<img" in (folder / "calibration-polarizer.html").read_text()
    done = apply_calibration(turned, Calibration.load(folder / "calibration.json"))
    assert (done.intrinsics, done.polarizer, done.poses) == (False, True, 0)
    with Session.open(turned) as session:
        assert session.polarizer_response is not None
        assert session.stokes(3, undistort=False).dolp.min() > 0.999
        assert Calibration.from_json(session.calibration_json).polarizer.sha256 == record.sha256


def test_the_polarizers_file_travels_with_the_calibration_and_is_checked(turned, tmp_path):
    add_polarizer(turned, tmp_path / "calibration.json")
    elsewhere = tmp_path / "elsewhere"
    elsewhere.mkdir()
    Calibration.load(tmp_path / "calibration.json").save(elsewhere / "other.json")
    copied = Calibration.load(elsewhere / "other.json")
    assert copied.polarizer_response is not None
    with np.load(elsewhere / "calibration-polarizer.npz") as content:
        changed = content["analysis"] + np.float32(0.01)
    np.savez(elsewhere / "calibration-polarizer.npz", analysis=changed)
    with pytest.raises(CalibrationError, match="not the file"):
        _ = copied.polarizer_response
    (elsewhere / "calibration-polarizer.npz").unlink()
    with pytest.raises(CalibrationError, match="belongs beside"):
        _ = copied.polarizer_response


def test_nothing_to_apply_is_said(turned, tilted, tmp_path):
    add_tool_tip(tilted, tmp_path / "calibration.json")
    with pytest.raises(CalibrationError, match="nothing to apply"):
        apply_calibration(turned, Calibration.load(tmp_path / "calibration.json"))
