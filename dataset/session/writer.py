"""Recording a session so that no accident loses what was already captured."""

from __future__ import annotations

import os
import threading
import uuid
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from datetime import datetime, timezone
from importlib import metadata
from pathlib import Path
from types import TracebackType

import h5py
import numpy as np
from numpy.typing import ArrayLike

from dataset.clocks import DeviceClock
from dataset.compression import Chunk, compress
from dataset.errors import SessionError
from dataset.frames import SUPERPIXEL, CameraInfo, ClockFit, RawFrame, RobotTrace
from dataset.intrinsics import Intrinsics
from dataset.schema import (
    CAMERA_ATTRIBUTES,
    DROP_DTYPE,
    FORMAT,
    FRAME_COLUMNS,
    KINDS,
    PAUSE_DTYPE,
    ROBOT_COLUMNS,
    VERSION,
    Kind,
    declaration,
)
from dataset.session.clock_store import fit_stored, store
from dataset.session.continuing import BEGINNING, begin_segment, growing, host_boot_id, open_to_continue
from dataset.session.edit import store_intrinsics, store_object
from dataset.session.files import (
    closed_on_failure,
    create,
    dtype_of,
    hold,
    make_dataset,
    open_to_write,
    require_room,
)
from dataset.session.records import Clocks, ObjectRecord
from dataset.session.seals import leave_open, seal


