"""Self-supervision in all its variants, and the RGB-D baseline: a few steps each, on eight small frames."""

from __future__ import annotations

import contextlib
import dataclasses
import json
import shutil
import warnings
from collections.abc import Mapping
from pathlib import Path
from typing import Literal

import h5py
import numpy as np
import pytest
import torch
from safetensors.torch import load_file

from dataset.errors import ToolkitError, ToolkitWarning
from dataset.polarimetry import Stokes
from dataset.session import Session, mask_box
from dataset.session.edit import write_depth
from s2p3 import losses, presets
from s2p3.config import ExperimentConfig, PhysicsVariant
from s2p3.inputs import View
from s2p3.networks.build import build_student, build_teacher
from s2p3.networks.detector import Detection
from s2p3.networks.teacher import Teacher, TeacherOutput
from s2p3.objects import ObjectModel
from s2p3.rendering import rasterize
from s2p3.rendering.differentiable import RenderMesh
from s2p3.synthesis.informativeness import Informativeness
from s2p3.training import Crops, captured_crops, checkpoint, labelled_crops, self_supervise
from s2p3.training.batches import form_input
from s2p3.training.mean_teacher import MeanTeacher
from s2p3.training.physics_signal import captured_signal, labelled_signal, objection, report_signal
from s2p3.training.pseudo_labels import labels_of, make_labels
from s2p3.training.self6d import self_supervise_rgbd
from s2p3.training.self_supervised import clouds, smoothed, visible_surface
from tests.s2p3.untrained import save_untrained

pytestmark = pytest.mark.filterwarnings("ignore::dataset.errors.ToolkitWarning")
"""Untrained teachers leave no signal, and are warned about."""


def tiny(
    modality: Literal["polarization", "rgb", "rgbd"] = "polarization",
    student: Literal["direct", "large"] = "direct",
) -> ExperimentConfig:
    base = presets.quick()
    return dataclasses.replace(
        base,
        input=dataclasses.replace(base.input, modality=modality),
        network=dataclasses.replace(base.network, student=student),
        self_supervision=dataclasses.replace(base.self_supervision, steps=2, batch=2, adapt_batches=1),
        self6d=dataclasses.replace(base.self6d, steps=2, batch=2),
    )


