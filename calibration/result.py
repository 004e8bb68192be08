"""calibration.json: everything estimated about a rig, with its uncertainty and what it came from."""

from __future__ import annotations

import json
import shutil
from collections.abc import Mapping
from dataclasses import MISSING, dataclass, field, fields, replace
from datetime import datetime, timezone
from importlib import metadata
from pathlib import Path
from typing import Any, Literal, TypeVar, get_args, get_origin, get_type_hints

import numpy as np
from numpy.typing import NDArray

from calibration.board import BoardSpec
from calibration.records import (
    FixedCameraRecord,
    HandEyeRecord,
    IntrinsicsRecord,
    ObjectPoseRecord,
    PolarizerRecord,
    Source,
    TimeOffsetRecord,
    ToolTipRecord,
    require_same_camera,
)
from calibration.response_file import read_response
from dataset.errors import CalibrationError
from dataset.frames import CameraInfo
from dataset.polarizer_response import PolarizerResponse
from dataset.transforms import SE3
from dataset.whole_files import replacing

Floats = NDArray[np.float64]

FORMAT = "s2p3-calibration"
VERSION = "1.2"
CONVENTIONS = (
    "T_a_b (4x4) maps points of frame b to frame a; metres, radians, seconds; intrinsics in pixels of the raw"
    " mosaic, pixel centres at integer coordinates, OpenCV's distortion order; the covariance of a transform"
    " is that of the twist [rho, phi] (m, rad) in T @ exp(twist)"
)


def _now() -> str:
    return datetime.now(timezone.utc).isoformat(timespec="seconds")


@dataclass(frozen=True, eq=False)
class Calibration:
    """What is known of a rig so far; parts not estimated yet are None. What was read from a file gives the
    file's text again, so that its digest holds wherever it is copied to."""

    board: BoardSpec | None = None
    intrinsics: IntrinsicsRecord | None = None
    hand_eye: HandEyeRecord | None = None
    time_offset: TimeOffsetRecord | None = None
    tool_tip: ToolTipRecord | None = None
    polarizer: PolarizerRecord | None = None
    fixed_camera: FixedCameraRecord | None = None
    objects: Mapping[str, ObjectPoseRecord] = field(default_factory=dict)
    created_utc: str = field(default_factory=_now, metadata={"stored": False})

    def merged(self, newer: Calibration) -> Calibration:
        """This calibration with every part that ``newer`` has taken from it; objects are merged by name."""
        parts = {f.name: getattr(newer, f.name) for f in fields(self) if f.name != "objects"}
        changed = {name: part for name, part in parts.items() if part is not None}
        return replace(self, **changed, objects={**self.objects, **newer.objects})

    @property
    def polarizer_response(self) -> PolarizerResponse | None:
        """Of every pixel, read from the file beside calibration.json; None where it was not calibrated.

        Raises:
            CalibrationError: the file is missing, or is not the one that was written.
        """
        return None if self.polarizer is None else read_response(self.polarizer)

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

    def require_camera(self, camera: CameraInfo, where: str) -> None:
        """Raises when this is not the calibration of a camera that gave ``where``.

        Raises:
            CalibrationError: as `IntrinsicsRecord.require_camera`, the polarizers' serial number included.
        """
        if self.intrinsics is not None:
            self.intrinsics.require_camera(camera, where)
        if self.polarizer is not None:
            require_same_camera(self.polarizer.camera_serial, camera.serial, where)

    def to_json(self) -> str:
        """The text of calibration.json."""
        content = {
            "format": FORMAT,
            "version": VERSION,
            "toolkit": metadata.version("s2p3"),
            "created_utc": self.created_utc,
            "conventions": CONVENTIONS,
            **_encode(self),
        }
        return json.dumps(content, indent=1, allow_nan=False) + "\n"

    def save(self, path: str | Path) -> None:
        """Writes calibration.json; a reader never sees half of it. The polarizers' file, where there is
        one, comes along.

        Raises:
            CalibrationError: the file cannot be written.
        """
        path = Path(path)
        try:
            folder = None if self.polarizer is None else self.polarizer.folder
            if self.polarizer is not None and folder is not None and folder != path.parent:
                shutil.copyfile(folder / self.polarizer.file, path.parent / self.polarizer.file)
            with replacing(path) as partial:
                partial.write_text(self.to_json(), encoding="utf-8")
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
        found = Calibration.from_json(text, str(path))
        if found.polarizer is None:
            return found
        return replace(found, polarizer=replace(found.polarizer, folder=path.parent))

    @staticmethod
    def load_or_new(path: str | Path) -> Calibration:
        """Reads calibration.json; an empty calibration where there is no file yet.

        Raises:
            CalibrationError: as `from_json`.
        """
        return Calibration.load(path) if Path(path).exists() else Calibration()


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
        stored = [f.name for f in fields(value) if f.metadata.get("stored", True)]
        return {name: _encode(getattr(value, name)) for name in stored}
    return value


T = TypeVar("T")


def _decode(kind: type[T], content: Any, where: str) -> T:
    """A dataclass from plain JSON values, by its fields' types; errors name the field."""
    hints = get_type_hints(kind)
    values: dict[str, Any] = {}
    for f in fields(kind):  # type: ignore[arg-type]
        at = f"{where}: {f.name}"
        if f.name not in content and (f.default is not MISSING or f.default_factory is not MISSING):
            continue  # written by a version that did not know it yet
        try:
            values[f.name] = _decode_value(hints[f.name], content[f.name], at)
        except (AttributeError, KeyError, TypeError, ValueError) as error:
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
    if get_origin(hint) is Literal:
        if value not in get_args(hint):
            raise ValueError(value)
        return value
    if hint is SE3:
        return SE3.from_matrix(np.asarray(value, np.float64))
    if hint == Floats:
        return np.asarray(value, np.float64)
    if value is None:
        return None
    options = getattr(hint, "__args__", ())
    return _decode_value(options[0], value, at) if options else _decode(hint, value, at)
