"""Records and evaluations of made-up errors."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from s2p3.evaluation import Evaluation, Record, Subject
from s2p3.evaluation.records import Sight
from s2p3.objects import ObjectModel

POSE = tuple(map(tuple, np.eye(4).tolist()))


def missed(frame: int) -> Record:
    return Record.missed(Sight(frame, 1.0, 0.4, 45.0, float("nan")))


def record(frame: int, error_m: float, **changed: Any) -> Record:
    """A target whose errors of distance are all `error_m`, its others 1."""
    errors = dict.fromkeys(("add_m", "add_s_m", "mssd_m"), error_m)
    others = dict.fromkeys(("mspd_px", "rotation_deg", "translation_mm", "depth_mm"), 1.0)
    values = {"box_xywh": (0.0, 0.0, 9.0, 9.0), "T_cam_obj": POSE, "score": 0.9} | errors | others | changed
    return replace(missed(frame), **values)


def evaluation(records: Sequence[Record], model: ObjectModel) -> Evaluation:
    return Evaluation.of(records, subject(model))


def subject(model: ObjectModel) -> Subject:
    return Subject.of(model, 640, "made up")
