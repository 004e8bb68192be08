"""Opening and laying out session files: the only place that calls `h5py.File`.

A recording grows in HDF5's single-writer-multiple-readers mode, in which the file on disk is consistent at
every moment, so that a process killed at any instant leaves what it had flushed.
"""

from __future__ import annotations

import errno
import fcntl
import os
import sys
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

import h5py
import numpy as np
from numpy.typing import ArrayLike, NDArray

from dataset.compression import filter_options
from dataset.errors import SessionError
from dataset.schema import FORMAT, MAJOR, TABLES, VERSION, Dataset, declaration
from dataset.session.seals import leave_open, plain, seal
from dataset.session.superblock import HealedFile
from dataset.whole_files import replacing

LIBVER = ("v110", "v110")
"""File format of HDF5 1.10: the oldest with single-writer-multiple-readers, readable by everything since."""

KEPT_FREE_BYTES = 16 << 20
"""What a write must leave free: the rest of the arm's trace needs room, and HDF5 can neither close a file on
a full disk nor, in the same process, open it again (our choice)."""

READ_ERRORS = (OSError, RuntimeError, KeyError, ValueError)
"""What h5py raises, depending on the place, when bytes in the file do not make sense."""


def create(path: Path) -> h5py.File:
    """A new empty file.

    Raises:
        SessionError: the path exists or cannot be written, or the disk is full.
    """
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        _check_room(path, KEPT_FREE_BYTES)
        return h5py.File(path, "x", libver=LIBVER)
    except FileExistsError as error:
        raise SessionError(f"{path} already exists; choose another name or remove it first") from error
    except OSError as error:
        why = os.strerror(error.errno) if error.errno else str(error).splitlines()[0]
        raise SessionError(
            f"{path} cannot be created ({why}); check the folder and its permissions"
        ) from error


def check_new(path: Path) -> None:
    """Makes the folder of a file to be. Raises SessionError where the file exists."""
    if path.exists():
        raise SessionError(f"{path} already exists; choose another name or remove it first")
    path.parent.mkdir(parents=True, exist_ok=True)


@contextmanager
def create_whole(path: Path, needs_bytes: int) -> Iterator[h5py.File]:
    """A new session file, which is sealed and appears under its name when the block is left without an
    exception; otherwise nothing is left.

    Args:
        path: of the file to be.
        needs_bytes: about how large it becomes.

    Raises:
        SessionError: the path exists or cannot be written, or the disk has no room.
    """
    check_new(path)
    _check_room(path, needs_bytes)
    try:
        with replacing(path) as partial, h5py.File(partial, "w", libver=LIBVER) as file:
            yield file
            seal(file)
    except (OSError, RuntimeError) as error:
        raise SessionError(
            f"{path} cannot be written ({str(error).splitlines()[0]}); check the folder, who may write, and "
            "the free disk space"
        ) from error


def open_for_reading(path: Path) -> tuple[h5py.File, bool]:
    """Opens a session, and says whether it was left open by its writer (still recording, or killed).

    Raises:
        SessionError: missing, not HDF5, damaged, not a session, or of a newer major version.
    """
    file, unfinished = open_hdf5(path)
    try:
        check_format(path, file)
    except SessionError:
        file.close()
        raise
    return file, unfinished


def open_hdf5(path: Path) -> tuple[h5py.File, bool]:
    """As `open_for_reading`, of any HDF5 file.

    Raises:
        SessionError: missing, not HDF5, or damaged.
    """
    if path.is_fifo():  # opening one waits for whoever may write to it
        raise SessionError(f"{path} is a pipe, so no session; check the path")
    try:
        return h5py.File(path, "r"), False
    except OSError as error:
        if "already open for write" not in str(error):
            raise _explained(path, error) from error
    if not in_use(path):
        return open_healed(path), True
    try:
        return h5py.File(path, "r", libver=LIBVER, swmr=True), True
    except OSError as error:
        raise SessionError(f"{path} is being changed by another program; wait for it or close it") from error


