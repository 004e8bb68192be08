"""What a synthetic set was made of, beside its session: enough to render any one frame again, to the bit.

`set.manifest.json` holds the request (object, cameras, domain, backend with versions, seed), an entry a frame
(its seeds, pose and scene parameters, and a checksum of the whole scene) and how informative the set is.
"""

from __future__ import annotations

import dataclasses
import json
from importlib import metadata
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dataset import Intrinsics, ToolkitError
from dataset.session import Session
from s2p3.objects import ObjectModel, Symmetry
from s2p3.synthesis.analytic_scene import Analytic
from s2p3.synthesis.domain import Domain
from s2p3.synthesis.frames import Recipe, manifest_of
from s2p3.synthesis.informativeness import Informativeness
from s2p3.synthesis.mitsuba_engine import Engine, find_engine
from s2p3.synthesis.path_traced import PathTraced
from s2p3.synthesis.scene import Backend, SceneImage
from s2p3.synthesis.views import Views, ViewsLike


def beside(session: str | Path, what: str) -> Path:
    """Where something about a synthetic session lies: cup.manifest.json beside cup.h5."""
    path = Path(session)
    return path.with_name(f"{path.name.removesuffix('.h5')}.{what}")


def manifest_path(session: str | Path) -> Path:
    """Where the manifest of a synthetic session lies."""
    return beside(session, "manifest.json")


def request_of(recipe: Recipe) -> dict[str, Any]:
    """A recipe for JSON; the mesh by its checksum: it is in the session."""
    model = recipe.model
    return {
        "toolkit": metadata.version("s2p3"),
        "object": {
            "name": model.name,
            "sha256": model.to_record().sha256,
            "material": model.material,
            "refractive_index": model.refractive_index,
            "extinction": model.extinction,
            "albedo": model.albedo,
            "roughness": model.roughness,
        },
        "camera": {
            "K": recipe.intrinsics.K.tolist(),
            "height": recipe.intrinsics.height,
            "width": recipe.intrinsics.width,
        },
        "domain": dataclasses.asdict(recipe.domain),
        "backend": recipe.backend.describe(),
        "seed": recipe.seed,
        "depth": recipe.depth,
    }


def write_manifest(
    session: str | Path, recipe: Recipe, figures: Informativeness, frames: list[dict[str, Any]]
) -> None:
    """Writes the manifest of a session, a line a frame."""
    head = {
        "request": json.dumps(request_of(recipe)),
        "informativeness": figures.to_json(),
        "frames": "[\n" + ",\n".join(map(json.dumps, frames)) + "\n]",
    }
    text = ",\n".join(f'"{name}": {value}' for name, value in head.items())
    manifest_path(session).write_text(f"{{\n{text}\n}}\n", encoding="utf-8")


def recipe_of(session: str | Path) -> tuple[Recipe, list[dict[str, Any]]]:
    """The recipe of a synthetic session, and its frames' entries.

    Raises:
        ToolkitError: it has no manifest, or what rendered it is not what is installed here.
    """
    path = manifest_path(session)
    try:
        manifest = json.loads(path.read_text(encoding="utf-8"))
        request = manifest["request"]
        name, camera = request["object"]["name"], request["camera"]
        model = _stored_object(session, name, request["object"])
        intrinsics = Intrinsics(np.array(camera["K"]), np.zeros(0), camera["height"], camera["width"])
        domain = _domain(request["domain"])
        backend = _backend(request["backend"])
        depth = request.get("depth")  # which the first manifests do not have
        recipe = Recipe(model, intrinsics, domain, backend, request["seed"], depth)
        frames: list[dict[str, Any]] = manifest["frames"]
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise ToolkitError(
            f"{path} cannot be read ({error}); a synthetic session and its manifest belong together"
        ) from error
    now = json.loads(json.dumps(request_of(recipe)))
    changed = [key for key in request if now.get(key) != request[key]]
    if changed:
        was, here = ({key: side.get(key) for key in changed} for side in (request, now))
        raise ToolkitError(
            f"{path}: made with {was}, here is {here}; install those versions to get the same bits"
        )
    return recipe, frames


def render_again(session: str | Path, index: int) -> tuple[SceneImage, NDArray[np.uint16]]:
    """One frame of a synthetic session rendered anew: its noiseless image with truth, and the raw mosaic,
    equal to the stored one to the bit on a machine of the same kind.

    Raises:
        ToolkitError: see `recipe_of`; or there is no such frame, or its scene came out otherwise.
    """
    recipe, frames = recipe_of(session)
    if not 0 <= index < len(frames):
        raise ToolkitError(f"{session} has frames 0 to {len(frames) - 1}, not {index}")
    drawn = recipe.draw(index)
    if manifest_of(drawn, index)["sha256"] != frames[index]["sha256"]:
        raise ToolkitError(
            f"{session}: frame {index} draws another scene than it did; "
            "use the toolkit and numpy it was made with"
        )
    return recipe.render(drawn)


def _stored_object(session: str | Path, name: str, made_of: dict[str, Any]) -> ObjectModel:
    with Session.open(session) as opened:
        record = opened.object(name)
    return ObjectModel(
        name,
        record.vertices,
        record.faces,
        made_of["material"],
        record.refractive_index,
        record.extinction,
        Symmetry.from_json(record.symmetry),
        record.diameter,
        made_of["albedo"],
        made_of["roughness"],
    )


def _domain(values: dict[str, Any]) -> Domain:
    views = {key: _tuples(value) for key, value in values["views"].items()}
    rest = {key: _tuples(value) for key, value in values.items() if key != "views"}
    return Domain(views=ViewsLike(**views) if "poses" in views else Views(**views), **rest)


def _backend(values: dict[str, Any]) -> Backend:
    if values["name"] == Analytic().name:
        return Analytic()
    engine = find_engine()
    if engine.variant != values["variant"]:
        engine = Engine(values["variant"])
    return PathTraced(engine, values["samples"])


def _tuples(value: Any) -> Any:
    return tuple(map(_tuples, value)) if isinstance(value, list) else value
