"""What a training starts from and leaves behind, damaged, mixed up, or of another object."""

from __future__ import annotations

import dataclasses
import functools
import json
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from safetensors.torch import load_file

from dataset.errors import ToolkitError
from dataset.symmetry import Symmetry
from s2p3 import objects, presets
from s2p3.config import FrameSource
from s2p3.evaluation import Estimator
from s2p3.objects import ObjectModel
from s2p3.training import checkpoint, labelled_crops, supervise, train_detector
from s2p3.training.supervised import load_student, load_teacher
from tests.s2p3.untrained import save_untrained


def larger(model: ObjectModel, factor: float) -> ObjectModel:
    return dataclasses.replace(model, vertices=model.vertices * factor, diameter=model.diameter * factor)


@pytest.fixture
def networks(cup: ObjectModel, tmp_path: Path) -> dict[str, Path]:
    return save_untrained(tmp_path / "networks", cup, presets.quick())


def test_weights_are_those_that_the_description_is_of(networks: dict[str, Path]) -> None:
    shutil.copy(networks["student"], networks["teacher"])
    with pytest.raises(ToolkitError, match=r"the weights are not those that .*teacher.json describes"):
        load_teacher(networks["teacher"])


def test_weights_that_do_not_fit_are_refused(networks: dict[str, Path]) -> None:
    weights, info = load_file(networks["student"]), checkpoint.read_info(networks["teacher"])
    checkpoint.save(networks["teacher"], weights, info)
    with pytest.raises(ToolkitError, match="does not fit this network"):
        load_teacher(networks["teacher"])


@pytest.mark.parametrize("kept", [0, 7, 4000])
def test_truncated_weights_are_refused(kept: int, networks: dict[str, Path]) -> None:
    path = networks["student"]
    path.write_bytes(path.read_bytes()[:kept])
    with pytest.raises(ToolkitError, match=r"student.safetensors: damaged .*; restore the file"):
        load_student(path)


@pytest.mark.parametrize(
    ("change", "complaint"),
    [
        ([], "not a checkpoint this version reads"),
        ({"format": "another"}, "not a checkpoint this version reads"),
        ({"config": 3}, "config must be a table"),
        ({"config": "[teacher]\nsteps = true"}, "teacher.steps must be a whole number"),
        ({"diameter_m": "large"}, "diameter_m must be a finite number"),
        ({"kind": "critic"}, "kind must be one of 'teacher', 'student', 'detector'"),
        ({"data": {"session": 4}}, "data.session must be a text"),
        ({"weight": 1}, "unknown table 'weight'"),
    ],
)
def test_a_description_that_makes_no_sense_is_refused(
    change: object, complaint: str, networks: dict[str, Path]
) -> None:
    description = networks["student"].with_suffix(".json")
    values = json.loads(description.read_text())
    description.write_text(json.dumps(values | change if isinstance(change, dict) else change))
    with pytest.raises(ToolkitError, match=complaint):
        load_student(networks["student"])


def test_a_network_of_a_larger_cup_is_refused(networks: dict[str, Path], cup: ObjectModel) -> None:
    load_student(networks["student"], larger(cup, 1.005))
    for load in (load_student, Estimator.load):
        with pytest.raises(ToolkitError, match=r"'cup' of 138.7 mm, and this one has 180.3 mm"):
            load(networks["student"], larger(cup, 1.3))


@pytest.mark.parametrize(
    ("change", "complaint"),
    [
        (
            {"refractive_index": 1.6},
            r"of refractive index 1.5, and this one has 1.6; give the mesh and the mat",
        ),
        (
            {"symmetry": Symmetry(axis=np.array([0.0, 0.0, 1.0]))},
            "of another symmetry than this one has; give",
        ),
    ],
)
def test_a_network_of_a_cup_of_another_kind_is_refused(
    networks: dict[str, Path], cup: ObjectModel, change: dict[str, Any], complaint: str
) -> None:
    with pytest.raises(ToolkitError, match=complaint):
        load_student(networks["student"], dataclasses.replace(cup, **change))


def test_a_network_that_says_nothing_of_symmetry_is_taken(
    networks: dict[str, Path], cup: ObjectModel
) -> None:
    info = dataclasses.replace(checkpoint.read_info(networks["student"]), symmetry="")
    checkpoint.save(networks["student"], load_file(networks["student"]), info)
    turning = dataclasses.replace(cup, symmetry=Symmetry(axis=np.array([0.0, 0.0, 1.0])))
    load_student(networks["student"], turning)


@pytest.mark.parametrize("name", ["cup.h5", "student.json"])
def test_what_is_no_checkpoint_is_called_so(networks: dict[str, Path], name: str) -> None:
    with pytest.raises(ToolkitError, match=rf"{name}: is no checkpoint; give NAME.safetensors"):
        load_student(networks["student"].with_name(name))


