"""Adding to a finished session what was computed from it: calibration, objects, poses, splits."""

from __future__ import annotations

import hashlib
import re
from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path

import h5py
import numpy as np
from numpy.typing import ArrayLike, DTypeLike, NDArray

from dataset.compression import compress
from dataset.errors import SessionError
from dataset.frames import SUPERPIXEL
from dataset.intrinsics import Intrinsics
from dataset.polarizer_response import PolarizerResponse
from dataset.schema import Dataset, checksums_of, declaration
from dataset.session.files import dtype_of, make_dataset, open_for_editing, put_array, require_room
from dataset.session.records import Image, Images, ObjectPoses, ObjectRecord
from dataset.session.seals import leave_open
from dataset.transforms import SE3

_NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9_.\-]*")


def write_calibration(
    path: str | Path,
    json_text: str,
    intrinsics: Intrinsics | None,
    response: PolarizerResponse | None = None,
) -> None:
    """Stores the calibration that was applied, replacing an earlier one; poses, boxes and masks that were
    computed with that are removed.

    Args:
        path: of a complete session.
        json_text: the whole calibration.json, kept verbatim with its sha256.
        intrinsics: at the mosaic's grid; None where they are not known yet.
        response: of the sensor's polarizers, if calibrated: from then on Stokes images are computed with it.

    Raises:
        SessionError: the file cannot be edited, or the calibration is for another image size.
    """
    path = Path(path)
    with open_for_editing(path, 0 if response is None else response.analysis.nbytes) as file:
        size = _mosaic_size(file)
        if intrinsics is not None and (intrinsics.height, intrinsics.width) != size:
            raise SessionError(
                f"{path}: the intrinsics are for {intrinsics.width}x{intrinsics.height} pixels, the mosaic "
                f"has {size[1]}x{size[0]}; calibrate at the mosaic's resolution"
            )
        if response is not None and response.shape != size:
            raise SessionError(
                f"{path}: the polarizer response is for {response.shape[1]}x{response.shape[0]} pixels, the "
                f"mosaic has {size[1]}x{size[0]}; calibrate the polarizers at the mosaic's resolution"
            )
        for outdated in ("calibration", "poses"):
            if outdated in file:
                del file[outdated]
        if intrinsics is not None:
            store_intrinsics(file, intrinsics)
        if response is not None:
            declared = declaration("calibration/polarizer_response")
            make_dataset(
                file, declared, declared.path, response.analysis, response.analysis.shape, np.float32
            )
        declared = declaration("calibration/json")
        make_dataset(file, declared, declared.path, json_text, (), dtype_of(declared))
        file["calibration"].attrs["sha256"] = hashlib.sha256(json_text.encode()).hexdigest()
        leave_open(file["calibration"])


def write_object(path: str | Path, record: ObjectRecord) -> None:
    """Stores an object's mesh and material, replacing one of the same name.

    Raises:
        SessionError: the file cannot be edited, the name is not a plain word, or the arrays are no mesh.
    """
    with open_for_editing(Path(path), record.vertices.nbytes + record.faces.nbytes) as file:
        store_object(file, record)


def write_poses(
    path: str | Path,
    T_base_cam: SE3,
    sigma_t: ArrayLike,
    sigma_r: ArrayLike,
    objects: Mapping[str, ObjectPoses],
) -> None:
    """Stores the camera's and the objects' poses of every frame, replacing earlier ones.

    Args:
        path: of a complete session with N frames.
        T_base_cam: N camera poses at mid-exposure; NaN where unknown.
        sigma_t: metres, one number or (N,).
        sigma_r: radians, one number or (N,).
        objects: by name; each must be among the session's objects.

    Raises:
        SessionError: the file cannot be edited, sizes differ from the session's, or an object is unknown.
    """
    path = Path(path)
    with open_for_editing(path) as file:
        count = len(file["camera/raw"])
        _require(path, "T_base_cam", T_base_cam.batch, (count,))
        for name, poses in objects.items():
            if f"objects/{name}" not in file:
                raise SessionError(f"{path} holds no object {name!r}; store its mesh first with write_object")
            _require(path, f"T_cam_obj of {name}", poses.T_cam_obj.batch, (count,))
            _require(path, f"visible_fraction of {name}", np.shape(poses.visible_fraction), (count,))
            _require(path, f"bbox_xywh of {name}", np.shape(poses.bbox_xywh), (count, 4))
            _require(path, f"masks of {name}", (len(poses.masks),), (count,))
        if "poses" in file:
            del file["poses"]
        _store(file, "poses/T_base_cam", _matrices(T_base_cam))
        _store(file, "poses/sigma_t", np.broadcast_to(sigma_t, (count,)))
        _store(file, "poses/sigma_r", np.broadcast_to(sigma_r, (count,)))
        for name, poses in objects.items():
            _store_object_poses(file, path, name, poses)


