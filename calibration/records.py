"""What calibration.json keeps of every result: its values, their covariance, and what they came from."""

from __future__ import annotations

import hashlib
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from calibration.hand_eye import HandEyeResult
from calibration.intrinsics import IntrinsicsResult
from calibration.object_pose import ObjectPoseResult
from calibration.polarizer import PolarizerResult
from calibration.time_offset import TimeOffsetResult
from calibration.tool_tip import ToolTipResult
from dataset.errors import CalibrationError
from dataset.frames import CameraInfo, Mosaic
from dataset.intrinsics import Intrinsics
from dataset.transforms import SE3

Floats = NDArray[np.float64]

EXTINCTION_MEASURABLE = 1e4
"""Beyond it noise decides; the number is kept finite for the file."""


@dataclass(frozen=True)
class Source:
    """A file that a result came from: its name, and the sha256 of its bytes when it was read."""

    file: str
    sha256: str

    @staticmethod
    def of(path: str | Path) -> Source:
        """Reads the whole file.

        Raises:
            CalibrationError: the file cannot be read.
        """
        path = Path(path)
        try:
            digest = hashlib.sha256()
            with path.open("rb") as file:
                while block := file.read(1 << 22):
                    digest.update(block)
            return Source(path.name, digest.hexdigest())
        except OSError as error:
            raise CalibrationError(f"{path}: cannot be read ({error.strerror}); check the path") from error


@dataclass(frozen=True, eq=False)
class IntrinsicsRecord:
    """K and distortion at the mosaic's grid; covariance (4 + n, 4 + n) of fx, fy, cx, cy, distortion; what is
    odd, in words; the camera's mosaic and serial number, None in a file written before they were kept."""

    intrinsics: Intrinsics
    covariance: Floats
    rms_px: float
    held_out_px: float
    views: int
    sources: tuple[Source, ...]
    warnings: tuple[str, ...] = ()
    mosaic: Mosaic | None = None
    camera_serial: str | None = None

    @staticmethod
    def of(
        result: IntrinsicsResult,
        camera: CameraInfo,
        sources: tuple[Source, ...],
        warnings: tuple[str, ...] = (),
    ) -> IntrinsicsRecord:
        """The part of a result that is kept."""
        return IntrinsicsRecord(
            result.intrinsics,
            result.covariance,
            result.rms_px,
            result.held_out_px,
            int(result.used.sum()),
            sources,
            warnings,
            camera.mosaic,
            camera.serial,
        )

    def require_camera(self, camera: CameraInfo, where: str) -> None:
        """Raises when these are not the intrinsics of a camera that gave ``where``.

        Raises:
            CalibrationError: another size or mosaic, or another serial number where both are known.
        """
        known = self.intrinsics
        if (camera.width, camera.height) != (known.width, known.height):
            raise CalibrationError(
                f"{where}: pictures of {camera.width}x{camera.height} pixels, the intrinsics are for"
                f" {known.width}x{known.height}; record everything at one resolution, without binning, or"
                " calibrate the intrinsics again"
            )
        if self.mosaic not in (None, camera.mosaic):
            raise CalibrationError(
                f"{where}: a {camera.mosaic} mosaic, the intrinsics are for a {self.mosaic} one; give the"
                " calibration of this camera"
            )
        require_same_camera(self.camera_serial, camera.serial, where)


def require_same_camera(calibrated: str | None, serial: str, where: str) -> None:
    """Raises when ``where`` came from a camera of another serial number than the calibrated one.

    Raises:
        CalibrationError: both are known and differ.
    """
    if calibrated and serial and serial != calibrated:
        raise CalibrationError(
            f"{where}: camera {serial}, the calibration is of camera {calibrated}; give the calibration of"
            " this camera, or calibrate it"
        )


def _known(tcp_offset: Floats | None) -> Floats:
    return np.zeros(0) if tcp_offset is None else tcp_offset


@dataclass(frozen=True, eq=False)
class HandEyeRecord:
    """The camera on the tool, the board in the base; covariance (12, 12) of both twists; the arm's noise;
    what is odd, in words; the arm's tool setting (6,) that T_tcp_cam holds for, empty where unknown."""

    T_tcp_cam: SE3
    T_base_board: SE3
    covariance: Floats
    rms_px: float
    held_out_mm: float
    held_out_deg: float
    arm_sigma_m: float
    arm_sigma_rad: float
    views: int
    sources: tuple[Source, ...]
    warnings: tuple[str, ...] = ()
    tcp_offset: Floats = field(default_factory=lambda: np.zeros(0))

    def camera_on(self, tcp_offset: Floats | None) -> SE3:
        """T_tcp_cam where the arm's tool setting is another (6,): the flange carries the camera, so the frame
        changes, not the camera's place. As calibrated where either setting is unknown."""
        if tcp_offset is None or len(self.tcp_offset) == 0:
            return self.T_tcp_cam
        T_flange_cam = SE3.from_pose6(self.tcp_offset) @ self.T_tcp_cam
        return SE3.from_pose6(tcp_offset).inverse() @ T_flange_cam

    @staticmethod
    def of(
        result: HandEyeResult,
        tcp_offset: Floats | None,
        sources: tuple[Source, ...],
        warnings: tuple[str, ...] = (),
    ) -> HandEyeRecord:
        """The part of a result that is kept."""
        return HandEyeRecord(
            result.T_tcp_cam,
            result.T_base_board,
            result.covariance,
            result.rigid_rms_px,
            result.held_out_mm,
            result.held_out_deg,
            result.arm_sigma_m,
            result.arm_sigma_rad,
            int(result.used.sum()),
            sources,
            warnings,
            _known(tcp_offset),
        )


