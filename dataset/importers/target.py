"""What every importer ends in: frames, and what is known about them, as one session."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Generic

import numpy as np
from numpy.typing import ArrayLike, NDArray

from dataset.errors import ToolkitError
from dataset.frames import CameraInfo, Mosaic, RawFrame
from dataset.intrinsics import Intrinsics
from dataset.polarimetry import Raw
from dataset.session import (
    ObjectPoses,
    ObjectRecord,
    SessionWriter,
    mask_box,
    write_object,
    write_poses,
    write_split,
)
from dataset.session.edit import write_depth, write_origin
from dataset.session.files import check_new
from dataset.session.records import Image, Images, Masks
from dataset.transforms import SE3
from dataset.whole_files import replacing


@dataclass(frozen=True, eq=False)
class ImportedObject:
    """An object and where it is in N frames.

    Attributes:
        record: mesh and material.
        T_cam_obj: a batch of N, NaN where unknown.
        visible_fraction: (N,) in [0, 1].
        masks: N visible masks (h, w) bool.
    """

    record: ObjectRecord
    T_cam_obj: SE3
    visible_fraction: NDArray[np.float64]
    masks: Masks


@dataclass(frozen=True)
class ReadWhenAsked(Generic[Image]):
    """N images that are read one at a time: a data set need not fit into memory.

    Attributes:
        count: N.
        read: reads one by its index.
    """

    count: int
    read: Callable[[int], Image]

    def __len__(self) -> int:
        return self.count

    def __getitem__(self, index: int, /) -> Image:
        return self.read(index)


@dataclass(frozen=True, eq=False)
class Stamps:
    """Measured times and settings of N frames; a column that nobody measured is unknown.

    Attributes:
        camera_time_ns, host_time_ns: (N,) int64, -1: unknown.
        exposure_us, gain_db: (N,) float64, NaN: unknown.
    """

    camera_time_ns: NDArray[np.int64]
    host_time_ns: NDArray[np.int64]
    exposure_us: NDArray[np.float64]
    gain_db: NDArray[np.float64]

    @staticmethod
    def unknown(count: int) -> Stamps:
        """Nothing is known."""
        times, values = np.full(count, -1, np.int64), np.full(count, np.nan)
        return Stamps(times, times, values, values)


@dataclass(frozen=True, eq=False)
class Imported:
    """Everything about an imported session but its mosaics.

    Attributes:
        camera: its description.
        intrinsics: at the mosaic's grid; None where unknown.
        frame_ids: (N,) increasing.
        origin: what it was imported from.
        objects: what is annotated.
        T_base_cam: N camera poses, or None.
        depth: N images (h, w) uint16, millimetres, or None.
        stamps: times and settings, or None.
        splits: frame indices by name.
    """

    camera: CameraInfo
    intrinsics: Intrinsics | None
    frame_ids: NDArray[np.int64]
    origin: str
    objects: Sequence[ImportedObject] = ()
    T_base_cam: SE3 | None = None
    depth: Images[NDArray[np.uint16]] | None = None
    stamps: Stamps | None = None
    splits: Mapping[str, NDArray[np.int64]] = field(default_factory=dict)


def write_imported(out: str | Path, imported: Imported, mosaics: Iterable[Raw]) -> int:
    """Writes a session and returns its number of frames; on an error, no file is left.

    Raises:
        SessionError: the file exists or cannot be written.
        ToolkitError: a mosaic does not fit the camera.
    """
    out = Path(out)
    check_new(out)
    with replacing(out) as partial:
        _write(partial, imported, mosaics)
    return len(imported.frame_ids)


def sensor(mosaic: Mosaic, height: int, width: int, bits: int) -> CameraInfo:
    """The description of a camera nothing more is known about."""
    name = ("BayerRG" if mosaic == "colour" else "Mono") + str(bits)
    return CameraInfo("unknown", "imported", "", "", name, mosaic, width, height, bits, 0)


def mosaic_intrinsics(K: ArrayLike, level: int, height: int, width: int) -> Intrinsics:
    """Intrinsics at the mosaic's grid from those (3, 3) of the image (height, width) with one pixel per
    `level` x `level` super-pixel: the inverse of `Intrinsics.at`."""
    matrix = np.array(K, dtype=np.float64)
    matrix[:2] *= level
    matrix[:2, 2] += (level - 1) / 2
    return Intrinsics(matrix, np.zeros(0), level * height, level * width)


def annotated(
    record: ObjectRecord,
    matrices: NDArray[np.float64],
    masks: Masks,
    fractions: NDArray[np.float64],
) -> ImportedObject:
    """An object from (N, 4, 4) poses whose rotations other tools may have stored with few digits."""
    known = np.asarray(np.isfinite(matrices).all(axis=(1, 2)))
    seen = known[:, None, None]
    u, _, v = np.linalg.svd(np.where(seen, matrices[:, :3, :3], np.eye(3)))
    nearest = u @ v
    off = np.abs(nearest - np.where(seen, matrices[:, :3, :3], nearest)).max(initial=0)
    if off > 1e-2 or (np.linalg.det(nearest) < 0).any():
        raise ToolkitError(f"the poses of {record.name} hold a matrix that is no rotation (off by {off:.2g})")
    rotation = np.where(seen, nearest, np.nan)
    return ImportedObject(record, SE3(rotation, matrices[:, :3, 3]), fractions, masks)


def _write(path: Path, imported: Imported, mosaics: Iterable[Raw]) -> None:
    count = len(imported.frame_ids)
    stamps = imported.stamps or Stamps.unknown(count)
    camera = imported.camera
    with SessionWriter(path, "sequence", camera, intrinsics=imported.intrinsics) as writer:
        for index, pixels in enumerate(mosaics):
            writer.add_frame(
                RawFrame(
                    pixels,
                    camera.pixel_format,
                    int(imported.frame_ids[index]),
                    int(stamps.camera_time_ns[index]),
                    int(stamps.host_time_ns[index]),
                    float(stamps.exposure_us[index]),
                    float(stamps.gain_db[index]),
                    0,
                )
            )
        for lost in np.setdiff1d(np.arange(*imported.frame_ids[[0, -1]]), imported.frame_ids):
            writer.add_drop(int(lost), "not in the imported data", -1)
    write_origin(path, imported.origin)
    if imported.depth is not None:
        write_depth(path, imported.depth)
    for found in imported.objects:
        write_object(path, found.record)
    if imported.objects or imported.T_base_cam is not None:
        unknown = SE3.from_matrix(np.full((count, 4, 4), np.nan))
        poses = {
            found.record.name: ObjectPoses(
                found.T_cam_obj,
                found.visible_fraction,
                np.stack([mask_box(found.masks[index]) for index in range(count)]),
                found.masks,
            )
            for found in imported.objects
        }
        write_poses(path, imported.T_base_cam or unknown, np.nan, np.nan, poses)
    for name, indices in imported.splits.items():
        write_split(path, name, indices)
