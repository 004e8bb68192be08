"""Seals: a CRC-32 on everything in a session, so that damage is found where plain HDF5 would hand it on.

Images (mosaics, masks, depth) have one checksum each, in a dataset beside them. Everything else carries its
own as the attribute `crc32`: a dataset that of its bytes, a group that of the attributes listed in its
attribute `crc32_of`, so that a file may be given further ones. HDF5 itself checks its metadata, but neither
contiguous arrays nor texts of variable length.
"""

from __future__ import annotations

import json
import zlib
from collections.abc import Iterator
from typing import Any

import h5py
import numpy as np
from numpy.typing import NDArray

SEAL = "crc32"
COVERED = "crc32_of"
OPEN = -1
"""What the attribute holds while its array or group is being written."""

CHANGING = ("complete", "repaired")
"""Attributes of / that are not under its seal: they change after it."""

_ROWS = 65536


def leave_open(node: h5py.Group | h5py.Dataset) -> None:
    """Marks a dataset, or a group with all its attributes, as not sealed: `seal` will, when it is whole."""
    if isinstance(node, h5py.Group):
        node.attrs[COVERED] = " ".join(sorted(set(node.attrs) - {*CHANGING, SEAL, COVERED}))
    node.attrs[SEAL] = np.int64(OPEN)


def reopen(node: h5py.Dataset) -> None:
    """Marks a sealed dataset as being written again."""
    if state(node) not in (None, OPEN):
        node.attrs.modify(SEAL, np.int64(OPEN))


def seal(file: h5py.File) -> None:
    """Seals what is still open in a file open for writing, growing ones included."""
    for node in _walk(file):
        if state(node) == OPEN:
            node.attrs.modify(SEAL, np.int64(digest(node)))


def state(node: h5py.Group | h5py.Dataset) -> int | None:
    """The stored seal, `OPEN`, or None for what carries none."""
    value = node.attrs.get(SEAL)
    return None if value is None else int(value)


def intact(node: h5py.Group | h5py.Dataset, data: NDArray[Any] | None = None) -> bool:
    """Whether content and seal agree; what is not sealed counts as intact.

    Args:
        node: the dataset or group.
        data: the dataset's whole content, where it has been read already.
    """
    found = state(node)
    if found is None or found == OPEN:
        return True
    return found == (digest(node) if data is None else zlib.crc32(np.ascontiguousarray(data).data))


def digest(node: h5py.Group | h5py.Dataset) -> int:
    """CRC-32 of a dataset's bytes in row order (UTF-8 of a text), or of a group's covered attributes as a
    JSON object with sorted names."""
    if isinstance(node, h5py.Group):
        values = {name: plain(node.attrs.get(name)) for name in str(node.attrs[COVERED]).split()}
        return zlib.crc32(json.dumps(values, sort_keys=True).encode())
    if node.dtype.kind == "O":
        return zlib.crc32(str(node.asstr()[()]).encode())
    if node.ndim == 0:
        return zlib.crc32(node[()].tobytes())
    found = 0
    for start in range(0, len(node), _ROWS):
        found = zlib.crc32(np.ascontiguousarray(node[start : start + _ROWS]).data, found)
    return found


def plain(value: Any) -> Any:
    """An attribute's value as a plain Python one."""
    if isinstance(value, bytes):
        return value.decode(errors="replace")
    return value.item() if isinstance(value, np.generic) else value


def _walk(group: h5py.Group) -> Iterator[h5py.Group | h5py.Dataset]:
    yield group
    for name in group:
        node = group[name]
        if isinstance(node, h5py.Group):
            yield from _walk(node)
        else:
            yield node
