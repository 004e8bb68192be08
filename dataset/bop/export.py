"""Sessions as a BOP data set that the BOP toolkit loads and scores."""

from __future__ import annotations

import re
import shutil
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dataset.bop.layout import ENCODING, EXTRA, read_json, tables_of, write_json
from dataset.bop.models import write_models
from dataset.bop.scene import Drawn, Scene
from dataset.errors import SessionError, ToolkitError
from dataset.intrinsics import Intrinsics
from dataset.progress import Progress, silent
from dataset.session import ObjectRecord, Session
from dataset.subset import require_complete

_SPLIT = re.compile(r"(train|val|test)(_[A-Za-z0-9]+)?")


def export_bop(
    paths: Sequence[str | Path],
    out: str | Path,
    draw: Drawn,
    split: str = "test",
    frames: str | None = None,
    on_progress: Progress = silent,
) -> Path:
    """Writes annotated sessions as the scenes of one split of a BOP data set; their images are undistorted.

    Image ids are frame indices, scene ids the order of the sessions, object ids the order of the objects'
    names, from 1. `rgb` (colour sensors) or `gray` is the mean over the polarizer angles, 8 bit, linear.
    Without depth, px_count_valid is 0. Boxes follow the BOP toolkit: width is last minus first column.

    Args:
        paths: of complete, annotated sessions.
        out: a folder to be, or an export that lacks this split and has the same objects.
        draw: draws the whole silhouettes; sessions hold the visible ones.
        split: the BOP name of the split, such as "test" or "train_real".
        frames: name of the session's split to which the export is limited; all frames when None.
        on_progress: called with (frames written, frames in all).

    Returns:
        The folder.

    Raises:
        SessionError: a session is incomplete, damaged, not calibrated or not annotated.
        ToolkitError: the folder holds something else, the split's name is not BOP's, or objects of one name
            differ.
    """
    out, sessions = Path(out), [Path(path) for path in paths]
    if not _SPLIT.fullmatch(split):
        raise ToolkitError(f"--split {split}: BOP's are train, val and test, with a type such as train_real")
    records = _objects(sessions)
    ids = {name: index for index, name in enumerate(sorted(records), start=1)}
    described = {str(ids[name]): _described(record) for name, record in records.items()}
    begun = _begun(out, split, described)
    partial = out / f".{split}.partial"
    try:
        camera, targets = _write_scenes(partial, sessions, records, ids, draw, frames, on_progress)
        if not begun:
            write_json(out / "camera.json", _camera(camera))
            write_models(out, {ids[name]: record for name, record in records.items()})
            write_json(out / EXTRA, {"objects": described, "stokes": ENCODING})
        if split.startswith("test"):
            write_json(out / "test_targets_bop19.json", targets)
        partial.rename(out / split)
    finally:
        shutil.rmtree(partial, ignore_errors=True)
        with suppress(OSError):  # it is not empty
            out.rmdir()
    return out


def _begun(out: Path, split: str, described: dict[str, Any]) -> bool:
    """Whether the folder holds an export that this split can join. Raises ToolkitError: it holds something
    else."""
    if not out.exists() or not any(out.iterdir()):
        return False
    if not (out / EXTRA).is_file():
        raise ToolkitError(f"{out} is not empty; name a new folder for the BOP data set")
    names = {path.name for path in out.iterdir()}
    if split in names or (split.startswith("test") and "test_targets_bop19.json" in names):
        raise ToolkitError(f"{out} has its {split.split('_')[0]} split already; name a new folder")
    with tables_of(out):
        if read_json(out / EXTRA)["objects"] != described:
            raise ToolkitError(f"{out} is of other objects; name a new folder for the BOP data set")
    return True


def _write_scenes(
    folder: Path,
    paths: Sequence[Path],
    records: dict[str, ObjectRecord],
    ids: dict[str, int],
    draw: Drawn,
    frames: str | None,
    on_progress: Progress,
) -> tuple[Intrinsics, list[dict[str, int]]]:
    """Writes one scene a session; returns the first one's camera and the targets of all."""
    shutil.rmtree(folder, ignore_errors=True)
    targets: list[dict[str, int]] = []
    total, done = sum(len(_frames(path, frames)) for path in paths), 0
    cameras = []
    for scene, path in enumerate(paths):
        with Session.open(path) as session:
            annotated = {name: records[name] for name in session.annotated}
            writer = Scene(session, folder / f"{scene:06d}", annotated, ids, draw)
            for index in _frames(path, frames):
                writer.add(int(index))
                done += 1
                on_progress(done, total)
            writer.finish()
            targets += writer.targets(scene)
            cameras.append(session.working_intrinsics)
    return cameras[0], targets


def _frames(path: Path, split: str | None) -> NDArray[np.int64]:
    with Session.open(path) as session:
        require_complete(session)
        return np.arange(len(session)) if split is None else session.frames_in(split)


def _objects(paths: Sequence[Path]) -> dict[str, ObjectRecord]:
    records: dict[str, ObjectRecord] = {}
    for path in paths:
        with Session.open(path) as session:
            annotated = session.annotated
            if not annotated:
                raise SessionError(f"{path} has no annotated object; run: s2p3 annotate {path}")
            for name in annotated:
                record = session.object(name)
                if record.sha256 != records.setdefault(name, record).sha256:
                    raise ToolkitError(
                        f"{path}: its mesh of {name!r} differs from the other sessions'; annotate again"
                    )
    return records


def _camera(camera: Intrinsics) -> dict[str, float]:
    K = camera.K
    sizes = {"cx": K[0, 2], "cy": K[1, 2], "depth_scale": 1.0, "fx": K[0, 0], "fy": K[1, 1]}
    return {name: float(value) for name, value in sizes.items()} | {
        "height": camera.height,
        "width": camera.width,
    }


def _described(record: ObjectRecord) -> dict[str, Any]:
    return {
        "name": record.name,
        "material": record.material,
        "refractive_index": record.refractive_index,
        "extinction": record.extinction,
        "sha256": record.sha256,
    }
