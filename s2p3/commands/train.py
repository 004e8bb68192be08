"""`s2p3 train ...`: the networks, on synthetic sessions first, then on captured ones."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import tyro

from dataset.errors import ToolkitError
from s2p3.commands.arguments import (
    ObjectName,
    ObjectNames,
    OptionalPath,
    RequiredName,
    RequiredPath,
    Sessions,
    at_least,
)
from s2p3.commands.experiment import (
    DetectorFields,
    DetectorPart,
    OptionalPreset,
    Preset,
    SelfSupervisionFields,
    SelfSupervisionPart,
    StudentFields,
    StudentPart,
    SupervisedFields,
    SupervisedPart,
    TeacherFields,
    TeacherPart,
    experiment_of,
)
from s2p3.config import FrameSource, load
from s2p3.console_output import progress_bars, say, show

if TYPE_CHECKING:
    from s2p3.config import ExperimentConfig

Frames = Annotated[FrameSource, tyro.conf.arg(name="")]
_FRAMES = FrameSource(workers=1)
_DETECTOR, _TEACHER, _STUDENT = DetectorPart(), TeacherPart(), StudentPart()
_SUPERVISED, _SELF_SUPERVISION = SupervisedPart(), SelfSupervisionPart()
_ANNOTATED = FrameSource(split="train", workers=1)


def train_detector(
    sessions: Sessions,
    *,
    object: ObjectNames,
    out: Path,
    mesh: OptionalPath = None,
    preset: Preset = "fast",
    config: OptionalPath = None,
    threads: int = 1,
    workers: int = 1,
    experiment: DetectorFields = _DETECTOR,
) -> None:
    """Train the detector: masks and boxes of one object, or of several, in the whole image.

    Args:
        sessions: files with poses and masks of the objects, usually synthetic; each shows one at least.
        object: cup, fork, knife, bottle, or the name of the object in --mesh; a class each.
        out: folder for detector.safetensors and the log; an interrupted training continues.
        mesh: PLY, OBJ or STL of the object, metres.
        preset: fast is our choice for two cores, paper the paper's values, quick a smoke test.
        config: experiment.toml, whose fields override the preset's.
        threads: CPU threads of the network.
        workers: processes that augment, a thread each; 0: the training does it itself.
    """
    from s2p3.objects import named_object
    from s2p3.training import train_detector as train

    _use(threads, workers)
    chosen = experiment.within(experiment_of(preset, config))
    if mesh is not None and len(object) > 1:
        raise ToolkitError("--mesh is of one object; train a detector of several with built-in ones")
    models = [named_object(name, mesh) for name in object]
    with progress_bars() as report:
        path = train(_some(sessions), models, chosen, out, workers=workers, report=report)
    say(str(path))


def train_teacher(
    sessions: Sessions = [],  # noqa: B006 (tyro tells a list apart, and nothing changes it)
    *,
    object: RequiredName = "",
    out: RequiredPath = Path(),
    mesh: OptionalPath = None,
    preset: Preset = "fast",
    config: OptionalPath = None,
    threads: int = 1,
    frames: Frames = _FRAMES,
    describe: bool = False,
    json: bool = False,
    experiment: TeacherFields = _TEACHER,
) -> None:
    """Pre-train the teacher on synthetic sessions.

    Args:
        sessions: files with poses of the object, usually synthetic.
        object: cup, fork, knife, bottle, or the name of the object in --mesh.
        out: folder for teacher.safetensors and the log; an interrupted training continues.
        mesh: PLY, OBJ or STL of the object, metres.
        preset: fast is our choice for two cores, paper the paper's values, quick a smoke test.
        config: experiment.toml, whose fields override the preset's.
        threads: CPU threads of the network.
        describe: train nothing; say what the teacher weighs and costs, what it takes and gives.
        json: with --describe, as JSON.
    """
    chosen = experiment.within(experiment_of(preset, config))
    if describe:
        _describe("teacher", chosen, json)
    else:
        _all_given(object=object, out=out)
        _supervise("teacher", sessions, object, mesh, chosen, out, threads, frames)


def train_student(
    sessions: Sessions = [],  # noqa: B006 (tyro tells a list apart, and nothing changes it)
    *,
    object: RequiredName = "",
    out: RequiredPath = Path(),
    mesh: OptionalPath = None,
    teacher: OptionalPath = None,
    preset: Preset = "fast",
    config: OptionalPath = None,
    threads: int = 1,
    frames: Frames = _FRAMES,
    describe: bool = False,
    json: bool = False,
    experiment: StudentFields = _STUDENT,
) -> None:
    """Pre-train the student on synthetic sessions.

    Args:
        sessions: files with poses of the object, usually synthetic.
        object: cup, fork, knife, bottle, or the name of the object in --mesh.
        out: folder for student.safetensors and the log; an interrupted training continues.
        mesh: PLY, OBJ or STL of the object, metres.
        teacher: teacher.safetensors from whose encoders to start, which ours learn from sooner; the paper's
            start from ImageNet's, as without.
        preset: fast is our choice for two cores, paper the paper's values, quick a smoke test.
        config: experiment.toml, whose fields override the preset's.
        threads: CPU threads of the network.
        describe: train nothing; say what the student weighs and costs, what it takes and gives.
        json: with --describe, as JSON.
    """
    chosen = experiment.within(experiment_of(preset, config))
    if describe:
        _describe("student", chosen, json)
    else:
        _all_given(object=object, out=out)
        _supervise("student", sessions, object, mesh, chosen, out, threads, frames, teacher=teacher)


def train_supervised(
    sessions: Sessions,
    *,
    object: ObjectName,
    out: Path,
    network: Literal["teacher", "student"] = "teacher",
    mesh: OptionalPath = None,
    preset: Preset = "fast",
    config: OptionalPath = None,
    threads: int = 1,
    frames: Frames = _ANNOTATED,
    experiment: SupervisedFields = _SUPERVISED,
) -> None:
    """Train on annotated captured frames, as on synthetic ones: the upper bound that needs annotations.

    Frames are those of the split train, unless --split names another.

    Args:
        sessions: annotated sequences.
        object: cup, fork, knife, bottle, or the name of the object in --mesh.
        out: folder for teacher.safetensors or student.safetensors; an interrupted training continues.
        network: the teacher is PPP-Net, the paper's upper bound.
        mesh: PLY, OBJ or STL of the object, metres.
        preset: fast is our choice for two cores, paper the paper's values, quick a smoke test.
        config: experiment.toml, whose fields override the preset's.
        threads: CPU threads of the network.
    """
    chosen = experiment.within(experiment_of(preset, config))
    _supervise(network, sessions, object, mesh, chosen, out, threads, frames, "supervised")


def train_self_supervised(
    session: tyro.conf.Positional[Path],
    *,
    object: ObjectName,
    detector: Path,
    teacher: Path,
    student: Path,
    out: Path,
    mesh: OptionalPath = None,
    preset: OptionalPreset = None,
    config: OptionalPath = None,
    split: str = "train",
    method: Literal["s2p3", "self6d"] = "s2p3",
    threads: int = 1,
    workers: int = 1,
    experiment: SelfSupervisionFields = _SELF_SUPERVISION,
) -> None:
    """Adapt the student to captured frames; no pose of the session is read.

    Args:
        session: the captured sequence.
        object: cup, fork, knife, bottle, or the name of the object in --mesh.
        detector: detector.safetensors.
        teacher: teacher.safetensors.
        student: student.safetensors to start from.
        out: folder for adapted.safetensors and the log; an interrupted training continues.
        mesh: PLY, OBJ or STL of the object, metres.
        preset: start from its settings instead of those that the student's experiment holds.
        config: experiment.toml, whose [self_supervision] or [self6d] overrides fields of those settings; what
            the networks are and see is the student's.
        split: name of the split to train on.
        method: s2p3 is the paper's, self6d the RGB-D baseline, after Self6D++: it needs depth, and networks
            trained with --config.input.modality rgb.
        threads: CPU threads of the network.
        workers: processes that augment, a thread each; 0: the training does it itself.
    """
    del preset  # its values, and those of the file, are the options' defaults; here mistakes are told
    if config is not None:
        load(config)
    from s2p3.captured_stages import adapt
    from s2p3.objects import named_object

    _use(threads, workers)
    model = named_object(object, mesh)
    settings = experiment.self_supervision if method == "s2p3" else experiment.self6d
    networks = (detector, teacher, student)
    with progress_bars() as report:
        path = adapt(session, split, model, *networks, out, settings, workers=workers, report=report)
    say(str(path))


def _supervise(
    network: Literal["teacher", "student"],
    sessions: list[Path],
    name: str,
    mesh: Path | None,
    experiment: ExperimentConfig,
    out: Path,
    threads: int,
    frames: FrameSource,
    stage: Literal["pretrained", "supervised"] = "pretrained",
    teacher: Path | None = None,
) -> None:
    from s2p3.objects import named_object
    from s2p3.training import supervise

    _use(threads, frames.workers)
    common = (_some(sessions), named_object(name, mesh), experiment, out)
    with progress_bars() as report:
        path = supervise(
            network, *common, teacher=teacher, cache=out.parent, frames=frames, stage=stage, report=report
        )
    say(str(path))


def _some(sessions: list[Path]) -> list[Path]:
    if not sessions:
        raise ToolkitError("no session to train on; name one or more, made with: s2p3 synthesize")
    return sessions


def _describe(kind: Literal["teacher", "student"], experiment: ExperimentConfig, as_json: bool) -> None:
    from s2p3.networks.describe import describe

    show(describe(kind, experiment), as_json)


def _all_given(**values: str | Path) -> None:
    """Raises ToolkitError: an option that a training needs is missing."""
    missing = [f"--{name}" for name, value in values.items() if value in ("", Path())]
    if missing:
        raise ToolkitError(
            f"{' and '.join(missing)} missing; a training needs an object and an output folder"
        )


def _use(threads: int, workers: int) -> None:
    import torch

    at_least(1, threads=threads)
    at_least(0, workers=workers)
    torch.set_num_threads(threads)
