"""Whether a file has the groups, datasets, types, shapes and attributes the schema declares."""

from __future__ import annotations

from collections.abc import Iterator

import h5py
import numpy as np

from dataset.frames import SUPERPIXEL
from dataset.schema import ATTRIBUTES, DATASETS, TABLES, Attribute, Dataset
from dataset.session.files import READ_ERRORS, attribute
from dataset.session.seals import OPEN, intact, state
from dataset.validate.problems import Problem, View, instances

_RERECORD = "the file was not written by this toolkit, or was changed since; record or import it again"


def check_reachable(view: View) -> Iterator[Problem]:
    """Everything that the table of contents names can be opened."""

    def inside(group: h5py.Group, prefix: str) -> Iterator[Problem]:
        for name in group:
            try:
                node = group[name]
            except READ_ERRORS as error:
                hint = "copy the file again from its source"
                yield Problem(prefix + name, f"cannot be opened ({error})", hint)
                continue
            if isinstance(node, h5py.Group):
                yield from inside(node, f"{prefix}{name}/")

    return inside(view.file, "")


def check_attributes(view: View) -> Iterator[Problem]:
    """Every declared attribute is there, has its type, and holds an allowed value."""
    for declared in ATTRIBUTES:
        for group, _ in instances(view, declared.group):
            node = view.file.get(group)
            if isinstance(node, h5py.Group):
                yield from _check_attribute(node, group, declared)
            elif declared.required and "*" not in group:
                yield Problem(group, f"the group of the attribute {declared.name} is missing", _RERECORD)


def check_datasets(view: View) -> Iterator[Problem]:
    """Every declared dataset is there with its type, shape, units and description.

    Those that are not are marked unusable, so that later checks leave them alone.
    """
    sizes = _sizes(view)
    for declared in DATASETS:
        for path, _ in instances(view, declared.path):
            node = view.file.get(path)
            if node is None:
                if declared.required:
                    yield Problem(path, "is missing", _RERECORD)
            elif not isinstance(node, h5py.Dataset):
                yield Problem(path, "is a group, expected a dataset", _RERECORD)
            else:
                problems = list(_check_dataset(node, path, declared, sizes))
                if problems:
                    view.unusable.add(path)
                yield from problems
                yield from _check_documented(node, path, declared)


def check_seals(view: View) -> Iterator[Problem]:
    """Arrays and descriptions are as they were written, by their checksums."""
    hint = "copy the file again from its source; numbers in it are wrong"
    for declared in DATASETS:
        for path, _ in instances(view, declared.path):
            node = view.dataset(path)
            if node is not None and not declared.compressed:
                yield from _check_seal(view, node, path, hint)
    for group in dict.fromkeys(declared.group for declared in ATTRIBUTES):
        for path, _ in instances(view, group):
            node = view.file.get(path)
            if isinstance(node, h5py.Group):
                yield from _check_seal(view, node, f"{path.rstrip('/')}/@", hint)


def _check_seal(view: View, node: h5py.Group | h5py.Dataset, where: str, hint: str) -> Iterator[Problem]:
    try:
        if not intact(node):
            yield Problem(where, "does not match its checksum", hint)
        elif state(node) == OPEN and attribute(view.file, "complete"):
            yield Problem(where, "was not sealed with a checksum", "an edit was cut short; repeat it")
    except READ_ERRORS as error:
        yield Problem(where, f"cannot be read ({error})", hint)


def _sizes(view: View) -> dict[str, int]:
    """Sizes the letters of the schema stand for in this file, as far as they can be told."""
    sizes = {}
    for letter, path in (("N", "camera/raw"), ("M", "robot/host_time_ns"), ("D", "camera/drops")):
        node = view.dataset(path)
        if node is not None and node.ndim:
            sizes[letter] = int(node.shape[0])
    camera = view.file.get("camera")
    if isinstance(camera, h5py.Group):
        height, width = attribute(camera, "height"), attribute(camera, "width")
        block = SUPERPIXEL.get(attribute(camera, "mosaic"))
        if isinstance(height, int) and isinstance(width, int):
            sizes.update(H=height, W=width)
            if block is not None:
                sizes.update(h=height // block, w=width // block)
    return sizes


def _check_attribute(node: h5py.Group, group: str, declared: Attribute) -> Iterator[Problem]:
    value = attribute(node, declared.name)
    where = f"{group.rstrip('/')}/@{declared.name}"
    if value is None:
        if declared.required:
            yield Problem(where, "is missing", _RERECORD)
        return
    allowed = (int, float) if declared.type is float else (declared.type,)
    if not isinstance(value, allowed) or (declared.type is int and isinstance(value, bool)):
        yield Problem(where, f"holds {value!r}, expected {declared.type.__name__}", _RERECORD)
    elif declared.choices and value not in declared.choices:
        yield Problem(where, f"holds {value!r}, expected one of {', '.join(declared.choices)}", _RERECORD)


def _check_dataset(
    node: h5py.Dataset, path: str, declared: Dataset, sizes: dict[str, int]
) -> Iterator[Problem]:
    if not any(_has_dtype(node, kind) for kind in declared.dtypes):
        expected = " or ".join(declared.dtypes)
        yield Problem(path, f"has type {node.dtype}, expected {expected}", _RERECORD)
    expected_shape = [sizes.get(n, n) if isinstance(n, str) else n for n in declared.shape]
    fits = len(expected_shape) == node.ndim and all(
        isinstance(n, str) or n == found for n, found in zip(expected_shape, node.shape, strict=True)
    )
    if not fits:
        shown = ", ".join(str(n) for n in expected_shape)
        yield Problem(path, f"has shape {node.shape}, expected ({shown})", _RERECORD)


def _has_dtype(node: h5py.Dataset, kind: str) -> bool:
    if kind in TABLES:
        return bool(node.dtype == np.dtype(TABLES[kind]))
    if kind == "text":
        return h5py.check_string_dtype(node.dtype) is not None
    return node.dtype.kind == kind[0] and node.dtype.itemsize == int(kind[1])


def _check_documented(node: h5py.Dataset, path: str, declared: Dataset) -> Iterator[Problem]:
    units = attribute(node, "units")
    if units != declared.units:
        yield Problem(path, f"its units attribute is {units!r}, expected {declared.units!r}", _RERECORD)
    if not attribute(node, "description"):
        yield Problem(path, "has no description attribute", _RERECORD)
