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
from numpy.typing import NDArray

from dataset import SE3
from dataset.bop import export_bop
from dataset.session import ObjectPoses, ObjectRecord, Session, mask_box, write_object, write_poses
from s2p3.silhouettes import Silhouettes

HERE = Path(__file__).parent
SESSION = "session.h5"
SIDES = 24


def objects() -> dict[str, ObjectRecord]:
    """By name: a tube, which looks nearly the same when turned, and a wedge. Made by formula, so that the
    stored errors hold whatever becomes of the toolkit's own objects."""
    turn = np.arange(SIDES) * 2 * np.pi / SIDES
    ring = 0.035 * np.stack([np.cos(turn), np.sin(turn)], axis=1)
    rings = [np.column_stack([ring, np.full(SIDES, height)]) for height in (-0.05, 0.05)]
    here, there = np.arange(SIDES), (np.arange(SIDES) + 1) % SIDES
    wall = [
        np.stack([here, there, here + SIDES], axis=1),
        np.stack([there, there + SIDES, here + SIDES], axis=1),
    ]
    corners = 0.04 * np.array([[-1, -1, -1], [1, -1, -1], [1, 1, -1], [-1, 1, -1], [-1, -1, 1], [-1, 1, 1]])
    sides = np.array([[0, 2, 1], [0, 3, 2], [0, 1, 4], [3, 5, 2], [0, 4, 5], [0, 5, 3], [1, 2, 5], [1, 5, 4]])
    return {
        "tube": _record("tube", np.concatenate(rings), np.concatenate(wall)),
        "wedge": _record("wedge", corners, sides),
    }


def exported(folder: Path) -> Path:
    """The golden session with both objects, exported as a BOP data set; the session stays beside it."""
    path = Path(shutil.copy(HERE / "session-1.1.h5", folder / SESSION))
    draw = Silhouettes()
    with Session.open(path) as session:
        turns, camera = session.object_poses("tetra").T_cam_obj.rotation, session.working_intrinsics
    poses = SE3(turns, np.tile([0.0, 0.0, 0.18], (len(turns), 1)))
    found = {}
    for name, record in objects().items():
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


def _record(name: str, vertices: NDArray[np.float64], faces: NDArray[np.int64]) -> ObjectRecord:
    apart = np.linalg.norm(vertices[:, None] - vertices[None], axis=-1)
    return ObjectRecord(name, vertices, faces.astype(np.int32), "plastic", 1.5, 0.0, "{}", float(apart.max()))


if __name__ == "__main__":
    with tempfile.TemporaryDirectory() as made_in:
        rows = errors(exported(Path(made_in)))
    made = "ADD and ADI in millimetres by bop_toolkit_lib at commit " + sys.argv[1]
    text = ",\n".join(json.dumps(row) for row in rows)
    (HERE / "bop_errors.json").write_text(f'{{"made": "{made}", "errors": [\n{text}\n]}}\n', encoding="utf-8")