class SessionWriter:
    """Writes one session file. A context manager: a clean exit marks the file complete, an exception (Ctrl-C
    included) leaves it closed and marked incomplete; a file in which nothing was recorded yet is removed.

    Every frame is on its way to the disk when `add_frame` returns: a killed process loses none of them.
    Methods may be called from several threads.

    Args:
        path: of the new file; missing folders are made.
        kind: what is being recorded.
        camera: its description, which every frame must fit.
        rig_toml: the rig's description, kept for the record.
        intrinsics: at the mosaic's grid, where they are known already (synthetic sessions).

    Raises:
        SessionError: the path exists, the kind is unknown, the camera's image is not whole super-pixels, or
            the disk is full.
    """

    def __init__(
        self,
        path: str | Path,
        kind: Kind,
        camera: CameraInfo,
        *,
        rig_toml: str = "",
        intrinsics: Intrinsics | None = None,
    ) -> None:
        if kind not in KINDS:
            raise SessionError(f"session kind {kind!r} is unknown; use one of {', '.join(KINDS)}")
        block = SUPERPIXEL[camera.mosaic]
        if camera.height % block or camera.width % block:
            raise SessionError(
                f"a {camera.mosaic} mosaic of {camera.width}x{camera.height} pixels is not whole "
                f"super-pixels; set the camera's width and height to multiples of {block}"
            )
        path = Path(path)
        file = create(path)
        try:
            with closed_on_failure(path, file):
                _lay_out(file, kind, camera, rig_toml, _dtype_of(camera))
                if intrinsics is not None:
                    store_intrinsics(file, intrinsics)
            self._begin(path, camera, file)
        except SessionError:
            path.unlink(missing_ok=True)  # nothing was recorded: the name is free for the next attempt
            raise

    @classmethod
    def append(cls, path: str | Path, kind: Kind, camera: CameraInfo) -> SessionWriter:
        """Goes on with a session that was interrupted and has been repaired, in a segment of its own.

        Frame ids go on from the last one, whatever the camera counts; both devices' clocks are fitted anew,
        so camera and arm may have been restarted since.

        Raises:
            SessionError: the file is incomplete, of another kind or camera, from before this computer was
                restarted, or holds what was computed from its frames.
        """
        writer = cls.__new__(cls)
        writer._begin(Path(path), camera, open_to_continue(Path(path), kind, camera))
        return writer

    def _begin(self, path: Path, camera: CameraInfo, file: h5py.File) -> None:
        self.path = path
        self.camera = camera
        self._lock = threading.RLock()
        self._dtype = _dtype_of(camera)
        self._file: h5py.File | None = file
        self._frames, self._samples = len(file["camera/raw"]), len(file["robot/host_time_ns"])
        self._drops, self._pauses = len(file["camera/drops"]), len(file["camera/pauses"])
        self._last_id = int(file["camera/frame_id"][-1]) if self._frames else None
        self._clock_epoch: int | None = None
        gaps = np.append(file["camera/drops"]["frame_id"], file["camera/pauses"]["last_id"])
        self.last_known_id = None if self._last_id is None else int(max(self._last_id, *gaps, -1))
        with closed_on_failure(path, file):
            file.swmr_mode = True
        self._held = hold(path)
        try:
            with self._writing("the beginning"):
                file.attrs.modify("complete", False)
                begin_segment(file, self._frames, self._samples)
        except SessionError:
            with suppress(SessionError):  # the error on its way out is the one the user must see
                self.close()
            raise

    def __enter__(self) -> SessionWriter:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if error is None:
            self.finish()
            return
        with suppress(SessionError):  # the error on its way out is the one the user must see
            self.close()
        if not (self._frames or self._samples or self._drops or self._pauses):
            self.path.unlink(missing_ok=True)  # nothing was recorded: the name is free for the next attempt

    def __len__(self) -> int:
        return self._frames

    def add_frame(self, frame: RawFrame, chunk: Chunk | None = None) -> int:
        """Appends a frame and returns its index.

        Args:
            frame: with an id larger than every one before.
            chunk: `compress(frame.pixels)` where another thread has done it already.

        Raises:
            SessionError: the frame does not fit the camera, its id does not grow, or the disk is full.
        """
        expected = (self.camera.height, self.camera.width)
        if frame.pixels.shape != expected or frame.pixels.dtype != self._dtype:
            raise SessionError(
                f"{self.path}: frame {frame.frame_id} is {frame.pixels.shape} {frame.pixels.dtype}, the "
                f"camera was described as {expected} {self._dtype}; open the camera anew after "
                "changing its format"
            )
        chunk = chunk if chunk is not None else compress(frame.pixels)
        with self._writing(f"frame {frame.frame_id}") as file:
            if self._last_id is not None and frame.frame_id <= self._last_id:
                raise SessionError(
                    f"{self.path}: frame id {frame.frame_id} follows {self._last_id}; unwrap the camera's "
                    "counter and hand frames over in order"
                )
            require_room(self.path, len(chunk.data))
            index = self._frames
            if self._clock_epoch is not None and frame.clock_epoch != self._clock_epoch:
                begin_segment(file, index, self._samples)
            self._clock_epoch = frame.clock_epoch
            raw = file["camera/raw"]
            raw.resize(index + 1, axis=0)
            raw.id.write_direct_chunk((index, 0, 0), chunk.data)
            _put(file["camera/crc32"], index, [chunk.crc32])
            for name in FRAME_COLUMNS:
                _put(file[f"camera/{name}"], index, [getattr(frame, name)])
            file.flush()
            self._frames, self._last_id = index + 1, frame.frame_id
        return index

    def add_polarizer_angle(self, angle: float) -> None:
        """Appends where the polarizer before the lens stood: radians, NaN where unknown; one a frame, in a
        session of kind "polarizer"."""
        with self._writing("the polarizer's angle") as file:
            stored = file["polarizer/angle"]
            _put(stored, len(stored), [angle])
            file.flush()

    def add_drop(self, frame_id: int, reason: str, host_time_ns: int) -> None:
        """Enters a frame into the ledger of those that were exposed and not stored.

        `reason` keeps its first 64 bytes.
        """
        row = np.array([(frame_id, reason.encode()[:64], host_time_ns)], dtype=DROP_DTYPE)
        with self._writing(f"the drop of frame {frame_id}") as file:
            _put(file["camera/drops"], self._drops, row)
            file.flush()
            self._drops += 1

    def add_pause(self, first_id: int, last_id: int, reason: str, host_time_ns: int, resumed_ns: int) -> None:
        """Declares a gap that somebody asked for: the frames from one id to another, and when they came."""
        row = np.array([(first_id, last_id, reason.encode()[:64], host_time_ns, resumed_ns)], PAUSE_DTYPE)
        with self._writing("a pause") as file:
            _put(file["camera/pauses"], self._pauses, row)
            file.flush()
            self._pauses += 1

    def add_robot_trace(
        self, trace: RobotTrace, tcp_offset: ArrayLike, payload: ArrayLike | None = None
    ) -> None:
        """Appends robot samples; call it once at the end, or again and again with what is new.

        Args:
            trace: M samples.
            tcp_offset: (6,) flange<-tcp as [x y z rx ry rz], metres and rotation vector.
            payload: (4,) mass, kg, and its centre in the flange frame, metres; None where it is not known.
        """
        tool = np.asarray(tcp_offset, dtype=np.float64)
        with self._writing("the robot trace") as file:
            if self._samples == 0:
                file["robot/tcp_offset"][:] = tool
            elif not np.allclose(file["robot/tcp_offset"][:], tool, rtol=0.0, atol=1e-6, equal_nan=True):
                raise SessionError(
                    f"{self.path}: the arm's tool offset is not the one that the session began with; set it "
                    "back at the pendant or in the rig file, or record to a new file"
                )
            if payload is not None:
                file["robot/payload"][:] = np.asarray(payload, dtype=np.float64)
            for name in ROBOT_COLUMNS:
                _put(file[f"robot/{name}"], self._samples, getattr(trace, name))
            file.flush()
            self._samples += len(trace)

    def set_clocks(self, camera: ClockFit | None = None, robot: ClockFit | None = None) -> None:
        """Stores clocks that are known, such as those of a synthetic session, in place of earlier ones."""
        with self._writing("the clocks") as file:
            for name, fit in (("camera", camera), ("robot", robot)):
                if fit is not None:
                    store(file, name, DeviceClock((0,), (fit,)))
            file.flush()

    def fit_clocks(self) -> Clocks:
        """Fits both devices' clocks to all arrivals recorded so far, stores them and returns them."""
        with self._writing("the clocks") as file:
            clocks = fit_stored(file)
            file.flush()
        return clocks

    def add_object(self, record: ObjectRecord) -> None:
        """Stores an object's mesh and material.

        Raises:
            SessionError: its name is not a plain word, or its arrays are no mesh.
        """
        with self._writing(f"object {record.name}") as file:
            # a file being read while it grows may get no new groups: leave that mode for a moment
            file.close()
            os.close(self._held)
            self._file = None
            file = open_to_write(self.path)
            try:
                store_object(file, record)
            finally:
                file.swmr_mode = True
                self._file, self._held = file, hold(self.path)

    def finish(self) -> None:
        """Marks the file complete and closes it, which it also does where the disk refuses; nothing may be
        added afterwards.

        Raises:
            SessionError: the disk refuses the last bytes; the file is incomplete.
        """
        try:
            with self._writing("the end of the file") as file:
                seal(file)
                file.attrs["complete"] = True
                file.flush()
        except BaseException:
            with suppress(SessionError):  # the error on its way out is the one the user must see
                self.close()
            raise
        self.close()

    def close(self) -> None:
        """Closes the file as it is: incomplete unless `finish` came first.

        Raises:
            SessionError: the disk refuses the last bytes.
        """
        with self._lock:
            file, self._file = self._file, None
            if file is None:
                return
            os.close(self._held)
            try:
                file.close()
            except (OSError, RuntimeError) as error:
                raise self._refused("the end of the file", error) from error

    @contextmanager
    def _writing(self, what: str) -> Iterator[h5py.File]:
        with self._lock:
            if self._file is None:
                raise SessionError(f"{self.path}: {what} cannot be written, the file is closed already")
            try:
                yield self._file
            except (OSError, RuntimeError) as error:
                raise self._refused(what, error) from error

    def _refused(self, what: str, error: Exception) -> SessionError:
        return SessionError(
            f"{self.path}: {what} could not be written ({str(error).splitlines()[0]}); check the free "
            f"disk space, then save the {self._frames} stored frames with: s2p3 dataset repair {self.path}"
        )