@dataclass(frozen=True, eq=False)
class FixedCameraRecord:
    """A camera beside the arm: where it stands, and the board on the tool; the rest as `HandEyeRecord`."""

    T_base_cam: SE3
    T_tcp_board: SE3
    covariance: Floats
    rms_px: float
    held_out_mm: float
    held_out_deg: float
    arm_sigma_m: float
    arm_sigma_rad: float
    views: int
    sources: tuple[Source, ...]
    warnings: tuple[str, ...] = ()

    @staticmethod
    def of(
        result: HandEyeResult, sources: tuple[Source, ...], warnings: tuple[str, ...] = ()
    ) -> FixedCameraRecord:
        """The part of a result that is kept.

        Raises:
            CalibrationError: a result with the camera on the tool.
        """
        return FixedCameraRecord(
            result.T_mount_cam,
            result.T_tcp_board,
            result.covariance,
            result.rigid_rms_px,
            result.held_out_mm,
            result.held_out_deg,
            result.arm_sigma_m,
            result.arm_sigma_rad,
            int(result.used.sum()),
            sources,
            warnings,
        )


@dataclass(frozen=True, eq=False)
class TimeOffsetRecord:
    """The arm's pose at an exposure is its trace at (mid exposure on the host clock + offset_s)."""

    offset_s: float
    sigma_s: float
    rms_px: float
    sources: tuple[Source, ...]

    @staticmethod
    def of(result: TimeOffsetResult, sources: tuple[Source, ...]) -> TimeOffsetRecord:
        """The part of a result that is kept."""
        return TimeOffsetRecord(result.offset_s, result.sigma_s, result.rms_px, sources)


@dataclass(frozen=True, eq=False)
class ToolTipRecord:
    """The touching tip in the tool's frame, (3,) metres; covariance (3, 3); the arm's tool setting (6,) that
    it holds for, empty where unknown."""

    tip_in_tcp: Floats
    covariance: Floats
    rms_m: float
    poses: int
    slipped: int
    tcp_offset: Floats
    sources: tuple[Source, ...]

    @staticmethod
    def of(result: ToolTipResult, tcp_offset: Floats | None, sources: tuple[Source, ...]) -> ToolTipRecord:
        """The part of a result that is kept."""
        return ToolTipRecord(
            result.tip_in_tcp,
            result.covariance,
            result.rms_m,
            int(result.used.sum()),
            int((~result.used).sum()),
            _known(tcp_offset),
            sources,
        )


@dataclass(frozen=True, eq=False)
class PolarizerRecord:
    """What the pixels' polarizers are like, and the file beside calibration.json that holds each of them.

    Attributes:
        file, sha256: the file's name, and the digest of the analysis vectors in it.
        extinction_ratio: (3,) its 5th, 50th and 95th percentile.
        orientation_sigma_rad, gain_sigma: spread about the nominal.
        cell_deg: (2, 2) mean orientation of the four kinds of pixels, degrees.
        sigma: standard deviation of a component of an analysis vector; the ideal pixel's first is 0.5.
        defective: share of pixels that are left out.
        frames: how many it was estimated from.
        warnings: what is odd, in words.
        camera_serial: None in a file written before it was kept.
        folder: where the file lies; not part of calibration.json.
    """

    file: str
    sha256: str
    extinction_ratio: Floats
    orientation_sigma_rad: float
    gain_sigma: float
    cell_deg: Floats
    sigma: float
    defective: float
    frames: int
    warnings: tuple[str, ...]
    sources: tuple[Source, ...]
    camera_serial: str | None = None
    folder: Path | None = field(default=None, metadata={"stored": False})

    @staticmethod
    def of(
        result: PolarizerResult, camera: CameraInfo, file: Path, digest: str, sources: tuple[Source, ...]
    ) -> PolarizerRecord:
        """The part of a result that is kept in calibration.json; the rest is in the file."""
        response = result.response
        alive = response.gain > 0
        ratio = np.minimum(response.extinction_ratio[alive], EXTINCTION_MEASURABLE)
        return PolarizerRecord(
            file.name,
            digest,
            np.percentile(ratio, [5, 50, 95]),
            float(response.orientation_error[alive].std()),
            float(response.gain[alive].std()),
            result.cell_deg,
            result.sigma,
            result.defective,
            len(result.states.level),
            result.warnings,
            sources,
            camera.serial,
            file.parent,
        )


@dataclass(frozen=True, eq=False)
class ObjectPoseRecord:
    """An object in the base frame; covariance (6, 6); what the touched points left open, in words."""

    T_base_obj: SE3
    covariance: Floats
    rms_m: float
    points: int
    unobservable: tuple[str, ...]
    sources: tuple[Source, ...]

    @staticmethod
    def of(result: ObjectPoseResult, sources: tuple[Source, ...]) -> ObjectPoseRecord:
        """The part of a result that is kept."""
        return ObjectPoseRecord(
            result.T_base_obj,
            result.covariance,
            result.rms_m,
            len(result.distance_m),
            (*result.unobservable, *result.rivals),
            sources,
        )
