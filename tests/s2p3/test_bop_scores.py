"""The BOP toolkit and this one agree on exported sessions; masks are held against poses."""

from __future__ import annotations

import importlib.util
import json
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import pytest

from dataset import SE3
from dataset.session import ObjectPoses, Session, mask_box, write_poses
from s2p3.metrics import add, add_s
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


def check_agreement(root: Path, rows: list[dict[str, Any]], names: list[str]) -> None:
    """Our errors from the session itself, in metres, against theirs from the export, in millimetres."""
    assert len(rows) == 16
    with Session.open(root.parent / "session.h5") as session:
        for row in rows:
            name = names[row["obj_id"] - 1]
            true = session.object_poses(name).T_cam_obj[row["im_id"] : row["im_id"] + 1]
            estimated = SE3(np.reshape(row["R"], (1, 3, 3)), np.reshape(row["t"], (1, 3)) / 1000)
            vertices = session.object(name).vertices
            assert abs(1000 * add(estimated, true, vertices)[0] - row["add"]) < 1e-6
            assert abs(1000 * add_s(estimated, true, vertices)[0] - row["adi"]) < 1e-6


def test_errors_agree_with_those_the_bop_toolkit_computed(exported: Path, theirs: ModuleType) -> None:
    rows = json.loads((GOLDEN / "bop_errors.json").read_text())["errors"]
    assert any(row["adi"] < 0.8 * row["add"] for row in rows)  # the two are told apart
    check_agreement(exported, rows, sorted(theirs.objects()))


def test_the_bop_toolkit_agrees_live(exported: Path, theirs: ModuleType) -> None:
    pytest.importorskip("bop_toolkit_lib.pose_error", reason="the BOP toolkit is not installed")
    from bop_toolkit_lib import misc
    from bop_toolkit_lib.dataset import bop_scenewise

    check_agreement(exported, theirs.errors(exported), sorted(theirs.objects()))
    scene = exported / "test" / "000000"
    found = bop_scenewise.read_scene_infos(scene, read_image_ids=True)
    assert found["has_rgb"]
    assert found["has_mask_visib"]
    assert found["image_ids"] == list(range(8))
    for image in found["image_ids"]:
        loaded = bop_scenewise.load_image_data(
            scene, image, load_depth=False, load_mask=True, load_gt=True, load_gt_info=True
        )
        assert loaded["im_rgb"].shape == (*loaded["mask"].shape[1:], 3)
        for mask, visible, info in zip(loaded["mask"], loaded["mask_visib"], loaded["gt_info"], strict=True):
            assert (visible > 0).sum() == info["px_count_visib"]
            assert (mask > 0).sum() <= info["px_count_all"]
            rows, columns = np.nonzero(visible)
            assert list(info["bbox_visib"]) == misc.calc_2d_bbox(columns, rows, None)


def test_masks_are_held_against_poses(exported: Path) -> None:
    path = exported.parent / "session.h5"
    assert list(check_masks(path)) == []
    with Session.open(path) as session:
        poses = session.object_poses("wedge")
        masks = np.stack([poses.mask(index) for index in range(len(session))])
        camera_poses = session.poses
    assert camera_poses is not None
    whole = masks.sum(axis=(1, 2))
    masks[3] = np.roll(masks[3], 4, axis=1)
    masks[5, :, : masks.shape[2] // 2] = False  # hidden, and it says so
    visible = masks.sum(axis=(1, 2)) / whole
    assert 0.1 < visible[5] < 0.9
    boxes = np.stack([mask_box(mask) for mask in masks])
    write_poses(path, camera_poses, 0.0, 0.0, {"wedge": ObjectPoses(poses.T_cam_obj, visible, boxes, masks)})
    (problem,) = check_masks(path)
    assert problem.where == "poses/objects/wedge/mask[3]"
    assert "at the stored pose" in problem.what
