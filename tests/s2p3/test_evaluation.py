"""Evaluation counts every target, feeds the networks no truth, and its report shows what it found."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import h5py
import numpy as np
import pytest

from calibration import html
from dataset.errors import ToolkitError
from dataset.session import Session, mask_box
from s2p3 import presets
from s2p3.evaluation import Estimator, Evaluation, Finder, evaluate, find_objects
from s2p3.evaluation.report import chosen_records, evaluation_section
from s2p3.networks.build import build_student
from s2p3.networks.detector import Detection, Detector
from s2p3.objects import ObjectModel
from s2p3.training import checkpoint
from s2p3.training.checkpoint import CheckpointInfo, Kind
from tests.s2p3.evaluations import evaluation, record


@pytest.fixture(scope="module")
def networks(tmp_path_factory: pytest.TempPathFactory, cup: ObjectModel) -> tuple[Path, Path]:
    """Untrained student and detector: good enough to follow what reaches them."""
    folder = tmp_path_factory.mktemp("networks")
    config = presets.quick()
    paths = folder / "student.safetensors", folder / "detector.safetensors"
    student, detector = build_student(config), Detector(1, imagenet=False)
    kinds: tuple[Kind, ...] = ("student", "detector")
    for path, kind, network in zip(paths, kinds, (student, detector), strict=True):
        checkpoint.save(path, network.state_dict(), CheckpointInfo.of(kind, "pretrained", cup, 0, config, {}))
    return paths


def found_in(session: Session, cup: ObjectModel) -> list[Detection | None]:
    masks = [session.object_poses(cup.name).mask(index) for index in range(len(session))]
    return [Detection(mask_box(mask), mask, 0.9) for mask in masks]


def test_every_target_is_counted(
    cup_session: Path, cup: ObjectModel, networks: tuple[Path, Path], tmp_path: Path
) -> None:
    with Session.open(cup_session) as session:
        found = found_in(session, cup)
        found[2] = found[5] = None
        result = evaluate(session, range(8), cup, networks[0], found)
    assert (result.summary.targets, result.summary.missed, result.summary.metric) == (8, 2, "ADD")
    assert np.isinf(result.errors_m).tolist() == [i in (2, 5) for i in range(8)]
    result.save(tmp_path / "evaluation.json")
    assert str(Evaluation.load(tmp_path / "evaluation.json")) == str(result)  # NaN is not equal to itself
    stored = json.loads((tmp_path / "evaluation.json").read_text())
    assert stored["summary"]["targets"] == len(stored["records"]) == 8
    assert stored["records"][2]["add_m"] is None


def test_the_truth_does_not_reach_the_networks(
    cup_session: Path, cup: ObjectModel, networks: tuple[Path, Path], tmp_path: Path
) -> None:
    """Detections and estimates of a file without poses are those of the file with them."""
    blind = tmp_path / "blind.h5"
    shutil.copy(cup_session, blind)
    with h5py.File(blind, "r+") as file:
        del file["poses"]
    estimate, find = Estimator.load(networks[0]), Finder.load(networks[1])
    with Session.open(cup_session) as seeing, Session.open(blind) as session:
        found = found_in(seeing, cup)[0]
        assert found is not None
        a, b = (
            estimate(one.stokes(0).stack(), found, one.working_intrinsics).T_cam_obj.as_matrix()
            for one in (seeing, session)
        )
        np.testing.assert_array_equal(a, b)
        assert (find(session.stokes(0).stack()) is None) == (find(seeing.stokes(0).stack()) is None)
        assert len(find_objects(session, range(8), networks[1], "cup")) == 8


def test_an_empty_split_is_said_clearly(
    cup_session: Path, cup: ObjectModel, networks: tuple[Path, Path]
) -> None:
    with Session.open(cup_session) as session, pytest.raises(ToolkitError, match="choose another split"):
        evaluate(session, [], cup, networks[0], [])


def exact(session: Session, cup: ObjectModel, error: float) -> Evaluation:
    poses = session.object_poses(cup.name).T_cam_obj.as_matrix()
    records = [
        record(index, error * (index + 1), T_cam_obj=tuple(map(tuple, poses[index].tolist())))
        for index in range(8)
    ]
    return evaluation(records, cup)


def test_the_report_shows_truth_before_and_after(cup_session: Path, cup: ObjectModel) -> None:
    with Session.open(cup_session) as session:
        runs = {"before": exact(session, cup, 0.01), "after": exact(session, cup, 0.001)}
        text = html.page("Test", "", [evaluation_section(session, cup, runs)])
    assert text.count("<img") == 6
    assert "ADD recall at 10 %" in text
    assert "100.0 %" in text
    for name in runs:
        assert f">{name}</text>" in text


def test_pictures_are_of_the_best_the_median_and_the_worst() -> None:
    errors = np.append(0.01 * np.arange(1, 8), np.inf)
    wanted = [("best", 0), ("best", 1), ("median", 3), ("median", 4), ("worst", 6), ("worst", 7)]
    assert chosen_records(errors, 6) == wanted
    assert len(chosen_records(errors[:1], 6)) == 3
