"""An export has the layout that "Format of BOP datasets" describes, and comes back as it went."""

from __future__ import annotations

import json
import re
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import h5py
import numpy as np
import pytest
from numpy.typing import NDArray

from dataset import SE3, Intrinsics, SessionError, ToolkitError
from dataset.bop import export_bop
from dataset.bop.layout import decode_stokes, encode_stokes, read_image
from dataset.importers import import_bop
from dataset.session import ObjectRecord, Session, write_object
from dataset.validate import validate


def draw(record: ObjectRecord, T_cam_obj: SE3, camera: Intrinsics) -> NDArray[np.bool_]:
    """The convex hull of the projected corners: exact for a tetrahedron."""
    corners = camera.project(T_cam_obj.apply(record.vertices)).astype(np.float32)
    image = np.zeros((camera.height, camera.width), np.uint8)
    if np.isfinite(corners).all():
        cv2.fillConvexPoly(image, cv2.convexHull(corners).astype(np.int32), 1)
    return image > 0


@pytest.fixture
def exported(recorded: Path, tmp_path: Path) -> Path:
    return export_bop([recorded], tmp_path / "bop", draw, "test", "test")


def test_the_layout_is_the_described_one(exported: Path) -> None:
    found = {str(path.relative_to(exported)) for path in exported.rglob("*") if path.is_file()}
    images = [f"{image:06d}" for image in (9, 10, 11)]
    scene = "test/000000"
    expected = {"camera.json", "test_targets_bop19.json", "s2p3.json"}
    expected |= {f"{models}/models_info.json" for models in ("models", "models_eval")}
    expected |= {f"{models}/obj_000001.ply" for models in ("models", "models_eval")}
    expected |= {f"{scene}/scene_{name}.json" for name in ("camera", "gt", "gt_info")}
    expected |= {f"{scene}/{kind}/{image}.png" for kind in ("rgb", "depth", "stokes") for image in images}
    expected |= {f"{scene}/{kind}/{image}_000000.png" for kind in ("mask", "mask_visib") for image in images}
    assert found == expected


def test_a_data_set_may_have_a_split_more(
    exported: Path, recorded: Path, tetrahedron: ObjectRecord, tmp_path: Path
) -> None:
    before = {path: path.read_bytes() for path in exported.rglob("*") if path.is_file()}
    export_bop([recorded], exported, draw, "train_real", "train")
    assert sorted(path.name for path in exported.iterdir() if path.is_dir()) == [
        "models", "models_eval", "test", "train_real"
    ]  # fmt: skip
    assert len(list((exported / "train_real/000000/stokes").iterdir())) == 9
    assert all(path.read_bytes() == content for path, content in before.items())
    for split in ("test", "test_dark", "train_real"):
        with pytest.raises(ToolkitError, match="split already"):
            export_bop([recorded], exported, draw, split)
    write_object(recorded, replace(tetrahedron, vertices=1.1 * tetrahedron.vertices))
    with pytest.raises(ToolkitError, match="of other objects"):
        export_bop([recorded], exported, draw, "val")
    with pytest.raises(ToolkitError, match="BOP's are train, val and test"):
        export_bop([recorded], tmp_path / "new", draw, "../test")


def test_an_export_that_fails_leaves_nothing(recorded: Path, tmp_path: Path) -> None:
    with h5py.File(recorded, "r+") as file:
        file["camera/raw"].id.write_direct_chunk((4, 0, 0), b"\0" * 40)
    with pytest.raises(SessionError, match="damaged"):
        export_bop([recorded], tmp_path / "new", draw)
    assert not (tmp_path / "new").exists()


def tables(root: Path) -> tuple[dict[str, Any], dict[str, Any], dict[str, Any]]:
    scene = root / "test" / "000000"
    camera, truth, infos = (
        json.loads((scene / f"scene_{name}.json").read_text()) for name in ("camera", "gt", "gt_info")
    )
    return camera, truth, infos


def test_the_tables_hold_what_the_format_says(exported: Path, recorded: Path) -> None:
    camera, truth, infos = tables(exported)
    with Session.open(recorded) as session:
        K = session.working_intrinsics.K
        for image in (9, 10, 11):
            entry, (gt,), (info,) = camera[str(image)], truth[str(image)], infos[str(image)]
            assert set(entry) == {"cam_K", "depth_scale", "cam_R_w2c", "cam_t_w2c"}
            np.testing.assert_allclose(np.reshape(entry["cam_K"], (3, 3)), K)
            assert set(gt) == {"cam_R_m2c", "cam_t_m2c", "obj_id"}
            pose = session.object_poses("tetra").T_cam_obj[image]
            np.testing.assert_allclose(np.reshape(gt["cam_R_m2c"], (3, 3)), pose.rotation)
            np.testing.assert_allclose(gt["cam_t_m2c"], 1000 * pose.translation)
            assert gt["obj_id"] == 1
            assert set(info) == {
                "bbox_obj", "bbox_visib", "px_count_all", "px_count_valid", "px_count_visib", "visib_fract"
            }  # fmt: skip
            mask = read_image(exported / f"test/000000/mask_visib/{image:06d}_000000.png")
            assert mask.dtype == np.uint8
            assert set(np.unique(mask)) <= {0, 255}
            assert info["px_count_visib"] == (mask > 0).sum()
            rows, columns = np.nonzero(mask)
            box = [columns.min(), rows.min(), np.ptp(columns), np.ptp(rows)]
            assert info["bbox_visib"] == box
            depth = cv2.imread(str(exported / f"test/000000/depth/{image:06d}.png"), cv2.IMREAD_UNCHANGED)
            assert depth.dtype == np.uint16
            np.testing.assert_allclose(depth * entry["depth_scale"] / 1000, session.depth(image), atol=1e-6)


