"""Estimates as the results file of the BOP challenge, which its toolkit scores."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from dataset.session import Session
from s2p3.evaluation.evaluate import Evaluation

_HEADER = "scene_id,im_id,obj_id,score,R,t,time"
_NOT_TIMED = -1


def write_bop_results(path: Path, evaluation: Evaluation, scene_id: int, object_id: int) -> None:
    """Writes the estimates of an evaluation as BOP19 CSV: t in millimetres, frame indices as image ids.

    Args:
        scene_id, object_id: in the data set that `dataset.bop.export_bop` writes of the session, see
            `bop_object_id`.
    """
    lines = [_HEADER]
    for record in evaluation.records:
        if record.T_cam_obj is None:
            continue
        pose = np.array(record.T_cam_obj)
        R, t = (" ".join(map(repr, part.ravel().tolist())) for part in (pose[:3, :3], 1e3 * pose[:3, 3]))
        lines.append(f"{scene_id},{record.frame},{object_id},{record.score!r},{R},{t},{_NOT_TIMED}")
    path.write_text("\n".join(lines) + "\n", encoding="ascii")


def bop_object_id(session: Session, object_name: str) -> int:
    """The id that exporting the session alone gives one of its objects."""
    return 1 + sorted(session.annotated).index(object_name)
