"""Several sessions of one camera as one file."""

from __future__ import annotations

import uuid
from collections.abc import Sequence
from contextlib import ExitStack
from dataclasses import dataclass, fields, replace
from itertools import pairwise
from pathlib import Path

import h5py
import numpy as np
from numpy.typing import NDArray

from dataset.clocks import DeviceClock
from dataset.errors import SessionError
from dataset.frames import CameraInfo
from dataset.schema import FRAME_COLUMNS, ROBOT_COLUMNS, SEGMENT_DTYPE, VERSION, declaration
from dataset.session import Session
from dataset.session.clock_store import store
from dataset.session.edit import store_images
from dataset.session.files import check_new, create_whole, dtype_of, make_dataset, open_for_reading, put_array
from dataset.session.seals import leave_open
from dataset.subset import require_complete

_SINGLE = ("kind", "rig_toml", "host_boot_id")
"""Attributes of / that the parts share, or that the merged file leaves empty."""


@dataclass(frozen=True)
class _Part:
    """A session and where its frames and samples go.

    Attributes:
        session: open.
        file: the same file, open.
        first_frame, first_sample: rows of its first frame and robot sample in the merged file.
        id_shift: what is added to its frame ids.
    """

    session: Session
    file: h5py.File
    first_frame: int
    first_sample: int
    id_shift: int


def merge(paths: Sequence[str | Path], out: str | Path, *, forget_clocks: bool = False) -> int:
    """Writes one session that holds the frames of several, in the order of their times.

    Each part keeps its own clocks, as a segment of its own, where all parts were recorded one after another
    on one computer that was not restarted in between: only then do their host times mean the same. Frame ids
    are shifted so that they increase from part to part.

    Args:
        paths: of complete sessions of one kind, camera and calibration.
        out: of the new file.
        forget_clocks: for parts without common host times, such as annotated ones of different days: all
            times
            are stored as unknown, and the arm's traces, without which times mean little, are left out.

    Returns:
        The number of frames.

    Raises:
        SessionError: fewer than two parts, one is incomplete or damaged, or they differ in something that a
            session has only one of; says in what.
    """
    out = Path(out)
    check_new(out)
    if len(paths) < 2:
        raise SessionError("a merge needs at least two sessions; name them all before --out")
    with ExitStack() as stack:
        sessions = [stack.enter_context(Session.open(path)) for path in paths]
        for session in sessions:
            require_complete(session)
            _check_alike(sessions[0], session)
        if not forget_clocks:
            sessions = _in_order(sessions)
        files = [stack.enter_context(open_for_reading(session.path)[0]) for session in sessions]
        parts = _placed(sessions, files)
        with create_whole(out, sum(session.path.stat().st_size for session in sessions)) as target:
            _write(target, parts, forget_clocks)
    return sum(len(session) for session in sessions)


def _check_alike(one: Session, other: Session) -> None:
    def refuse(what: str) -> SessionError:
        return SessionError(f"{one.path} and {other.path} cannot be one session: {what}")

    if one.session_id == other.session_id and one is not other:
        raise refuse("they are the same recording; name each session once")
    if one.kind != other.kind:
        raise refuse(f"their kinds are {one.kind} and {other.kind}")
    if replace(one.camera, packet_size=0) != replace(other.camera, packet_size=0):
        differing = [
            f.name for f in fields(CameraInfo) if getattr(one.camera, f.name) != getattr(other.camera, f.name)
        ]
        raise refuse(f"their cameras differ in {', '.join(differing)}")
    for name in (
        "calibration/K",
        "calibration/distortion",
        "calibration/polarizer_response",
        "calibration/json",
    ):
        if one.contents.has(name) != other.contents.has(name):
            raise refuse(f"only one of them has {name}; annotate both with one calibration.json")
        if one.contents.has(name) and not _same(one, other, name):
            raise refuse(f"{name} differs; annotate both with one calibration.json")
    if one.has_depth != other.has_depth:
        raise refuse("only one of them has depth")
    for name in set(one.objects) & set(other.objects):
        if one.object(name).sha256 != other.object(name).sha256:
            raise refuse(f"their meshes of {name!r} differ; annotate both with one mesh")


def _same(one: Session, other: Session, name: str) -> bool:
    if name.endswith("json"):
        return one.contents.text(name) == other.contents.text(name)
    return np.array_equal(one.contents.read(name), other.contents.read(name))


