"""A scene of HouseCat6D as a session.

`SCENE/pol/NNNNNN_{0,45,90,135}.png` (RGB, 8 bit), `depth/NNNNNN.png` (millimetres), `instance/NNNNNN.png`
(the instance number in the red channel), `labels/NNNNNN_label.pkl` (rotations and translations by instance
number), `intrinsics.txt` (3x3), `meta.txt` (lines "instance class name"), and the meshes
`obj_models_small_size_final/CLASS/NAME.obj` beside the scenes. Source: the data set of Jung et al. (CVPR
2024) and its visualization tool, which says how labels and meshes belong together. That tool does not read
`pol`: how its files are named there is our assumption, and other names are refused.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from dataset.bop.layout import read_image
from dataset.errors import ToolkitError
from dataset.importers.mosaics import angle_images, colour_mosaic
from dataset.importers.plain_pickle import read_plain_pickle
from dataset.importers.target import (
    Imported,
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

MODELS = "obj_models_small_size_final"

_MATERIALS = {"glass": ("glass", 1.52), "cutlery": ("steel", 2.75)}
"""Of the two photometrically hard classes, after the S2P3 paper's table; others count as plastic, 1.5."""

_LEVEL = 4


@dataclass(frozen=True)
class _Instance:
    """A line of meta.txt."""

    number: int
    name: str

    @property
    def kind(self) -> str:
        """The class, which is the first word of the name."""
        return self.name.split("-")[0]


def import_housecat6d(
    scene: str | Path,
    out: str | Path,
    *,
    mesh_units: Unit,
    pose_units: Unit,
    models: str | Path | None = None,
) -> int:
    """Writes one scene as a session, with meshes, poses, visible masks and depth.

    Args:
        scene: its folder.
        out: of the session to be.
        mesh_units, pose_units: of the meshes and of the translations in the labels.
        models: folder of the meshes; the one beside the scene when None.

    Returns:
        The number of frames.

    Raises:
        ToolkitError: files are missing or malformed, a label is more than plain arrays, or lengths that
            cannot be.
        SessionError: the session exists.
    """
    scene = Path(scene)
    folder = scene.parent / MODELS if models is None else Path(models)
    numbers = _numbers(scene)
    instances = _instances(scene / "meta.txt")
    labels = [read_plain_pickle(scene / "labels" / f"{number:06d}_label.pkl") for number in numbers]
    first = angle_images(scene, numbers[0])
    height, width = first.shape[1:3]
    seen = [set(np.unique(_numbered(scene, number)).tolist()) for number in numbers]
    objects = []
    for instance in instances:
        matrices = _poses(scene, labels, instance, UNITS[pose_units])
        check_distances(instance.name, matrices[:, :3, 3])
        # the labels do not say how much is hidden: 1 where anything is seen (our choice)
        fractions = np.array([float(instance.number in found) for found in seen])
        masks = ReadWhenAsked(len(numbers), partial(_mask, scene, numbers, instance.number))
        objects.append(annotated(_record(folder, instance, mesh_units), matrices, masks, fractions))
    depth = None
    if (scene / "depth").is_dir():
        depth = ReadWhenAsked(len(numbers), lambda row: _depth(scene, numbers[row]))
    try:
        matrix = np.loadtxt(scene / "intrinsics.txt").reshape(3, 3)
    except (OSError, ValueError) as error:
        raise ToolkitError(
            f"{scene}/intrinsics.txt is not a 3x3 matrix ({error}); check the folder"
        ) from error
    imported = Imported(
        camera=sensor("colour", _LEVEL * height, _LEVEL * width, 8),
        intrinsics=mosaic_intrinsics(matrix, _LEVEL, height, width),
        frame_ids=np.array(numbers),
        origin=f"HouseCat6D {scene.resolve().name}",
        objects=objects,
        depth=depth,
    )

    def mosaics() -> Iterator[Raw]:
        for number in numbers:
            yield colour_mosaic(angle_images(scene, number))

    return write_imported(out, imported, mosaics())


def _numbers(scene: Path) -> list[int]:
    numbers = sorted(int(path.name.split("_")[0]) for path in (scene / "pol").glob("*_0.png"))
    if not numbers:
        found = next((path.name for path in sorted((scene / "pol").glob("*"))), "nothing")
        raise ToolkitError(
            f"{scene}/pol holds no NNNNNN_0.png (but {found}); split its images into NNNNNN_0.png, _45, _90 "
            "and _135"
        )
    return numbers


def _numbered(scene: Path, number: int) -> NDArray[np.uint8]:
    """(h, w) the number of the instance that each pixel shows, 0 where none."""
    image: NDArray[np.uint8] = read_image(scene / "instance" / f"{number:06d}.png")
    return image if image.ndim == 2 else image[..., 0]


def _mask(scene: Path, numbers: list[int], instance: int, row: int) -> NDArray[np.bool_]:
    return np.asarray(_numbered(scene, numbers[row]) == instance)


def _depth(scene: Path, number: int) -> NDArray[np.uint16]:
    return read_image(scene / "depth" / f"{number:06d}.png").astype(np.uint16)


def _instances(path: Path) -> list[_Instance]:
    if not path.is_file():
        raise ToolkitError(f"{path} is missing; check that the folder is complete")
    rows = [line.split() for line in path.read_text(encoding="utf-8").splitlines() if line.strip()]
    if any(len(row) != 3 or not row[0].isdigit() or "-" not in row[2] for row in rows):
        raise ToolkitError(f"{path}: every line must be 'instance class class-name'; check the file")
    return [_Instance(int(row[0]), row[2]) for row in rows]


def _poses(
    scene: Path, labels: list[dict[str, object]], instance: _Instance, unit: float
) -> NDArray[np.float64]:
    matrices = np.tile(np.eye(4), (len(labels), 1, 1))
    for row, label in enumerate(labels):
        try:
            matrices[row, :3, :3] = np.asarray(label["rotations"])[instance.number - 1]
            matrices[row, :3, 3] = np.asarray(label["translations"])[instance.number - 1].astype(float) * unit
        except (KeyError, IndexError, TypeError, ValueError) as error:
            raise ToolkitError(
                f"{scene}: label {row} has no pose of instance {instance.number} ({error})"
            ) from error
    return matrices


def _record(folder: Path, instance: _Instance, unit: Unit) -> ObjectRecord:
    vertices, faces = read_mesh(folder / instance.kind / f"{instance.name}.obj", UNITS[unit])
    check_mesh(instance.name, vertices)
    material, index = _MATERIALS.get(instance.kind, ("plastic", 1.5))
    return ObjectRecord(instance.name, vertices, faces, material, index, 0.0, "{}", diameter(vertices))
