"""Names, units and encodings of an exported BOP data set.

Source: "Format of BOP datasets" (docs/bop_datasets_format.md of the BOP toolkit), scenewise. What the format
has no place for, polarization and materials, is in the folder `stokes` beside `rgb` and in `s2p3.json`.
"""

from __future__ import annotations

import json
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from dataset.errors import ToolkitError

MM = 1000.0
"""Millimetres in a metre: the format's unit of length."""

EXTRA = "s2p3.json"
"""In the root folder: names and materials of the objects, and how Stokes images are encoded."""

ENCODING = {
    "file": "stokes/IMID.png, 16 bit, three channels R, G, B",
    "R": "S0 = value / 32767.5",
    "G": "S1 = (value - 32768) / 32767",
    "B": "S2 = (value - 32768) / 32767",
    "scale": "the sensor's white level behind a polarizer is 1, S0 of unpolarized white light is 2",
    "angles": "counter-clockwise as displayed, 0 along image right",
}

_S0_STEP, _ZERO, _STEP = 1 / 32767.5, 32768, 1 / 32767


def encode_stokes(stack: NDArray[np.float32]) -> NDArray[np.uint16]:
    """(3, h, w) S0, S1, S2 -> (h, w, 3) uint16 as `ENCODING` says; values beyond white are clipped."""
    s0, s1, s2 = stack.astype(np.float64)
    counts = np.stack([s0 / _S0_STEP, s1 / _STEP + _ZERO, s2 / _STEP + _ZERO], axis=-1)
    return np.clip(np.rint(counts), 0, 65535).astype(np.uint16)


def decode_stokes(counts: NDArray[np.uint16]) -> NDArray[np.float32]:
    """Inverse of `encode_stokes`, to 1.6e-5."""
    values = counts.astype(np.float64)
    stack = [values[..., 0] * _S0_STEP, *(np.moveaxis(values[..., 1:] - _ZERO, -1, 0) * _STEP)]
    return np.stack(stack).astype(np.float32)


def write_image(path: Path, image: NDArray[Any]) -> None:
    """Writes a PNG: (h, w) grey, or (h, w, 3) in R, G, B."""
    path.parent.mkdir(parents=True, exist_ok=True)
    channels = image if image.ndim == 2 else np.ascontiguousarray(image[..., ::-1])
    if not cv2.imwrite(str(path), channels):
        raise ToolkitError(f"{path} cannot be written; check the free disk space and who may write")


def read_image(path: Path) -> NDArray[Any]:
    """Reads an image file as it is: (h, w) grey or (h, w, 3) R, G, B.

    Raises:
        ToolkitError: missing, or no image.
    """
    image = cv2.imread(str(path), cv2.IMREAD_UNCHANGED) if path.is_file() else None
    if image is None:
        raise ToolkitError(f"{path} is missing or no image that can be read; check the folder")
    return image if image.ndim == 2 else np.ascontiguousarray(image[..., 2::-1])


def write_json(path: Path, values: Any) -> None:
    """Writes JSON, one entry a line as the BOP toolkit does: large files stay readable and comparable."""
    path.parent.mkdir(parents=True, exist_ok=True)
    if isinstance(values, dict):
        body = ",\n".join(f"  {json.dumps(str(key))}: {json.dumps(value)}" for key, value in values.items())
        text = "{\n" + body + "\n}\n"
    else:
        text = "[\n" + ",\n".join(f"  {json.dumps(value)}" for value in values) + "\n]\n"
    path.write_text(text, encoding="utf-8")


def read_json(path: Path) -> Any:
    """Reads a JSON file.

    Raises:
        ToolkitError: missing, or not JSON.
    """
    if not path.is_file():
        raise ToolkitError(f"{path} is missing; check that the folder is complete")
    try:
        return json.loads(path.read_text(encoding="utf-8"))
    except (ValueError, UnicodeDecodeError) as error:
        raise ToolkitError(f"{path} is not JSON ({error}); copy it again from its source") from error


@contextmanager
def tables_of(folder: Path) -> Iterator[None]:
    """Turns what tables of another shape than the format's provoke into a ToolkitError that names the folder
    they are in."""
    try:
        yield
    except (AttributeError, IndexError, KeyError, TypeError, ValueError) as error:
        raise ToolkitError(
            f"{folder}: its JSON tables are not of the format ({type(error).__name__}: {error}); "
            "check them, or export them again"
        ) from error


def model_file(folder: Path, object_id: int) -> Path:
    """The mesh of an object."""
    return folder / f"obj_{object_id:06d}.ply"