@pytest.fixture(scope="module")
def with_depth(cup_session: Path, cup: ObjectModel, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The session of the cup with the depth of the cup alone."""
    path = Path(shutil.copy(cup_session, tmp_path_factory.mktemp("depth") / "cup.h5"))
    with Session.open(path) as session:
        poses = session.object_poses("cup")
        depths = [rasterize(cup.mesh, pose, session.working_intrinsics).depth for pose in poses.T_cam_obj]
    write_depth(path, [np.rint(1000 * depth).astype(np.uint16) for depth in depths])
    return path


def confident(networks: dict[str, Path]) -> dict[str, Path]:
    """The same networks, the teacher sure that it sees the object everywhere."""
    path = networks["teacher"]
    weights = load_file(path)
    weights["maps.bias"][0] = 5.0
    checkpoint.save(path, weights, checkpoint.read_info(path))
    return networks


def crops_of(path: Path, config: ExperimentConfig) -> Crops:
    with Session.open(path) as session:
        masks = [session.object_poses("cup").mask(index) for index in range(len(session))]
        found: list[Detection | None] = [Detection(mask_box(mask), mask, 0.9) for mask in masks]
        return captured_crops(session, range(len(session)), found, config.input)


@pytest.fixture(scope="module")
def direct(cup: ObjectModel, tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    return confident(save_untrained(tmp_path_factory.mktemp("direct"), cup, tiny()))


@pytest.fixture(scope="module")
def large(cup: ObjectModel, tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    return confident(save_untrained(tmp_path_factory.mktemp("large"), cup, tiny(student="large")))


def run(
    path: Path, cup: ObjectModel, networks: dict[str, Path], out: Path, **changes: object
) -> tuple[dict[str, float], Path]:
    """The last logged losses, and the adapted checkpoint."""
    config = tiny()
    settings = dataclasses.replace(config.self_supervision, **changes)  # type: ignore[arg-type]
    pair = (networks["teacher"], networks["student"])
    adapted = self_supervise(crops_of(path, config), cup, *pair, out, settings)
    return json.loads(adapted.with_suffix(".log.jsonl").read_text().splitlines()[-1]), adapted


@pytest.mark.parametrize(
    ("changes", "terms"),
    [
        ({}, {"pose", "mask", "normals", "physics"}),
        ({"physics": "dolp-gain", "adapt_batches": 0}, {"pose", "mask", "normals", "physics"}),
        ({"physics": "none", "adapt_batches": 0, "depth": "chamfer"}, {"pose", "mask", "normals", "depth"}),
        ({"physics": "none", "adapt_batches": 0, "depth": "pixel"}, {"pose", "mask", "normals", "depth"}),
    ],
)
def test_the_total_is_the_weighted_sum_of_the_terms(
    changes: dict[str, object],
    terms: set[str],
    with_depth: Path,
    cup: ObjectModel,
    direct: dict[str, Path],
    tmp_path: Path,
) -> None:
    last, out = run(with_depth, cup, direct, tmp_path, **changes)
    assert terms == set(last) - {"step", "seconds", "learning_rate", "total"}
    assert all(last[name] > 0 for name in terms)
    total = sum(getattr(tiny().self_supervision, f"{name}_weight") * last[name] for name in terms)
    assert last["total"] == pytest.approx(total, rel=1e-5)
    info = checkpoint.read_info(out, "student", "cup")
    assert info.stage == "self-supervised"
    kept = info.config.self_supervision  # what was used, not what the student was pre-trained with
    assert all(getattr(kept, name) == value for name, value in changes.items())


@pytest.mark.parametrize("frozen", [True, False])
def test_frozen_norms_keep_their_statistics(
    frozen: bool, cup_session: Path, cup: ObjectModel, direct: dict[str, Path], tmp_path: Path
) -> None:
    _, out = run(cup_session, cup, direct, tmp_path, adapt_batches=0, freeze_norms=frozen)
    before, after = load_file(direct["student"]), load_file(out)
    kept = {name for name, value in before.items() if torch.equal(value, after[name])}
    statistics = {name for name in before if "running_" in name}
    assert kept >= statistics if frozen else not kept & statistics
    assert not kept & {name for name in before if name.endswith(".weight")}


def test_a_depth_loss_without_depth_is_refused(
    cup_session: Path, cup: ObjectModel, direct: dict[str, Path], tmp_path: Path
) -> None:
    with pytest.raises(ToolkitError, match="needs depth, and the session has none"):
        run(cup_session, cup, direct, tmp_path, depth="chamfer")


def test_the_large_student_learns_by_what_it_predicts_too(
    cup_session: Path, cup: ObjectModel, large: dict[str, Path], tmp_path: Path
) -> None:
    last, out = run(cup_session, cup, large, tmp_path, adapt_batches=0)
    assert last["mask"] > 0
    before, after = load_file(large["student"]), load_file(out)
    assert not torch.equal(before["maps.weight"], after["maps.weight"])


def test_an_ema_teacher_follows_a_student_of_its_kind(
    cup_session: Path, cup: ObjectModel, large: dict[str, Path], direct: dict[str, Path], tmp_path: Path
) -> None:
    last, out = run(cup_session, cup, large, tmp_path, teacher="ema", adapt_batches=0)
    assert set(load_file(out)) == set(load_file(large["student"]))
    assert last["total"] > 0
    with pytest.raises(ToolkitError, match=r'network\.student = "large"'):
        run(cup_session, cup, direct, tmp_path / "direct", teacher="ema", adapt_batches=0)
    wide = dataclasses.replace(tiny(), network=dataclasses.replace(tiny().network, decoder_channels=48))
    other = {**large, "teacher": save_untrained(tmp_path / "wide", cup, wide)["teacher"]}
    with pytest.raises(ToolkitError, match="own architecture"):
        run(cup_session, cup, other, tmp_path / "wide", teacher="ema", adapt_batches=0)


@pytest.mark.parametrize("teacher", ["frozen", "ema"])
def test_a_stopped_adaptation_goes_on_as_if_nothing_had_happened(
    teacher: Literal["frozen", "ema"],
    cup_session: Path,
    cup: ObjectModel,
    direct: dict[str, Path],
    large: dict[str, Path],
    tmp_path: Path,
) -> None:
    """Losses and weights, to the last bit; an ema teacher goes on from where it was, too."""
    networks = direct if teacher == "frozen" else large
    settings = dataclasses.replace(tiny().self_supervision, steps=4, checkpoint_every=2, teacher=teacher)
    crops = crops_of(cup_session, tiny())

    def curve(out: Path, stop: int | None = None) -> dict[int, dict[str, float]]:
        """The losses by step."""
        seen: dict[int, dict[str, float]] = {}

        def note(label: str, done: int, total: int, values: Mapping[str, float]) -> None:
            del label, total
            seen[done] = dict(values)
            if done == stop:
                raise KeyboardInterrupt

        pair = (networks["teacher"], networks["student"])
        with contextlib.suppress(KeyboardInterrupt):
            self_supervise(crops, cup, *pair, out, settings, report=note)
        return seen

    whole, stopped = curve(tmp_path / "whole"), curve(tmp_path / "stopped", stop=3)
    resumed = curve(tmp_path / "stopped")
    assert ([*stopped], [*resumed]) == ([1, 2, 3], [3, 4])
    assert stopped | resumed == whole
    a, b = (load_file(tmp_path / run / "adapted.safetensors") for run in ("whole", "stopped"))
    assert all(torch.equal(a[name], b[name]) for name in a | b)


def test_the_mean_teacher_moves_by_the_decay_and_has_no_gradient() -> None:
    torch.manual_seed(0)
    student, teacher = (build_teacher(tiny()) for _ in range(2))
    pair = MeanTeacher(student, teacher, 0.9).train()
    before = {name: value.clone() for name, value in teacher.state_dict().items()}
    followed = {name: value.clone() for name, value in student.state_dict().items()}
    images = torch.randn(2, 7, 64, 64), torch.randn(2, 9, 64, 64)
    answer, said = pair(*images)
    for name in ("maps.weight", "encoder.polarization.stem.1.running_mean"):
        expected = 0.9 * before[name] + 0.1 * followed[name]
        torch.testing.assert_close(teacher.state_dict()[name], expected)
    (answer.pose.sum() + said.pose.sum()).backward()
    assert all(weight.grad is None for weight in teacher.parameters())
    assert not teacher.training
    still = {name: value.clone() for name, value in teacher.state_dict().items()}
    pair.eval()(*images)
    assert all(torch.equal(still[name], value) for name, value in teacher.state_dict().items())


def test_labels_made_over_all_crops_are_those_of_each_batch(cup_session: Path, cup: ObjectModel) -> None:
    config, mesh = tiny(), RenderMesh.from_mesh(cup.mesh)
    crops = labelled_crops([cup_session], cup, config.input)
    teacher = build_teacher(config).eval()
    labels = make_labels(teacher, crops, cup, mesh, config)
    assert labels.rotation.shape == (8, 3, 3)
    output = TeacherOutput(
        torch.zeros(1, 9),
        torch.full((1, 1, 16, 16), 9.0),
        torch.zeros(1, 3, 16, 16),
        torch.zeros(1, 3, 16, 16),
    )
    seen = form_input(crops, torch.tensor([0]), View.centred(1, 1.4), 1.5, config)
    said = labels_of(output, seen, mesh, cup.diameter)
    covered = said.rendered_mask.mean()
    assert float(said.delta) == pytest.approx(
        1 - float(covered), abs=0.01
    )  # against a mask that is everywhere


@pytest.fixture(scope="module")
def baseline(cup: ObjectModel, tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    return confident(save_untrained(tmp_path_factory.mktemp("rgb"), cup, tiny("rgb")))


def test_the_rgbd_baseline_adapts_by_appearance_and_depth(
    baseline: dict[str, Path], with_depth: Path, cup: ObjectModel, tmp_path: Path
) -> None:
    config = tiny("rgb")
    crops = crops_of(with_depth, config)
    out = self_supervise_rgbd(crops, cup, baseline["teacher"], baseline["student"], tmp_path)
    last = json.loads(out.with_suffix(".log.jsonl").read_text().splitlines()[-1])
    assert {"pose", "mask", "chamfer", "colour", "structure"} < set(last)
    assert "perceptual" not in last
    assert last["colour"] == pytest.approx(0, abs=1e-3)  # of grey images
    assert last["chamfer"] > 0
    before, after = load_file(baseline["student"]), load_file(out)
    assert set(before) == set(after)
    statistics = [name for name in before if "running" in name]
    assert all(torch.equal(before[name], after[name]) for name in statistics)  # BatchNorm is frozen
    assert not torch.equal(before["pose.output.weight"], after["pose.output.weight"])


def test_the_baseline_uses_lpips_where_its_weights_are_named(
    baseline: dict[str, Path], with_depth: Path, cup: ObjectModel, tmp_path: Path
) -> None:
    from tests.s2p3.test_appearance_losses import stored_weights

    config = tiny("rgb")
    weights = str(stored_weights(tmp_path / "lpips.safetensors"))
    settings = dataclasses.replace(config.self6d, steps=1, lpips_weights=weights)
    networks = (baseline["teacher"], baseline["student"])
    out = self_supervise_rgbd(crops_of(with_depth, config), cup, *networks, tmp_path, settings)
    assert json.loads(out.with_suffix(".log.jsonl").read_text().splitlines()[-1])["perceptual"] > 0


def test_the_baseline_refuses_polarization_and_missing_depth(
    baseline: dict[str, Path],
    direct: dict[str, Path],
    cup_session: Path,
    with_depth: Path,
    cup: ObjectModel,
    tmp_path: Path,
) -> None:
    networks = (baseline["teacher"], baseline["student"])
    with pytest.raises(ToolkitError, match="the session has none"):
        self_supervise_rgbd(crops_of(cup_session, tiny("rgb")), cup, *networks, tmp_path)
    with pytest.raises(
        ToolkitError, match=r'teaches by polarization, which .* does not see; set physics = "none"'
    ):
        self_supervise(crops_of(with_depth, tiny("rgb")), cup, *networks, tmp_path)
    with pytest.raises(ToolkitError, match=r"sees polarization.*input.modality"):
        self_supervise_rgbd(crops_of(with_depth, tiny()), cup, direct["teacher"], direct["student"], tmp_path)


def test_the_signal_of_a_specular_cup_is_seen(cup_session: Path, cup: ObjectModel) -> None:
    crops = labelled_crops([cup_session], cup, tiny().input)
    figures = labelled_signal(crops, torch.arange(8), cup)
    assert figures.images == 8
    assert figures.dolp_residual < 0.5 * figures.dolp_residual_shuffled
    assert objection(figures) is None
    at_truth = captured_signal(crops, crops.rotation, crops.translation, cup)
    assert at_truth.dolp_residual == pytest.approx(figures.dolp_residual, abs=0.03)


def test_unpolarized_light_is_warned_about(cup_session: Path, cup: ObjectModel, tmp_path: Path) -> None:
    crops = labelled_crops([cup_session], cup, tiny().input)
    faint = crops.stokes.clone()
    noise = torch.randn(faint[:, 1:].shape, generator=torch.Generator().manual_seed(0))
    faint[:, 1:] = (0.02 * faint[:, :1] * noise).to(faint.dtype)
    figures = labelled_signal(dataclasses.replace(crops, stokes=faint), torch.arange(8), cup)
    with pytest.warns(ToolkitWarning, match="teacher: L_physics cannot help here"):
        report_signal(figures, tmp_path / "teacher.safetensors", "dolp")
    stored = (tmp_path / "teacher.signal.json").read_text()
    assert Informativeness.from_json(stored) == figures
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        report_signal(labelled_signal(crops, torch.arange(8), cup), tmp_path / "student.safetensors", "dolp")
    assert objection(Informativeness.mean([])) is not None


@pytest.mark.parametrize("physics", ["stokes", "aolp", "none"])
def test_only_a_loss_on_dolp_alone_is_said_to_be_blind(
    cup_session: Path, cup: ObjectModel, physics: PhysicsVariant
) -> None:
    crops = labelled_crops([cup_session], cup, tiny().input)
    figures = labelled_signal(crops, torch.arange(8), cup)
    diluted = dataclasses.replace(figures, dolp_residual=figures.dolp_residual_shuffled)
    assert "L_physics" in str(objection(diluted))
    assert objection(diluted, physics) is None


def test_the_physics_sees_what_was_measured_not_what_was_augmented(cup_session: Path) -> None:
    config, rows, view = tiny(), torch.arange(4), View.centred(4, 1.4)
    crops = crops_of(cup_session, config)
    plain = form_input(crops, rows, view, 1.5, config)
    augmented = form_input(crops, rows, view, 1.5, config, torch.Generator().manual_seed(0))
    assert torch.equal(augmented.stokes, plain.stokes)
    assert not torch.equal(augmented.polarization, plain.polarization)


def test_saturated_pixels_are_no_measurement(cup_session: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    config, whole = tiny(), Session.stokes

    def saturated(self: Session, index: int) -> Stokes:
        stokes = whole(self, index)
        valid = stokes.valid.copy()
        valid[:, : valid.shape[1] // 2] = False
        return dataclasses.replace(stokes, valid=valid)

    before = crops_of(cup_session, config)
    monkeypatch.setattr(Session, "stokes", saturated)
    crops = crops_of(cup_session, config)
    seen = form_input(crops, torch.arange(8), View.centred(8, 1.4), 1.5, config)
    everywhere = form_input(before, torch.arange(8), View.centred(8, 1.4), 1.5, config)
    assert 0 < seen.valid.float().mean() < everywhere.valid.float().mean()
    spoilt = torch.where(seen.valid, seen.stokes, 7.0)
    assert torch.equal(smoothed(spoilt, seen.valid, 3), smoothed(seen.stokes, seen.valid, 3))


def test_depth_is_cut_on_the_grid_of_the_crops(with_depth: Path, cup: ObjectModel) -> None:
    crops = labelled_crops([with_depth], cup, tiny().input)
    assert crops.depth is not None
    covered = (crops.normals.norm(dim=1) > 0.5) & (crops.depth[:, 0] > 0)
    assert covered.float().mean() > 0.1
    # the depth of the object's coordinates, placed by its pose
    lower, extent = torch.from_numpy(cup.mesh.lower), torch.from_numpy(cup.mesh.extent)
    points = lower[:, None, None] + extent[:, None, None] * (crops.coordinates.float() + 1) / 2
    z = torch.einsum("bj,bjhw->bhw", crops.rotation[:, 2], points) + crops.translation[:, 2, None, None]
    error = (z - crops.depth[:, 0].float())[covered].abs()
    assert error.median() < 0.002
    assert (error < 0.01).float().mean() > 0.9


@pytest.mark.parametrize("depth", ["chamfer", "pixel"])
def test_depth_losses_pull_an_object_that_is_too_far_nearer(
    depth: Literal["chamfer", "pixel"], with_depth: Path, cup: ObjectModel
) -> None:
    config = tiny()
    crops = labelled_crops([with_depth], cup, config.input)
    mesh, rows = RenderMesh.from_mesh(cup.mesh), torch.arange(2)
    seen = form_input(crops, rows, View.centred(2, 1.4), 1.5, config)
    assert seen.depth is not None
    inside = (seen.depth > 0).float()
    for wrong in (0.02, -0.02):
        shift = torch.zeros(2, 3, requires_grad=True)
        away = crops.translation[rows] * (1 + wrong)
        surface = visible_surface(mesh, crops.rotation[rows], away + shift, seen)
        if depth == "pixel":
            loss = losses.depth_loss(surface.depth, seen.depth, inside)
        else:
            loss = losses.chamfer_loss(*clouds(seen, surface, inside))
        (gradient,) = torch.autograd.grad(loss.sum(), shift)
        assert (gradient[:, 2] * wrong > 0).all()
        assert (gradient[:, 2].abs() < 3).all()  # metres per metre: nothing of an outline that moves


def test_networks_that_see_depth_want_it(cup_session: Path, with_depth: Path, cup: ObjectModel) -> None:
    config = tiny("rgbd")
    with pytest.raises(ToolkitError, match="has no depth, and these networks see it"):
        labelled_crops([cup_session], cup, config.input)
    assert isinstance(build_student(config), torch.nn.Module)
    assert isinstance(build_student(tiny(student="large")), Teacher)
    with h5py.File(with_depth) as file:
        assert "depth" in file
    assert labelled_crops([with_depth], cup, config.input).depth is not None


def test_networks_without_polarization_are_not_judged_by_it(
    baseline: dict[str, Path], cup_session: Path, cup: ObjectModel, tmp_path: Path
) -> None:
    config = tiny("rgb")
    settings = dataclasses.replace(config.self_supervision, physics="none")
    pair = (baseline["teacher"], baseline["student"])
    adapted = self_supervise(crops_of(cup_session, config), cup, *pair, tmp_path, settings)
    assert adapted.exists()
    assert not adapted.with_suffix(".signal.json").exists()
