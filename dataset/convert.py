"""Bringing sessions of an older major version to the present one.

A converter is a function from an open old file to an open new one, listed under the version it reads. It
writes by the present schema, so that a later change of the schema changes converters too; an old file is
never changed.

The one here is the worked example. Version 0.9 was a draft that was never released: camera times in
microseconds, poses as position and quaternion, boxes by their corners, and no checksum but the frames'.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import h5py
import numpy as np
from numpy.typing import NDArray

from dataset.compression import checksum
from dataset.errors import SessionError
from dataset.schema import FORMAT, MAJOR, VERSION, declared_at
from dataset.session.files import (
    attribute,
    check_new,
    create_whole,
    make_dataset,
    open_hdf5,
    put_array,
    reading,
)
from dataset.session.seals import leave_open
from dataset.transforms import SE3

Converter = Callable[[h5py.File, h5py.File], None]


def convert(path: str | Path, out: str | Path) -> str:
    """Writes a session of an older major version as one of the present.

    Args:
        path: of the old session, which stays as it is.
        out: of the new one.

    Returns:
        The version converted from.

    Raises:
        SessionError: no session, damaged, of a version that needs no converter or has none here, or the new
            file exists.
    """
    path, out = Path(path), Path(out)
    check_new(out)
    source, unfinished = open_hdf5(path)
    with source:
        with reading(path):
            found, version = attribute(source, "format"), str(attribute(source, "schema"))
        converter = _converter(path, found, version)
        if unfinished or not attribute(source, "complete"):
            raise SessionError(
                f"{path} is incomplete; repair it with the toolkit that wrote it, then convert it"
            )
        with create_whole(out, path.stat().st_size) as target, reading(path, "its content"):
            converter(source, target)
    return version


def _converter(path: Path, found: object, version: str) -> Converter:
    if found != FORMAT:
        raise SessionError(f"{path} is HDF5 but no session; see: s2p3 dataset import --help")
    if version.split(".")[0] == str(MAJOR):
        raise SessionError(
            f"{path} has schema {version}, which this toolkit reads as it is; nothing to convert"
        )
    if version not in CONVERTERS:
        known = ", ".join(CONVERTERS)
        raise SessionError(
            f"{path} has schema {version}; there are converters from {known} to {VERSION} only"
        )
    return CONVERTERS[version]


def _from_0_9(source: h5py.File, target: h5py.File) -> None:
    target.attrs.update(dict(source.attrs) | {"schema": VERSION})
    leave_open(target)

    def copy(path: str, node: h5py.Group | h5py.Dataset) -> None:
        if isinstance(node, h5py.Group):
            group = target.require_group(path)
            group.attrs.update(dict(node.attrs))
            leave_open(group)
        elif path in _CHANGED_IN_0_9 or path.startswith("poses/"):
            return
        elif (declared := declared_at(path)) is None or declared.compressed:
            source.copy(node, target, name=path)
        else:
            make_dataset(target, declared, path, node[()], node.shape, node.dtype)

    source.visititems(copy)
    put_array(
        target, "camera/camera_time_ns", np.rint(1e3 * source["camera/camera_time_us"][:]).astype(np.int64)
    )
    for path in [path for path in ("poses/T_base_cam",) if path in source]:
        put_array(target, path, _matrices(source[path][:]))
        for name in ("poses/sigma_t", "poses/sigma_r"):
            put_array(target, name, source[name][:])
    for name in source.get("poses/objects", ()):
        old = source[f"poses/objects/{name}"]
        corners = old["bbox_xyxy"][:]
        values = {
            "T_cam_obj": _matrices(old["T_cam_obj"][:]),
            "visible_fraction": old["visible_fraction"][:],
            "bbox_xywh": np.concatenate([corners[:, :2], corners[:, 2:] - corners[:, :2]], axis=1),
            "mask_crc32": np.array([checksum(mask) for mask in old["mask"]], np.uint32),
        }
        for part, data in values.items():
            put_array(target, f"poses/objects/*/{part}", data, name)
        source.copy(old["mask"], target, name=f"poses/objects/{name}/mask")


_CHANGED_IN_0_9 = ("camera/camera_time_us",)

CONVERTERS: dict[str, Converter] = {"0.9": _from_0_9}
"""By the version they read."""


def _matrices(pose7: NDArray[np.float64]) -> NDArray[np.float64]:
    """(N, 7) x y z qx qy qz qw, NaN: unknown -> (N, 4, 4)."""
    matrices = np.full((len(pose7), 4, 4), np.nan)
    known = np.isfinite(pose7).all(axis=1)
    matrices[known] = SE3.from_quaternion(pose7[known, 3:], pose7[known, :3]).as_matrix()
    return matrices
