"""A folder of raw mosaics as a session."""

from __future__ import annotations

import csv
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from dataset.errors import ToolkitError
from dataset.frames import CameraInfo, Mosaic
from dataset.importers.target import Imported, Stamps, sensor, write_imported
from dataset.polarimetry import Raw, white_level

_SUFFIXES = (".png", ".tif", ".tiff", ".npy")
_INTEGERS, _NUMBERS = ("camera_time_ns", "host_time_ns"), ("exposure_us", "gain_db")


def import_raw_folder(
    folder: str | Path,
    out: str | Path,
    layout: Mosaic,
    bits: int | None = None,
    stamps: str | Path | None = None,
) -> int:
    """Writes the PNG, TIFF or npy mosaics of a folder, in the order of their names, as a session.

    Args:
        folder: of (H, W) mosaics, 8 or 16 bit.
        out: of the session to be.
        layout: "mono" for cells of 2x2 pixels, "colour" for super-pixels of 4x4.
        bits: significant bits of a value; must be given for 16-bit files, which may hold 10, 12 or 16.
        stamps: a CSV file with a column `file` (names in the folder) and any of camera_time_ns, host_time_ns,
            exposure_us, gain_db; what it does not tell is stored as unknown.

    Returns:
        The number of frames.

    Raises:
        ToolkitError: no or unequal images, ambiguous or wrong bits, or a malformed CSV.
        SessionError: the session exists.
    """
    folder = Path(folder)
    mosaics = RawMosaics.of(folder, layout, bits)
    names = [path.name for path in mosaics.files]
    imported = Imported(
        camera=mosaics.camera,
        intrinsics=None,
        frame_ids=np.arange(len(names)),
        origin=f"raw mosaics of the folder {folder.resolve().name}",
        stamps=None if stamps is None else _stamps(Path(stamps), names),
    )
    return write_imported(out, imported, mosaics)


@dataclass(frozen=True)
class RawMosaics:
    """The mosaics in the files of a folder, all of one camera; iterating reads and checks one after another.

    Attributes:
        files: by name.
        camera: what the files and their owner say of it.
        dtype: of every file's pixels.
    """

    files: tuple[Path, ...]
    camera: CameraInfo
    dtype: np.dtype[Any]

    @staticmethod
    def of(folder: Path, layout: Mosaic, bits: int | None) -> RawMosaics:
        """Of a folder's PNG, TIFF and npy files; arguments as those of `import_raw_folder`.

        Raises:
            ToolkitError: no such files, the first is no mosaic, or ambiguous or wrong bits.
        """
        files = mosaic_files(folder)
        first = read_mosaic(files[0])
        if bits is None and first.dtype == np.uint16:
            raise ToolkitError(f"{files[0]} has 16 bits, of which 10, 12 or all may count; give --bits")
        depth, most = 8 if bits is None else bits, 8 * first.dtype.itemsize
        if not 1 <= depth <= most:
            raise ToolkitError(
                f"--bits {depth} does not fit {files[0]}, which holds {first.dtype}; give 1 to {most}"
            )
        height, width = first.shape
        return RawMosaics(tuple(files), sensor(layout, height, width, depth), first.dtype)

    def __iter__(self) -> Iterator[Raw]:
        """(H, W) each.

        Raises:
            ToolkitError: a file is no mosaic, differs from the first in size or type, or has values that its
                bits do not hold.
        """
        shape = (self.camera.height, self.camera.width)
        for path in self.files:
            pixels = read_mosaic(path)
            if pixels.shape != shape or pixels.dtype != self.dtype:
                raise ToolkitError(
                    f"{path} is {pixels.shape} {pixels.dtype}, {self.files[0].name} is {shape} {self.dtype}; "
                    "keep them in folders of their own"
                )
            if int(pixels.max()) > white_level(self.camera.bits):
                raise ToolkitError(
                    f"{path} holds the value {pixels.max()}, more than --bits {self.camera.bits} allow; "
                    "give the bits that its camera has"
                )
            yield pixels


def mosaic_files(folder: Path) -> list[Path]:
    """The PNG, TIFF and npy files of a folder, by name. Raises ToolkitError: there are none."""
    files = sorted(path for path in folder.glob("*") if path.suffix.lower() in _SUFFIXES)
    if not files:
        raise ToolkitError(
            f"{folder} holds no {', '.join(_SUFFIXES)} file; name the folder of the raw mosaics"
        )
    return files


def read_mosaic(path: Path) -> Raw:
    """The raw mosaic in a PNG, TIFF or npy file, (H, W). Raises ToolkitError: it is none."""
    if path.suffix.lower() == ".npy":
        try:
            image = np.load(path, allow_pickle=False)
        except (ValueError, OSError, EOFError) as error:
            raise ToolkitError(
                f"{path} is no plain numpy array ({error}); save it with numpy.save"
            ) from error
    else:
        image = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
    if image is None or image.ndim != 2 or not image.size or image.dtype not in (np.uint8, np.uint16):
        found = "no image" if image is None else f"{image.shape} {image.dtype}"
        raise ToolkitError(f"{path} is {found}; a raw mosaic is a grey image (H, W) of 8 or 16 bits")
    return image


def _stamps(path: Path, names: list[str]) -> Stamps:
    known = ("file", *_INTEGERS, *_NUMBERS)
    try:
        with path.open(newline="", encoding="utf-8-sig") as stream:  # with the mark that Excel writes, too
            rows = list(csv.DictReader(stream))
    except OSError as error:
        raise ToolkitError(f"{path} cannot be read ({error.strerror}); check the path") from error
    except (UnicodeDecodeError, csv.Error) as error:
        raise ToolkitError(f"{path} is no CSV file ({error}); save it as CSV, UTF-8") from error
    columns = set(rows[0]) if rows else set()
    if "file" not in columns or not columns <= set(known):
        raise ToolkitError(f"{path}: its first line must name columns among {', '.join(known)}, with file")
    by_name = {row["file"]: row for row in rows}
    if len(by_name) < len(rows):
        raise ToolkitError(f"{path} names a file twice; leave one row of each")
    if missing := [name for name in names if name not in by_name]:
        raise ToolkitError(f"{path} has no row for {missing[0]}; add it, or remove the image")
    stamps = Stamps.unknown(len(names))
    found = {name: getattr(stamps, name) for name in known[1:]}
    for name in columns - {"file"}:
        try:
            values = [by_name[file][name] for file in names]
            integers = name in _INTEGERS
            found[name] = np.array(
                [int(v) if integers else float(v) for v in values], "i8" if integers else "f8"
            )
        except (ValueError, TypeError, OverflowError) as error:
            raise ToolkitError(f"{path}: the column {name} holds no number somewhere ({error})") from error
        _check_column(path, name, found[name], names)
    return Stamps(**found)


def _check_column(path: Path, name: str, values: NDArray[Any], names: list[str]) -> None:
    """Raises ToolkitError where times do not grow with the files, or exposure or gain cannot be."""
    wrong = ~np.isfinite(values) if name == "gain_db" else ~((values >= 0) & np.isfinite(values))
    what = "is no time, exposure or gain"
    if name == "exposure_us":
        wrong |= values == 0
    elif name in _INTEGERS and not wrong.any():
        least = 1 if name == "camera_time_ns" else 0
        wrong, what = np.append(False, np.diff(values) < least), "is not later than the file's before"
    if wrong.any():
        row = int(np.argmax(wrong))
        raise ToolkitError(f"{path}: {name} of {names[row]}, {values[row]}, {what}; correct it")
