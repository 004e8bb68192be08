"""One target of an evaluation: how it was seen, what was estimated, and how wrong that is."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np

from dataset import SE3, Intrinsics
from s2p3 import metrics
from s2p3.metrics import Floats
from s2p3.objects import ObjectModel

_INFINITE = ("add_m", "add_s_m", "mssd_m", "mspd_px")
_MEDIANS = ("rotation_deg", "translation_mm", "depth_mm")


@dataclass(frozen=True)
class Subject:
    """What an evaluation is about.

    Attributes:
        object_name: of the object.
        metric: "ADD", or "ADD-S" for an object with a symmetry: what the recalls are of.
        diameter_m: of the object.
        image_width: of the polarization image, pixels: scales the thresholds of MSPD.
        session_id: of the evaluated recording.
    """

    object_name: str
    metric: str
    diameter_m: float
    image_width: int
    session_id: str

    @staticmethod
    def of(model: ObjectModel, image_width: int, session_id: str) -> Subject:
        """The subject of an object seen in a recording."""
        return Subject(model.name, metrics.metric_name(model), model.diameter, image_width, session_id)


@dataclass(frozen=True)
class Sight:
    """How a target is seen, by its true pose.

    Attributes:
        frame: index in the session.
        visible_fraction: of the silhouette.
        distance_m: from the camera to the object's origin.
        elevation_deg: of the camera above the object's xy plane.
        unseen_deg: on the sphere of views, to the nearest known view (of the split `train`); NaN without any.
    """

    frame: int
    visible_fraction: float
    distance_m: float
    elevation_deg: float
    unseen_deg: float


@dataclass(frozen=True)
class Record(Sight):
    """One target and its estimate.

    Attributes:
        box_xywh: the detected box, or None where nothing was detected.
        T_cam_obj: the estimate, 4x4 as nested tuples, or None.
        score: the detection's, 0 to 1; 0 where missed.
        add_m, add_s_m, mssd_m, mspd_px: errors, see `metrics`; infinite where missed.
        rotation_deg, translation_mm, depth_mm: errors, the last signed (positive: estimated too far); NaN
            where missed.
    """

    box_xywh: tuple[float, ...] | None
    T_cam_obj: tuple[tuple[float, ...], ...] | None
    score: float
    add_m: float
    add_s_m: float
    mssd_m: float
    mspd_px: float
    rotation_deg: float
    translation_mm: float
    depth_mm: float

    @staticmethod
    def missed(sight: Sight) -> Record:
        """A target without an estimate."""
        nothing: dict[str, Any] = {"box_xywh": None, "T_cam_obj": None, "score": 0.0}
        nothing |= dict.fromkeys(_INFINITE, math.inf) | dict.fromkeys(_MEDIANS, math.nan)
        return Record(**vars(sight), **nothing)

    def error_m(self, metric: str) -> float:
        """ADD or ADD-S, as `Subject.metric` says."""
        return self.add_s_m if metric == "ADD-S" else self.add_m

    @staticmethod
    def from_json(row: Mapping[str, Any]) -> Record:
        """A record from its fields in JSON, where None stands for what is not finite.

        Raises KeyError, TypeError: another layout.
        """
        values = dict(row)
        for names, value in ((_INFINITE, math.inf), ((*_MEDIANS, "unseen_deg"), math.nan)):
            values |= {name: value for name in names if row[name] is None}
        if values["T_cam_obj"] is not None:
            values["T_cam_obj"] = tuple(map(tuple, values["T_cam_obj"]))
            values["box_xywh"] = tuple(values["box_xywh"])
        return Record(**values)


@dataclass(frozen=True)
class Ruler:
    """Measures estimates of one object.

    Attributes:
        model: the object.
        camera: the pinhole that MSPD projects with.
        known_views: (M, 3) viewing directions to measure new views from, see `metrics.viewing_direction`.
    """

    model: ObjectModel
    camera: Intrinsics
    known_views: Floats

    @cached_property
    def _errors(self) -> dict[str, Callable[[SE3, SE3], Floats]]:
        return metrics.surface_errors(self.model)

    @cached_property
    def _symmetries(self) -> Floats:
        return self.model.symmetry.sampled(metrics.SYMMETRY_STEPS)

    def sight(self, frame: int, visible_fraction: float, true: SE3) -> Sight:
        """How a target of pose `true` is seen."""
        direction = metrics.viewing_direction(SE3.stack([true]))
        unseen = math.nan
        if len(self.known_views):
            found = metrics.view_distance_deg(direction, self.known_views, self.model.symmetry)
            unseen = float(found[0])
        elevation = math.degrees(math.asin(float(np.clip(direction[0, 2], -1, 1))))
        return Sight(frame, visible_fraction, float(np.linalg.norm(true.translation)), elevation, unseen)

    def record(self, sight: Sight, found: SE3, true: SE3, box_xywh: Floats, score: float) -> Record:
        """The record of an estimate `found` of the pose `true`."""
        model, poses = self.model, (SE3.stack([found]), SE3.stack([true]))
        offset = 1e3 * (found.translation - true.translation)
        return Record(
            **vars(sight),
            box_xywh=tuple(float(value) for value in box_xywh),
            T_cam_obj=tuple(tuple(float(value) for value in row) for row in found.as_matrix()),
            score=float(score),
            add_m=float(self._errors["ADD"](*poses)[0]),
            add_s_m=float(self._errors["ADD-S"](*poses)[0]),
            mssd_m=float(metrics.mssd(*poses, model.vertices, self._symmetries)[0]),
            mspd_px=float(metrics.mspd(*poses, model.vertices, self._symmetries, self.camera.K)[0]),
            rotation_deg=float(metrics.rotation_error_deg(*poses, model.symmetry)[0]),
            translation_mm=float(np.linalg.norm(offset)),
            depth_mm=float(offset[2]),
        )
