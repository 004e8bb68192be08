"""Guarded access to an open session file: whatever is missing or damaged becomes a `SessionError`."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import h5py
import numpy as np
from numpy.typing import NDArray

from dataset.compression import checksum
from dataset.errors import SessionError
from dataset.schema import checksums_of
from dataset.session.files import attribute, reading
from dataset.session.seals import intact


class Contents:
    """The groups, datasets and attributes of an open file.

    Args:
        path: of the file, for messages.
        file: open for reading.
    """

    def __init__(self, path: Path, file: h5py.File) -> None:
        self.path = path
        self._file = file
        self._checked: set[str] = set()

    def close(self) -> None:
        """Closes the file."""
        self._file.close()

    def has(self, path: str) -> bool:
        """Whether the file holds this group or dataset."""
        with reading(self.path):
            return path in self._open_file()

    def names(self, group: str) -> tuple[str, ...]:
        """The members of a group; none where it is absent."""
        with reading(self.path):
            file = self._open_file()
            return tuple(file[group]) if group in file else ()

    def attribute(self, group: str, name: str) -> Any:
        """An attribute as a plain Python value; None where it is absent.

        Raises:
            SessionError: the group's attributes do not match their checksum.
        """
        with reading(self.path, f"the description of {group}"):
            node = self._open_file()[group]
            if group not in self._checked:
                if not intact(node):
                    raise _damaged(self.path, f"the description of {group}")
                self._checked.add(group)
            return attribute(node, name)

    def length(self, path: str) -> int:
        """Rows of a dataset."""
        return int(self._dataset(path).shape[0])

    def read(self, path: str, rows: slice | int = slice(None)) -> Any:
        """Rows of a dataset as a numpy array; all of them unless told.

        Raises:
            SessionError: absent or damaged; only a dataset that is read whole is held against its checksum.
        """
        dataset = self._dataset(path)
        with reading(self.path, f"{path}[{rows}]" if isinstance(rows, int) else path):
            data = dataset[rows]
            whole = not isinstance(rows, int) and len(data) == len(dataset)
            if whole and not intact(dataset, data):
                raise _damaged(self.path, path)
        return data

    def image(self, path: str, index: int) -> Any:
        """One image of a dataset of images, held against its checksum (masks of schema 1.0 have none).

        Raises:
            SessionError: absent or damaged.
        """
        image, checksums = self.read(path, index), checksums_of(path)
        if self.has(checksums) and checksum(image) != int(self.read(checksums, index)):
            raise _damaged(self.path, f"{path}[{index}]")
        return image

    def text(self, path: str) -> str:
        """A dataset that holds one string."""
        dataset = self._dataset(path)
        with reading(self.path, path):
            if not intact(dataset):
                raise _damaged(self.path, path)
            return str(dataset.asstr()[()])

    def _dataset(self, path: str) -> h5py.Dataset:
        with reading(self.path):
            found = self._open_file()[path] if self.has(path) else None  # `get` hides damage
        if not isinstance(found, h5py.Dataset):
            raise SessionError(f"{self.path} lacks {path}; see: s2p3 dataset validate {self.path}")
        return found

    def _open_file(self) -> h5py.File:
        if not self._file:
            raise SessionError(f"{self.path} is closed; open it again")
        return self._file


class StoredMasks:
    """Masks in a file, read one at a time.

    Args:
        contents: of the file; must stay open.
        path: of the (N, h, w) dataset.
    """

    def __init__(self, contents: Contents, path: str) -> None:
        self._contents = contents
        self._path = path

    def __len__(self) -> int:
        return self._contents.length(self._path)

    def __getitem__(self, index: int, /) -> NDArray[np.bool_]:
        mask: NDArray[np.bool_] = self._contents.image(self._path, index) != 0
        return mask


def _damaged(path: Path, part: str) -> SessionError:
    return SessionError(
        f"{path}: {part} is damaged (it does not match its checksum); copy the file again from its source, "
        f"see: s2p3 dataset validate {path}"
    )
