"""`s2p3 synthesize`, `s2p3 train ...` and `s2p3 evaluate`: from an object to a pose model."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Literal

import tyro

from s2p3.commands.arguments import ObjectName, OptionalPath, Sessions, at_least
from s2p3.commands.output import counting, say, show

if TYPE_CHECKING:
    from s2p3.config import ExperimentConfig

Preset = Literal["fast", "paper", "quick"]


def synthesize(
    *,
    object: ObjectName,
    count: int = 400,
    out: Path,
    mesh: OptionalPath = None,
    intrinsics: OptionalPath = None,
    seed: int = 0,
    workers: int = 2,
    backend: Literal["analytic"] = "analytic",
) -> None:
    """Render a training set: polarized images of the object, with exact poses and masks.

    Args:
        object: cup, fork, knife, bottle, or the name of the object in --mesh.
        count: frames; a set that was interrupted is continued.
        out: session file to write.
        mesh: PLY, OBJ or STL of the object, metres.
        intrinsics: calibration.json of the camera to imitate; the paper's camera by default.
        seed: the same seed, the same frames.
        workers: processes that render.
        backend: analytic is Fresnel reflection of lights and environment, without shadows.
    """
    from s2p3.objects import named_object
    from s2p3.synthesis import session_camera
    from s2p3.synthesis import synthesize as render

    del backend  # one so far; the choice is in the interface that both will share
    with counting("synthesize") as report:
        figures = render(
            named_object(object, mesh), count, session_camera(intrinsics), seed, out, workers, report
        )
    say(f"{out}: {count} frames; {figures}")


def train_detector(
    sessions: Sessions,
    *,
    object: ObjectName,
    out: Path,
    mesh: OptionalPath = None,
    preset: Preset = "fast",
    config: OptionalPath = None,
    threads: int = 1,
) -> None:
    """Train the detector: the object's mask and box in the whole image.

    Args:
        sessions: files with poses and masks of the object, usually synthetic.
        object: cup, fork, knife, bottle, or the name of the object in --mesh.
        out: folder for detector.safetensors and the log; an interrupted training continues.
        mesh: PLY, OBJ or STL of the object, metres.
        preset: fast is our choice for two cores, paper the paper's values, quick a smoke test.
        config: experiment.toml instead of a preset.
        threads: CPU threads; one each when two trainings run side by side.
    """
    from s2p3.objects import named_object
    from s2p3.training import train_detector as train

    _use_threads(threads)
    say(str(train(_some(sessions), named_object(object, mesh), _experiment(preset, config), out)))


def train_teacher(
    sessions: Sessions,
    *,
    object: ObjectName,
    out: Path,
    mesh: OptionalPath = None,
    preset: Preset = "fast",
    config: OptionalPath = None,
    threads: int = 1,
) -> None:
    """Pre-train the teacher on synthetic sessions.

    Args:
        sessions: files with poses of the object, usually synthetic.
        object: cup, fork, knife, bottle, or the name of the object in --mesh.
        out: folder for teacher.safetensors and the log; an interrupted training continues.
        mesh: PLY, OBJ or STL of the object, metres.
        preset: fast is our choice for two cores, paper the paper's values, quick a smoke test.
        config: experiment.toml instead of a preset.
        threads: CPU threads; one each when two trainings run side by side.
    """
    from s2p3.objects import named_object
    from s2p3.training import train_teacher as train

    _use_threads(threads)
    say(
        str(
            train(
                _some(sessions),
                named_object(object, mesh),
                _experiment(preset, config),
                out,
                cache=out.parent,
            )
        )
    )


def train_student(
    sessions: Sessions,
    *,
    object: ObjectName,
    out: Path,
    mesh: OptionalPath = None,
    teacher: OptionalPath = None,
    preset: Preset = "fast",
    config: OptionalPath = None,
    threads: int = 1,
) -> None:
    """Pre-train the student on synthetic sessions.

    Args:
        sessions: files with poses of the object, usually synthetic.
        object: cup, fork, knife, bottle, or the name of the object in --mesh.
        out: folder for student.safetensors and the log; an interrupted training continues.
        mesh: PLY, OBJ or STL of the object, metres.
        teacher: checkpoint to start the encoders from, where the experiment asks for a warm start.
        preset: fast is our choice for two cores, paper the paper's values, quick a smoke test.
        config: experiment.toml instead of a preset.
        threads: CPU threads; one each when two trainings run side by side.
    """
    from s2p3.objects import named_object
    from s2p3.training import train_student as train

    _use_threads(threads)
    model = named_object(object, mesh)
    say(
        str(
            train(_some(sessions), model, _experiment(preset, config), out, cache=out.parent, teacher=teacher)
        )
    )


def train_self_supervised(
    session: tyro.conf.Positional[Path],
    *,
    object: ObjectName,
    detector: Path,
    teacher: Path,
    student: Path,
    out: Path,
    mesh: OptionalPath = None,
    config: OptionalPath = None,
    split: str = "train",
    threads: int = 2,
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
        config: experiment.toml whose [self_supervision] to use instead of the student's.
        split: name of the split to train on.
        threads: CPU threads.
    """
    from s2p3.config import load
    from s2p3.learning import adapt
    from s2p3.objects import named_object

    _use_threads(threads)
    model = named_object(object, mesh)
    settings = None if config is None else load(config).self_supervision
    say(str(adapt(session, split, model, detector, teacher, student, out, settings)))


def evaluate(
    session: tyro.conf.Positional[Path],
    *,
    object: ObjectName,
    network: Path,
    detector: Path,
    mesh: OptionalPath = None,
    split: str = "test",
    out: OptionalPath = None,
    json: bool = False,
) -> None:
    """Evaluate a teacher or student on an annotated session, in detected boxes; every target counts.

    Args:
        session: an annotated session.
        object: cup, fork, knife, bottle, or the name of the object in --mesh.
        network: checkpoint of a teacher or student.
        detector: detector.safetensors.
        mesh: PLY, OBJ or STL of the object, metres.
        split: name of the split to evaluate on.
        out: JSON file for the summary and a record of every target.
        json: print the summary as JSON.
    """
    from dataclasses import asdict

    from s2p3.learning import evaluate_split
    from s2p3.objects import named_object

    networks = {"network": network}
    result = evaluate_split(session, split, named_object(object, mesh), networks, detector)["network"]
    if out is not None:
        result.save(out)
    show(asdict(result.summary), json)


def _some(sessions: list[Path]) -> list[Path]:
    from dataset.errors import ToolkitError

    if not sessions:
        raise ToolkitError("no session to train on; name one or more, made with: s2p3 synthesize")
    return sessions


def _experiment(preset: Preset, config: Path | None) -> ExperimentConfig:
    from s2p3.config import PRESETS, load

    return PRESETS[preset]() if config is None else load(config)


def _use_threads(threads: int) -> None:
    import torch

    at_least(1, threads=threads)
    torch.set_num_threads(threads)
