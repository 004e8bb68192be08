"""The loop itself, on a linear network: several processes, what is kept and written down, what stops it."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from dataclasses import dataclass, replace
from pathlib import Path

import pytest
import torch
from accelerate import Accelerator
from safetensors import safe_open
from safetensors.torch import load_file
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator
from torch import Tensor, nn

from dataset.errors import ToolkitError
from s2p3 import config, presets
from s2p3.config import AugmentationConfig
from s2p3.networks.teacher import TeacherOutput
from s2p3.objects import ObjectModel
from s2p3.training import supervise
from s2p3.training.checkpoint import Validation
from s2p3.training.loop import Forward, Losses, Run, Score, Trained, optimize, rate_factor
from s2p3.training.processes import Processes
from s2p3.training.supervised import load_student
from tests.s2p3.linear_run import SETTINGS, Numbers, Squares, network, run

ROOT = Path(__file__).parents[2]


def train(folder: Path, objective: Squares | Broken, score: Score | None = None) -> Trained[nn.Module]:
    return optimize(
        network(), Numbers(), objective, SETTINGS, Run("linear", folder / "linear.safetensors", ""), score
    )


def launch(*words: object) -> None:
    """Runs a Python script or module by two processes that train together."""
    together = ["-m", "torch.distributed.run", "--standalone", "--nproc-per-node", "2"]
    command = [sys.executable, *together, *map(str, words)]
    environment = os.environ | {"PYTHONPATH": str(ROOT), "OMP_NUM_THREADS": "1"}
    process = subprocess.Popen(command, cwd=ROOT, env=environment, stderr=subprocess.PIPE)
    try:
        errors = process.communicate(timeout=300)[1]
    finally:
        process.terminate()  # so that it ends its processes, which a kill would leave behind
    assert process.returncode == 0, errors.decode()


def test_two_processes_train_as_one_does(tmp_path: Path) -> None:
    """They see different rows, and end with equal weights: those that one process gives whole batches."""
    alone, together = tmp_path / "alone", tmp_path / "together"
    together.mkdir()
    launch(ROOT / "tests/s2p3/linear_run.py", together)
    run(alone)
    one, first, second = (
        json.loads((folder / f"seen-{rank}.json").read_text())
        for folder, rank in ((alone, 0), (together, 0), (together, 1))
    )
    assert len(first) == len(second) == SETTINGS.steps
    for batch, half, other in zip(one, first, second, strict=True):
        assert not {*half} & {*other}
        assert {*half} | {*other} == {*batch}
    weights, *others = (
        load_file(folder / f"weights-{rank}.safetensors")
        for folder, rank in ((alone, 0), (together, 0), (together, 1))
    )
    for name, value in weights.items():
        assert torch.equal(others[0][name], others[1][name])
        torch.testing.assert_close(others[0][name], value)
        assert (value - network().state_dict()[name]).abs().max() > 0.05


def test_two_processes_train_a_student_together(cup_session: Path, cup: ObjectModel, tmp_path: Path) -> None:
    """By the command line: the first one scores and writes. Its losses are of its half of the rows, and
    BatchNorm is each one's own, so they are like those of one process, not equal."""
    base = presets.quick()
    few = replace(base.student, steps=2, batch=6, validations=1, holdout=0.25)
    experiment = replace(base, student=few, augmentation=AugmentationConfig(1.4, 1.4, 0, 0, 0, 0, 0, 0))
    config.save(experiment, tmp_path / "experiment.toml")
    words = ["train", "student", cup_session, "--object", "cup", "--config", tmp_path / "experiment.toml"]
    together, alone = tmp_path / "together", tmp_path / "alone"
    launch("-m", "s2p3", *words, "--workers", 0, "--out", together)
    supervise("student", [cup_session], cup, experiment, alone, cache=tmp_path)
    files = [{path.name for path in folder.iterdir()} for folder in (together, alone)]
    assert files[0] == files[1] >= {"student.safetensors", "student.json", "student.log.jsonl"}
    (line,), (expected,) = (
        [json.loads(text) for text in (folder / "student.log.jsonl").read_text().splitlines()]
        for folder in (together, alone)
    )
    assert line.keys() == expected.keys() >= {"add_recall_10"}
    assert line["step"] == load_student(together / "student.safetensors")[1].step == 2
    assert line["total"] == pytest.approx(expected["total"], rel=0.2)