def test_everybody_may_read_what_is_written(
    networks: dict[str, Path], cup_session: Path, cup: ObjectModel
) -> None:
    folder = networks["student"].parent
    labelled_crops([cup_session], cup, presets.quick().input, folder)
    (folder / "text").touch()
    usual = (folder / "text").stat().st_mode
    assert {path.stat().st_mode for path in folder.iterdir()} == {usual}


def test_a_place_that_cannot_be_written_is_told(tmp_path: Path, cup_session: Path, cup: ObjectModel) -> None:
    with pytest.raises(ToolkitError, match=r"/proc/net.safetensors: cannot be written .*disk's space"):
        checkpoint.save_tensors(Path("/proc/net.safetensors"), {"weight": torch.zeros(3)})
    (tmp_path / "file").touch()
    with pytest.raises(ToolkitError, match=r"file is a file, and a folder is needed in its place"):
        supervise("student", [cup_session], cup, presets.quick(), tmp_path / "file" / "runs")


def test_damaged_kept_crops_are_made_anew(cup_session: Path, cup: ObjectModel, tmp_path: Path) -> None:
    config = presets.quick().input
    before = labelled_crops([cup_session], cup, config, tmp_path)
    (kept,) = tmp_path.glob("crops-*.safetensors")
    whole = kept.read_bytes()
    kept.write_bytes(whole[: len(whole) // 2])
    assert torch.equal(labelled_crops([cup_session], cup, config, tmp_path).stokes, before.stokes)
    assert kept.read_bytes() == whole


def test_a_session_of_a_larger_cup_is_refused(cup_session: Path, cup: ObjectModel) -> None:
    with pytest.raises(ToolkitError, match="'cup' has another mesh than the one given"):
        labelled_crops([cup_session], larger(cup, 1.3), presets.quick().input)


def test_kept_crops_are_those_of_the_object_as_it_is_now(
    cup_session: Path, cup: ObjectModel, tmp_path: Path
) -> None:
    config, axis = presets.quick().input, torch.tensor([0.0, 0.0, 1.0]).double().numpy()
    turning = dataclasses.replace(cup, symmetry=Symmetry(axis=axis))
    before = labelled_crops([cup_session], cup, config, tmp_path)
    after = labelled_crops([cup_session], turning, config, tmp_path)
    anew = labelled_crops([cup_session], turning, config)
    assert torch.equal(after.rotation, anew.rotation)
    assert not torch.equal(after.rotation, before.rotation)


def test_what_a_model_is_shows_in_its_fingerprint(cup: ObjectModel) -> None:
    others = [
        objects.build("fork"),
        larger(cup, 1.001),
        dataclasses.replace(cup, refractive_index=1.6),
        dataclasses.replace(cup, name="mug"),
    ]
    assert len({model.fingerprint for model in (cup, *others)}) == 5
    assert objects.build("cup").fingerprint == cup.fingerprint


def test_a_session_counts_once(cup_session: Path, cup: ObjectModel, tmp_path: Path) -> None:
    twice, config = [cup_session, cup_session], presets.quick()
    for train in (functools.partial(supervise, "student"), train_detector):
        with pytest.raises(ToolkitError, match="this session was given before; name each one once"):
            train(twice, cup, config, tmp_path)


def test_a_session_does_not_validate_itself(cup_session: Path, cup: ObjectModel, tmp_path: Path) -> None:
    frames = FrameSource(validation=str(cup_session))
    with pytest.raises(ToolkitError, match="this session was given before"):
        supervise("student", [cup_session], cup, presets.quick(), tmp_path, frames=frames)


def test_a_detector_knows_an_object_once(cup_session: Path, cup: ObjectModel, tmp_path: Path) -> None:
    with pytest.raises(ToolkitError, match="cup, cup: an object is named twice"):
        train_detector([cup_session], [cup, cup], presets.quick(), tmp_path)


def test_frames_to_score_on_are_named_for_a_use(cup_session: Path, cup: ObjectModel, tmp_path: Path) -> None:
    base = presets.quick()
    config = dataclasses.replace(base, student=dataclasses.replace(base.student, validations=0))
    with pytest.raises(ToolkitError, match="validations = 0 scores nothing on 'test'"):
        supervise("student", [cup_session], cup, config, tmp_path, frames=FrameSource(validation="test"))


def test_a_finished_checkpoint_is_not_overwritten(
    networks: dict[str, Path], cup_session: Path, cup: ObjectModel
) -> None:
    before = networks["student"].read_bytes()
    with pytest.raises(ToolkitError, match=r"student.safetensors is there already; delete it to train anew"):
        supervise("student", [cup_session], cup, presets.quick(), networks["student"].parent)
    assert networks["student"].read_bytes() == before


def test_a_damaged_resume_file_is_refused(cup_session: Path, cup: ObjectModel, tmp_path: Path) -> None:
    (tmp_path / "student.resume.safetensors").write_bytes(b"half a file")
    with pytest.raises(
        ToolkitError, match=r"student.resume.safetensors: damaged .*; delete it to start anew"
    ):
        supervise("student", [cup_session], cup, presets.quick(), tmp_path)
