"""Whole training sets: scenes rendered by several workers, written as one session of kind "synthetic".

A frame depends on the seed and its index alone, so that it is the same however many workers share the work.
Until the set is complete its frames lie in a folder beside the session; a set that was interrupted goes on
there. Beside the session come its manifest and a picture of how informative it is.
"""

from __future__ import annotations

import time
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from dataset import SE3, CameraInfo, Intrinsics, RawFrame, SessionError, ToolkitError
from dataset.importers.target import ReadWhenAsked
from dataset.progress import Progress, silent
from dataset.session import (
    Chunk,
    ObjectPoses,
    PackedMasks,
    SessionWriter,
    check_name,
    write_object,
    write_poses,
)
from dataset.session.edit import write_depth
from s2p3.objects import ObjectModel
from s2p3.synthesis.analytic_scene import Analytic
from s2p3.synthesis.depth import DepthSensor
from s2p3.synthesis.domain import SYNTHETIC, Domain
from s2p3.synthesis.executors import Executor, rendered
from s2p3.synthesis.frames import BITS, Part, Recipe
from s2p3.synthesis.informativeness import Informativeness
from s2p3.synthesis.manifest import beside, request_of, write_manifest
from s2p3.synthesis.parts import Parts
from s2p3.synthesis.scene import Backend


def synthesize(
    model: ObjectModel,
    count: int,
    intrinsics: Intrinsics,
    seed: int,
    out: str | Path,
    workers: int = 1,
    on_progress: Progress = silent,
    domain: Domain = SYNTHETIC,
    backend: Backend | None = None,
    executor: Executor = "local",
    depth: DepthSensor | None = None,
) -> Informativeness:
    """Render a training set and write it as a session; its camera is at the base frame's origin.

    Args:
        model: the object; it rests on the table.
        count: frames.
        intrinsics: of the working image, a pinhole such as `session_camera` gives.
        seed: the same seed, the same frames.
        out: session file to write.
        workers: processes, or actors of one CPU each.
        on_progress: called with (frames done, count).
        domain: what scenes are drawn from.
        backend: what renders them; `Analytic()` when None.
        executor: "local" processes or "ray".
        depth: the depth camera that sees every frame, too; none when None.

    Returns:
        How much the set says about shape, measured on its first frames.

    Raises:
        ToolkitError: `out` exists, another process is at it or it was begun otherwise, the object cannot be
            seen in these views or has no name for a session, or backend or executor are not installed.
    """
    out = Path(out)
    if out.exists():
        raise SessionError(f"{out} exists; remove it or choose another name")
    if count < 1:
        raise ToolkitError(f"{out}: a set needs at least one frame, not {count}")
    check_name(model.name)
    recipe = Recipe(model, intrinsics.pinhole, domain, backend or Analytic(), seed, depth)
    with Parts.of(out, request_of(recipe)) as parts:
        missing = parts.missing(count)
        for done, (index, part) in enumerate(
            rendered(recipe, missing, workers, executor), start=count - len(missing) + 1
        ):
            parts.store(index, part)
            on_progress(done, count)
        return _assemble(recipe, parts, count, out)


def _assemble(recipe: Recipe, parts: Parts, count: int, out: Path) -> Informativeness:
    """Write the session from its parts, under another name until it and all beside it are complete."""
    height, width = 2 * recipe.intrinsics.height, 2 * recipe.intrinsics.width
    matrix = recipe.intrinsics.K.copy()
    matrix[:2] *= 2
    matrix[:2, 2] += 0.5  # the working pixel's centre lies between the four pixels of its cell
    backend = recipe.backend.name
    camera = CameraInfo("s2p3", backend, f"seed {recipe.seed}", "", "Mono12", "mono", width, height, BITS, 0)
    unfinished = parts.folder / "session.h5"
    unfinished.unlink(missing_ok=True)
    poses, visible, boxes, masks, figures, entries = [], [], [], [], [], []
    pixels = np.broadcast_to(np.zeros((), np.uint16), (height, width))
    mosaic = Intrinsics(matrix, np.zeros(0), height, width)
    with SessionWriter(unfinished, "synthetic", camera, intrinsics=mosaic) as writer:
        for index in range(count):
            part = Part(parts.path(index))
            now = time.monotonic_ns()
            frame = RawFrame(pixels, "Mono12", index, now, now, 1.0, 0.0, 0)
            writer.add_frame(frame, Chunk(part["chunk"].tobytes(), int(part["crc32"])))
            poses.append(SE3.from_matrix(part["T_cam_obj"]))
            visible.append(float(part["visible_fraction"]))
            boxes.append(part["bbox_xywh"])
            masks.append(part["mask"])
            entries.append(part.manifest)
            if part.figures is not None:
                figures.append(part.figures)
    write_object(unfinished, recipe.model.to_record())
    shape = (recipe.intrinsics.height, recipe.intrinsics.width)
    truth = ObjectPoses(SE3.stack(poses), np.array(visible), np.array(boxes), PackedMasks(masks, shape))
    write_poses(unfinished, SE3.identity((count,)), 0.0, 0.0, {recipe.model.name: truth})
    if recipe.depth is not None:
        depths = ReadWhenAsked[NDArray[np.uint16]](count, lambda index: Part(parts.path(index))["depth"])
        write_depth(unfinished, depths)
    result = Informativeness.mean(figures)
    write_manifest(out, recipe, result, entries)
    result.draw(beside(out, "informativeness.png"), f"{recipe.model.name}, {backend}, {count} frames")
    unfinished.rename(out)
    return result
