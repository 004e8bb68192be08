"""Reading a session: everything small at once, frames one at a time when asked."""

from __future__ import annotations

from functools import cached_property
from pathlib import Path
from types import TracebackType
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dataset.clocks import DeviceClock
from dataset.compression import checksum
from dataset.errors import SessionError
from dataset.frames import SUPERPIXEL, CameraInfo, ClockFit, RobotTrace
from dataset.intrinsics import Intrinsics
from dataset.on_camera import Polarization, as_mosaic, decode_frame, decode_polarization
from dataset.polarimetry import Raw, Stokes, remap
from dataset.polarizer_response import PolarizerResponse
from dataset.schema import CAMERA_ATTRIBUTES, FRAME_COLUMNS, ROBOT_COLUMNS, TABLES, declaration
from dataset.session.contents import Contents, StoredMasks
from dataset.session.files import open_for_reading
from dataset.session.frame import Frame
from dataset.session.records import Clocks, ObjectPoses, ObjectRecord
from dataset.transforms import SE3


class Session:
    """An open session file, read-only. A context manager and a sequence of `Frame`.

    Sending it to another process sends the path: each process opens the file for itself.
    Everything derived (Stokes images, boxes, masks, T_cam_obj) lives in the undistorted image of
    `working_intrinsics`; raw mosaics are as the camera sent them.

    Attributes:
        path: of the file.
        contents: everything in the file by its path, for what has no property here.
        kind, session_id, rig_toml: as stored.
        origin: what the file was made from; empty for a recording of its own.
        complete: whether the recording ended as intended.
        camera: its description.
    """

    def __init__(self, path: Path, contents: Contents, unfinished: bool) -> None:
        self.path = path
        self.contents = contents
        self._object_poses: dict[str, ObjectPoses] = {}
        self.complete = bool(contents.attribute("/", "complete")) and not unfinished
        self.kind = str(contents.attribute("/", "kind"))
        self.session_id = str(contents.attribute("/", "session_id"))
        self.rig_toml = str(contents.attribute("/", "rig_toml"))
        self.origin = str(contents.attribute("/", "origin") or "")
        self._count = min(contents.length(f"camera/{name}") for name in ("raw", "crc32", *FRAME_COLUMNS))
        found = {a.name: contents.attribute("camera", a.name) for a in CAMERA_ATTRIBUTES}
        found = {a.name: found[a.name] for a in CAMERA_ATTRIBUTES if a.required or found[a.name] is not None}
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
            return cls(path, Contents(path, file), unfinished)
        except SessionError:
            file.close()
            raise

    def close(self) -> None:
        """Closes the file; frames can no longer be read."""
        self.contents.close()

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
        pixels: Raw = self.contents.read("camera/raw", index)
        if checksum(pixels) != int(self.contents.read("camera/crc32", index)):
            raise SessionError(
                f"{self.path}: frame {index} is damaged (its pixels do not match their checksum); copy the "
                f"file again from its source, or drop damaged frames with: s2p3 dataset repair {self.path}"
            )
        return pixels

    def stokes(self, index: int, undistort: bool = True) -> Stokes:
        """The Stokes image of a frame, one pixel per super-pixel, by the `polarizer_response` where there is
        one.

        Args:
            index: of the frame.
            undistort: whether to resample to the pinhole camera `working_intrinsics`, in which masks and
                poses live; needs a calibrated session.

        Raises:
            SessionError: the frame is damaged, or not calibrated when `undistort` is asked for.
            ToolkitError: the camera sent degrees and angles of polarization only.
        """
        decoded = decode_frame(self.raw(index), self.camera, self.polarizer_response)
        if not undistort:
            return decoded
        maps = self._undistort_map
        return decoded if maps is None else remap(decoded, *maps)

    def polarization(self, index: int) -> Polarization:
        """Degree and angle of polarization as the camera saw them, distorted, whatever format was recorded.

        Raises:
            SessionError: the frame is damaged.
        """
        return decode_polarization(self.raw(index), self.camera)

    def mosaic(self, index: int) -> Raw:
        """The raw mosaic of a frame, (H, W); rebuilt where the camera sent Stokes channels.

        Raises:
            SessionError: the frame is damaged.
            ToolkitError: the camera sent degrees and angles of polarization only.
        """
        return as_mosaic(self.raw(index), self.camera)

    @property
    def has_depth(self) -> bool:
        """Whether there is a depth image for every frame."""
        return self.contents.has("depth")

    def depth(self, index: int) -> NDArray[np.float32]:
        """(h, w) float32 depth of a frame in the undistorted polarization image, metres; 0 where unknown.

        Raises:
            SessionError: there is none, or it is damaged.
            IndexError: there is no such frame.
        """
        image = self.contents.image("depth", range(self._count)[index])
        return image.astype(np.float32) * np.float32(1e-3)

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
        rows: NDArray[np.void] = self.contents.read("camera/drops")
        return rows

    @cached_property
    def pauses(self) -> NDArray[np.void]:
        """Gaps that were asked for: rows of first_id, last_id, reason (bytes), host_time_ns, resumed_ns."""
        return self._table("camera/pauses")

    @cached_property
    def segments(self) -> NDArray[np.void]:
        """Uninterrupted recordings the file is made of: rows of first_frame, first_sample, begun_utc."""
        return self._table("segments")

    @cached_property
    def robot(self) -> RobotTrace | None:
        """Every robot sample of the recording; None where there was no robot."""
        count = min(self.contents.length(f"robot/{name}") for name in ROBOT_COLUMNS)
        if count == 0:
            return None
        return RobotTrace(
            **{name: self.contents.read(f"robot/{name}", slice(count)) for name in ROBOT_COLUMNS}
        )

    @cached_property
    def tcp_offset(self) -> NDArray[np.float64] | None:
        """(6,) flange<-tcp [x y z rx ry rz], metres and rotation vector; None where unknown."""
        offset: NDArray[np.float64] = self.contents.read("robot/tcp_offset")
        return offset if np.isfinite(offset).all() else None

    @cached_property
    def payload(self) -> NDArray[np.float64] | None:
        """(4,) what the arm reckoned with: mass, kg, and its centre in the flange frame, metres; None where
        the arm did not tell."""
        if not self.contents.has("robot/payload"):
            return None
        payload: NDArray[np.float64] = self.contents.read("robot/payload")
        return payload if np.isfinite(payload).all() else None

    @cached_property
    def clocks(self) -> Clocks:
        """The fits of the camera's and the robot's clock to the host's."""
        return Clocks(self._clock("camera"), self._clock("robot"))

    @cached_property
    def mid_exposure_host_ns(self) -> NDArray[np.int64]:
        """(N,) int64: the middle of each exposure on the host clock, by the camera's clock fit.

        Raises:
            SessionError: the camera's clock was not fitted, or it did not tell how long it exposed.
        """
        fit = self.clocks.camera
        if fit is None:
            raise SessionError(
                f"{self.path}: the camera's clock was not related to the host's, so exposures have no host "
                "time; record the session again, and mind what `s2p3 capture` says of the clocks"
            )
        if not np.isfinite(self.exposures_us).all():
            raise SessionError(
                f"{self.path}: the camera did not tell how long it exposed, so the middle of an exposure is "
                "not known; record with a camera that has ExposureTime, or import with a column exposure_us"
            )
        half = np.rint(500.0 * self.exposures_us).astype(np.int64)
        return fit.to_host(self.camera_time_ns + half)

    @cached_property
    def time_sigma_s(self) -> NDArray[np.float64]:
        """(N,) standard deviation of the time of each exposure among the arm's samples, seconds: that of the
        camera's clock and of the arm's, where it has been fitted. A constant delay between them is not in it.

        Raises:
            SessionError: the camera's clock was not fitted.
        """
        at = self.mid_exposure_host_ns
        camera, robot, trace = self.clocks.camera, self.clocks.robot, self.robot
        assert camera is not None
        variance = camera.sigmas_ns(len(at)) ** 2
        if robot is not None and trace is not None:
            sigmas = robot.sigmas_ns(len(trace))
            nearest = np.searchsorted(trace.host_time_ns, at)
            variance += sigmas[np.clip(nearest, 0, len(trace) - 1)] ** 2
        return 1e-9 * np.sqrt(variance)

    @cached_property
    def intrinsics(self) -> Intrinsics | None:
        """Of the raw mosaic, as calibrated; None before calibration."""
        if not self.contents.has("calibration/K"):
            return None
        matrix, distortion = (
            self.contents.read("calibration/K"),
            self.contents.read("calibration/distortion"),
        )
        return Intrinsics(matrix, distortion, self.camera.height, self.camera.width)

    @cached_property
    def polarizer_response(self) -> PolarizerResponse | None:
        """Of the camera's pixels, as calibrated; None: Stokes images take the polarizers for ideal."""
        if not self.contents.has("calibration/polarizer_response"):
            return None
        return PolarizerResponse(self.contents.read("calibration/polarizer_response"))

    @cached_property
    def polarizer_angles(self) -> NDArray[np.float64] | None:
        """(N,) radians, NaN where unknown: the dial of the polarizer before the lens, counter-clockwise as
        the image shows it; None in a recording without one."""
        if not self.contents.has("polarizer/angle"):
            return None
        angles: NDArray[np.float64] = self.contents.read("polarizer/angle", slice(self._count))
        return angles

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
        if not self.contents.has("calibration/json"):
            return None
        return self.contents.text("calibration/json")

    @cached_property
    def poses(self) -> SE3 | None:
        """T_base_cam at mid-exposure, a batch of N, NaN where unknown; None before annotation."""
        if not self.contents.has("poses/T_base_cam"):
            return None
        return SE3.from_matrix(self.contents.read("poses/T_base_cam"))

    @property
    def objects(self) -> tuple[str, ...]:
        """Names of the objects whose mesh the session holds."""
        return self.contents.names("objects")

    @property
    def annotated(self) -> tuple[str, ...]:
        """Names of the objects that have poses."""
        return self.contents.names("poses/objects")

    def object(self, name: str) -> ObjectRecord:
        """An object's mesh and material.

        Raises:
            SessionError: there is no such object.
        """
        if name not in self.objects:
            known = ", ".join(self.objects) or "none"
            raise SessionError(f"{self.path} holds no object {name!r}; its objects: {known}")
        root = f"objects/{name}"
        return ObjectRecord(
            name=name,
            vertices=self.contents.read(f"{root}/vertices"),
            faces=self.contents.read(f"{root}/faces"),
            material=str(self.contents.attribute(root, "material")),
            refractive_index=float(self.contents.attribute(root, "refractive_index")),
            extinction=float(self.contents.attribute(root, "extinction")),
            symmetry=str(self.contents.attribute(root, "symmetry")),
            diameter=float(self.contents.attribute(root, "diameter")),
        )

    def object_poses(self, name: str) -> ObjectPoses:
        """An object's pose, visibility, box and (read when asked) mask in every frame.

        Raises:
            SessionError: the object was not annotated.
        """
        if name in self._object_poses:
            return self._object_poses[name]
        root = f"poses/objects/{name}"
        if not self.contents.has(root):
            raise SessionError(f"{self.path}: object {name!r} has no poses; run: s2p3 annotate {self.path}")
        self._object_poses[name] = ObjectPoses(
            T_cam_obj=SE3.from_matrix(self.contents.read(f"{root}/T_cam_obj")),
            visible_fraction=self.contents.read(f"{root}/visible_fraction"),
            bbox_xywh=self.contents.read(f"{root}/bbox_xywh"),
            masks=StoredMasks(self.contents, f"{root}/mask"),
        )
        return self._object_poses[name]

    @property
    def splits(self) -> dict[str, NDArray[np.int64]]:
        """Frame indices by split name."""
        return {name: self.contents.read(f"splits/{name}") for name in self.contents.names("splits")}

    def frames_in(self, split: str) -> NDArray[np.int64]:
        """Frame indices of one split.

        Raises:
            SessionError: there is no such split.
        """
        splits = self.splits
        if split not in splits:
            known = ", ".join(splits) or "none"
            raise SessionError(
                f"{self.path}: no split {split!r} (its splits: {known}); "
                f"make one with: s2p3 dataset split {self.path}"
            )
        return splits[split]

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
        return self.contents.read(f"camera/{name}", slice(self._count))

    def _table(self, path: str) -> NDArray[np.void]:
        if not self.contents.has(path):
            return np.empty(0, TABLES[declaration(path).dtypes[0]])
        rows: NDArray[np.void] = self.contents.read(path)
        return rows

    def _clock(self, name: str) -> DeviceClock | None:
        path = f"clocks/{name}_pieces"
        pieces = self.contents.read(path) if self.contents.has(path) else np.empty((0, 4))
        if len(pieces) == 0:
            line = self.contents.read(f"clocks/{name}")
            pieces = np.array([[0.0, *line]])[~np.isnan(line[:1])]
        if len(pieces) == 0:
            return None
        fits = tuple(ClockFit(float(a), float(b), float(sigma)) for _, a, b, sigma in pieces)
        return DeviceClock(tuple(int(row) for row in pieces[:, 0]), fits)
