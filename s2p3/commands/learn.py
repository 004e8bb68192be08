"""`s2p3 synthesize` and `s2p3 train ...`: from an object to a pose model."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Literal

import tyro

from s2p3.commands.arguments import (
    ObjectName,
    OptionalNumber,
    OptionalPath,
    RequiredName,
    RequiredPath,
    Sessions,
    at_least,
)
from s2p3.commands.output import counting, say, show

if TYPE_CHECKING:
    from s2p3.config import ExperimentConfig
    from s2p3.objects import ObjectModel

Preset = Literal["fast", "paper", "quick"]


def synthesize(
    *,
    object: ObjectName,
    count: int = 400,
    out: Path,
    mesh: OptionalPath = None,
    material: OptionalPath = None,
    simplify_mm: OptionalNumber = None,
    intrinsics: OptionalPath = None,
    views_like: OptionalPath = None,
    domain: Literal["synthetic", "captured"] = "synthetic",
    seed: int = 0,
    workers: int = 2,
    backend: Literal["analytic", "path-traced"] = "analytic",
    samples: int = 32,
    executor: Literal["local", "ray"] = "local",
    depth: Literal["none", "ideal", "tof"] = "none",
) -> None:
    """Render a training set: polarized images of the object, with exact poses and masks.

    Args:
        object: cup, fork, knife, bottle, or the name of the object in --mesh.
        count: frames; a set that was interrupted is continued.
        out: session file to write; its manifest and a picture of how informative it is come beside it.
        mesh: PLY, OBJ or STL of the object, metres.
        material: TOML file of what it is made of; that beside the mesh by default.
        simplify_mm: render a mesh of fewer faces whose surface is nowhere further off than this.
        intrinsics: calibration.json of the camera to imitate; the paper's camera by default.
        views_like: session whose poses of the object the views are distributed like.
        domain: synthetic to train on; captured has a denser material, harder light, more noise, occlusion.
        seed: the same seed, the same frames.
        workers: processes that render, or Ray actors.
        backend: analytic is Fresnel reflection of lights and environment, without shadows; path-traced is
            Mitsuba 3, with shadows, inter-reflection and glass.
        samples: paths per pixel, at least 16; path-traced only.
        executor: ray uses the cluster that RAY_ADDRESS names, or starts one here.
        depth: what a depth camera adds to every frame, for the RGB-D baselines; tof errs as time-of-flight
            cameras do on silhouettes, metal and glass.
    """
    from dataclasses import replace

    from s2p3.synthesis import DOMAINS, Analytic, PathTraced, ViewsLike, add_depth, session_camera
    from s2p3.synthesis import synthesize as render

    at_least(1, workers=workers, count=count)
    at_least(16, samples=samples)
    at_least(0, seed=seed)
    model = _prepared(object, mesh, material, simplify_mm)
    chosen = DOMAINS[domain]
    if views_like is not None:
        chosen = replace(chosen, views=ViewsLike.of(views_like, model.name))
    renderer = Analytic() if backend == "analytic" else PathTraced.here(samples)
    if isinstance(renderer, PathTraced) and renderer.engine.note:
        say(renderer.engine.note)
    with counting("synthesize") as report:
        figures = render(
            model, count, session_camera(intrinsics), seed, out, workers, report, chosen, renderer, executor
        )
    if depth != "none":
        with counting("depth") as report:
            add_depth(out, depth, report)
    say(f"{out}: {count} frames; {figures}")


def _prepared(name: str, mesh: Path | None, material: Path | None, simplify_mm: float | None) -> ObjectModel:
    """The object to render; says what a mesh file was found to be."""
    from dataclasses import replace

    from s2p3.objects import named_object
    from s2p3.simplify import simplify

    model = named_object(name, mesh, material)
    if mesh is not None:
        size = f"{1000 * model.diameter:.1f} mm across, {len(model.faces)} faces, watertight"
        say(f"{name}: {size}; {model.material} of index {model.refractive_index:g}")
        proposal = model.proposed_symmetry()
        if proposal.any and not model.symmetry.any:
            say(f"{name}: {proposal}; if you agree, add to {mesh.with_suffix('.toml')}:\n{proposal.toml}")
    if simplify_mm is None:
        return model
    fewer = simplify(model, simplify_mm / 1000)
    say(
        f"{name}: {len(fewer.model.faces)} of {len(model.faces)} faces, "
        f"at most {1000 * fewer.error_m:.3f} mm off"
    )
    return replace(fewer.model, diameter=model.diameter)


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
    sessions: Sessions = [],  # noqa: B006 (tyro tells a list apart, and nothing changes it)
    *,
    object: RequiredName = "",
    out: RequiredPath = Path(),
    mesh: OptionalPath = None,
    preset: Preset = "fast",
    config: OptionalPath = None,
    threads: int = 1,
    describe: bool = False,
    json: bool = False,
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
        describe: train nothing; say what the teacher weighs and costs, what it takes and gives.
        json: with --describe, as JSON.
    """
    if describe:
        _describe("teacher", _experiment(preset, config), json)
        return
    _all_given(object=object, out=out)
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
    sessions: Sessions = [],  # noqa: B006 (tyro tells a list apart, and nothing changes it)
    *,
    object: RequiredName = "",
    out: RequiredPath = Path(),
    mesh: OptionalPath = None,
    teacher: OptionalPath = None,
    preset: Preset = "fast",
    config: OptionalPath = None,
    threads: int = 1,
    describe: bool = False,
    json: bool = False,
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
        describe: train nothing; say what the student weighs and costs, what it takes and gives.
        json: with --describe, as JSON.
    """
    if describe:
        _describe("student", _experiment(preset, config), json)
        return
    _all_given(object=object, out=out)
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


def _some(sessions: list[Path]) -> list[Path]:
    from dataset.errors import ToolkitError

    if not sessions:
        raise ToolkitError("no session to train on; name one or more, made with: s2p3 synthesize")
    return sessions


def _describe(kind: Literal["teacher", "student"], experiment: ExperimentConfig, as_json: bool) -> None:
    from s2p3.networks.describe import describe

    show(describe(kind, experiment), as_json)


def _all_given(**values: str | Path) -> None:
    """Raises ToolkitError: an option that a training needs is missing."""
    from dataset.errors import ToolkitError

    missing = [f"--{name}" for name, value in values.items() if value in ("", Path())]
    if missing:
        raise ToolkitError(
            f"{' and '.join(missing)} missing; a training needs an object and an output folder"
        )


def _experiment(preset: Preset, config: Path | None) -> ExperimentConfig:
    from s2p3.config import PRESETS, load

    return PRESETS[preset]() if config is None else load(config)


def _use_threads(threads: int) -> None:
    import torch

    at_least(1, threads=threads)
    torch.set_num_threads(threads)
