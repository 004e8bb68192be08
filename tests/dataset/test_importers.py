"""Other data sets come in without loss, with measured values only, and never with a guessed unit."""

from __future__ import annotations

import json
import os
import pickle
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from dataset import SE3, ToolkitError
from dataset.importers import import_housecat6d, import_ppp_net, import_raw_folder
from dataset.importers.mosaics import colour_mosaic, mono_mosaic
from dataset.importers.plain_pickle import read_plain_pickle
from dataset.polarimetry import split_angles, split_colours
from dataset.session import Session
from dataset.validate import validate

SIZE = (12, 16)
ANGLES = (0, 45, 90, 135)
TETRAHEDRON = """ply
format ascii 1.0
element vertex 4
property float x
property float y
property float z
element face 4
property list uchar int vertex_indices
end_header
0 0 0
0.1 0 0
0 0.1 0
0 0 0.1
3 0 2 1
3 0 1 3
3 0 3 2
3 1 2 3
"""


def images(seed: int) -> NDArray[np.uint8]:
    return np.random.default_rng(seed).integers(0, 256, (4, *SIZE, 3), dtype=np.uint8)


def write_angles(folder: Path, number: int) -> None:
    folder.mkdir(parents=True, exist_ok=True)
    for angle, image in zip(ANGLES, images(number), strict=True):
        cv2.imwrite(str(folder / f"{number:06d}_{angle}.png"), image[..., ::-1])


def test_mosaics_are_rebuilt_exactly() -> None:
    coloured = images(0)
    np.testing.assert_array_equal(split_colours(colour_mosaic(coloured)), coloured)
    grey = coloured[..., 0]
    np.testing.assert_array_equal(split_angles(mono_mosaic(grey)), grey)


@pytest.fixture
def ppp_net(tmp_path: Path) -> Path:
    """Three images of a cup in PPP-Net's layout; the second shows none."""
    folder = tmp_path / "data" / "cup"
    (folder / "mask_visib").mkdir(parents=True)
    truth: dict[str, Any] = {}
    for number in (3, 4, 6):
        write_angles(folder / "pol", number)
        if number != 4:
            rotation = SE3.from_rotvec([0.1 * number, 0, 0], np.zeros(3)).rotation
            truth[str(number)] = [
                {"cam_R_m2c": rotation.ravel().tolist(), "cam_t_m2c": [0, 0, 0.5], "obj_id": 1}
            ]
            mask = np.zeros(SIZE, np.uint8)
            mask[2:6, 3:9] = 255
            cv2.imwrite(str(folder / "mask_visib" / f"{number:06d}_000000.png"), mask)
    (folder / "scene_gt.json").write_text(json.dumps(truth))
    infos = {number: [{"visib_fract": 0.75}] for number in truth}
    (folder / "scene_gt_info.json").write_text(json.dumps(infos))
    camera = {str(number): {"cam_K": [20.0, 0, 7.5, 0, 20.0, 5.5, 0, 0, 1]} for number in (3, 4, 6)}
    (folder / "scene_camera.json").write_text(json.dumps(camera))
    (folder / "train.txt").write_text("000003\n000006\n")
    (tmp_path / "cup.ply").write_text(TETRAHEDRON)
    return folder


def test_ppp_net_comes_in(ppp_net: Path, tmp_path: Path) -> None:
    out = tmp_path / "cup.h5"
    assert import_ppp_net(ppp_net, out, mesh=tmp_path / "cup.ply", mesh_units="m", pose_units="m") == 3
    assert validate(out) == []
    with Session.open(out) as session:
        for index, number in enumerate((3, 4, 6)):
            np.testing.assert_array_equal(split_colours(session.raw(index)), images(number))
        assert session.frame_ids.tolist() == [3, 4, 6]
        assert session.drops["frame_id"].tolist() == [5]
        assert set(session.camera_time_ns) == {-1}
        assert session.splits["train"].tolist() == [0, 2]
        assert session.object("cup").refractive_index == 1.5
        poses = session.object_poses("cup")
        assert poses.T_cam_obj.finite.tolist() == [True, False, True]
        assert poses.visible_fraction.tolist() == [0.75, 0, 0.75]
        assert poses.bbox_xywh[0].tolist() == [3, 2, 6, 4]
        np.testing.assert_allclose(session.working_intrinsics.K, [[20, 0, 7.5], [0, 20, 5.5], [0, 0, 1]])


