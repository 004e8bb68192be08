"""The layout of PPP-Net's instance-level data as a session.

`ROOT/OBJECT/pol/NNNNNN_{0,45,90,135}.png` (RGB, 8 bit), `mask_visib/`, `scene_gt.json`, `scene_gt_info.json`,
text files with the image numbers of a split, and `ROOT/models/`. Source: "Polarimetric Pose Prediction" (Gao
et al., ECCV 2022) and the data set that goes with it.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dataset.bop.layout import read_image, read_json, tables_of
from dataset.errors import ToolkitError
from dataset.importers.mosaics import angle_images, colour_mosaic
from dataset.importers.target import (
    Imported,
    ImportedObject,
    ReadWhenAsked,
    annotated,
    mosaic_intrinsics,
    sensor,
    write_imported,
)
from dataset.importers.units import UNITS, Unit, check_distances, check_mesh
from dataset.meshes import diameter, read_mesh
from dataset.polarimetry import Raw
from dataset.session import ObjectRecord

K_612x512 = ((351.450, 0.0, 303.646), (0.0, 351.477, 251.423), (0.0, 0.0, 1.0))
"""Intrinsics published with the data, at 612x512."""

REFRACTIVE_INDICES = {"knife": 2.75, "fork": 2.75, "bottle": 1.52, "cup": 1.50, "can": 1.35, "teapot": 1.54}

_LEVEL = 4  # mosaic pixels per pixel of an angle image


def import_ppp_net(
    folder: str | Path, out: str | Path, *, mesh: str | Path, mesh_units: Unit, pose_units: Unit
) -> int:
    """Writes one object's images as a session, with its mesh, poses, visible masks and splits.

    Args:
        folder: of the object, such as ROOT/cup.
        out: of the session to be.
        mesh: PLY, OBJ or STL of the object.
        mesh_units, pose_units: of the mesh and of cam_t_m2c; the published scene_gt.json is in metres, unlike
            BOP's.

    Returns:
        The number of frames.

    Raises:
        ToolkitError: files are missing or malformed, or lengths that cannot be.
        SessionError: the session exists.
    """
    folder = Path(folder)
    numbers = sorted({int(path.name.split("_")[0]) for path in (folder / "pol").glob("*_0.png")})
    if not numbers:
        raise ToolkitError(f"{folder / 'pol'} holds no NNNNNN_0.png; name the folder of one object")
    name = folder.resolve().name
    vertices, faces = read_mesh(Path(mesh), UNITS[mesh_units])
    check_mesh(name, vertices)
    record = ObjectRecord(
        name=name,
        vertices=vertices,
        faces=faces,
        material="steel" if name in ("knife", "fork") else "plastic",
        refractive_index=REFRACTIVE_INDICES.get(name, 1.5),
        extinction=0.0,
        symmetry=_symmetry(name),
        diameter=diameter(vertices),
    )
    size = angle_images(folder, numbers[0]).shape[1:3]
    with tables_of(folder):
        found = _annotation(folder, record, numbers, size, UNITS[pose_units])
        matrix = _matrix(folder, numbers[0], size)
    check_distances(name, found.T_cam_obj.translation)
    imported = Imported(
        camera=sensor("colour", _LEVEL * size[0], _LEVEL * size[1], 8),
        intrinsics=mosaic_intrinsics(matrix, _LEVEL, *size),
        frame_ids=np.array(numbers),
        origin=f"PPP-Net data, object {name}",
        objects=[found],
        splits=_splits(folder, numbers),
    )

    def mosaics() -> Iterator[Raw]:
        for number in numbers:
            yield colour_mosaic(angle_images(folder, number))

    return write_imported(out, imported, mosaics())


def _annotation(
    folder: Path, record: ObjectRecord, numbers: list[int], size: tuple[int, int], unit: float
) -> ImportedObject:
    truth, infos = read_json(folder / "scene_gt.json"), read_json(folder / "scene_gt_info.json")
    matrices, fractions = np.full((len(numbers), 4, 4), np.nan), np.zeros(len(numbers))
    masks: list[Path | None] = [None] * len(numbers)
    for row, number in enumerate(numbers):
        entry, info = _first(truth, number), _first(infos, number)
        if entry is None:
            continue
        matrices[row] = np.eye(4)
        matrices[row, :3, :3] = np.reshape(entry["cam_R_m2c"], (3, 3))
        matrices[row, :3, 3] = np.ravel(entry["cam_t_m2c"]) * unit
        masks[row] = _mask_file(folder, number)
        fractions[row] = 1.0 if info is None else min(1.0, float(info.get("visib_fract", 1.0)))

    def mask(row: int) -> NDArray[np.bool_]:
        path = masks[row]
        return np.zeros(size, dtype=bool) if path is None else _mask(path, size)

    return annotated(record, matrices, ReadWhenAsked(len(numbers), mask), fractions)


def _first(table: dict[str, Any], number: int) -> dict[str, Any] | None:
    entries = table.get(str(number)) or []
    if len(entries) > 1:
        raise ToolkitError(
            f"image {number} shows the object {len(entries)} times; a session holds one of each"
        )
    return entries[0] if entries else None


def _mask_file(folder: Path, number: int) -> Path:
    found = sorted((folder / "mask_visib").glob(f"{number:06d}*.png"))
    if len(found) != 1:
        raise ToolkitError(
            f"{folder}/mask_visib holds {len(found)} masks of image {number:06d}, expected one"
        )
    return found[0]


def _mask(path: Path, size: tuple[int, int]) -> NDArray[np.bool_]:
    mask = read_image(path)
    mask = mask if mask.ndim == 2 else mask.max(axis=2)
    if mask.shape != size:
        raise ToolkitError(f"{path} is {mask.shape}, the images are {size}")
    inside: NDArray[np.bool_] = mask > 0
    return inside


def _matrix(folder: Path, number: int, size: tuple[int, int]) -> NDArray[np.float64]:
    """cam_K of scene_camera.json where there is one, otherwise the published one, which is for 612x512."""
    if (folder / "scene_camera.json").is_file():
        return np.reshape(read_json(folder / "scene_camera.json")[str(number)]["cam_K"], (3, 3))
    if size != (512, 612):
        raise ToolkitError(
            f"{folder} has images of {size[1]}x{size[0]}, the published intrinsics are for 612x512; "
            "put a scene_camera.json with cam_K beside scene_gt.json"
        )
    return np.array(K_612x512)


def _symmetry(name: str) -> str:
    turning = '[{"axis": [0, 0, 1], "offset": [0, 0, 0]}]' if name == "bottle" else "[]"
    return f'{{"symmetries_discrete": [], "symmetries_continuous": {turning}}}'


def _splits(folder: Path, numbers: list[int]) -> dict[str, NDArray[np.int64]]:
    """Text files with the number of an image on each line; what names other images is not a split."""
    found = {}
    for path in sorted(folder.glob("*.txt")):
        words = path.read_text(encoding="utf-8").split()
        chosen = [int(match[1]) for word in words if (match := re.search(r"(\d+)(?:\.png)?$", word))]
        if chosen and set(chosen) <= set(numbers):
            found[path.stem] = np.unique(np.searchsorted(numbers, chosen)).astype(np.int64)
    return found
