"""`s2p3 synthesize`, `s2p3 train ...` and `s2p3 evaluate`: from an object to a pose model."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Literal

import tyro

from s2p3.commands.output import console, counting, show

if TYPE_CHECKING:
    from s2p3.config import ExperimentConfig

Preset = Literal["fast", "paper", "quick"]


def synthesize(
    *,
    object: str,
    count: int = 400,
    out: Path,
    mesh: Path | None = None,
    intrinsics: Path | None = None,
    seed: int = 0,
    workers: int = 2,
    backend: Literal["analytic"] = "analytic",
) -> None:
    """Render a training set: polarized images of the object with exact poses and masks, as a session of kind
    synthetic.

    Args:
        object: cup, fork, knife, bottle, or the name of the object in --mesh.
        count: frames; a set that was interrupted is continued.
        out: session file to write.
        mesh: PLY, OBJ or STL of the object, metres.
        intrinsics: calibration.json of the camera to imitate; the paper's camera by default.
        seed: the same seed, the same frames.
        workers: processes.
        backend: `analytic`: Fresnel reflection of lights and environment, without shadows.
    """
    from s2p3.objects import named_object
    from s2p3.synthesis import session_camera
    from s2p3.synthesis import synthesize as render

    del backend  # one so far; the choice is in the interface that both will share
    with counting("synthesize") as report:
        figures = render(
            named_object(object, mesh), count, session_camera(intrinsics), seed, out, workers, report
        )
    console.print(f"{out}: {count} frames; {figures}")


def train_detector(
    sessions: tyro.conf.Positional[list[Path]],
    *,
    object: str,
    out: Path,
    mesh: Path | None = None,
    preset: Preset = "fast",
    config: Path | None = None,
) -> None:
    """Train the detector: the object's mask and box in the whole image.

    Args:
        sessions: with poses and masks of the object, usually synthetic.
        object: its name.
        out: folder for detector.safetensors and the log; an interrupted training continues.
        mesh: PLY, OBJ or STL of an object of your own, metres.
        preset: `fast` is our choice for two cores, `paper` the paper's values, `quick` a smoke test.
        config: experiment.toml instead of a preset.
    """
    from s2p3.objects import named_object
    from s2p3.training import train_detector as train

    console.print(str(train(sessions, named_object(object, mesh), _experiment(preset, config), out)))


def train_teacher(
    sessions: tyro.conf.Positional[list[Path]],
    *,
    object: str,
    out: Path,
    mesh: Path | None = None,
    preset: Preset = "fast",
    config: Path | None = None,
    threads: int = 1,
) -> None:
    """Pre-train the teacher on synthetic sessions.

    Args:
        sessions: with poses of the object, usually synthetic.
        object: its name.
        out: folder for teacher.safetensors and the log; an interrupted training continues.
        mesh: PLY, OBJ or STL of an object of your own, metres.
        preset: `fast` is our choice for two cores, `paper` the paper's values, `quick` a smoke test.
        config: experiment.toml instead of a preset.
        threads: of the CPU; one each when two trainings run side by side.
    """
    from s2p3.objects import named_object
    from s2p3.training import train_teacher as train

    _use_threads(threads)
    console.print(
        str(train(sessions, named_object(object, mesh), _experiment(preset, config), out, cache=out.parent))
    )


def train_student(
    sessions: tyro.conf.Positional[list[Path]],
    *,
    object: str,
    out: Path,
    mesh: Path | None = None,
    teacher: Path | None = None,
    preset: Preset = "fast",
    config: Path | None = None,
    threads: int = 1,
) -> None:
    """Pre-train the student on synthetic sessions.

    Args:
        sessions: with poses of the object, usually synthetic.
        object: its name.
        out: folder for student.safetensors and the log; an interrupted training continues.
        mesh: PLY, OBJ or STL of an object of your own, metres.
        teacher: checkpoint to start the encoders from, where the experiment asks for a warm start.
        preset: `fast` is our choice for two cores, `paper` the paper's values, `quick` a smoke test.
        config: experiment.toml instead of a preset.
        threads: of the CPU; one each when two trainings run side by side.
    """
    from s2p3.objects import named_object
    from s2p3.training import train_student as train

    _use_threads(threads)
    model = named_object(object, mesh)
    console.print(
        str(train(sessions, model, _experiment(preset, config), out, cache=out.parent, teacher=teacher))
    )


def train_self_supervised(
    session: tyro.conf.Positional[Path],
    *,
    object: str,
    detector: Path,
    teacher: Path,
    student: Path,
    out: Path,
    mesh: Path | None = None,
    split: str = "train",
    threads: int = 2,
) -> None:
    """Adapt the student to captured frames; no pose of the session is read.

    Args:
        session: the captured sequence.
        object: its name.
        detector: detector.safetensors.
        teacher: teacher.safetensors.
        student: student.safetensors to start from.
        out: folder for adapted.safetensors and the log.
        mesh: PLY, OBJ or STL of an object of your own, metres.
        split: frames to train on.
        threads: of the CPU.
    """
    from s2p3.learning import adapt
    from s2p3.objects import named_object

    _use_threads(threads)
    console.print(str(adapt(session, split, named_object(object, mesh), detector, teacher, student, out)))


def evaluate(
    session: tyro.conf.Positional[Path],
    *,
    object: str,
    network: Path,
    detector: Path,
    mesh: Path | None = None,
    split: str = "test",
    out: Path | None = None,
    json: bool = False,
) -> None:
    """Evaluate a teacher or student on an annotated session, in detected boxes; every target counts.

    Args:
        session: annotated.
        object: its name.
        network: checkpoint of a teacher or student.
        detector: detector.safetensors.
        mesh: PLY, OBJ or STL of an object of your own, metres.
        split: frames to evaluate on.
        out: JSON file for the summary and a record of every target.
        json: print the summary as JSON.
    """
    from dataclasses import asdict

    from s2p3.learning import evaluate_split
    from s2p3.objects import named_object

    result = evaluate_split(session, split, named_object(object, mesh), network, detector)
    if out is not None:
        result.save(out)
    show(asdict(result.summary), json)


def _experiment(preset: Preset, config: Path | None) -> ExperimentConfig:
    from s2p3.config import PRESETS, load

    return PRESETS[preset]() if config is None else load(config)


def _use_threads(threads: int) -> None:
    import torch

    torch.set_num_threads(threads)