def _in_order(sessions: list[Session]) -> list[Session]:
    """The sessions sorted by host time. Raises SessionError where those have no common meaning."""
    hint = "merge with --forget-clocks if their times no longer matter"
    boots = {str(session.contents.attribute("/", "host_boot_id") or "") for session in sessions}
    spans = []
    for session in sessions:
        times = session.host_time_ns
        if len(times) == 0 or (times < 0).any():
            raise SessionError(f"{session.path}: its frames have no host times; {hint}")
        trace = session.robot
        ends = times[[0, -1]]
        if trace is not None:
            ends = np.concatenate([ends, trace.host_time_ns[[0, -1]]])
        spans.append((int(ends.min()), int(ends.max()), session))
    if len(boots) > 1 or "" in boots:
        raise SessionError(
            f"{sessions[0].path} and the others were not recorded on one computer between two of its "
            f"restarts, so their clocks cannot be compared; {hint}"
        )
    spans.sort(key=lambda span: span[0])
    for (_, end, one), (begin, _, other) in pairwise(spans):
        if begin < end:
            raise SessionError(f"{one.path} and {other.path} overlap in time; {hint}")
    return [session for _, _, session in spans]


def _placed(sessions: list[Session], files: list[h5py.File]) -> list[_Part]:
    parts = []
    frames = samples = next_id = 0
    for session, file in zip(sessions, files, strict=True):
        named = (
            session.frame_ids,
            session.drops["frame_id"],
            session.pauses["first_id"],
            session.pauses["last_id"],
        )
        known = np.concatenate(named)
        known = known[known >= 0]  # a frame that never came has no id
        shift = next_id - int(known.min()) if len(known) else 0
        parts.append(_Part(session, file, frames, samples, shift))
        next_id = int(known.max()) + shift + 1 if len(known) else next_id
        frames += len(session)
        samples += 0 if session.robot is None else len(session.robot)
    return parts


def _write(target: h5py.File, parts: list[_Part], forget_clocks: bool) -> None:
    first = parts[0].session
    shared = {}
    for name in _SINGLE:
        values = {str(part.session.contents.attribute("/", name) or "") for part in parts}
        shared[name] = values.pop() if len(values) == 1 else ""
    for name in ("format", "toolkit", "created_utc"):
        shared[name] = first.contents.attribute("/", name)
    origin = "merged from the sessions " + ", ".join(part.session.session_id for part in parts)
    target.attrs.update(shared | {"schema": VERSION, "session_id": uuid.uuid4().hex, "origin": origin})
    target.attrs["complete"] = True
    leave_open(target)
    _write_camera(target, parts, forget_clocks)
    _write_robot(target, parts, forget_clocks)
    _write_tables(target, parts, forget_clocks)
    if "calibration" in parts[0].file:
        parts[0].file.copy("calibration", target)
    for part in parts:
        for name in part.session.objects:
            if f"objects/{name}" not in target:
                part.file.copy(f"objects/{name}", target.require_group("objects"))
    _write_poses(target, parts)
    for name in dict.fromkeys(name for part in parts for name in part.session.splits):
        chosen = [p.session.splits[name] + p.first_frame for p in parts if name in p.session.splits]
        put_array(target, "splits/*", np.concatenate(chosen), name)


def _write_camera(target: h5py.File, parts: list[_Part], forget_clocks: bool) -> None:
    sessions = [part.session for part in parts]
    shape = (sum(map(len, sessions)), sessions[0].camera.height, sessions[0].camera.width)
    raw = make_dataset(
        target, declaration("camera/raw"), "camera/raw", None, shape, parts[0].file["camera/raw"].dtype
    )
    for part in parts:
        source = part.file["camera/raw"]
        for index in range(len(part.session)):
            part.session.raw(index)  # a damaged frame must not be copied as a good one
            mask, chunk = source.id.read_direct_chunk((index, 0, 0))
            raw.id.write_direct_chunk((part.first_frame + index, 0, 0), chunk, mask)
    for name in ("crc32", *FRAME_COLUMNS):
        columns = [s.contents.read(f"camera/{name}", slice(len(s))) for s in sessions]
        if name == "frame_id":
            columns = [column + part.id_shift for column, part in zip(columns, parts, strict=True)]
        if forget_clocks and name in ("camera_time_ns", "host_time_ns"):
            columns = [np.full_like(column, -1) for column in columns]
        put_array(target, f"camera/{name}", np.concatenate(columns))
    target["camera"].attrs.update(dict(parts[0].file["camera"].attrs))
    if sessions[0].has_depth:
        images = (s.contents.image("depth", i) for s in sessions for i in range(len(s)))
        store_images(
            target, declaration("depth"), images, (shape[0], *sessions[0].camera.working_size), np.uint16
        )
    angles = [session.polarizer_angles for session in sessions]
    if known := [angle for angle in angles if angle is not None]:
        put_array(target, "polarizer/angle", np.concatenate(known))


