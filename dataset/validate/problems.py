"""What a check reports, and the guarded view of a file that checks read through."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import h5py
import numpy as np

from dataset.session.files import READ_ERRORS


@dataclass(frozen=True)
class Problem:
    """Something wrong with a session.

    Attributes:
        where: path inside the file, with the frame where there is one.
        what: what is wrong, with the numbers.
        hint: what to do about it.
    """

    where: str
    what: str
    hint: str

    def __str__(self) -> str:
        return f"{self.where}: {self.what}; {self.hint}"


class View:
    """A session as checks see it: what is missing or unreadable reads as None, having been reported once.

    Args:
        path: of the file.
        file: open for reading.
    """

    def __init__(self, path: Path, file: h5py.File) -> None:
        self.path = path
        self.file = file
        self.unusable: set[str] = set()
        self.unreadable: list[Problem] = []

    def dataset(self, path: str) -> h5py.Dataset | None:
        """A dataset that has the declared type and shape; otherwise None."""
        if path in self.unusable:
            return None
        node = self.file.get(path)
        return node if isinstance(node, h5py.Dataset) else None

    def read(self, path: str) -> Any:
        """A dataset's whole content as a numpy array; None where there is none to be had."""
        node = self.dataset(path)
        if node is None:
            return None
        try:
            return node[()]
        except READ_ERRORS as error:
            self.unusable.add(path)
            self.unreadable.append(
                Problem(path, f"cannot be read ({error})", "copy the file again from its source")
            )
            return None

    def names(self, group: str) -> list[str]:
        """The members of a group; empty where it is absent."""
        node = self.file.get(group)
        return list(node) if isinstance(node, h5py.Group) else []


def first_frames(wrong: np.ndarray[Any, Any]) -> str:
    """The indices of the first true entries of (N,) bool, for a message."""
    indices = np.flatnonzero(wrong)
    shown = ", ".join(str(i) for i in indices[:5])
    return shown if len(indices) <= 5 else f"{shown} and {len(indices) - 5} more"


def instances(view: View, declared_path: str) -> Iterator[tuple[str, str]]:
    """(path, name) of every place a declared path stands for; name is "" without a `*`."""
    before, star, after = declared_path.partition("*")
    if not star:
        yield declared_path, ""
        return
    for name in view.names(before.rstrip("/")):
        yield before + name + after, name