@pytest.mark.parametrize(
    ("mesh_units", "pose_units", "message"),
    [("mm", "m", "the mesh of cup .*--mesh-units"), ("m", "mm", "away.*--pose-units")],
)
def test_lengths_that_cannot_be_are_refused(
    ppp_net: Path, tmp_path: Path, mesh_units: Any, pose_units: Any, message: str
) -> None:
    with pytest.raises(ToolkitError, match=message):
        import_ppp_net(
            ppp_net,
            tmp_path / "c.h5",
            mesh=tmp_path / "cup.ply",
            mesh_units=mesh_units,
            pose_units=pose_units,
        )
    assert not list(tmp_path.glob("c.h5*"))


def test_ppp_net_without_its_files_is_refused(ppp_net: Path, tmp_path: Path) -> None:
    def refused(message: str) -> None:
        with pytest.raises(ToolkitError, match=message):
            import_ppp_net(
                ppp_net, tmp_path / "c.h5", mesh=tmp_path / "cup.ply", mesh_units="m", pose_units="m"
            )

    (ppp_net / "mask_visib" / "000006_000000.png").unlink()
    refused("0 masks of image 000006")
    (ppp_net / "pol" / "000004_90.png").unlink()
    (ppp_net / "scene_camera.json").unlink()
    refused("published intrinsics are for 612x512|masks")
    (ppp_net / "scene_gt.json").write_text('{"3": [{"cam_R_m2c": [1, 2]}]}')
    refused("JSON tables are not of the format")
    (ppp_net / "scene_gt.json").unlink()
    refused("scene_gt.json is missing")


@pytest.fixture
def housecat(tmp_path: Path) -> Path:
    """Two images of a cup and a glass in HouseCat6D's layout, in metres."""
    scene = tmp_path / "scene01"
    for folder in ("labels", "instance", "depth"):
        (scene / folder).mkdir(parents=True)
    for number in (0, 1):
        write_angles(scene / "pol", number)
        instance = np.zeros((*SIZE, 3), np.uint8)
        instance[1:5, 1:6, 2], instance[6:9, 7:12, 2] = 1, 2  # blue, green, red
        cv2.imwrite(str(scene / "instance" / f"{number:06d}.png"), instance)
        cv2.imwrite(str(scene / "depth" / f"{number:06d}.png"), np.full(SIZE, 700 + number, np.uint16))
        label = {
            "instance_ids": [1, 2],
            "class_ids": [4, 8],
            "rotations": np.tile(np.eye(3), (2, 1, 1)),
            "translations": np.array([[0, 0, 0.7], [0.1, 0, 0.8]]),
        }
        (scene / "labels" / f"{number:06d}_label.pkl").write_bytes(pickle.dumps(label))
    np.savetxt(scene / "intrinsics.txt", [[20, 0, 7.5], [0, 20, 5.5], [0, 0, 1]])
    (scene / "meta.txt").write_text("1 4 cup-red\n2 8 glass-tall\n")
    for kind, name in (("cup", "cup-red"), ("glass", "glass-tall")):
        folder = tmp_path / "obj_models_small_size_final" / kind
        folder.mkdir(parents=True)
        corners = ["0 0 0", "0.1 0 0", "0 0.1 0", "0 0 0.1"]
        faces = ["f 1 3 2", "f 1 2 4", "f 1 4 3", "f 2 3 4"]
        (folder / f"{name}.obj").write_text("\n".join([*(f"v {c}" for c in corners), *faces]) + "\n")
    return scene


def test_housecat6d_comes_in(housecat: Path, tmp_path: Path) -> None:
    out = tmp_path / "scene.h5"
    assert import_housecat6d(housecat, out, mesh_units="m", pose_units="m") == 2
    assert validate(out) == []
    with Session.open(out) as session:
        np.testing.assert_array_equal(split_colours(session.raw(1)), images(1))
        assert session.objects == ("cup-red", "glass-tall")
        assert session.object("glass-tall").material == "glass"
        assert session.object_poses("glass-tall").T_cam_obj[1].translation.tolist() == [0.1, 0, 0.8]
        assert session.object_poses("glass-tall").bbox_xywh[0].tolist() == [7, 6, 5, 3]
        assert session.depth(1)[0, 0] == pytest.approx(0.701)


class Harmful:
    def __reduce__(self) -> tuple[Any, tuple[str]]:
        return os.system, ("touch harmed",)


@pytest.mark.parametrize("content", [pickle.dumps(Harmful()), b"", b"not a pickle", pickle.dumps(Path("x"))])
def test_a_pickle_that_would_do_more_is_not_run(
    content: bytes, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "label.pkl").write_bytes(content)
    with pytest.raises(ToolkitError, match="no pickle of plain arrays"):
        read_plain_pickle(tmp_path / "label.pkl")
    assert not (tmp_path / "harmed").exists()


