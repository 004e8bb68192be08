"""Reading a session: everything small at once, frames one at a time when asked."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from types import TracebackType
from typing import Any

import h5py
import numpy as np
from numpy.typing import NDArray

from dataset.compression import checksum
from dataset.errors import SessionError
from dataset.frames import SUPERPIXEL, CameraInfo, ClockFit, RobotTrace
from dataset.intrinsics import Intrinsics
from dataset.polarimetry import Raw, Stokes, decode, remap
from dataset.schema import CAMERA_ATTRIBUTES, FRAME_COLUMNS, ROBOT_COLUMNS
from dataset.session.files import attribute, open_for_reading
from dataset.session.records import Clocks, ObjectPoses, ObjectRecord
from dataset.transforms import SE3


class Session:
    """An open session file, read-only. A context manager and a sequence of `Frame`.

    Sending it to another process sends the path: each process opens the file for itself.
    Everything derived (Stokes images, boxes, masks, T_cam_obj) lives in the undistorted image of
    `working_intrinsics`; raw mosaics are as the camera sent them.
    """

    def __init__(self, path: Path, file: h5py.File, unfinished: bool) -> None:
        self.path = path
        self._file = file
        self._object_poses: dict[str, ObjectPoses] = {}
        self.complete = bool(attribute(file, "complete")) and not unfinished
        self.kind = str(attribute(file, "kind"))
        self.session_id = str(attribute(file, "session_id"))
        self.rig_toml = str(attribute(file, "rig_toml"))
        self._count = min(
            self._dataset(f"camera/{name}").shape[0] for name in ("raw", "crc32", *FRAME_COLUMNS)
        )
        found = {a.name: attribute(file["camera"], a.name) for a in CAMERA_ATTRIBUTES}
        missing = [name for name, value in found.items() if value is None]
        if missing or found["mosaic"] not in SUPERPIXEL:
            raise SessionError(
                f"{path}: the camera's description is damaged ({', '.join(missing) or found['mosaic']}); "
                f"see: s2p3 dataset validate {path}"
            )
        self.camera = CameraInfo(**found)

    @classmethod
    def open(cls, path: str | Path) -> Session:
        """Opens a file; an incomplete one opens too, with `complete` False.

        Raises:
            SessionError: missing, not HDF5, not a session, of a newer major version, or damaged.
        """
        path = Path(path)
        file, unfinished = open_for_reading(path)
        try:
            return cls(path, file, unfinished)
        except SessionError:
            file.close()
            raise

    def close(self) -> None:
        """Closes the file; frames can no longer be read."""
        self._file.close()

    def __enter__(self) -> Session:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def __reduce__(self) -> tuple[Any, tuple[Path]]:
        return Session.open, (self.path,)

    def __len__(self) -> int:
        return self._count

    def __getitem__(self, index: int) -> Frame:
        return Frame(self, range(self._count)[index])

    def raw(self, index: int) -> Raw:
        """The mosaic of a frame, (H, W) uint8 or uint16, checked against its checksum.

        Raises:
            SessionError: the frame is damaged.
            IndexError: there is no such frame.
        """
        index = range(self._count)[index]
        try:
            pixels: Raw = self._dataset("camera/raw")[index]
        except (OSError, RuntimeError) as error:
            raise self._damaged(index) from error
        if checksum(pixels) != int(self._dataset("camera/crc32")[index]):
            raise self._damaged(index)
        return pixels

    def stokes(self, index: int, undistort: bool = True) -> Stokes:
        """The Stokes image of a frame, one pixel per super-pixel.

        Args:
            index: of the frame.
            undistort: whether to resample to the pinhole camera `working_intrinsics`, in which masks and
                poses live; needs a calibrated session.

        Raises:
            SessionError: the frame is damaged, or not calibrated when `undistort` is asked for.
        """
        decoded = decode(self.raw(index), self.camera.mosaic, self.camera.bits)
        if not undistort:
            return decoded
        maps = self._undistort_map
        return decoded if maps is None else remap(decoded, *maps)

    @cached_property
    def frame_ids(self) -> NDArray[np.int64]:
        """(N,) int64, the camera's counter, unwrapped."""
        return self._column("frame_id")

    @cached_property
    def camera_time_ns(self) -> NDArray[np.int64]:
        """(N,) int64, start of the exposures on the camera's clock."""
        return self._column("camera_time_ns")

    @cached_property
    def host_time_ns(self) -> NDArray[np.int64]:
        """(N,) int64, host monotonic clock when the first packet was seen."""
        return self._column("host_time_ns")

    @cached_property
    def exposures_us(self) -> NDArray[np.float64]:
        """(N,) float64, microseconds."""
        return self._column("exposure_us")

    @cached_property
    def drops(self) -> NDArray[np.void]:
        """The ledger of frames not stored: (D,) rows of frame_id, reason (bytes), host_time_ns."""
        rows: NDArray[np.void] = self._dataset("camera/drops")[:]
        return rows

    @cached_property
    def robot(self) -> RobotTrace | None:
        """Every robot sample of the recording; None where there was no robot."""
        columns = {name: self._dataset(f"robot/{name}") for name in ROBOT_COLUMNS}
        count = min(len(column) for column in columns.values())
        if count == 0:
            return None
        return RobotTrace(**{name: column[:count] for name, column in columns.items()})

    @cached_property
    def tcp_offset(self) -> NDArray[np.float64] | None:
        """(6,) flange<-tcp [x y z rx ry rz], metres and rotation vector; None where unknown."""
        offset: NDArray[np.float64] = self._dataset("robot/tcp_offset")[:]
        return offset if np.isfinite(offset).all() else None

    @cached_property
    def clocks(self) -> Clocks:
        """The fits of the camera's and the robot's clock to the host's."""
        return Clocks(self._clock("camera"), self._clock("robot"))

    @cached_property
    def mid_exposure_host_ns(self) -> NDArray[np.int64]:
        """(N,) int64: the middle of each exposure on the host clock, by the camera's clock fit.

        Raises:
            SessionError: the camera's clock was not fitted.
        """
        fit = self.clocks.camera
        if fit is None:
            raise SessionError(
                f"{self.path}: the camera's clock was not related to the host's, so exposures have no host "
                "time; record the session again, for at least a few seconds"
            )
        half = np.rint(500.0 * self.exposures_us).astype(np.int64)
        return fit.to_host(self.camera_time_ns + half)

    @cached_property
    def intrinsics(self) -> Intrinsics | None:
        """Of the raw mosaic, as calibrated; None before calibration."""
        if "calibration/K" not in self._file:
            return None
        matrix, distortion = self._dataset("calibration/K")[:], self._dataset("calibration/distortion")[:]
        return Intrinsics(matrix, distortion, self.camera.height, self.camera.width)

    @cached_property
    def working_intrinsics(self) -> Intrinsics:
        """The pinhole camera of the undistorted polarization image, one pixel per super-pixel.

        Raises:
            SessionError: the session is not calibrated.
        """
        return self._distorted_working_intrinsics.pinhole

    @cached_property
    def calibration_json(self) -> str | None:
        """The calibration.json that was applied; None before calibration."""
        if "calibration/json" not in self._file:
            return None
        return str(self._dataset("calibration/json").asstr()[()])

    @cached_property
    def poses(self) -> SE3 | None:
        """T_base_cam at mid-exposure, a batch of N, NaN where unknown; None before annotation."""
        if "poses/T_base_cam" not in self._file:
            return None
        return SE3.from_matrix(self._dataset("poses/T_base_cam")[:])

    @property
    def objects(self) -> tuple[str, ...]:
        """Names of the objects whose mesh the session holds."""
        return tuple(self._file.get("objects", ()))

    def object(self, name: str) -> ObjectRecord:
        """An object's mesh and material.

        Raises:
            SessionError: there is no such object.
        """
        if name not in self.objects:
            known = ", ".join(self.objects) or "none"
            raise SessionError(f"{self.path} holds no object {name!r}; its objects: {known}")
        group = self._file[f"objects/{name}"]
        return ObjectRecord(
            name=name,
            vertices=self._dataset(f"objects/{name}/vertices")[:],
            faces=self._dataset(f"objects/{name}/faces")[:],
            material=str(attribute(group, "material")),
            refractive_index=float(attribute(group, "refractive_index")),
            extinction=float(attribute(group, "extinction")),
            symmetry=str(attribute(group, "symmetry")),
            diameter=float(attribute(group, "diameter")),
        )

    def object_poses(self, name: str) -> ObjectPoses:
        """An object's pose, visibility, box and (read when asked) mask in every frame.

        Raises:
            SessionError: the object was not annotated.
        """
        if name in self._object_poses:
            return self._object_poses[name]
        root = f"poses/objects/{name}"
        if root not in self._file:
            raise SessionError(f"{self.path}: object {name!r} has no poses; run: s2p3 annotate {self.path}")
        self._object_poses[name] = ObjectPoses(
            T_cam_obj=SE3.from_matrix(self._dataset(f"{root}/T_cam_obj")[:]),
            visible_fraction=self._dataset(f"{root}/visible_fraction")[:],
            bbox_xywh=self._dataset(f"{root}/bbox_xywh")[:],
            masks=self._dataset(f"{root}/mask"),
        )
        return self._object_poses[name]

    @property
    def splits(self) -> dict[str, NDArray[np.int64]]:
        """Frame indices by split name."""
        return {name: self._dataset(f"splits/{name}")[:] for name in self._file.get("splits", ())}

    @cached_property
    def _distorted_working_intrinsics(self) -> Intrinsics:
        if self.intrinsics is None:
            raise SessionError(
                f"{self.path} is not calibrated, so it has no undistorted image; "
                "apply a calibration.json with s2p3 annotate, or read it distorted"
            )
        return self.intrinsics.at(SUPERPIXEL[self.camera.mosaic])

    @cached_property
    def _undistort_map(self) -> tuple[NDArray[np.float32], NDArray[np.float32]] | None:
        intrinsics = self._distorted_working_intrinsics
        return intrinsics.undistort_map() if intrinsics.distortion.any() else None

    def _column(self, name: str) -> Any:
        return self._dataset(f"camera/{name}")[: self._count]

    def _clock(self, name: str) -> ClockFit | None:
        a, b, sigma = (float(value) for value in self._dataset(f"clocks/{name}")[:])
        return None if np.isnan(a) else ClockFit(a, b, sigma)

    def _dataset(self, path: str) -> h5py.Dataset:
        found = self._file.get(path) if self._file else None
        if not isinstance(found, h5py.Dataset):
            state = f"lacks the dataset {path}; see: s2p3 dataset validate {self.path}"
            raise SessionError(f"{self.path} {state if self._file else 'is closed; open it again'}")
        return found

    def _damaged(self, index: int) -> SessionError:
        return SessionError(
            f"{self.path}: frame {index} is damaged (its pixels do not match their checksum); copy the file "
            f"again from its source, or drop damaged frames with: s2p3 dataset repair {self.path}"
        )


@dataclass(frozen=True)
class Frame:
    """One frame of a session; everything is read when asked.

    Attributes:
        session: where it comes from; must stay open.
        index: within the session.
    """

    session: Session
    index: int

    @property
    def raw(self) -> Raw:
        """(H, W) uint8 or uint16 mosaic."""
        return self.session.raw(self.index)

    @property
    def stokes(self) -> Stokes:
        """Undistorted Stokes image, one pixel per super-pixel."""
        return self.session.stokes(self.index)

    @property
    def T_base_cam(self) -> SE3 | None:
        """Camera pose at mid-exposure; None before annotation."""
        return None if self.session.poses is None else self.session.poses[self.index]

    def T_cam_obj(self, name: str) -> SE3:
        """An object's pose; NaN where unknown."""
        return self.session.object_poses(name).T_cam_obj[self.index]

    def mask(self, name: str) -> NDArray[np.bool_]:
        """(h, w) bool visible mask of an object."""
        return self.session.object_poses(name).mask(self.index)