def test_models_are_in_millimetres(exported: Path, tetrahedron: ObjectRecord) -> None:
    info = json.loads((exported / "models/models_info.json").read_text())["1"]
    expected = {"diameter", *(f"{kind}_{axis}" for kind in ("min", "size") for axis in "xyz")}
    assert set(info) == expected
    assert info["diameter"] == pytest.approx(1000 * tetrahedron.diameter)
    assert info["size_x"] == pytest.approx(100)
    lines = (exported / "models/obj_000001.ply").read_text().splitlines()
    assert lines[:3] == ["ply", "format ascii 1.0", "element vertex 4"]
    normals = np.array([line.split()[3:] for line in lines[lines.index("end_header") + 1 :][:4]], float)
    np.testing.assert_allclose(np.linalg.norm(normals, axis=1), 1)


def test_targets_are_the_instances_that_can_be_seen(exported: Path) -> None:
    _, _, infos = tables(exported)
    targets = json.loads((exported / "test_targets_bop19.json").read_text())
    seen = [int(image) for image, (info,) in infos.items() if info["visib_fract"] >= 0.1]
    assert [target["im_id"] for target in targets] == seen
    assert all(set(target) == {"im_id", "inst_count", "obj_id", "scene_id"} for target in targets)


def test_symmetries_travel_in_millimetres(recorded: Path, tmp_path: Path) -> None:
    from dataset.bop.models import read_models, write_models

    half_turn = np.diag([-1.0, -1, 1, 1])
    half_turn[0, 3] = 0.02
    symmetry = {
        "symmetries_discrete": [half_turn.ravel().tolist()],
        "symmetries_continuous": [{"axis": [0, 0, 1], "offset": [0.01, 0, 0]}],
    }
    with Session.open(recorded) as session:
        record = replace(session.object("tetra"), symmetry=json.dumps(symmetry))
    write_models(tmp_path / "bop", {3: record})
    info = json.loads((tmp_path / "bop/models/models_info.json").read_text())["3"]
    assert info["symmetries_discrete"][0][3] == pytest.approx(20)
    assert info["symmetries_continuous"] == [{"axis": [0, 0, 1], "offset": [10.0, 0.0, 0.0]}]
    back = read_models(tmp_path / "bop", {})[3]
    assert json.loads(back.symmetry)["symmetries_discrete"][0][3] == pytest.approx(0.02)
    np.testing.assert_allclose(back.vertices, record.vertices)


def test_stokes_images_keep_their_values() -> None:
    stack = np.random.default_rng(0).uniform(-1, 1, (3, 5, 7)).astype(np.float32)
    stack[0] += 1
    counts = encode_stokes(stack)
    assert counts.dtype == np.uint16
    np.testing.assert_allclose(decode_stokes(counts), stack, atol=1.6e-5)
    assert encode_stokes(np.zeros((3, 1, 1), np.float32)).ravel().tolist() == [0, 32768, 32768]


def test_an_export_comes_back(exported: Path, recorded: Path, tmp_path: Path) -> None:
    out = tmp_path / "back.h5"
    assert import_bop(exported / "test" / "000000", out) == 3
    assert validate(out) == []
    with Session.open(out) as back, Session.open(recorded) as session:
        assert back.frame_ids.tolist() == [9, 10, 11]
        assert "BOP scene bop/test/000000" in back.origin
        np.testing.assert_allclose(back.working_intrinsics.K, session.working_intrinsics.K)
        assert back.poses is not None
        assert session.poses is not None
        record = back.object("tetra")
        assert (record.material, record.refractive_index) == ("plastic", 1.5)
        np.testing.assert_allclose(record.vertices, session.object("tetra").vertices)
        for new, old in enumerate((9, 10, 11)):
            np.testing.assert_allclose(back.stokes(new).stack(), session.stokes(old).stack(), atol=1e-4)
            np.testing.assert_allclose(
                back.object_poses("tetra").T_cam_obj[new].as_matrix(),
                session.object_poses("tetra").T_cam_obj[old].as_matrix(),
                atol=1e-12,
            )
            np.testing.assert_allclose(back.poses[new].as_matrix(), session.poses[old].as_matrix(), atol=1e-9)
            np.testing.assert_array_equal(
                back.object_poses("tetra").mask(new), session.object_poses("tetra").mask(old)
            )
            np.testing.assert_array_equal(back.depth(new), session.depth(old))


def test_mistakes_get_one_line(recorded: Path, exported: Path, tmp_path: Path) -> None:
    with pytest.raises(ToolkitError, match="not empty"):
        export_bop([recorded], recorded.parent, draw)
    with pytest.raises(SessionError, match="no split 'x'"):
        export_bop([recorded], tmp_path / "new", draw, frames="x")
    scene = exported / "test" / "000000"
    with pytest.raises(SessionError, match="already exists"):
        import_bop(scene, recorded)
    (scene / "scene_gt.json").write_text('{"9": [{"obj_id": "cup"}], "10": 3}')
    with pytest.raises(ToolkitError, match="JSON tables are not of the format"):
        import_bop(scene, tmp_path / "a.h5")
    (scene / "scene_gt.json").write_text("{}")
    for path in (scene / "stokes").iterdir():
        path.unlink()
    with pytest.raises(ToolkitError, match=r"000009\.png is missing"):
        import_bop(scene, tmp_path / "a.h5")
    (scene / "stokes").rmdir()
    with pytest.raises(ToolkitError, match="not polarized"):
        import_bop(scene, tmp_path / "a.h5")
    (scene / "scene_gt.json").write_text("{")
    with pytest.raises(ToolkitError, match=re.escape("scene_gt.json is not JSON")):
        import_bop(scene, tmp_path / "a.h5")
    assert not (tmp_path / "a.h5").exists()
