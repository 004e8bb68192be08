"""Writes docs/session-format.md from the schema's own declaration: `python tools/session_format.py`.

The prose here says what a declaration cannot: why, and how to read a file. A test compares the committed
page with the one this file makes.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from dataset.schema import ATTRIBUTES, DATASETS, FORMAT, KINDS, MAJOR, TABLES, VERSION, Attribute, Dataset

PAGE = Path(__file__).parents[1] / "docs" / "session-format.md"

_HEAD = f"""# The session file

<!-- Made by tools/session_format.py from dataset/schema.py; edit those, not this page. -->

A recording is one HDF5 file, schema {VERSION} (`format = "{FORMAT}"`). A folder of such files is a data set.
Plain `h5py` with `hdf5plugin` reads all of it:

```python
import h5py
import hdf5plugin  # registers Blosc2, with which frames and masks are compressed

with h5py.File("sequence.h5") as file:
    raw = file["camera/raw"][0]  # (H, W) mosaic, as it came from the wire
    print(file["robot/pose"].attrs["units"], file["robot/pose"].attrs["description"])
```

The toolkit's own reader adds what follows from the raw values:

```python
from dataset.session import Session

with Session.open("sequence.h5") as session:
    stokes = session.stokes(0)  # undistorted, at the super-pixel: stokes.s0, .dolp, .aolp
    camera = session.working_intrinsics  # the pinhole camera of that image
    T_cam_obj = session.object_poses("cup").T_cam_obj  # one SE3 a frame
```

## Promises
- Raw mosaics are stored; whatever can be computed from them is computed when asked for.
- Times are measured, never made up from a frame rate. The camera's, the arm's and the host's clocks are kept
  apart, and `/clocks` says how they relate.
- A frame that is known to exist is stored or listed in `camera/drops`, with the reason.
- The arm's trace is stored at the controller's rate, not one sample a frame.
- A file whose writer was killed opens, says that it is incomplete, and `s2p3 dataset repair` restores every
  frame that had been flushed.
- Everything carries a CRC-32, so that damage is found and never handed on. Images have one each, in a dataset
  beside them (`camera/crc32`, `depth_crc32`, `mask_crc32`); every other dataset has that of its bytes as its
  attribute `crc32` (-1 while it is being written), a group that of the attributes named in `crc32_of`, as a
  JSON object with sorted names.
- A file of this major version always opens, whatever its minor version. A new major version comes with a
  converter (`s2p3 dataset convert`); a toolkit older than the file says so.

Kinds: {", ".join(f"`{kind}`" for kind in KINDS)}.

## Conventions
`T_a_b` maps points given in frame b to frame a (`p_a = T_a_b p_b`). Metres, radians, seconds; `_ns` are
integer nanoseconds. The camera frame is OpenCV's: x right, y down, z forward. Pixel centres lie at integer
coordinates; boxes are in pixel-edge coordinates. Everything derived (boxes, masks, `T_cam_obj`) refers to the
*undistorted* image with one pixel per super-pixel: a block of 4 x 4 mosaic pixels for colour sensors, 2 x 2
for monochrome ones.

Letters in shapes: N frames, H x W the raw mosaic, h x w the undistorted polarization image, M robot samples,
D drops, V vertices, F faces, n and k any count. A `*` stands for a name that the user chose.

## Minor versions
What 1.0 declared is frozen: as long as the major version is 1 it keeps its name, type, shape and unit. A
later minor version only adds, never as a requirement, and a reader leaves alone what it does not know; so an
older toolkit reads a newer file, and a newer one an older file.

1.1 added what is marked *since 1.1* below; the checksums of everything but the mosaics; the kind `touches`;
"unknown" (-1, NaN) for times, exposure and gain that nobody measured; and clocks in several pieces, where
`clocks/camera` and `clocks/robot` hold NaN.
"""

_TYPES = {
    "u1": "uint8",
    "u2": "uint16",
    "u4": "uint32",
    "i4": "int32",
    "i8": "int64",
    "f4": "float32",
    "f8": "float64",
}
_NAMES = {str: "text", int: "integer", float: "float", bool: "boolean"}


def page() -> str:
    """The whole page, as it should stand in docs/."""
    sections = [_HEAD, "## Attributes\n", _attributes(), ""]
    for group in dict.fromkeys(_group(dataset) for dataset in DATASETS):
        chosen = [dataset for dataset in DATASETS if _group(dataset) == group]
        sections += [f"## /{group}\n".replace("//", "/"), _datasets(chosen), "", *_columns(chosen)]
    return "\n".join(sections).rstrip() + "\n"


def _group(dataset: Dataset) -> str:
    """The first folder of a data set's path; empty for those in the root."""
    return dataset.path.split("/")[0] if "/" in dataset.path else ""


def _attributes() -> str:
    rows = [(f"`{a.group}`", f"`{a.name}`", _NAMES[a.type], _described(a)) for a in ATTRIBUTES]
    return _table(("group", "attribute", "type", ""), rows)


def _described(attribute: Attribute) -> str:
    choices = ": " + ", ".join(f"`{choice}`" for choice in attribute.choices) if attribute.choices else ""
    return attribute.description + choices + _notes(attribute)


def _notes(declared: Attribute | Dataset) -> str:
    """Whether it may be missing, and since when there is such a thing, in brackets."""
    notes = [] if declared.required else ["optional"]
    notes += [f"since {MAJOR}.{declared.since}"] if declared.since else []
    return f" ({', '.join(notes)})" if notes else ""


def _columns(datasets: list[Dataset]) -> list[str]:
    """What a row of each table among some data sets holds."""
    lines = []
    for dataset in datasets:
        if dataset.dtypes[0] in TABLES:
            columns = ", ".join(f"`{name}` ({_typed(dtype)})" for name, dtype in TABLES[dataset.dtypes[0]])
            lines.append(f"A row of `{dataset.path}` holds {columns}.\n")
    return lines


def _typed(dtype: str) -> str:
    kind = dtype.lstrip("<")
    return f"text of {kind[1:]} bytes" if kind.startswith("S") else _TYPES[kind]


def _datasets(datasets: list[Dataset]) -> str:
    rows = [
        (
            f"`{dataset.path}`",
            " or ".join("table" if dtype in TABLES else _TYPES.get(dtype, dtype) for dtype in dataset.dtypes),
            f"({', '.join(map(str, dataset.shape))})" if dataset.shape else "one",
            dataset.units if dataset.units != "1" else "",
            dataset.description + _notes(dataset),
        )
        for dataset in datasets
    ]
    return _table(("data set", "type", "shape", "unit", ""), rows)


def _table(head: tuple[str, ...], rows: Sequence[tuple[str, ...]]) -> str:
    lines = [head, ("---",) * len(head), *rows]
    return "\n".join(f"| {' | '.join(cell.replace('|', chr(92) + '|') for cell in line)} |" for line in lines)


if __name__ == "__main__":
    PAGE.write_text(page(), encoding="utf-8")
    print(PAGE)
