"""A scene of a BOP data set as a session."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dataset.bop.layout import EXTRA, MM, decode_stokes, read_image, read_json, tables_of
from dataset.bop.models import read_models
from dataset.errors import ToolkitError
from dataset.importers.mosaics import stokes_mosaic
from dataset.importers.target import (
    Imported,
    ImportedObject,
    ReadWhenAsked,
    annotated,
    mosaic_intrinsics,
    sensor,
    write_imported,
)
from dataset.polarimetry import Raw
from dataset.session import ObjectRecord
from dataset.transforms import SE3

_BITS = 16


def import_bop(scene: str | Path, out: str | Path) -> int:
    """Writes one scene as a session, with meshes, poses, visible masks and depth.

    The images are the 16-bit Stokes images of an export; their mosaic is rebuilt for a monochrome sensor,
    without distortion. A BOP data set has no times, so all are stored as unknown.

    Args:
        scene: folder of the scene, such as DATASET/test/000000.
        out: of the session to be.

    Returns:
        The number of frames.

    Raises:
        ToolkitError: files are missing or malformed, the scene has no polarization, or its images differ in
            camera.
        SessionError: the session exists.
    """
    scene = Path(scene)
    with tables_of(scene):
        imported, ids = _described(scene)

    def mosaics() -> Iterator[Raw]:
        for image in ids:
            yield stokes_mosaic(decode_stokes(read_image(_stokes_file(scene, image))), _BITS)

    return write_imported(out, imported, mosaics())


def _described(scene: Path) -> tuple[Imported, list[str]]:
    """All but the mosaics, and the ids of the images."""
    root = scene.parent.parent
    cameras: dict[str, Any] = read_json(scene / "scene_camera.json")
    truth, infos = read_json(scene / "scene_gt.json"), read_json(scene / "scene_gt_info.json")
    if not (scene / "stokes").is_dir():
        raise ToolkitError(
            f"{scene} has no folder stokes: its images are not polarized, so they are of no use here; "
            "export with: s2p3 dataset export-bop"
        )
    described = read_json(root / EXTRA)["objects"] if (root / EXTRA).is_file() else {}
    records = read_models(root, described)
    ids = sorted(cameras, key=int)
    if not ids:
        raise ToolkitError(f"{scene} lists no image; check scene_camera.json")
    matrices = np.array([cameras[image]["cam_K"] for image in ids], dtype=np.float64).reshape(-1, 3, 3)
    if np.ptp(matrices, axis=0).max() > 0:
        raise ToolkitError(
            f"{scene}: its images have different cam_K, a session has one camera; split the scene"
        )
    height, width = read_image(_stokes_file(scene, ids[0])).shape[:2]
    depth = None
    if (scene / "depth").is_dir():
        scales = [float(cameras[image].get("depth_scale", 1.0)) for image in ids]
        depth = ReadWhenAsked(len(ids), lambda row: _depth(scene, ids[row], scales[row]))
    objects = [
        _object(scene, object_id, record, ids, truth, infos, (height, width))
        for object_id, record in records.items()
    ]
    imported = Imported(
        camera=sensor("mono", 2 * height, 2 * width, _BITS),
        intrinsics=mosaic_intrinsics(matrices[0], 2, height, width),
        frame_ids=np.array([int(image) for image in ids]),
        objects=[found for found in objects if found.T_cam_obj.finite.any()],
        T_base_cam=_base(cameras, ids),
        depth=depth,
        origin=f"BOP scene {scene.resolve().parent.parent.name}/{scene.parent.name}/{scene.name}",
    )
    return imported, ids


def _stokes_file(scene: Path, image: str) -> Path:
    return scene / "stokes" / f"{int(image):06d}.png"


def _depth(scene: Path, image: str, scale: float) -> NDArray[np.uint16]:
    """Millimetres."""
    counts = read_image(scene / "depth" / f"{int(image):06d}.png")
    return np.clip(np.rint(counts * scale), 0, 65535).astype(np.uint16)


def _object(
    scene: Path,
    object_id: int,
    record: ObjectRecord,
    ids: list[str],
    truth: dict[str, Any],
    infos: dict[str, Any],
    size: tuple[int, int],
) -> ImportedObject:
    matrices = np.full((len(ids), 4, 4), np.nan)
    fractions = np.zeros(len(ids))
    files: list[Path | None] = [None] * len(ids)
    for row, image in enumerate(ids):
        found = [index for index, entry in enumerate(truth[image]) if entry["obj_id"] == object_id]
        if len(found) > 1:
            raise ToolkitError(
                f"{scene}: image {image} shows object {object_id} {len(found)} times, a session holds one of "
                "each; split the scene"
            )
        for index in found:
            entry = truth[image][index]
            matrices[row] = np.eye(4)
            matrices[row, :3, :3] = np.array(entry["cam_R_m2c"]).reshape(3, 3)
            matrices[row, :3, 3] = np.array(entry["cam_t_m2c"]) / MM
            fractions[row] = infos[image][index]["visib_fract"]
            files[row] = scene / "mask_visib" / f"{int(image):06d}_{index:06d}.png"

    def mask(row: int) -> NDArray[np.bool_]:
        file = files[row]
        return np.zeros(size, dtype=bool) if file is None else read_image(file) > 0

    return annotated(record, matrices, ReadWhenAsked(len(ids), mask), fractions)


def _base(cameras: dict[str, Any], ids: list[str]) -> SE3 | None:
    if not any("cam_R_w2c" in cameras[image] for image in ids):
        return None
    matrices = np.full((len(ids), 4, 4), np.nan)
    for row, image in enumerate(ids):
        if "cam_R_w2c" in cameras[image]:
            matrices[row] = np.eye(4)
            matrices[row, :3, :3] = np.array(cameras[image]["cam_R_w2c"]).reshape(3, 3)
            matrices[row, :3, 3] = np.array(cameras[image]["cam_t_w2c"]) / MM
    return SE3.from_matrix(matrices).inverse()