def write_split(path: str | Path, name: str, indices: ArrayLike) -> None:
    """Stores a named split, replacing one of the same name.

    Args:
        path: of a complete session.
        name: such as "train".
        indices: frame indices; stored in increasing order.

    Raises:
        SessionError: the file cannot be edited, an index is repeated or out of range.
    """
    path = Path(path)
    check_name(name)
    with open_for_editing(path) as file:
        count = len(file["camera/raw"])
        chosen = np.sort(np.asarray(indices, dtype=np.int64).ravel())
        if len(chosen) and (chosen[0] < 0 or chosen[-1] >= count):
            raise SessionError(f"{path}: split {name!r} names frames outside 0..{count - 1}")
        if np.any(np.diff(chosen) == 0):
            raise SessionError(f"{path}: split {name!r} names a frame twice")
        if f"splits/{name}" in file:
            del file[f"splits/{name}"]
        make_dataset(file, declaration("splits/*"), f"splits/{name}", chosen, chosen.shape, np.int64)


def write_origin(path: str | Path, origin: str) -> None:
    """Notes what a session was made from, where it is no recording of its own.

    Raises:
        SessionError: the file cannot be edited.
    """
    with open_for_editing(Path(path)) as file:
        file.attrs["origin"] = origin
        leave_open(file)


