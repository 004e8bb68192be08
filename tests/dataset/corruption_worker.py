"""Damages copies of a session, one after another, and says what the toolkit makes of each.

`python corruption_worker.py SESSION FOLDER SEED FIRST COUNT` prints a JSON line before and after each damage,
so that whoever waits knows which one crashed or hung the process.
"""

from __future__ import annotations

import json
import sys
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from dataset.errors import SessionError
from dataset.session import Session
from dataset.validate import info, validate

_TRUNCATIONS = 5  # one damage in so many is a cut, the others change one byte


COLUMNS = (
    "frame_ids",
    "camera_time_ns",
    "host_time_ns",
    "exposures_us",
    "drops",
    "pauses",
    "segments",
    "tcp_offset",
    "payload",
    "polarizer_angles",
    "time_sigma_s",
)


def damage(content: bytes, seed: int, index: int) -> tuple[str, bytes]:
    """Damage `index`: what it is, and the damaged bytes."""
    rng = np.random.default_rng([seed, index])
    at = int(rng.integers(len(content)))
    if index % _TRUNCATIONS == 0:
        return f"cut at {at}", content[:at]
    value = int(rng.integers(1, 256)) ^ content[at]
    return f"byte {at}: {content[at]} -> {value}", content[:at] + bytes([value]) + content[at + 1 :]


def values(path: Path) -> Iterator[tuple[str, Callable[[], Any]]]:
    """Everything a reader can be asked for, by name."""
    with Session.open(path) as session:
        yield "camera", lambda: session.camera
        yield "kind", lambda: (session.kind, session.session_id, session.rig_toml, session.origin)
        yield "frames", lambda: len(session)
        for i in range(len(session)):
            yield f"raw {i}", lambda i=i: session.raw(i)
            yield f"depth {i}", lambda i=i: session.depth(i)
        for name in COLUMNS:
            yield name, lambda name=name: getattr(session, name)
        yield "clocks", lambda: str(session.clocks)
        yield "mid exposure", lambda: session.mid_exposure_host_ns
        yield "robot", lambda: None if session.robot is None else session.robot.pose
        yield "camera poses", lambda: None if session.poses is None else session.poses.as_matrix()
        yield "calibration", lambda: session.calibration_json
        yield "intrinsics", lambda: session.working_intrinsics.K
        yield "response", lambda: session.polarizer_response and session.polarizer_response.analysis
        for name in session.objects:
            yield (
                f"object {name}",
                lambda name=name: (session.object(name).sha256, session.object(name).symmetry),
            )
            yield f"poses {name}", lambda name=name: session.object_poses(name).T_cam_obj.as_matrix()
            yield f"boxes {name}", lambda name=name: session.object_poses(name).bbox_xywh
            yield f"visibility {name}", lambda name=name: session.object_poses(name).visible_fraction
            for i in range(len(session)):
                yield f"mask {name} {i}", lambda name=name, i=i: session.object_poses(name).mask(i)
        yield "splits", lambda: session.splits


def reading(path: Path) -> tuple[dict[str, str], list[str]]:
    """A text for each value that could be read, and the messages about those that could not."""
    found: dict[str, str] = {}
    errors: list[str] = []
    try:
        for name, get in values(path):
            try:
                found[name] = _text(get())
            except SessionError as error:
                errors.append(str(error))
    except SessionError as error:
        errors.append(str(error))
    try:
        found["info"] = _text(replace(info(path), path="", size_bytes=0, duration_s=0.0))
    except SessionError as error:
        errors.append(str(error))
    return found, errors


def problems_of(path: Path) -> list[str]:
    """What `validate` says, which may be that the file cannot be opened."""
    try:
        return [str(problem) for problem in validate(path)]
    except SessionError as error:
        return [str(error)]


def _text(value: Any) -> str:
    if isinstance(value, np.ndarray):
        return f"{value.dtype} {value.shape} {value.tobytes().hex()}"
    if isinstance(value, dict):
        return str({name: _text(item) for name, item in value.items()})
    return str(value)


def main() -> None:
    session, folder = Path(sys.argv[1]), Path(sys.argv[2])
    seed, first, count = map(int, sys.argv[3:6])
    truth, errors = reading(session)
    assert not errors, errors
    content = session.read_bytes()
    copy = folder / f"damaged-{first}.h5"
    for index in range(first, first + count):
        what, damaged = damage(content, seed, index)
        print(json.dumps({"index": index, "damage": what}), flush=True)
        copy.write_bytes(damaged)
        found, errors = reading(copy)
        wrong = [name for name, value in found.items() if truth.get(name) != value]
        result = {"index": index, "wrong": wrong, "errors": errors, "problems": problems_of(copy)}
        print(json.dumps(result | {"damage": what, "complete": len(found) == len(truth)}), flush=True)


if __name__ == "__main__":
    main()