def open_healed(path: Path) -> h5py.File:
    """Opens what a killed writer, a full disk or a short copy left; parts of it may not be readable.

    Raises:
        SessionError: not even the table of contents can be read.
    """
    try:
        return h5py.File(HealedFile(path), "r")
    except OSError as error:
        raise SessionError(
            f"{path} is damaged beyond repair ({str(error).splitlines()[0]}); use a copy of it"
        ) from error


@contextmanager
def open_for_editing(path: Path, needs_bytes: int = 0) -> Iterator[h5py.File]:
    """Opens a finished session for adding to it; the file is closed, hence consistent, on leaving.

    Args:
        path: of the session.
        needs_bytes: about how much is added, images aside.

    Raises:
        SessionError: as `open_for_reading`, the recording is incomplete, or the disk has no room.
    """
    if path.is_file() and in_use(path):
        raise SessionError(f"{path} is in use by another program; wait for it or close it")
    file, unfinished = open_for_reading(path)
    complete = not unfinished and bool(file.attrs.get("complete", False))
    file.close()
    if not complete:
        raise SessionError(f"{path} is incomplete; run first: s2p3 dataset repair {path}")
    with changing(path, needs_bytes) as file:
        yield file


@contextmanager
def changing(path: Path, needs_bytes: int = 0) -> Iterator[h5py.File]:
    """As `open_for_editing`, of an incomplete session, too.

    Raises:
        SessionError: as `open_to_write`, or a write fails.
    """
    file = open_to_write(path, needs_bytes)
    try:
        with file:
            yield file
            seal(file)
    except (OSError, RuntimeError) as error:
        raise SessionError(
            f"{path} could not be written ({str(error).splitlines()[0]}), which costs no frame; check the "
            f"free disk space, run s2p3 dataset repair {path}, and repeat what was being added"
        ) from error


def open_to_write(path: Path, needs_bytes: int = 0) -> h5py.File:
    """Opens a file that was closed cleanly.

    Raises:
        SessionError: missing, damaged or in use, or the disk has no room.
    """
    try:
        _check_room(path, needs_bytes + KEPT_FREE_BYTES)
        return h5py.File(path, "r+", libver=LIBVER)
    except OSError as error:
        raise _explained(path, error) from error


@contextmanager
def closed_on_failure(path: Path, file: h5py.File) -> Iterator[None]:
    """Closes a file whose first bytes cannot be written. Raises SessionError: says so."""
    try:
        yield
    except (OSError, RuntimeError) as error:
        with suppress(OSError, RuntimeError):
            file.close()
        raise SessionError(
            f"{path} cannot be written ({str(error).splitlines()[0]}); check the free disk space"
        ) from error


def hold(path: Path) -> int:
    """Marks a file as in use, for `in_use` in any process, until the returned descriptor is closed.

    HDF5 itself gives its lock up once a file may be read while it grows. Where the file system has no
    locks, files simply count as not in use.
    """
    descriptor = os.open(path, os.O_RDONLY)
    with suppress(OSError):
        fcntl.flock(descriptor, fcntl.LOCK_SH | fcntl.LOCK_NB)
    return descriptor


def room(path: Path) -> int:
    """Bytes that can still be written to the disk that a file is on; no end of them where it does not say."""
    disk = os.statvfs(path)
    return disk.f_bavail * disk.f_frsize if disk.f_blocks else sys.maxsize


def require_room(path: Path, bytes_: int) -> None:
    """Raises OSError unless the disk takes so many bytes and keeps `KEPT_FREE_BYTES`."""
    if room(path) < bytes_ + KEPT_FREE_BYTES:
        raise OSError(f"{KEPT_FREE_BYTES >> 20} MB are left on the disk")


def in_use(path: Path) -> bool:
    """Whether any program has the session open: recording, changing or reading it."""
    descriptor = os.open(path, os.O_RDONLY)
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        return True
    except OSError:
        return False
    finally:
        os.close(descriptor)
    return False


