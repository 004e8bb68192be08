"""Trainings for real, on eight small frames: losses fall, resuming changes nothing, no pose leaks."""

from __future__ import annotations

import dataclasses
import json
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Mapping
from dataclasses import fields
from pathlib import Path

import h5py
import numpy as np
import pytest
import torch
from numpy.typing import NDArray
from safetensors import safe_open
from safetensors.torch import load_file

from dataset import SE3, Intrinsics
from dataset.errors import ToolkitError
from dataset.polarizer_response import PolarizerResponse
from dataset.session import ObjectPoses, Session, mask_box, write_calibration, write_poses, write_split
from dataset.symmetry import Symmetry
from s2p3 import config, presets
from s2p3.config import AugmentationConfig, ExperimentConfig, FrameSource
from s2p3.inputs import View, square_box
from s2p3.networks.detector import CELL, Detection
from s2p3.networks.pose_head import ray_rotation, site_from_translation
from s2p3.networks.teacher import Teacher
from s2p3.objects import ObjectModel, build
from s2p3.provenance import toolkit_state
from s2p3.rendering.differentiable import RenderMesh
from s2p3.training import (
    Crops,
    LabelledCrops,
    captured_crops,
    checkpoint,
    labelled_crops,
    self_supervise,
    supervise,
    train_detector,
)
from s2p3.training.batches import form_input, form_targets
from s2p3.training.crops import canonical_pose, content_hashes
from s2p3.training.detection import MaskScorer, SmallFrames, box_distances, detector_losses
from s2p3.training.examples import Examples, divide
from s2p3.training.log import RunLog
from s2p3.training.pseudo_labels import make_labels, warp_labels
from s2p3.training.scoring import PoseScorer
from s2p3.training.supervised import ALL_FRAMES, load_student, load_teacher


def tiny() -> ExperimentConfig:
    base = presets.quick()
    pretrain = dataclasses.replace(
        base.teacher, steps=24, batch=4, checkpoint_every=10, learning_rate=2e-3, validations=2, holdout=0.25
    )
    still = AugmentationConfig(1.4, 1.4, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0)
    return dataclasses.replace(
        base,
        augmentation=still,
        detector=dataclasses.replace(base.detector, steps=50, batch=4),
        teacher=pretrain,
        student=pretrain,
        self_supervision=dataclasses.replace(base.self_supervision, steps=4, batch=4, adapt_batches=1),
    )


@pytest.fixture(scope="module")
def crops(cup_session: Path, cup: ObjectModel) -> LabelledCrops:
    return labelled_crops([cup_session], cup, tiny().input)


