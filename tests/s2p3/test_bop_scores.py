"""The BOP toolkit and this one agree on exported sessions; masks are held against poses."""

from __future__ import annotations

import importlib.util
import json
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest

from dataset import SE3
from dataset.bop.layout import read_json
from dataset.importers.meshes import read_mesh
from dataset.session import ObjectPoses, Session, mask_box, write_poses
from s2p3.evaluation.metrics import add, add_s
from s2p3.silhouettes import check_masks

GOLDEN = Path(__file__).parents[1] / "dataset" / "golden"


@pytest.fixture(scope="module")
def theirs() -> ModuleType:
    spec = importlib.util.spec_from_file_location("bop_errors", GOLDEN / "bop_errors.py")
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@pytest.fixture(scope="module")
def exported(theirs: ModuleType, tmp_path_factory: pytest.TempPathFactory) -> Path:
    root: Path = theirs.exported(tmp_path_factory.mktemp("bop"))
    return root


def check_agreement(root: Path, rows: list[dict[str, object]]) -> None:
    truth = read_json(root / "test" / "000000" / "scene_gt.json")
    points = {number: read_mesh(root / "models" / f"obj_{number:06d}.ply", 1.0)[0] for number in (1, 2)}
    assert len(rows) == 16
    for row in rows:
        entry = next(e for e in truth[str(row["im_id"])] if e["obj_id"] == row["obj_id"])
        true = SE3(np.reshape(entry["cam_R_m2c"], (1, 3, 3)), np.reshape(entry["cam_t_m2c"], (1, 3)))
        estimated = SE3(np.reshape(row["R"], (1, 3, 3)), np.reshape(row["t"], (1, 3)))
        vertices = points[row["obj_id"]]  # type: ignore[index]
        assert abs(add(estimated, true, vertices)[0] - row["add"]) < 1e-6  # type: ignore[operator]
        assert abs(add_s(estimated, true, vertices)[0] - row["adi"]) < 1e-6  # type: ignore[operator]


def test_errors_agree_with_those_the_bop_toolkit_computed(exported: Path) -> None:
    rows = json.loads((GOLDEN / "bop_errors.json").read_text())["errors"]
    assert any(row["adi"] < 0.8 * row["add"] for row in rows)  # the two are told apart
    check_agreement(exported, rows)


def test_errors_agree_with_the_bop_toolkit_live(exported: Path, theirs: ModuleType) -> None:
    pytest.importorskip("bop_toolkit_lib.pose_error", reason="the BOP toolkit is not installed")
    check_agreement(exported, theirs.errors(exported))


def test_masks_are_held_against_poses(exported: Path) -> None:
    path = exported.parent / "session.h5"
    assert list(check_masks(path)) == []
    with Session.open(path) as session:
        poses = session.object_poses("cup")
        masks = np.stack([poses.mask(index) for index in range(len(session))])
        camera_poses = session.poses
    assert camera_poses is not None
    whole = masks.sum(axis=(1, 2))
    masks[3] = np.roll(masks[3], 4, axis=1)
    masks[5, :, : masks.shape[2] // 2] = False  # hidden, and it says so
    visible = masks.sum(axis=(1, 2)) / whole
    assert 0.1 < visible[5] < 0.9
    boxes = np.stack([mask_box(mask) for mask in masks])
    write_poses(path, camera_poses, 0.0, 0.0, {"cup": ObjectPoses(poses.T_cam_obj, visible, boxes, masks)})
    (problem,) = check_masks(path)
    assert problem.where == "poses/objects/cup/mask[3]"
    assert "at the stored pose" in problem.what