@pytest.mark.parametrize("best", [1, 2, 3])
def test_the_weights_that_score_best_are_kept(tmp_path: Path, best: int) -> None:
    taken: list[Tensor] = []

    def of(network: nn.Linear) -> float:
        taken.append(network.weight.detach().clone())
        return 1.0 if len(taken) == best else 0.5

    trained = train(tmp_path, Squares([]), Score("made_up", of, 3, "none"))
    assert (trained.step, trained.validation, len(taken)) == (
        10 * best,
        Validation("made_up", 1.0, "none"),
        3,
    )
    assert torch.equal(trained.network.weight, taken[best - 1])


def test_what_is_written_down(tmp_path: Path) -> None:
    """The same numbers for scripts and for TensorBoard."""
    trained = train(tmp_path, Squares([]), Score("made_up", lambda _: 7.0, 6, "none"))
    assert trained.validation == Validation("made_up", 7, "none")
    lines = [json.loads(line) for line in (tmp_path / "linear.log.jsonl").read_text().splitlines()]
    assert [line["step"] for line in lines] == [5, 10, 15, 20, 25, 30]
    events = EventAccumulator(str(tmp_path / "tensorboard" / "linear"))
    events.Reload()
    assert set(events.Tags()["scalars"]) == {"total", "learning_rate", "seconds", "made_up"}
    for name in ("total", "learning_rate", "made_up"):
        shown = [(event.step, event.value) for event in events.Scalars(name)]
        assert shown == [(line["step"], pytest.approx(line[name])) for line in lines]


@dataclass
class Broken(Squares):
    """Not finite at one step: its loss, or only its gradient."""

    where: str = "loss"

    def __call__(self, forward: Forward, batch: tuple[Tensor, Tensor, Tensor]) -> Losses:
        terms = {"fit": super().__call__(forward, batch)["total"]}
        if len(self.seen) == 7:
            zero = terms["fit"] * 0
            terms["odd"] = zero + torch.nan if self.where == "loss" else zero.sqrt()
        return {"total": torch.stack([*terms.values()]).sum(), **terms}


@pytest.mark.parametrize(("where", "said"), [("loss", r"the loss \(odd\)"), ("gradient", "the gradient")])
def test_a_step_that_cannot_be_taken_is_kept_and_named(tmp_path: Path, where: str, said: str) -> None:
    objective = Broken([], where)
    with pytest.raises(
        ToolkitError, match=rf"^linear: {said} is not finite at step 7; [^\n]*bad-batch[^\n]*$"
    ):
        train(tmp_path, objective)
    (kept,) = tmp_path.glob("*bad-batch*")
    found = load_file(kept)
    assert found["batch.0"].tolist() == objective.seen[-1]
    assert found["network.weight"].isfinite().all()
    with safe_open(kept, "pt") as file:
        assert file.metadata() == {"step": "7"}


def test_what_half_precision_computes_arrives_whole() -> None:
    """Losses and renderer are given float32, whatever the network computes in."""
    inside: list[torch.dtype] = []

    class Maps(nn.Module):
        def __init__(self) -> None:
            super().__init__()
            self.layer = nn.Linear(4, 9)

        def forward(self, x: Tensor) -> TeacherOutput:
            y = self.layer(x)
            inside.append(y.dtype)
            return TeacherOutput(y, y, y, y)

    forward = Processes(Accelerator(cpu=True), half_precision=True).prepare(Maps())
    output = forward(torch.rand(2, 4))
    assert inside == [torch.bfloat16]
    assert {output.pose.dtype, output.mask_logits.dtype, output.normals.dtype} == {torch.float32}
    output.pose.sum().backward()


def test_learning_rates() -> None:
    assert rate_factor("halving", 0.0) == 1
    assert rate_factor("halving", 0.26) == 0.5
    assert rate_factor("halving", 0.99) == 0.125
    assert rate_factor("cosine", 0.08) == 1
    assert rate_factor("cosine", 0.0) < 0.05
    assert rate_factor("cosine", 0.999) < 0.01
    assert rate_factor("flat", 0.71) == 1
    assert rate_factor("flat", 0.999) < 0.01


def test_epochs_are_passes_through_the_data() -> None:
    assert replace(SETTINGS, steps=7, epochs=0, batch=8).steps_over(100) == 7
    assert replace(SETTINGS, steps=7, epochs=3, batch=8).steps_over(100) == 37