def _lay_out(
    file: h5py.File, kind: str, camera: CameraInfo, rig_toml: str, dtype: np.dtype[np.unsignedinteger]
) -> None:
    """Everything a recording can hold is made before the first frame: a file that is read while it grows may
    get no new datasets."""
    file.attrs.update(
        {
            "format": FORMAT,
            "schema": VERSION,
            "session_id": uuid.uuid4().hex,
            "kind": kind,
            "created_utc": datetime.now(timezone.utc).isoformat(timespec="seconds"),
            "toolkit": f"s2p3 {metadata.version('s2p3')}",
            "rig_toml": rig_toml,
            "host_boot_id": host_boot_id(),
            "complete": False,
        }
    )
    raw = declaration("camera/raw")
    make_dataset(file, raw, raw.path, None, (0, camera.height, camera.width), dtype)
    for declared in map(declaration, growing(kind)):
        row = tuple(n for n in declared.shape[1:] if isinstance(n, int))
        make_dataset(file, declared, declared.path, None, (0, *row), dtype_of(declared))
    for path, size in BEGINNING:
        make_dataset(file, declaration(path), path, np.full(size, np.nan), (size,), np.float64)
    for attribute in CAMERA_ATTRIBUTES:
        file["camera"].attrs[attribute.name] = getattr(camera, attribute.name)
    leave_open(file)
    leave_open(file["camera"])
    file.flush()


def _dtype_of(camera: CameraInfo) -> np.dtype[np.unsignedinteger]:
    return np.dtype(np.uint8 if camera.bits <= 8 else np.uint16)


def _put(dataset: h5py.Dataset, index: int, rows: ArrayLike) -> None:
    rows = np.asarray(rows)
    dataset.resize(index + len(rows), axis=0)
    dataset[index:] = rows
