"""Copying what can be read of a session into a new file, frame by frame."""

from __future__ import annotations

from collections.abc import Iterator

import h5py
import numpy as np
from numpy.typing import NDArray

from dataset.compression import compress
from dataset.schema import (
    ATTRIBUTES,
    DATASETS,
    DROP_DTYPE,
    ROBOT_COLUMNS,
    TABLES,
    Dataset,
    checksums_of,
    declaration,
    declared_at,
)
from dataset.session.files import READ_ERRORS, make_dataset
from dataset.session.seals import SEAL, intact

Indices = NDArray[np.int64]


def copy_content(
    source: h5py.File,
    target: h5py.File,
    keep: Indices,
    gone: Indices,
    reason: bytes = b"damaged in the file",
) -> tuple[str, ...]:
    """Copies a session with only some of its frames.

    Args:
        source: open for reading, perhaps damaged.
        target: open for writing, empty.
        keep: frames to copy; everything that has one row a frame is cut to these, splits are renumbered.
        gone: frames to enter in the ledger instead, with the `reason`.

    Returns:
        Paths that could not be read and are left out.
    """
    lost: list[str] = []
    target.attrs.update(dict(source.attrs))
    samples = _readable_samples(source)
    for path, node in _walk(source, "", lost):
        declared = declared_at(path)
        try:
            if isinstance(node, h5py.Group):
                target.require_group(path).attrs.update(dict(node.attrs))
            elif path == "camera/drops":
                _copy_drops(source, target, gone, reason)
            elif declared is not None and declared.compressed:
                lost += _copy_images(source, target, declared, path, keep)
            elif declared is not None:
                data = _rows(node, declared, keep, samples)
                copied = make_dataset(target, declared, path, data, data.shape, node.dtype)
                if not intact(node):  # stays visible: a fresh seal would call the damage good
                    copied.attrs.modify(SEAL, node.attrs[SEAL])
            else:
                source.copy(node, target, name=path)
        except READ_ERRORS:
            lost.append(path)
            target.pop(path, None)
    _drop_undescribed(target, lost)
    _restore_required(target)
    return tuple(lost)


def _walk(group: h5py.Group, prefix: str, lost: list[str]) -> Iterator[tuple[str, h5py.Group | h5py.Dataset]]:
    try:
        names = list(group)
    except READ_ERRORS:
        lost.append(prefix.rstrip("/"))
        return
    for name in names:
        path = prefix + name
        try:
            node = group[name]
        except READ_ERRORS:
            lost.append(path)
            continue
        yield path, node
        if isinstance(node, h5py.Group):
            yield from _walk(node, path + "/", lost)


def _rows(node: h5py.Dataset, declared: Dataset, keep: Indices, samples: int) -> NDArray[np.generic]:
    first = declared.shape[0] if declared.shape else None
    if first == "N":
        return _frame_rows(node, keep)
    if first == "M":
        return np.asarray(node[:samples])
    if declared.path == "splits/*":
        chosen = node[:]
        return np.searchsorted(keep, chosen[np.isin(chosen, keep)])
    if declared.path == "segments":
        segments = node[:]
        segments["first_frame"] = np.searchsorted(keep, segments["first_frame"])
        return np.asarray(segments)
    if declared.path == "clocks/camera_pieces":
        pieces = node[:]
        pieces[:, 0] = np.searchsorted(keep, pieces[:, 0])
        return np.asarray(pieces)
    return np.asarray(node[()], dtype=node.dtype)


def _frame_rows(node: h5py.Dataset, keep: Indices) -> NDArray[np.generic]:
    """Rows of these frames; NaN, hence unknown, for frames whose row had not been written yet."""
    count = int(keep[-1]) + 1 if len(keep) else 0
    stored: NDArray[np.generic] = node[:count]
    if len(stored) < count:
        if stored.dtype.kind != "f":
            raise ValueError(f"{node.name} has {len(stored)} rows for {count} frames")
        unknown = np.full((count - len(stored), *stored.shape[1:]), np.nan, stored.dtype)
        stored = np.concatenate([stored, unknown])
    return stored[keep]


def _copy_images(
    source: h5py.File, target: h5py.File, declared: Dataset, path: str, keep: Indices
) -> list[str]:
    """Copies the images that can be read and returns the paths of the others, whose checksums, copied too,
    go on to say that they are damaged."""
    node, lost = source[path], []
    stored = make_dataset(target, declared, path, None, (len(keep), *node.shape[1:]), node.dtype)
    for row, index in enumerate(keep):
        try:
            stored.id.write_direct_chunk((row, 0, 0), compress(node[int(index)]).data)
        except READ_ERRORS:
            if checksums_of(path) not in source:
                raise
            lost.append(f"{path}[{index}]")
    return lost


def _copy_drops(source: h5py.File, target: h5py.File, gone: Indices, reason: bytes) -> None:
    declared = declaration("camera/drops")
    ids, times = source["camera/frame_id"], source["camera/host_time_ns"]
    rows = [(int(ids[int(i)]), reason, int(times[int(i)])) for i in gone]
    ledger = np.concatenate([source["camera/drops"][:], np.array(rows, dtype=DROP_DTYPE)])
    make_dataset(target, declared, declared.path, ledger, ledger.shape, ledger.dtype)


def _readable_samples(source: h5py.File) -> int:
    """Rows that every column of the robot's trace has; none when one of them cannot be read."""
    try:
        return min(len(source[f"robot/{name}"][:]) for name in ROBOT_COLUMNS)
    except READ_ERRORS:
        return 0


def _drop_undescribed(target: h5py.File, lost: list[str]) -> None:
    """Removes objects without their description, which nobody could use."""
    needed = {attribute.name for attribute in ATTRIBUTES if attribute.group == "/objects/*"}
    for path in [f"objects/{name}" for name in target.get("objects", ())]:
        if not needed <= set(target[path].attrs):
            del target[path]
            lost += [path] if path not in lost else []


def _restore_required(target: h5py.File) -> None:
    """Empty stand-ins for what every session has and this one lost."""
    for declared in DATASETS:
        if not declared.required or "*" in declared.path or declared.path in target:
            continue
        kind = np.dtype(TABLES.get(declared.dtypes[0], declared.dtypes[0]))
        shape = tuple(n if isinstance(n, int) else 0 for n in declared.shape)
        fill = np.full(shape, np.nan if kind.kind == "f" else 0, dtype=kind) if 0 not in shape else None
        make_dataset(target, declared, declared.path, fill, shape, kind)
