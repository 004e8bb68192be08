"""`s2p3 synthesize`: from an object to training images."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Literal

from s2p3.commands.arguments import (
    ObjectName,
    OptionalNumber,
    OptionalPath,
    at_least,
)
from s2p3.console_output import counting, say

if TYPE_CHECKING:
    from s2p3.objects import ObjectModel


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
    domain: Literal["plain", "synthetic", "captured"] = "synthetic",
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
        views_like: session whose poses of the object the views are distributed like; those of its split
            train, where it has one.
        domain: synthetic to train on; plain varies less; captured has a denser material, harder light, more
            noise, occlusion.
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

    from s2p3.synthesis import DOMAINS, Analytic, PathTraced, ViewsLike, session_camera
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
            model,
            count,
            session_camera(intrinsics),
            seed,
            out,
            workers,
            report,
            chosen,
            renderer,
            executor,
            None if depth == "none" else depth,
        )
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
        proposal, declared = model.proposed_symmetry(), model.has_its_symmetry()
        if not declared:
            say(f"{name}: warning: the symmetry in its material file is not that of its shape, but is used")
        if proposal.any and not (model.symmetry.any and declared):
            say(f"{name}: {proposal}; if you agree, write into its material file:\n{proposal.toml}")
    if simplify_mm is None:
        return model
    fewer = simplify(model, simplify_mm / 1000)
    say(
        f"{name}: {len(fewer.model.faces)} of {len(model.faces)} faces, "
        f"at most {1000 * fewer.error_m:.3f} mm off"
    )
    return replace(fewer.model, diameter=model.diameter)
