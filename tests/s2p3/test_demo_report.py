"""The comparison with the hidden truth says how far off everything is, no less and no more."""

from __future__ import annotations

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
    ToolTipRecord,
)
from dataset import SE3
from s2p3 import objects
from s2p3.demo_report import TARGETS, compare
from s2p3.evaluation import Evaluation
from s2p3.lab import LabTruth
from s2p3.lab.truth import sample_truth
from tests.s2p3.evaluations import evaluation, missed, record


def lab(name: str) -> LabTruth:
    model = objects.build(name)
    return sample_truth(4, name, model.refractive_index, (0.4, 0.3), model.resting)


def recovered(truth: LabTruth) -> Calibration:
    """A calibration without an error."""
    camera = IntrinsicsRecord(truth.intrinsics, np.eye(9), 0.04, 0.05, 20, ())
    arm = HandEyeRecord(truth.T_tcp_cam, truth.T_base_board, np.eye(12), 0.1, 0.1, 0.01, 1e-5, 1e-5, 20, ())
    pose = ObjectPoseRecord(truth.T_base_object, np.eye(6), 1e-4, 40, (), ())
    clock = TimeOffsetRecord(truth.time_offset_s, 1e-4, 0.1, ())
    tip = ToolTipRecord(np.array(truth.tcp_tip), np.eye(3), 1e-4, 12, 0, np.zeros(6), ())
    return Calibration(None, camera, arm, clock, tip, objects={truth.object_name: pose})


def runs(name: str) -> dict[str, Evaluation]:
    """Before: one of four found; after: three of four; one is missed by both."""
    made = {}
    for run, found in (("teacher", 2), ("before", 1), ("after", 3)):
        errors = [1e-4] * found + [0.5] * (3 - found)
        records = [record(i, error) for i, error in enumerate(errors)]
        made[run] = evaluation([*records, missed(3)], objects.build(name))
    return made


@pytest.mark.parametrize("name", ["cup", "bottle"])
def test_the_truth_itself_has_no_error(name: str, cup_session: Path) -> None:
    result = compare(recovered(lab(name)), lab(name), [cup_session] * 2, runs(name), {"a": 1.5, "b": 2.0})
    for part, key in TARGETS:
        assert result[part][key] == pytest.approx(0.0, abs=1e-5)
    assert result["intrinsics"]["reproj_px"] == 0.04
    assert result["frames"] == {"captured": 16, "dropped": 0}
    assert result["seconds"] == {"a": 1.5, "b": 2.0, "total": 3.5}
    recall = result["recall"]
    assert (recall["before"], recall["after"], recall["targets"], recall["missed"]) == (25.0, 75.0, 4, 1)
    assert recall["metric"].startswith("ADD-S" if name == "bottle" else "ADD ")


def test_every_error_is_seen_in_its_unit(cup_session: Path) -> None:
    truth = lab("cup")
    exact = recovered(truth)
    assert exact.intrinsics is not None
    assert exact.hand_eye is not None
    assert exact.time_offset is not None
    intrinsics = exact.intrinsics.intrinsics
    off = SE3.from_rotvec([0.0, 0.0, np.radians(0.2)], [0.003, 0.0, 0.0])
    spoilt = replace(
        exact,
        intrinsics=replace(
            exact.intrinsics,
            intrinsics=replace(intrinsics, K=intrinsics.K @ np.diag([1.01, 1.0, 1.0])),
        ),
        hand_eye=replace(exact.hand_eye, T_tcp_cam=exact.hand_eye.T_tcp_cam @ off),
        time_offset=replace(exact.time_offset, offset_s=truth.time_offset_s + 0.004),
        objects={"cup": replace(exact.objects["cup"], T_base_obj=truth.T_base_object @ off)},
    )
    result = compare(spoilt, truth, [cup_session], runs("cup"), {})
    assert result["intrinsics"]["fx_rel_err"] == pytest.approx(0.01)
    assert result["clock"]["offset_err_ms"] == pytest.approx(4.0)
    for part in ("hand_eye", "object"):
        assert result[part]["rot_deg"] == pytest.approx(0.2, rel=1e-3)
        assert result[part]["trans_mm"] == pytest.approx(3.0, rel=1e-3)


def test_how_far_a_bottle_is_turned_about_its_axis_is_no_error(cup_session: Path) -> None:
    truth = lab("bottle")
    axis = objects.build("bottle").symmetry.axis
    assert axis is not None
    turned = truth.T_base_object @ SE3.from_rotvec(1.0 * np.asarray(axis), np.zeros(3))
    exact = recovered(truth)
    spun = replace(exact, objects={"bottle": replace(exact.objects["bottle"], T_base_obj=turned)})
    result = compare(spun, truth, [cup_session], runs("bottle"), {})
    assert result["object"]["rot_deg"] == pytest.approx(0.0, abs=1e-3)
