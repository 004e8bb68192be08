"""How long opening and summarising a session takes, short and long: `python tools/bench/session_open.py
[--json]`.

The sessions hold 500 and 50,000 copies of one frame of 8x8 pixels. The peer is plain h5py opening the same
file and reading the length of its frames.
"""

from __future__ import annotations

import argparse
import json
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

import h5py
import numpy as np

from dataset import CameraInfo, RawFrame
from dataset.schema import FRAME_COLUMNS
from dataset.session import Session, SessionWriter
from dataset.session.seals import reopen, seal
from dataset.validate import info

_CAMERA = CameraInfo("bench", "bench", "", "", "Mono12", "mono", 8, 8, 12, 0)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--frames", type=int, default=50_000, help="of the long session")
    parser.add_argument("--json", action="store_true")
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        short, long = (write(Path(folder), count) for count in (500, options.frames))
        opened = milliseconds(lambda: Session.open(long).close())
        plain = milliseconds(lambda: plain_length(long))
        infos = milliseconds(lambda: info(short)), milliseconds(lambda: info(long))
    result = {
        "frames": options.frames,
        "open_ms": opened,
        "info_ms": infos[1],
        "info_ratio_to_500_frames": infos[1] / infos[0],
        "plain_h5py_open_ms": plain,
    }
    if options.json:
        print(json.dumps(result))
    else:
        for name, value in result.items():
            print(f"{name:26}{value:10.2f}")


def write(folder: Path, frames: int) -> Path:
    """A session of copies of one frame of noise."""
    path = folder / f"{frames}.h5"
    pixels = np.random.default_rng(0).integers(0, 4096, (8, 8)).astype(np.uint16)
    with SessionWriter(path, "sequence", _CAMERA) as writer:
        writer.add_frame(RawFrame(pixels, "Mono12", 0, 0, 0, 1.0, 0.0, 0))
    with h5py.File(path, "r+") as file:
        raw = file["camera/raw"]
        mask, chunk = raw.id.read_direct_chunk((0, 0, 0))
        raw.resize(frames, axis=0)
        for index in range(1, frames):
            raw.id.write_direct_chunk((index, 0, 0), chunk, mask)
        for name in ("crc32", *FRAME_COLUMNS):
            column = file[f"camera/{name}"]
            reopen(column)
            column.resize(frames, axis=0)
            step = 0 if column.dtype.kind == "f" or name in ("crc32", "missing_packets") else 1
            column[:] = column[0] + step * np.arange(frames)
        seal(file)
    return path


def plain_length(path: Path) -> int:
    """Frames of a session, by h5py alone."""
    with h5py.File(path) as file:
        return len(file["camera/raw"])


def milliseconds(work: Callable[[], object], times: int = 20) -> float:
    """The median of some runs, after one that does not count."""
    work()
    spent = []
    for _ in range(times):
        start = time.perf_counter()
        work()
        spent.append(1e3 * (time.perf_counter() - start))
    return float(np.median(spent))


if __name__ == "__main__":
    main()