@pytest.fixture(scope="module")
def trained(cup_session: Path, cup: ObjectModel, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with teacher and student of 24 steps, and their logs."""
    out = tmp_path_factory.mktemp("trained")
    supervise("teacher", [cup_session], cup, tiny(), out)
    supervise("student", [cup_session], cup, tiny(), out)
    return out


def log_of(path: Path) -> list[dict[str, float]]:
    return [json.loads(line) for line in path.read_text().splitlines()]


def test_crops_show_the_object_where_their_pose_says(crops: LabelledCrops, cup: ObjectModel) -> None:
    assert len(crops) == 8
    covered = crops.normals.norm(dim=1) > 0.5
    seen = crops.mask[:, 0] > 0.5
    overlap = (covered & seen).sum((1, 2)) / (covered | seen).sum((1, 2))
    assert overlap.min() > 0.93
    assert (crops.coordinates.abs() <= 1.001).all()
    points = torch.from_numpy(cup.surface_points(50)).float()
    placed = points @ crops.rotation.transpose(1, 2) + crops.translation[:, None]
    pixels = (placed @ crops.K.transpose(1, 2))[..., :2] / placed[..., 2:]
    assert ((pixels > 0) & (pixels < 95)).all()


def test_crops_are_kept_for_the_next_call(cup_session: Path, cup: ObjectModel, tmp_path: Path) -> None:
    first = labelled_crops([cup_session], cup, tiny().input, tmp_path)
    (stored,) = tmp_path.iterdir()
    before = stored.stat().st_mtime_ns
    second = labelled_crops([cup_session], cup, tiny().input, tmp_path)
    assert stored.stat().st_mtime_ns == before
    a, b = first.tensors(), second.tensors()
    assert all(torch.equal(a[name], b[name]) for name in a | b)


def test_targets_of_a_turned_view_agree_with_its_pose(crops: LabelledCrops, cup: ObjectModel) -> None:
    """The coordinates under a pixel, placed by the turned pose, project back onto that pixel."""
    experiment = tiny()
    view = View(torch.full((8,), 1.4), torch.full((8, 2), 0.05), torch.full((8,), 0.5))
    targets = form_targets(crops, torch.arange(8), view, experiment)
    K = form_input(crops, torch.arange(8), view, 1.5, experiment).K
    lower, extent = torch.from_numpy(cup.mesh.lower), torch.from_numpy(cup.mesh.extent)
    points = lower[:, None, None] + extent[:, None, None] * (targets.coordinates + 1) / 2
    placed = torch.einsum("bij,bjhw->bihw", targets.rotation, points) + targets.translation[:, :, None, None]
    projected = torch.einsum("bij,bjhw->bihw", K, placed)
    projected = projected[:, :2] / projected[:, 2:]
    steps = 4 * torch.arange(16) + 1.5
    wanted = torch.stack(torch.meshgrid(steps, steps, indexing="xy"))
    inside = targets.coordinates.abs().sum(1) > 0
    error = (projected - wanted).norm(dim=1)[inside]
    assert error.median() < 0.7


def test_a_symmetry_axis_leaves_one_pose(cup: ObjectModel) -> None:
    symmetry = Symmetry(axis=np.array([0.0, 0.0, 1.0]))
    pose = SE3.from_rotvec(np.array([1.8, 0.2, 0.1]), np.array([0.05, 0.0, 0.5]))
    turned = pose @ SE3.from_rotvec(np.array([0.0, 0.0, 1.234]), np.zeros(3))
    first, second = canonical_pose(pose, symmetry), canonical_pose(turned, symmetry)
    np.testing.assert_allclose(first.as_matrix(), second.as_matrix(), atol=1e-9)
    np.testing.assert_allclose(first.rotation[:, 2], pose.rotation[:, 2], atol=1e-9)
    assert canonical_pose(pose, cup.symmetry) is pose


@pytest.mark.parametrize("axis", [None, np.array([0.0, 0.0, 1.0])], ids=["half turns", "cylinder"])
def test_poses_that_look_the_same_have_one_target(axis: NDArray[np.float64] | None) -> None:
    turns = [SE3.from_rotvec(np.pi * np.eye(3)[i], np.zeros(3)) for i in range(3)]
    symmetry = Symmetry(np.stack([turn.as_matrix() for turn in turns]), axis)
    rng = np.random.default_rng(0)
    for _ in range(20):
        pose = SE3.from_rotvec(rng.normal(size=3), np.array([0.02, -0.05, 0.5]))
        wanted = canonical_pose(pose, symmetry).as_matrix()
        for turn in turns:
            np.testing.assert_allclose(canonical_pose(pose @ turn, symmetry).as_matrix(), wanted, atol=1e-9)


def test_teacher_and_student_learn(trained: Path) -> None:
    assert (trained / "student.signal.json").exists()
    for name in ("teacher", "student"):
        log = log_of(trained / f"{name}.log.jsonl")
        assert [line["step"] for line in log] == [10, 12, 20, 24]
        assert log[-1]["total"] < 0.75 * log[0]["total"]


def test_checkpoints_say_what_they_are(trained: Path, cup: ObjectModel) -> None:
    network, info = load_teacher(trained / "teacher.safetensors", "cup")
    assert isinstance(network, Teacher)
    assert not network.training
    assert (info.kind, info.stage, info.object_name) == ("teacher", "pretrained", "cup")
    assert info.config == tiny()
    assert info.diameter_m == cup.diameter
    with pytest.raises(ToolkitError, match=r"'cup', not 'fork'"):
        load_student(trained / "student.safetensors", "fork")
    with pytest.raises(ToolkitError, match="holds a teacher, not a student"):
        load_student(trained / "teacher.safetensors")
    with pytest.raises(ToolkitError, match="no such file"):
        load_student(trained / "nothing.safetensors")


def test_weights_are_chosen_on_frames_that_were_kept_from_the_training(
    trained: Path, cup_session: Path, cup: ObjectModel
) -> None:
    _, info = load_student(trained / "student.safetensors", "cup")
    assert info.validation is not None
    assert info.validation.metric == "add_recall_10"
    assert info.validation.frames == "2 of 8 frames, drawn with seed 0"
    scores = {line["step"]: line["add_recall_10"] for line in log_of(trained / "student.log.jsonl")[1::2]}
    assert (info.step, info.validation.value) == max(scores.items(), key=lambda item: (item[1], -item[0]))
    division = divide([cup_session], cup, tiny().student, ALL_FRAMES)
    assert not {*division.rows.tolist()} & {*division.held_out.tolist()}
    with safe_open(trained / "student.safetensors", "pt") as file:
        described = json.loads(file.metadata()["s2p3"])
    assert described == json.loads((trained / "student.json").read_text())
    assert list(described["data"].values()) == list(content_hashes([cup_session], cup).values())
    assert described["commit"] == toolkit_state()


def test_frames_to_validate_on_are_named_by_split_or_session(
    cup_session: Path, cup: ObjectModel, tmp_path: Path
) -> None:
    session = shutil.copy(cup_session, tmp_path / "split.h5")
    write_split(session, "train", [0, 2, 3, 6])
    write_split(session, "val", [2, 5])

    def chosen(split: str | None, validation: str | None) -> tuple[list[int], list[int]]:
        division = divide([session], cup, tiny().student, FrameSource(split, validation))
        return division.rows.tolist(), division.held_out.tolist()

    rows, held_out = chosen("train", None)
    assert (len(held_out), sorted(rows + held_out)) == (1, [0, 2, 3, 6])
    assert chosen(None, "val") == ([0, 1, 3, 4, 6, 7], [2, 5])
    assert chosen("train", "val") == ([0, 3, 6], [2, 5])
    assert chosen("train", str(cup_session)) == ([0, 2, 3, 6], [])
    with pytest.raises(ToolkitError, match="'train' leaves no frame to learn from"):
        chosen("train", "train")
    with pytest.raises(ToolkitError, match=r"no split 'night' \(its splits: train, val\)"):
        chosen(None, "night")
    with pytest.raises(ToolkitError, match=r"val\.h5"):
        Examples.of([session], cup, tiny().input, tiny().student, FrameSource(None, str(tmp_path / "val.h5")))


def test_a_true_pose_scores_full_marks(cup_session: Path, crops: LabelledCrops, cup: ObjectModel) -> None:
    """By ADD; turned about its axis, an object that looks the same scores by ADD-S only."""

    class Oracle(torch.nn.Module):
        def __init__(self, turn: SE3) -> None:
            super().__init__()
            self.weight = torch.nn.Parameter(torch.zeros(1))
            self.turn, self.given = turn, 0

        def forward(self, polarization: torch.Tensor, priors: torch.Tensor) -> torch.Tensor:
            del priors
            view = View.centred(8, experiment.input.zoom)
            K = form_input(crops, torch.arange(8), view, 1.5, experiment).K
            rotation = crops.rotation @ torch.tensor(self.turn.rotation, dtype=torch.float32)
            site = site_from_translation(crops.translation, K, polarization.shape[-1], cup.diameter)
            allocentric = ray_rotation(crops.translation).transpose(1, 2) @ rotation
            columns = allocentric[:, :, :2].transpose(1, 2).reshape(-1, 6)
            identity = torch.tensor([1.0, 0, 0, 0, 1, 0, 0, 0, 1])
            return torch.cat([columns, site], dim=1) - identity

    experiment = tiny()
    still, turned = SE3.identity(), SE3.from_rotvec(np.array([0.0, 0.0, 2.0]), np.zeros(3))
    assert PoseScorer(crops, cup, experiment)(Oracle(still)) == 100
    assert PoseScorer(crops, cup, experiment)(Oracle(turned)) == 0
    bottle = dataclasses.replace(build("bottle"), diameter=cup.diameter)
    scorer = PoseScorer(crops, bottle, experiment)
    assert scorer.name == "add_s_recall_10"
    assert scorer(Oracle(turned)) == 100


def test_a_killed_training_goes_on_as_if_nothing_had_happened(
    trained: Path, cup_session: Path, tmp_path: Path
) -> None:
    """A process of the command line, its batches made by a worker, killed by SIGKILL; the second one and the
    first one's log are, to the last bit, a training that was left alone and made its batches itself."""
    config.save(tiny(), tmp_path / "experiment.toml")
    words = ["train", "student", cup_session, "--object", "cup", "--config", tmp_path / "experiment.toml"]
    command = [sys.executable, "-m", "s2p3.cli", *words, "--out", tmp_path, "--workers", "1"]
    first = subprocess.Popen(command, stderr=subprocess.DEVNULL)
    resume = tmp_path / "student.resume.safetensors"
    until = time.monotonic() + 240
    while not resume.exists() and first.poll() is None and time.monotonic() < until:
        time.sleep(0.01)
    first.kill()
    assert first.wait() == -signal.SIGKILL
    assert resume.exists()
    assert not (tmp_path / "student.safetensors").exists()
    subprocess.run(command, check=True, capture_output=True, timeout=240)
    charts = list((tmp_path / "tensorboard" / "student").iterdir())
    assert len(charts) == 2  # a training that begins anew clears the folder
    assert not resume.exists()
    whole, resumed = log_of(trained / "student.log.jsonl"), log_of(tmp_path / "student.log.jsonl")
    for line in (*whole, *resumed):
        del line["seconds"]
    assert whole == resumed
    a, b = (load_file(folder / "student.safetensors") for folder in (trained, tmp_path))
    assert all(torch.equal(a[name], b[name]) for name in a)


def test_a_resume_file_of_other_settings_is_refused(
    cup_session: Path, cup: ObjectModel, tmp_path: Path
) -> None:
    def stop(label: str, done: int, total: int, values: Mapping[str, float]) -> None:
        del total, values
        if label == "student" and done == 3:
            raise KeyboardInterrupt

    experiment = dataclasses.replace(tiny(), student=dataclasses.replace(tiny().student, checkpoint_every=2))
    with pytest.raises(KeyboardInterrupt):
        supervise("student", [cup_session], cup, experiment, tmp_path, report=stop)
    other = dataclasses.replace(experiment, student=dataclasses.replace(experiment.student, seed=1))
    with pytest.raises(ToolkitError, match="other settings"):
        supervise("student", [cup_session], cup, other, tmp_path)


def test_a_student_starts_from_its_teachers_encoders(
    trained: Path, cup_session: Path, cup: ObjectModel, tmp_path: Path
) -> None:
    still = dataclasses.replace(tiny().student, steps=1, learning_rate=0.0, ema=0.0, validations=0)
    experiment = dataclasses.replace(tiny(), student=still)
    teacher = trained / "teacher.safetensors"
    other = dataclasses.replace(experiment, input=dataclasses.replace(experiment.input, aolp="angle"))
    with pytest.raises(ToolkitError, match="encoders see other channels"):
        supervise("student", [cup_session], cup, other, tmp_path, teacher=teacher)
    path = supervise("student", [cup_session], cup, experiment, tmp_path, teacher=teacher)
    wanted, found = load_file(teacher), load_file(path)
    stem = "encoder.polarization.stem.0.weight"
    assert torch.equal(wanted[stem], found[stem])
    assert json.loads(path.with_suffix(".json").read_text())["data"]["teacher"] == checkpoint.file_hash(
        teacher
    )


def test_the_detector_learns(cup_session: Path, cup: ObjectModel, tmp_path: Path) -> None:
    train_detector([cup_session], cup, tiny(), tmp_path)
    log = log_of(tmp_path / "detector.log.jsonl")
    assert log[-1]["total"] < 0.8 * log[0]["total"]


def test_box_distances_by_hand() -> None:
    mask = torch.zeros(1, 8, 10, dtype=torch.bool)
    mask[0, 2:6, 3:9] = True
    distances, side = box_distances(mask, (4, 5))
    assert side.tolist() == [6]
    # the cell in row 1, column 2 has its centre at x = 5, y = 3
    assert distances[0, :, 1, 2].tolist() == [2, 1, 4, 3]
    perfect = detector_losses(
        torch.where(mask[:, None, ::2, ::2], 20.0, -20.0), distances, torch.ones(1, 1, 8, 10) * mask[:, None]
    )
    assert perfect["box"] == 0


def detections(session: Session, cup: ObjectModel) -> list[Detection | None]:
    masks = [session.object_poses(cup.name).mask(index) for index in range(len(session))]
    found: list[Detection | None] = [Detection(mask_box(mask), mask, 0.9) for mask in masks]
    found[3] = None
    return found


def test_captured_crops_hold_no_pose() -> None:
    assert {field.name for field in fields(Crops)} == {"stokes", "mask", "K", "depth", "valid"}


def test_warped_labels_match_labels_made_on_the_same_view(
    crops: LabelledCrops, trained: Path, cup: ObjectModel
) -> None:
    experiment = tiny()
    teacher, _ = load_teacher(trained / "teacher.safetensors")
    mesh = RenderMesh.from_mesh(cup.mesh)
    labels = make_labels(teacher, crops, cup, mesh, experiment)
    view = View.centred(8, experiment.input.zoom)
    same = warp_labels(labels, crops, torch.arange(8), view, mesh, experiment)
    torch.testing.assert_close(same.rendered_mask, labels.rendered_mask, atol=1e-3, rtol=0)
    torch.testing.assert_close(same.mask, labels.mask, atol=1e-4, rtol=0)
    torch.testing.assert_close(same.rotation, labels.rotation)
    assert ((labels.delta >= 0) & (labels.delta <= 1)).all()
    share = (labels.delta <= labels.threshold(experiment.self_supervision)).float().mean()
    assert 0 < share < 0.5


def test_self_supervision_cannot_see_captured_poses(
    trained: Path, cup_session: Path, cup: ObjectModel, tmp_path: Path
) -> None:
    """The same weights to the last bit, whether the file holds poses or not."""
    blind = tmp_path / "blind.h5"
    shutil.copy(cup_session, blind)
    with Session.open(cup_session) as session:
        found = detections(session, cup)
    with h5py.File(blind, "r+") as file:
        del file["poses"]
    networks = (trained / "teacher.safetensors", trained / "student.safetensors")
    weights = []
    for path in (cup_session, blind):
        with Session.open(path) as session:
            crops = captured_crops(session, range(8), found, tiny().input)
        out = self_supervise(crops, cup, *networks, tmp_path / path.stem)
        weights.append(load_file(out))
    assert len(crops) == 7
    assert all(torch.equal(weights[0][name], weights[1][name]) for name in weights[0])
    before = load_file(networks[1])
    assert any(not torch.equal(before[name], weights[0][name]) for name in before)
    info = checkpoint.read_info(tmp_path / "blind" / "adapted.safetensors", "student", "cup")
    assert info.stage == "self-supervised"


def test_self_supervision_refuses_another_objects_networks(
    trained: Path, crops: LabelledCrops, tmp_path: Path
) -> None:
    with pytest.raises(ToolkitError, match="not 'fork'"):
        self_supervise(
            crops, build("fork"), trained / "teacher.safetensors", trained / "student.safetensors", tmp_path
        )


def test_nothing_detected_is_said_clearly(cup_session: Path) -> None:
    with Session.open(cup_session) as session, pytest.raises(ToolkitError, match="none of the frames"):
        captured_crops(session, [0, 1], [None, None], tiny().input)


def test_an_object_the_session_lacks_is_said_clearly(cup_session: Path) -> None:
    with pytest.raises(ToolkitError, match="knife"):
        labelled_crops([cup_session], build("knife"), tiny().input)


@pytest.mark.parametrize("changed", ["distortion", "response"])
def test_what_a_new_calibration_changes_in_the_images_changes_their_hash(
    changed: str, cup_session: Path, cup: ObjectModel, tmp_path: Path
) -> None:
    path = Path(shutil.copy(cup_session, tmp_path / "again.h5"))
    before = content_hashes([path], cup)
    with Session.open(path) as session:
        assert session.intrinsics is not None
        lens, size = session.intrinsics, (session.camera.height, session.camera.width)
        poses, masks = session.object_poses("cup"), [session.object_poses("cup").mask(i) for i in range(8)]
    ideal = PolarizerResponse.ideal(*size)
    response = PolarizerResponse(0.98 * ideal.analysis) if changed == "response" else None
    if changed == "distortion":
        lens = Intrinsics(lens.K, np.array([0.1, 0, 0, 0, 0.0]), lens.height, lens.width)
    write_calibration(path, "{}", lens, response)
    kept = ObjectPoses(poses.T_cam_obj, poses.visible_fraction, poses.bbox_xywh, masks)
    write_poses(path, SE3.identity((8,)), 0.0, 0.0, {"cup": kept})
    assert content_hashes([path], cup) != before


def test_outside_the_image_there_is_neither_object_nor_measurement(
    cup_session: Path, cup: ObjectModel
) -> None:
    config = tiny().input
    with Session.open(cup_session) as session:
        width = session.camera.working_size[1]
        mask = np.zeros(session.camera.working_size, bool)
        mask[40:80, width - 40 :] = True  # cut by the right edge
        crops = captured_crops(session, [0], [Detection(mask_box(mask), mask, 0.9)], config)
        _, _, side, _ = square_box(mask_box(mask), config.canonical_zoom)
    assert crops.valid is not None
    edge = round(config.canonical_size / 2 + 20 / side * config.canonical_size)  # 20 px right of the centre
    assert crops.valid[0, 0, :, : edge - 1].all()
    assert not crops.valid[0, 0, :, edge + 1 :].any()
    assert not crops.mask[0, 0, :, edge + 1 :].any()
    assert crops.stokes[0, 0, :, edge + 1 :].all()  # there the light at the edge is repeated


def test_seeing_nothing_where_nothing_is_scores_full_marks() -> None:
    class Silent(torch.nn.Module):
        def __init__(self, level: float) -> None:
            super().__init__()
            self.level = torch.nn.Parameter(torch.tensor(level))

        def forward(self, image: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
            logits = self.level.expand(len(image), 1, image.shape[2] // CELL, image.shape[3] // CELL)
            return logits, logits

    empty = SmallFrames(torch.rand(2, 3, 64, 64), torch.zeros(2, 1, 64, 64))
    assert MaskScorer(empty)(Silent(-1.0)) == 100
    assert MaskScorer(empty)(Silent(1.0)) == 0


def test_a_log_cut_short_in_a_line_does_not_stop_a_training_from_going_on(tmp_path: Path) -> None:
    log = tmp_path / "student.log.jsonl"
    log.write_text('{"step": 10, "total": 1.0}\n{"step": 20, "tot')
    with RunLog(tmp_path / "student.safetensors", 10) as lines:
        lines.write({"step": 20, "total": 0.5})
    assert [json.loads(line)["step"] for line in log.read_text().splitlines()] == [10, 20]
