"""Predictions on shots: as JSON lines, and drawn over the image."""

from __future__ import annotations

import itertools
import json
import time
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2

from acquisition.rig import Rig
from calibration import Calibration
from dataset import SE3
from dataset.errors import ToolkitError
from dataset.frames import Mosaic
from dataset.pictures import Picture, in_colour, to_bytes
from dataset.schema import SUFFIXES
from dataset.session import Session
from s2p3.evaluation.predict import Estimator, Finder, PoseEstimate
from s2p3.evaluation.shots import Shot, folder_shots, live_shots, session_shots
from s2p3.objects import ObjectModel
from s2p3.pictures import draw_object
from s2p3.rendering import rasterize

LINES = "poses.jsonl"


@dataclass(frozen=True, eq=False)
class Prediction:
    """What was found in a shot, in so many seconds; an estimate of None where nothing was."""

    shot: Shot
    estimate: PoseEstimate | None
    seconds: float

    @property
    def T_base_obj(self) -> SE3 | None:
        """The object in the robot's base frame; None where it or the camera's place is not known."""
        if self.estimate is None or self.shot.T_base_cam is None:
            return None
        return self.shot.T_base_cam @ self.estimate.T_cam_obj

    def to_json(self) -> dict[str, Any]:
        """Plain values: poses 4x4, metres; the box in pixels of the undistorted polarization image."""
        found, base = self.estimate, self.T_base_obj
        return {
            "frame": self.shot.name,
            "host_time_ns": self.shot.host_time_ns,
            "found": found is not None,
            "score": None if found is None else float(found.score),
            "box_xywh_px": None if found is None else found.detection.box_xywh.tolist(),
            "T_cam_obj": None if found is None else found.T_cam_obj.as_matrix().tolist(),
            "T_base_obj": None if base is None else base.as_matrix().tolist(),
            "time_ms": round(1e3 * self.seconds, 2),
        }


def predictions(shots: Iterable[Shot], find: Finder, estimate: Estimator) -> Iterator[Prediction]:
    """One for each shot, as they come."""
    for shot in shots:
        started = time.perf_counter()
        detection = find(shot.stokes)
        found = None if detection is None else estimate(shot.stokes, detection, shot.intrinsics, shot.depth)
        yield Prediction(shot, found, time.perf_counter() - started)


def saved(found: Iterable[Prediction], model: ObjectModel, out: Path) -> Iterator[Prediction]:
    """Passes predictions on and writes `out`/poses.jsonl and an overlay of each, NAME.png.

    Raises ToolkitError: the folder holds predictions already.
    """
    if (out / LINES).exists():
        raise ToolkitError(f"{out / LINES} exists; name another folder with --out")
    out.mkdir(parents=True, exist_ok=True)
    with (out / LINES).open("w", encoding="utf-8") as lines:
        for prediction in found:
            lines.write(json.dumps(prediction.to_json()) + "\n")
            lines.flush()
            cv2.imwrite(str(out / f"{Path(prediction.shot.name).stem}.png"), overlay(prediction, model))
            yield prediction


def overlay(prediction: Prediction, model: ObjectModel) -> Picture:
    """(H, W, 3) BGR: S0, and over it the object as it was estimated."""
    s0 = prediction.shot.stokes[0]
    picture = in_colour(to_bytes((s0 / max(float(s0.max()), 1e-6)).clip(0, 1) ** (1 / 2.2)))
    if prediction.estimate is not None:
        draw_object(picture, rasterize(model.mesh, prediction.estimate.T_cam_obj, prediction.shot.intrinsics))
    return picture


@contextmanager
def opened_source(
    source: Path,
    calibration: Path | None,
    split: str | None,
    count: int | None,
    mosaic: Mosaic | None,
    bits: int | None,
) -> Iterator[Iterator[Shot]]:
    """The shots of a session, a rig's camera or a folder, see `s2p3.evaluation.shots`.

    Raises:
        ToolkitError: it is none of them, or lacks its calibration.
        SessionError: no such split.
    """
    if source.suffix in SUFFIXES:
        with Session.open(source) as session:
            frames = range(len(session)) if split is None else session.frames_in(split)
            yield session_shots(session, [int(index) for index in frames][:count])
        return
    is_rig = source.suffix == ".toml"
    if not is_rig and not source.is_dir():
        raise ToolkitError(
            f"{source}: is no session (.h5), rig (.toml) or folder of raw mosaics; check the path"
        )
    if calibration is None:
        raise ToolkitError(
            f"{source}: poses need the camera's calibration; give --calibration calibration.json"
        )
    known_camera = Calibration.load(calibration)
    if is_rig:
        yield live_shots(Rig.load(source), known_camera, count)
    else:
        yield itertools.islice(folder_shots(source, mosaic, bits, known_camera), count)
