"""calibration.json: everything estimated about a rig, with its uncertainty and what it came from."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping
from dataclasses import dataclass, field, fields, replace
from datetime import datetime, timezone
from importlib import metadata
from pathlib import Path
from typing import Any, TypeVar, get_type_hints

import numpy as np
from numpy.typing import NDArray

from calibration.board import BoardSpec
from calibration.hand_eye import HandEyeResult
from calibration.intrinsics import IntrinsicsResult
from calibration.object_pose import ObjectPoseResult
from calibration.time_offset import TimeOffsetResult
from dataset.errors import CalibrationError
from dataset.intrinsics import Intrinsics
from dataset.transforms import SE3

Floats = NDArray[np.float64]

FORMAT = "s2p3-calibration"
VERSION = "1.0"
CONVENTIONS = (
    "T_a_b (4x4) maps points of frame b to frame a; metres, radians, seconds; intrinsics in pixels of the raw"
    " mosaic, pixel centres at integer coordinates, OpenCV's distortion order; the covariance of a"
    " transform is"
    " that of the twist [rho, phi] (m, rad) in T @ exp(twist)"
)


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


@dataclass(frozen=True, eq=False)
class Calibration:
    """What is known of a rig so far; parts not estimated yet are None."""

    board: BoardSpec | None = None
    intrinsics: IntrinsicsRecord | None = None
    hand_eye: HandEyeRecord | None = None
    time_offset: TimeOffsetRecord | None = None
    tool_tip: ToolTipRecord | None = None
    objects: Mapping[str, ObjectPoseRecord] = field(default_factory=dict)

    def merged(self, newer: Calibration) -> Calibration:
        """This calibration with every part that ``newer`` has taken from it; objects are merged by name."""
        parts = {f.name: getattr(newer, f.name) for f in fields(self) if f.name != "objects"}
        changed = {name: part for name, part in parts.items() if part is not None}
        return replace(self, **changed, objects={**self.objects, **newer.objects})

    def require(self, *parts: str) -> None:
        """Raises when a part is missing.

        Raises:
            CalibrationError: naming the missing part and the command that estimates it.
        """
        for part in parts:
            if getattr(self, part) is None:
                verb = part.replace("_", "-")
                raise CalibrationError(
                    f"calibration: {part} is missing; estimate it with `s2p3 calibrate {verb}` first"
                )

    def to_json(self) -> str:
        """The text of calibration.json."""
        content = {
            "format": FORMAT,
            "version": VERSION,
            "toolkit": metadata.version("s2p3"),
            "created_utc": datetime.now(timezone.utc).isoformat(timespec="seconds"),
            "conventions": CONVENTIONS,
            **_encode(self),
        }
        return json.dumps(content, indent=1, allow_nan=False) + "\n"

    def save(self, path: str | Path) -> None:
        """Writes calibration.json, through a temporary file: a reader never sees half of it.

        Raises:
            CalibrationError: the file cannot be written.
        """
        path = Path(path)
        temporary = path.with_name(path.name + ".tmp")
        try:
            temporary.write_text(self.to_json(), encoding="utf-8")
            temporary.replace(path)
        except OSError as error:
            raise CalibrationError(
                f"{path}: cannot be written ({error.strerror}); check the folder exists and is writable"
            ) from error

    @staticmethod
    def from_json(text: str, where: str = "calibration.json") -> Calibration:
        """Reads the text of a calibration.json; ``where`` names it in errors.

        Raises:
            CalibrationError: not JSON, a foreign format, a newer major version, a missing or malformed field.
        """
        try:
            content = json.loads(text)
        except json.JSONDecodeError as error:
            raise CalibrationError(
                f"{where}: not JSON (line {error.lineno}: {error.msg}); run the calibration again"
            ) from error
        if not isinstance(content, dict) or content.get("format") != FORMAT:
            raise CalibrationError(
                f"{where}: not a calibration of this toolkit (format is not {FORMAT!r}); give the file that"
                " `s2p3 calibrate` wrote"
            )
        major = str(content.get("version", "")).split(".")[0]
        if major != VERSION.split(".")[0]:
            raise CalibrationError(
                f"{where}: calibration version {content.get('version')} cannot be read by this toolkit, which"
                f" reads {VERSION}; update the toolkit or run the calibration again"
            )
        known = {f.name for f in fields(Calibration)}
        return _decode(Calibration, {k: v for k, v in content.items() if k in known}, where)

    @staticmethod
    def load(path: str | Path) -> Calibration:
        """Reads calibration.json.

        Raises:
            CalibrationError: as `from_json`, or the file is missing.
        """
        path = Path(path)
        try:
            text = path.read_text(encoding="utf-8")
        except (OSError, UnicodeDecodeError) as error:
            raise CalibrationError(
                f"{path}: cannot be read as a calibration; check the path, or run `s2p3 calibrate` first"
            ) from error
        return Calibration.from_json(text, str(path))


def _encode(value: Any) -> Any:
    if isinstance(value, SE3):
        return value.as_matrix().tolist()
    if isinstance(value, np.ndarray):
        return value.tolist()
    if isinstance(value, float):
        return value if np.isfinite(value) else None
    if isinstance(value, Mapping):
        return {key: _encode(item) for key, item in value.items()}
    if isinstance(value, tuple):
        return [_encode(item) for item in value]
    if hasattr(value, "__dataclass_fields__"):
        return {f.name: _encode(getattr(value, f.name)) for f in fields(value)}
    return value


T = TypeVar("T")


def _decode(kind: type[T], content: Any, where: str) -> T:
    """A dataclass from plain JSON values, by its fields' types; errors name the field."""
    hints = get_type_hints(kind)
    values: dict[str, Any] = {}
    for f in fields(kind):  # type: ignore[arg-type]
        at = f"{where}: {f.name}"
        try:
            values[f.name] = _decode_value(hints[f.name], content[f.name], at)
        except (KeyError, TypeError, ValueError) as error:
            raise CalibrationError(f"{at} is missing or malformed; run the calibration again") from error
    return kind(**values)


def _decode_value(hint: Any, value: Any, at: str) -> Any:
    if hint == Mapping[str, ObjectPoseRecord]:
        return {name: _decode(ObjectPoseRecord, item, f"{at}.{name}") for name, item in value.items()}
    if hint == tuple[Source, ...]:
        return tuple(_decode(Source, item, at) for item in value)
    if hint == tuple[str, ...]:
        return tuple(str(item) for item in value)
    if hint is float:
        return float("nan") if value is None else float(value)
    if hint in (int, str):
        return hint(value)
    if hint is SE3:
        return SE3.from_matrix(np.asarray(value, np.float64))
    if hint == Floats:
        return np.asarray(value, np.float64)
    if value is None:
        return None
    options = getattr(hint, "__args__", ())
    return _decode(options[0] if options else hint, value, at)