def write_depth(path: str | Path, images: Images[NDArray[np.uint16]]) -> None:
    """Stores the depth of every frame, replacing an earlier one.

    Args:
        path: of a complete session with N frames.
        images: N of them, (h, w) uint16, millimetres, 0: unknown, in the undistorted polarization image.

    Raises:
        SessionError: the file cannot be edited, or the images do not fit its frames.
    """
    path = Path(path)
    with open_for_editing(path) as file:
        block = SUPERPIXEL[file["camera"].attrs["mosaic"]]
        height, width = _mosaic_size(file)
        shape = (len(file["camera/raw"]), height // block, width // block)
        _require(path, "depth", (len(images), *shape[1:]), shape)
        for name in ("depth", "depth_crc32"):
            if name in file:
                del file[name]
        store_images(file, declaration("depth"), _of_size(path, "depth", images, shape[1:]), shape, np.uint16)


def store_intrinsics(file: h5py.File, intrinsics: Intrinsics) -> None:
    """Writes /calibration/K and distortion into an open file."""
    _store(file, "calibration/K", intrinsics.K)
    _store(file, "calibration/distortion", intrinsics.distortion)


def store_object(file: h5py.File, record: ObjectRecord) -> None:
    """Writes /objects/<name> into an open file, replacing one of the same name."""
    check_name(record.name)
    vertices, faces = np.asarray(record.vertices), np.asarray(record.faces)
    if vertices.ndim != 2 or vertices.shape[1] != 3 or faces.ndim != 2 or faces.shape[1] != 3:
        raise SessionError(
            f"object {record.name}: vertices {vertices.shape} and faces {faces.shape} are no triangle mesh; "
            "give (V, 3) and (F, 3)"
        )
    if f"objects/{record.name}" in file:
        del file[f"objects/{record.name}"]
    for part, data, dtype in (("vertices", vertices, "<f8"), ("faces", faces, "<i4")):
        declared = declaration(f"objects/*/{part}")
        make_dataset(file, declared, f"objects/{record.name}/{part}", data, data.shape, dtype)
    file[f"objects/{record.name}"].attrs.update(
        {
            "material": record.material,
            "refractive_index": float(record.refractive_index),
            "extinction": float(record.extinction),
            "symmetry": record.symmetry,
            "diameter": float(record.diameter),
            "sha256": record.sha256,
        }
    )
    leave_open(file[f"objects/{record.name}"])


def store_images(
    file: h5py.File,
    declared: Dataset,
    images: Iterable[NDArray[np.uint8] | NDArray[np.uint16]],
    shape: tuple[int, int, int],
    dtype: DTypeLike,
    name: str = "",
) -> None:
    """Writes a dataset of images, each compressed, and their checksums into an open file.

    Args:
        file: open for writing.
        declared: the images' declaration; `name` stands for the `*` in its path.
        images: N of them, each (h, w).
        shape, dtype: (N, h, w) and their type.

    Raises:
        OSError: the disk has no room for an image.
    """
    beside, checksums = declaration(checksums_of(declared.path)), np.zeros(shape[0], np.uint32)
    stored_checksums = make_dataset(  # before the images: what a cut leaves out must not read as black
        file, beside, beside.path.replace("*", name), checksums, checksums.shape, np.uint32
    )
    stored = make_dataset(file, declared, declared.path.replace("*", name), None, shape, dtype)
    for index, image in enumerate(images):
        chunk = compress(image)
        require_room(Path(file.filename), len(chunk.data))
        stored.id.write_direct_chunk((index, 0, 0), chunk.data)
        checksums[index] = chunk.crc32
    stored_checksums[:] = checksums


def _store_object_poses(file: h5py.File, path: Path, name: str, poses: ObjectPoses) -> None:
    columns = (
        ("T_cam_obj", _matrices(poses.T_cam_obj)),
        ("visible_fraction", poses.visible_fraction),
        ("bbox_xywh", poses.bbox_xywh),
    )
    for part, data in columns:
        _store(file, f"poses/objects/*/{part}", data, name)
    block = SUPERPIXEL[file["camera"].attrs["mosaic"]]
    height, width = _mosaic_size(file)
    size = (height // block, width // block)
    count = len(poses.masks)

    masks = (np.asarray(mask, dtype=bool) for mask in _of_size(path, f"mask of {name}", poses.masks, size))
    bytes_ = (mask.view(np.uint8) for mask in masks)
    store_images(file, declaration("poses/objects/*/mask"), bytes_, (count, *size), np.uint8, name)


def _of_size(path: Path, what: str, images: Images[Image], size: tuple[int, int]) -> Iterator[Image]:
    """The images, one after another. Raises SessionError: one is of another size."""
    for index in range(len(images)):
        image = images[index]
        _require(path, f"{what} in frame {index}", image.shape, size)
        yield image


def _matrices(poses: SE3) -> NDArray[np.float64]:
    """(N, 4, 4), wholly NaN where a pose is unknown."""
    matrices = poses.as_matrix()
    matrices[~poses.finite] = np.nan
    return matrices


def _store(file: h5py.File, declared_path: str, data: ArrayLike, name: str = "") -> None:
    put_array(file, declared_path, np.asarray(data, np.float64), name)


def _mosaic_size(file: h5py.File) -> tuple[int, int]:
    attrs = file["camera"].attrs
    return int(attrs["height"]), int(attrs["width"])


def check_name(name: str) -> None:
    """Raises a SessionError unless a session can hold an object or a split of this name."""
    if not _NAME.fullmatch(name):
        raise SessionError(f"the name {name!r} may hold only letters, digits, '_', '-' and '.'")


def _require(path: Path, what: str, found: tuple[int, ...], expected: tuple[int, ...]) -> None:
    if tuple(found) != expected:
        raise SessionError(f"{path}: {what} has shape {tuple(found)}, the session needs {expected}")
