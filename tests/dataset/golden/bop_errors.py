"""ADD and ADI of wrong poses by the BOP toolkit's own loader and code, and how bop_errors.json was made with
it: `PYTHONPATH=<its clone> python bop_errors.py <its commit>`."""

from __future__ import annotations

import json
import shutil
import sys
import tempfile
from pathlib import Path
from typing import Any

import numpy as np

from dataset import SE3
from dataset.bop import export_bop
from dataset.session import ObjectPoses, Session, mask_box, write_object, write_poses
from s2p3.objects import build
from s2p3.silhouettes import Silhouettes

HERE = Path(__file__).parent
OBJECTS = ("cup", "fork")


def exported(folder: Path) -> Path:
    """The golden session with two built-in objects, exported as a BOP data set."""
    path = Path(shutil.copy(HERE / "session-1.1.h5", folder / "session.h5"))
    draw = Silhouettes()
    with Session.open(path) as session:
        turns, camera = session.object_poses("tetra").T_cam_obj.rotation, session.working_intrinsics
    poses = SE3(turns, np.tile([0.0, 0.0, 0.18], (len(turns), 1)))
    found = {}
    for name in OBJECTS:
        record = build(name).to_record()
        write_object(path, record)
        masks = np.stack([draw(record, poses[index], camera) for index in range(len(turns))])
        boxes = np.stack([mask_box(mask) for mask in masks])
        found[name] = ObjectPoses(poses, np.ones(len(masks)), boxes, masks)
    write_poses(path, poses.inverse(), 0.0, 0.0, found)
    return export_bop([path], folder / "bop", draw)


def errors(root: Path) -> list[dict[str, Any]]:
    """For every annotation of scene 0: a wrong pose, and how wrong it is in millimetres."""
    from bop_toolkit_lib import inout, pose_error, transform

    scene = root / "test" / "000000"
    rng = np.random.default_rng(11)
    points = {index: inout.load_ply(root / "models_eval" / f"obj_{index:06d}.ply")["pts"] for index in (1, 2)}
    rows = []
    for image, entries in inout.load_scene_gt(scene / "scene_gt.json").items():
        for entry in entries:
            turn = transform.rotation_matrix(rng.uniform(0, 3), rng.normal(size=3))[:3, :3]
            R, t = turn @ entry["cam_R_m2c"], entry["cam_t_m2c"] + rng.normal(scale=8, size=(3, 1))
            poses = (R, t, entry["cam_R_m2c"], entry["cam_t_m2c"], points[entry["obj_id"]])
            row = {
                "im_id": image,
                "obj_id": entry["obj_id"],
                "R": R.ravel().tolist(),
                "t": t.ravel().tolist(),
            }
            rows.append(row | {"add": float(pose_error.add(*poses)), "adi": float(pose_error.adi(*poses))})
    return rows


if __name__ == "__main__":
    with tempfile.TemporaryDirectory() as made_in:
        rows = errors(exported(Path(made_in)))
    made = "ADD and ADI in millimetres by bop_toolkit_lib at commit " + sys.argv[1]
    text = ",\n".join(json.dumps(row) for row in rows)
    (HERE / "bop_errors.json").write_text(f'{{"made": "{made}", "errors": [\n{text}\n]}}\n', encoding="utf-8")
