"""What calibration.json keeps of every result: its values, their covariance, and what they came from."""

from __future__ import annotations

import hashlib
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from calibration.hand_eye import HandEyeResult
from calibration.intrinsics import IntrinsicsResult
from calibration.object_pose import ObjectPoseResult
from calibration.time_offset import TimeOffsetResult
from dataset.errors import CalibrationError
from dataset.intrinsics import Intrinsics
from dataset.transforms import SE3

Floats = NDArray[np.float64]


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
    """K and distortion at the mosaic's grid; covariance (4 + n, 4 + n) of fx, fy, cx, cy, distortion."""

    intrinsics: Intrinsics
    covariance: Floats
    rms_px: float
    held_out_px: float
    views: int
    sources: tuple[Source, ...]

    @staticmethod
    def of(result: IntrinsicsResult, sources: tuple[Source, ...]) -> IntrinsicsRecord:
        """The part of a result that is kept."""
        return IntrinsicsRecord(
            result.intrinsics,
            result.covariance,
            result.rms_px,
            result.held_out_px,
            int(result.used.sum()),
            sources,
        )


@dataclass(frozen=True, eq=False)
class HandEyeRecord:
    """The camera on the tool, the board in the base; covariance (12, 12) of both twists; the arm's noise."""

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

    @staticmethod
    def of(result: HandEyeResult, sources: tuple[Source, ...]) -> HandEyeRecord:
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
    """The touching tip in the tool's frame, (3,) metres; covariance (3, 3)."""

    tip_in_tcp: Floats
    covariance: Floats
    sources: tuple[Source, ...]


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
            result.unobservable,
            sources,
        )
