"""What a session holds, at a glance; costs the same however long the session is."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from dataset.frames import CameraInfo
from dataset.session.accounting import paused
from dataset.session.reader import Session


@dataclass(frozen=True)
class SessionInfo:
    """A summary.

    Attributes:
        path, kind, schema, session_id, created_utc, toolkit: as stored.
        complete: whether the recording ended as intended.
        advice: what to do about an incomplete file; empty otherwise.
        repaired: when and what a repair restored; empty otherwise.
        size_bytes: of the file.
        camera: its description.
        frames, drops: frames stored, and known to be missing.
        paused: frames taken while the recording was paused.
        segments: uninterrupted recordings that the file is made of.
        duration_s: from the first to the last frame, host clock, seconds; read from two places, so it is not
            held against a checksum, as `validate` does.
        robot_samples: of the arm's trace.
        clocks: whose clock was fitted to the host's.
        calibrated, posed: whether a calibration and camera poses are stored.
        polarizers: whether Stokes images are computed with the calibrated response of the pixels.
        objects: names; annotated: those with poses.
        splits: number of frames by name.
    """

    path: str
    kind: str
    schema: str
    session_id: str
    created_utc: str
    toolkit: str
    complete: bool
    advice: str
    repaired: str
    size_bytes: int
    camera: CameraInfo
    frames: int
    drops: int
    paused: int
    segments: int
    duration_s: float
    robot_samples: int
    clocks: tuple[str, ...]
    calibrated: bool
    polarizers: bool
    posed: bool
    objects: tuple[str, ...]
    annotated: tuple[str, ...]
    splits: dict[str, int]


def info(path: str | Path) -> SessionInfo:
    """Summarises a session; an incomplete one too.

    Raises:
        SessionError: as `Session.open`.
    """
    path = Path(path)
    with Session.open(path) as session:
        contents = session.contents
        frames = len(session)
        ends = [int(contents.read("camera/host_time_ns", i)) for i in (0, frames - 1)] if frames else [0]
        fits = session.clocks
        return SessionInfo(
            path=str(path),
            kind=session.kind,
            schema=str(contents.attribute("/", "schema")),
            session_id=session.session_id,
            created_utc=str(contents.attribute("/", "created_utc")),
            toolkit=str(contents.attribute("/", "toolkit")),
            complete=session.complete,
            advice="" if session.complete else f"incomplete: run s2p3 dataset repair {path}",
            repaired=str(contents.attribute("/", "repaired") or ""),
            size_bytes=path.stat().st_size,
            camera=session.camera,
            frames=frames,
            drops=contents.length("camera/drops"),
            paused=paused(session),
            segments=max(1, len(session.segments)),
            duration_s=(ends[-1] - ends[0]) * 1e-9,
            robot_samples=contents.length("robot/host_time_ns"),
            clocks=tuple(name for name in ("camera", "robot") if getattr(fits, name) is not None),
            calibrated=contents.has("calibration/K"),
            polarizers=contents.has("calibration/polarizer_response"),
            posed=contents.has("poses/T_base_cam"),
            objects=session.objects,
            annotated=contents.names("poses/objects"),
            splits={name: contents.length(f"splits/{name}") for name in contents.names("splits")},
        )
