"""Nothing of the ground truth reaches a network at test, whatever it sees: the file's poses, boxes, masks and
objects may say something else, or be gone, and the estimates stay the same to the last bit."""

from __future__ import annotations

import dataclasses
import shutil
from pathlib import Path
from typing import Literal

import h5py
import numpy as np
import pytest

from dataset import SE3
from dataset.session import ObjectPoses, Session, write_poses
from dataset.session.edit import write_depth
from s2p3.evaluation import Estimator, Finder, evaluate, find_objects
from s2p3.evaluation.predictions import predictions
from s2p3.evaluation.shots import session_shots
from s2p3.objects import ObjectModel
from tests.s2p3.untrained import eager_detector_config, save_untrained

Modality = Literal["polarization", "rgb", "rgbd"]
SHOTS = range(3)


@pytest.fixture(scope="module")
def session(cup_session: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The cup's session, with what a depth camera saw, which is not the cup's true depth."""
    path = Path(shutil.copy(cup_session, tmp_path_factory.mktemp("truth") / "cup.h5"))
    with Session.open(path) as opened:
        count, shape = len(opened), opened.camera.working_size
    rng = np.random.default_rng(0)
    write_depth(path, list(rng.integers(350, 550, (count, *shape)).astype(np.uint16)))
    return path


@pytest.fixture(scope="module")
def lying(session: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The same file, its truth moved, its masks and boxes somewhere else."""
    path = Path(shutil.copy(session, tmp_path_factory.mktemp("lying") / "cup.h5"))
    with Session.open(path) as opened:
        poses = opened.object_poses("cup")
        count = len(opened)
        masks = [poses.mask(index).copy() for index in reversed(range(count))]
    away = SE3(np.eye(3), np.array([0.05, -0.1, 0.2])) @ poses.T_cam_obj
    moved = ObjectPoses(away, poses.visible_fraction, np.tile([1.0, 2, 30, 20], (count, 1)), masks)
    write_poses(path, SE3.identity((count,)), 0.0, 0.0, {"cup": moved})
    return path


@pytest.fixture(scope="module")
def blind(session: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The same file without any truth."""
    path = Path(shutil.copy(session, tmp_path_factory.mktemp("blind") / "cup.h5"))
    with h5py.File(path, "r+") as file:
        del file["poses"], file["objects"]
    return path


def networks_of(modality: Modality, kind: str, folder: Path, cup: ObjectModel) -> tuple[Path, Path]:
    base = eager_detector_config()
    config = dataclasses.replace(
        base, input=dataclasses.replace(base.input, modality=modality, background="mask")
    )
    saved = save_untrained(folder, cup, config)
    return saved[kind], saved["detector"]


@pytest.mark.parametrize("kind", ["teacher", "student"])
@pytest.mark.parametrize("modality", ["polarization", "rgb", "rgbd"])
def test_estimates_do_not_depend_on_the_truth(
    modality: Modality,
    kind: str,
    session: Path,
    lying: Path,
    blind: Path,
    cup: ObjectModel,
    tmp_path: Path,
) -> None:
    network, detector = networks_of(modality, kind, tmp_path, cup)
    find, estimate = Finder.load(detector, "cup"), Estimator.load(network, "cup")
    answers = []
    for path in (session, lying, blind):
        with Session.open(path) as opened:
            found = [one.estimate for one in predictions(session_shots(opened, SHOTS), find, estimate)]
        answers.append([None if one is None else one.T_cam_obj.as_matrix().tolist() for one in found])
    assert any(answer is not None for answer in answers[0])
    assert answers[0] == answers[1] == answers[2]


def test_an_evaluation_compares_with_the_truth_and_shows_it_to_nobody(
    session: Path, lying: Path, cup: ObjectModel, tmp_path: Path
) -> None:
    network, detector = networks_of("polarization", "student", tmp_path, cup)
    records = []
    for path in (session, lying):
        with Session.open(path) as opened:
            found = find_objects(opened, SHOTS, detector, cup.name)
            records.append(evaluate(opened, SHOTS, cup, network, found).records)
    true, false = records
    assert [one.T_cam_obj for one in true] == [one.T_cam_obj for one in false]
    assert [one.error_m("ADD") for one in true] != [one.error_m("ADD") for one in false]