def check_format(path: Path, file: h5py.File) -> None:
    """Refuses a file that is no session, or of a schema newer than this toolkit.

    Raises:
        SessionError: with what was found.
    """
    with reading(path):
        found, version = attribute(file, "format"), str(attribute(file, "schema"))
    if found != FORMAT:
        raise SessionError(
            f"{path} is HDF5 but no session: its format attribute is {found!r}, expected {FORMAT!r}; "
            "convert it with: s2p3 dataset import"
        )
    major = version.split(".")[0]
    if not major.isdigit():
        raise SessionError(f"{path}: the schema version {version!r} is not MAJOR.MINOR; the file is damaged")
    if int(major) < MAJOR:
        raise SessionError(
            f"{path} has schema {version}, this toolkit reads {MAJOR}.x; bring it up with: "
            f"s2p3 dataset convert {path} --out NEW.h5"
        )
    if int(major) > MAJOR:
        raise SessionError(
            f"{path} has schema {version}, this toolkit reads up to {VERSION}; upgrade the toolkit, whose "
            f"`s2p3 dataset convert` also brings sessions of schema {MAJOR}.x to {major}.x"
        )


@contextmanager
def reading(path: Path, part: str = "its table of contents") -> Iterator[None]:
    """Turns what h5py raises on damaged bytes into a `SessionError` that says what to do."""
    try:
        yield
    except READ_ERRORS as error:
        raise SessionError(
            f"{path}: {part} is damaged ({str(error).splitlines()[0]}); copy the file again from its "
            f"source, or save what is left with: s2p3 dataset repair {path}"
        ) from error


def attribute(node: h5py.Group, name: str) -> Any:
    """An attribute as a plain Python value; None where it is absent."""
    return plain(node.attrs.get(name))


def make_dataset(
    file: h5py.File, declared: Dataset, path: str, data: ArrayLike | None, shape: tuple[int, ...], dtype: Any
) -> h5py.Dataset:
    """Creates a dataset as the schema declares it, with its units and description; `seal` the file when done.

    Args:
        file: open for writing.
        declared: its declaration; a dataset with `chunk` rows may grow along its first axis.
        path: where, with the `*` of the declaration filled in.
        data: the initial content, or None.
        shape, dtype: of the content.
    """
    options: dict[str, Any] = {}
    if declared.chunk:
        options = {"maxshape": (None, *shape[1:]), "chunks": (declared.chunk, *shape[1:])}
    if declared.compressed:
        options.update(filter_options())
    dataset = file.create_dataset(path, shape=shape, dtype=dtype, data=data, **options)
    dataset.attrs["units"] = declared.units
    dataset.attrs["description"] = declared.description
    if not declared.compressed:
        leave_open(dataset)
    return dataset


def put_array(file: h5py.File, declared_path: str, data: NDArray[Any], name: str = "") -> None:
    """`make_dataset` of an array as it is; `name` stands for the `*` in the declaration's path."""
    path = declared_path.replace("*", name)
    make_dataset(file, declaration(declared_path), path, data, data.shape, data.dtype)


def dtype_of(declared: Dataset) -> Any:
    """The dtype h5py should use for a declared dataset with one possible type."""
    kind = declared.dtypes[0]
    if kind in TABLES:
        return np.dtype(TABLES[kind])
    return h5py.string_dtype() if kind == "text" else np.dtype("<" + kind)


def _check_room(path: Path, needs_bytes: int) -> None:
    if room(path if path.exists() else path.parent) < needs_bytes:
        raise SessionError(
            f"{path} needs {needs_bytes / 1e9:.2f} GB of free disk space; make room and repeat"
        )


def _explained(path: Path, error: OSError) -> SessionError:
    message = str(error)
    if isinstance(error, FileNotFoundError) or not path.exists():
        return SessionError(f"{path} does not exist; check the path")
    if path.is_dir():
        return SessionError(f"{path} is a folder; name one session file in it")
    if isinstance(error, PermissionError):
        return SessionError(f"{path} may not be opened ({error.strerror}); check its permissions")
    if error.errno in (errno.EAGAIN, errno.EACCES) or "unable to lock file" in message:
        return SessionError(f"{path} is in use by another program; wait for it or close it")
    if "file signature not found" in message:
        return SessionError(f"{path} is not an HDF5 file, so no session; check the path")
    return SessionError(
        f"{path} is damaged or truncated ({message.splitlines()[0]}); copy it again from its source, "
        f"or save what is left with: s2p3 dataset repair {path}"
    )
