"""calibration.json: a round trip, merging, and refusing what it cannot trust."""

import json

import numpy as np
import pytest

from calibration.records import (
    HandEyeRecord,
    IntrinsicsRecord,
    ObjectPoseRecord,
    Source,
    TimeOffsetRecord,
    ToolTipRecord,
)
from calibration.result import Calibration
from dataset.errors import CalibrationError
from dataset.transforms import SE3


@pytest.fixture
def calibration(world, tmp_path):
    (tmp_path / "a.h5").write_bytes(b"abc")
    source = (Source.of(tmp_path / "a.h5"),)
    return Calibration(
        board=world.spec,
        intrinsics=IntrinsicsRecord(world.intrinsics, np.eye(9), 0.1, float("nan"), 20, source, (), "mono"),
        hand_eye=HandEyeRecord(
            world.T_tcp_cam, world.T_base_board, np.eye(12), 0.2, 0.1, 0.01, 3e-5, 5e-5, 22, source
        ),
        time_offset=TimeOffsetRecord(0.031, 2e-5, 0.2, source),
        tool_tip=ToolTipRecord(np.array([0, 0, 0.12]), np.eye(3), 1e-4, 12, 1, np.zeros(6), ()),
        objects={"cup": ObjectPoseRecord(SE3.identity(), np.eye(6), 1e-4, 24, ("its turn",), source)},
    )


def test_what_is_saved_is_loaded(calibration, tmp_path):
    path = tmp_path / "calibration.json"
    calibration.save(path)
    loaded = Calibration.load(path)
    assert loaded.board == calibration.board
    np.testing.assert_array_equal(loaded.intrinsics.intrinsics.K, calibration.intrinsics.intrinsics.K)
    assert np.isnan(loaded.intrinsics.held_out_px)
    assert loaded.intrinsics.mosaic == "mono"
    np.testing.assert_array_equal(loaded.hand_eye.T_tcp_cam.rotation, calibration.hand_eye.T_tcp_cam.rotation)
    assert loaded.time_offset.offset_s == 0.031
    np.testing.assert_array_equal(loaded.tool_tip.tip_in_tcp, [0, 0, 0.12])
    assert loaded.objects["cup"].unobservable == ("its turn",)
    assert loaded.to_json() == path.read_text(encoding="utf-8")
    assert json.loads(loaded.to_json())["created_utc"] == calibration.created_utc


@pytest.mark.parametrize("forget", [lambda c: c.pop("mosaic"), lambda c: c.update(mosaic=None)])
def test_a_file_that_does_not_know_the_mosaic_is_read(calibration, forget):
    content = json.loads(calibration.to_json())
    forget(content["intrinsics"])
    assert Calibration.from_json(json.dumps(content)).intrinsics.mosaic is None


def test_inputs_are_named_by_their_sha256(calibration):
    expected = "ba7816bf8f01cfea414140de5dae2223b00361a396177a9cb410ff61f20015ad"  # of "abc", FIPS 180-2
    assert calibration.intrinsics.sources == (Source("a.h5", expected),)


def test_merging_keeps_what_the_newer_lacks(calibration):
    newer = Calibration(
        time_offset=TimeOffsetRecord(0.02, 1e-5, 0.1, ()),
        objects={"fork": ObjectPoseRecord(SE3.identity(), np.eye(6), 1e-4, 24, (), ())},
    )
    merged = calibration.merged(newer)
    assert merged.time_offset.offset_s == 0.02
    assert merged.intrinsics is calibration.intrinsics
    assert set(merged.objects) == {"cup", "fork"}


def test_a_missing_part_names_the_command():
    with pytest.raises(CalibrationError, match="s2p3 calibrate hand-eye"):
        Calibration().require("hand_eye")


@pytest.mark.parametrize(
    ("change", "reason"),
    [
        (lambda c: c.update(format="x"), "not a calibration of this toolkit"),
        (lambda c: c.update(version="2.0"), "version 2.0"),
        (lambda c: c["hand_eye"].pop("T_tcp_cam"), "T_tcp_cam is missing"),
        (lambda c: c["hand_eye"].update(covariance="?"), "covariance is missing or malformed"),
        (lambda c: c["board"].update(marker_m=1.0), "marker_m"),
        (lambda c: c["intrinsics"].update(mosaic="cyan"), "mosaic is missing or malformed"),
    ],
)
def test_a_file_that_cannot_be_trusted_is_refused(calibration, change, reason):
    content = json.loads(calibration.to_json())
    change(content)
    with pytest.raises(CalibrationError, match=reason):
        Calibration.from_json(json.dumps(content))


def test_a_file_that_is_not_json_is_refused(tmp_path):
    (tmp_path / "c.json").write_text("{")
    with pytest.raises(CalibrationError, match="not JSON"):
        Calibration.load(tmp_path / "c.json")
    with pytest.raises(CalibrationError, match="cannot be read"):
        Calibration.load(tmp_path / "missing.json")