def _write_robot(target: h5py.File, parts: list[_Part], forget_clocks: bool) -> None:
    moved = [part.session for part in parts if part.session.robot is not None and not forget_clocks]
    traces = [session.robot for session in moved]
    for name in ROBOT_COLUMNS:
        declared = declaration(f"robot/{name}")
        row = tuple(n for n in declared.shape[1:] if isinstance(n, int))
        none = np.empty((0, *row), dtype_of(declared))
        put_array(
            target, f"robot/{name}", np.concatenate([none, *(getattr(trace, name) for trace in traces)])
        )
    offsets = [session.tcp_offset for session in moved]
    if any(not _equal(offsets[0], offset) for offset in offsets):
        raise SessionError(
            f"{parts[0].session.path} and the others were recorded with different tool offsets, a session "
            "has one; merge with --forget-clocks, which leaves the arm's traces out"
        )
    known = next((offset for offset in offsets if offset is not None), np.full(6, np.nan))
    put_array(target, "robot/tcp_offset", known)
    payloads = [session.payload for session in moved]
    alike = all(_equal(payloads[0], payload) for payload in payloads)
    payload = payloads[0] if payloads and alike else None
    put_array(target, "robot/payload", np.full(4, np.nan) if payload is None else payload)


def _equal(one: NDArray[np.float64] | None, other: NDArray[np.float64] | None) -> bool:
    return one is other or (one is not None and other is not None and np.array_equal(one, other))


def _write_tables(target: h5py.File, parts: list[_Part], forget_clocks: bool) -> None:
    drops, pauses, segments = [], [], []
    for part in parts:
        ledger, gaps = part.session.drops.copy(), part.session.pauses.copy()
        ledger["frame_id"][ledger["frame_id"] >= 0] += part.id_shift
        for name in ("first_id", "last_id"):
            gaps[name] += part.id_shift
        begun = part.session.segments
        if len(begun) == 0:
            utc = str(part.session.contents.attribute("/", "created_utc")).encode()
            begun = np.array([(0, 0, utc)], SEGMENT_DTYPE)
        begun = begun.copy()
        begun["first_frame"] += part.first_frame
        begun["first_sample"] += part.first_sample
        drops.append(ledger)
        pauses.append(gaps)
        segments.append(begun)
    if forget_clocks:
        for table in (*drops, *pauses):
            table["host_time_ns"] = -1
        for table in pauses:
            table["resumed_ns"] = -1
        for table in segments:
            table["first_sample"] = 0
    for path, tables in (("camera/drops", drops), ("camera/pauses", pauses), ("segments", segments)):
        put_array(target, path, np.concatenate(tables))
    for device in ("camera", "robot"):
        put_array(target, f"clocks/{device}", np.full(3, np.nan))
        timed = [part for part in parts if device == "camera" or part.session.robot is not None]
        clocks = [getattr(part.session.clocks, device) for part in timed]
        firsts = [part.first_frame if device == "camera" else part.first_sample for part in timed]
        if timed and not forget_clocks and all(clock is not None for clock in clocks):
            pieces = [row + first for clock, first in zip(clocks, firsts, strict=True) for row in clock.first]
            store(
                target, device, DeviceClock(tuple(pieces), tuple(f for clock in clocks for f in clock.fits))
            )


def _write_poses(target: h5py.File, parts: list[_Part]) -> None:
    """Poses of all parts; unknown where a part has none."""
    if not any(part.session.poses is not None for part in parts):
        return
    for name in ("T_base_cam", "sigma_t", "sigma_r"):
        put_array(target, f"poses/{name}", _stacked(parts, f"poses/{name}", np.nan))
    annotated = dict.fromkeys(name for part in parts for name in part.session.annotated)
    for name in annotated:
        root = f"poses/objects/{name}"
        for column, missing in (("T_cam_obj", np.nan), ("visible_fraction", 0.0), ("bbox_xywh", 0.0)):
            path = f"poses/objects/*/{column}"
            put_array(target, path, _stacked(parts, path, missing, name), name)
        size = parts[0].session.camera.working_size
        masks = (
            part.session.object_poses(name).mask(index).view(np.uint8)
            if part.session.contents.has(root)
            else np.zeros(size, np.uint8)
            for part in parts
            for index in range(len(part.session))
        )
        shape = (sum(len(part.session) for part in parts), *size)
        store_images(target, declaration("poses/objects/*/mask"), masks, shape, np.uint8, name)


def _stacked(parts: list[_Part], declared_path: str, missing: float, name: str = "") -> NDArray[np.float64]:
    """Rows of all parts' frames; `missing` for a part that has none."""
    path = declared_path.replace("*", name)
    row = [n for n in declaration(declared_path).shape[1:] if isinstance(n, int)]
    columns = [
        part.session.contents.read(path)
        if part.session.contents.has(path)
        else np.full((len(part.session), *row), missing)
        for part in parts
    ]
    return np.concatenate(columns)