@pytest.mark.parametrize("protocol", range(pickle.HIGHEST_PROTOCOL + 1))
def test_plain_pickles_are_read(protocol: int, tmp_path: Path) -> None:
    value = {"a": np.arange(6.0).reshape(2, 3), "b": [1, "x"], "c": np.float64(2.5)}
    (tmp_path / "label.pkl").write_bytes(pickle.dumps(value, protocol=protocol))
    found = read_plain_pickle(tmp_path / "label.pkl")
    np.testing.assert_array_equal(found["a"], value["a"])
    assert (found["b"], found["c"]) == (value["b"], value["c"])


@pytest.fixture
def raw_folder(tmp_path: Path) -> Path:
    folder = tmp_path / "raw"
    folder.mkdir()
    rng = np.random.default_rng(0)
    frames = rng.integers(0, 4096, (3, 8, 12)).astype(np.uint16)
    cv2.imwrite(str(folder / "a.png"), frames[0])
    cv2.imwrite(str(folder / "b.tiff"), frames[1])
    np.save(folder / "c.npy", frames[2])
    return folder


def test_raw_mosaics_come_in(raw_folder: Path, tmp_path: Path) -> None:
    stamps = tmp_path / "stamps.csv"
    stamps.write_text(
        "\ufefffile,camera_time_ns,exposure_us\nc.npy,3000,20.5\na.png,1000,20.5\nb.tiff,2000,20.5\n"
    )
    out = tmp_path / "raw.h5"
    assert import_raw_folder(raw_folder, out, "mono", 12, stamps) == 3
    assert validate(out) == []
    with Session.open(out) as session:
        np.testing.assert_array_equal(session.raw(2), np.load(raw_folder / "c.npy"))
        assert session.camera_time_ns.tolist() == [1000, 2000, 3000]
        assert set(session.host_time_ns) == {-1}
        assert session.exposures_us.tolist() == [20.5] * 3
        assert session.camera.bits == 12


@pytest.mark.parametrize(
    ("bits", "stamps", "message"),
    [
        (None, None, "give --bits"),
        (8, None, "more than --bits 8"),
        (17, None, "does not fit"),
        (0, None, "does not fit"),
        (12, "file,colour\na.png,red\n", "must name columns"),
        (12, "file,camera_time_ns\na.png,1\n", r"no row for b\.tiff"),
        (12, "file,camera_time_ns\na.png,1\nb.tiff,x\nc.npy,3\n", "holds no number"),
        (12, "file,camera_time_ns\na.png,1\nb.tiff\nc.npy,3\n", "holds no number"),
        (12, f"file,camera_time_ns\na.png,1\nb.tiff,2\nc.npy,{10**25}\n", "holds no number"),
        (12, "file,camera_time_ns\na.png,1\nb.tiff,2\nc.npy,3\nc.npy,4\n", "a file twice"),
        (12, "file,camera_time_ns\na.png,1\nb.tiff,3\nc.npy,2\n", r"of c\.npy, 2, is not later"),
        (12, "file,host_time_ns\na.png,-1\nb.tiff,3\nc.npy,4\n", r"of a\.png, -1, is no time"),
        (12, "file,exposure_us\na.png,1\nb.tiff,0\nc.npy,4\n", r"of b\.tiff, 0\.0, is no"),
        (12, "file,gain_db\na.png,1\nb.tiff,nan\nc.npy,4\n", r"of b\.tiff, nan, is no"),
    ],
)
def test_ambiguous_mosaics_are_refused(
    raw_folder: Path, tmp_path: Path, bits: int | None, stamps: str | None, message: str
) -> None:
    csv = None
    if stamps is not None:
        csv = tmp_path / "stamps.csv"
        csv.write_text(stamps)
    with pytest.raises(ToolkitError, match=message):
        import_raw_folder(raw_folder, tmp_path / "raw.h5", "mono", bits, csv)
    assert not list(tmp_path.glob("raw.h5*"))


def test_pictures_that_are_no_mosaics_are_refused(raw_folder: Path, tmp_path: Path) -> None:
    np.save(raw_folder / "d.npy", np.array([Harmful()], dtype=object), allow_pickle=True)
    with pytest.raises(ToolkitError, match="no plain numpy array"):
        import_raw_folder(raw_folder, tmp_path / "raw.h5", "mono", 12)
    with pytest.raises(ToolkitError, match=r"holds no \.png"):
        import_raw_folder(tmp_path / "nothing", tmp_path / "raw.h5", "mono")
