"""`s2p3 evaluate` writes figures, report and BOP results, compares runs, and refuses what it cannot judge."""

from __future__ import annotations

import csv
import json
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import trimesh
from safetensors.torch import load_file

from dataset.session import ObjectPoses, Session, write_poses, write_split
from s2p3.cli import main
from s2p3.evaluation.bop_results import write_bop_results
from s2p3.evaluation.files import told_apart
from s2p3.evaluation.summary import FIGURES
from s2p3.objects import ObjectModel, build
from s2p3.training import checkpoint
from tests.s2p3.evaluations import evaluation, missed, record
from tests.s2p3.untrained import eager_detector_config, save_untrained


@pytest.fixture(scope="module")
def session(tmp_path_factory: pytest.TempPathFactory, cup_session: Path) -> Path:
    path = Path(shutil.copy(cup_session, tmp_path_factory.mktemp("session") / "cup.h5"))
    write_split(path, "train", [0, 1, 2])
    write_split(path, "test", [3, 4, 5, 6, 7])
    return path


def words(session: Path, networks: dict[str, Path], network: str = "student", name: str = "cup") -> list[str]:
    chosen = ["--network", str(networks[network]), "--detector", str(networks["detector"])]
    return ["evaluate", str(session), "--object", name, *chosen]


def refusal(arguments: list[str], capfd: pytest.CaptureFixture[str]) -> str:
    """The one line with which the command line refuses."""
    capfd.readouterr()
    assert main(arguments) == 2
    (line,) = capfd.readouterr().err.splitlines()
    return line


def test_an_evaluation_leaves_figures_report_and_results(
    session: Path, networks: dict[str, Path], tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    first, second = tmp_path / "teacher.json", tmp_path / "student.json"
    assert main([*words(session, networks, "teacher"), "--out", str(first)]) == 0
    capfd.readouterr()
    extra = ["--out", str(second), "--beside", str(first), "--scene-id", "3", "--json"]
    assert main([*words(session, networks), *extra]) == 0
    printed = json.loads(capfd.readouterr().out)
    assert set(printed["intervals"]) == set(printed["above"]["teacher"]) == set(FIGURES)
    content = json.loads(second.read_text())
    assert content["subject"]["object_name"] == "cup"
    assert len(content["records"]) == content["summary"]["targets"] == 5
    assert all(record["unseen_deg"] >= 0 for record in content["records"])
    assert "from the nearest known view" in content["groups"]
    page = second.with_suffix(".html").read_text()
    assert page.count("<img") == 6
    for text in ("student minus", "AR MSSD", "from the nearest known view", "cup: teacher"):
        assert text in page
    rows = list(csv.DictReader(second.with_suffix(".csv").open()))
    assert [int(row["im_id"]) for row in rows] == [3, 4, 5, 6, 7]
    assert {(row["scene_id"], row["obj_id"]) for row in rows} == {("3", "1")}


def test_results_hold_the_estimates_as_the_bop_toolkit_reads_them(cup: ObjectModel, tmp_path: Path) -> None:
    pose = np.eye(4)
    pose[:3] = [[0, -1, 0, 0.001], [1, 0, 0, -0.02], [0, 0, 1, 0.4]]
    found = record(7, 0.01, T_cam_obj=tuple(map(tuple, pose.tolist())))
    path = tmp_path / "results.csv"
    write_bop_results(path, evaluation([found, missed(8)], cup), scene_id=2, object_id=5)
    header, row = path.read_text().splitlines()
    assert header == "scene_id,im_id,obj_id,score,R,t,time"
    assert row == "2,7,5,0.9,0.0 -1.0 0.0 1.0 0.0 0.0 0.0 0.0 1.0,1.0 -20.0 400.0,-1"


def test_a_checkpoint_of_another_object_is_refused(
    session: Path, networks: dict[str, Path], tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    other = save_untrained(tmp_path, build("fork"), eager_detector_config())
    for kind in ("student", "detector"):
        line = refusal(words(session, networks | {kind: other[kind]}), capfd)
        assert f"was trained for 'fork', not 'cup'; train a {kind}" in line


def test_a_checkpoint_of_another_kind_is_refused(
    session: Path, networks: dict[str, Path], capfd: pytest.CaptureFixture[str]
) -> None:
    line = refusal(words(session, networks | {"detector": networks["student"]}), capfd)
    assert "holds a student, not a detector" in line
    line = refusal(words(session, networks, "detector"), capfd)
    assert "holds a detector, not a teacher or student" in line


def test_a_checkpoint_of_another_input_set_is_refused(
    session: Path, networks: dict[str, Path], tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    info, moved = checkpoint.read_info(networks["student"]), tmp_path / "student.safetensors"
    config = replace(info.config, input=replace(info.config.input, aolp="angle"))
    checkpoint.save(moved, load_file(networks["student"]), replace(info, config=config))
    line = refusal(words(session, networks | {"student": moved}), capfd)
    assert "student.safetensors: does not fit this network" in line


def test_a_session_without_the_object_is_refused(
    session: Path, networks: dict[str, Path], tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    other = save_untrained(tmp_path, build("fork"), eager_detector_config())
    assert "object 'fork' has no poses; run: s2p3 annotate" in refusal(
        words(session, other, name="fork"), capfd
    )


def test_an_unknown_or_empty_split_is_refused(
    session: Path, networks: dict[str, Path], tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    assert "no split 'night'" in refusal([*words(session, networks), "--split", "night"], capfd)
    empty = Path(shutil.copy(session, tmp_path / "empty.h5"))
    with Session.open(empty) as opened:
        poses = opened.object_poses("cup")
        masks = np.stack([poses.mask(index) for index in range(len(opened))])
    hidden = ObjectPoses(poses.T_cam_obj, 0.05 * poses.visible_fraction, poses.bbox_xywh, masks)
    write_poses(empty, poses.T_cam_obj.inverse(), 0.0, 0.0, {"cup": hidden})
    assert "none of the 5 frames shows 'cup'; choose another split" in refusal(words(empty, networks), capfd)


def test_a_mesh_in_millimetres_is_refused(
    session: Path,
    networks: dict[str, Path],
    cup: ObjectModel,
    tmp_path: Path,
    capfd: pytest.CaptureFixture[str],
) -> None:
    mesh = tmp_path / "cup.ply"
    trimesh.Trimesh(1000 * cup.vertices, cup.faces).export(mesh)
    assert "probably in millimetres" in refusal([*words(session, networks), "--mesh", str(mesh)], capfd)


def test_what_cannot_stand_beside_is_refused(
    session: Path, networks: dict[str, Path], tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "not.json").write_text("{}")
    line = refusal([*words(session, networks), "--beside", str(tmp_path / "not.json")], capfd)
    assert "is no saved evaluation" in line
    line = refusal([*words(session, networks), "--beside", str(tmp_path / "gone.json")], capfd)
    assert "gone.json: no such file" in line


@pytest.mark.parametrize(
    ("paths", "names"),
    [
        ([], []),
        (["results/after.json"], ["after"]),
        (["row-1/test.json", "row-2/test.json", "before.json"], ["row-1/test", "row-2/test", "before"]),
        (["a/1/test.json", "b/1/test.json", "2/test.json"], ["a/1/test", "b/1/test", "2/test"]),
    ],
)
def test_evaluations_are_called_by_the_shortest_end_of_the_path_that_tells_them_apart(
    paths: list[str], names: list[str]
) -> None:
    assert told_apart([Path(path) for path in paths]) == names


def test_evaluations_of_the_same_name_stand_beside_each_other(
    session: Path, networks: dict[str, Path], tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    outs = [tmp_path / row / "test.json" for row in ("row-1", "row-2", "row-3")]
    for kind, out in zip(("teacher", "student"), outs, strict=False):
        assert main([*words(session, networks, kind), "--out", str(out)]) == 0
    capfd.readouterr()
    beside = ["--beside", str(outs[0]), str(outs[1])]
    assert main([*words(session, networks), *beside, "--out", str(outs[2]), "--json"]) == 0
    above = json.loads(capfd.readouterr().out)["above"]
    assert list(above) == ["row-1/test", "row-2/test"]
    moved = {name: found["translation_mm"]["value"] for name, found in above.items()}
    assert moved["row-2/test"] == 0 != moved["row-1/test"]
    page = outs[2].with_suffix(".html").read_text()
    assert all(f"row-{row}/test" in page for row in (1, 2, 3))


@pytest.mark.parametrize(
    ("out", "beside", "said"),
    [
        ("page.html", [], "name it"),
        (".", [], "is a folder"),
        ("new.json", ["old.json", "./old.json"], "named twice"),
        ("old.json", ["old.json"], "named twice"),
    ],
)
def test_names_that_cannot_be_are_refused_before_anything_is_read(
    out: str, beside: list[str], said: str, tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    nothing = {kind: tmp_path / f"{kind}.safetensors" for kind in ("student", "detector")}
    arguments = [*words(tmp_path / "no.h5", nothing), "--out", str(tmp_path / out)]
    earlier = ["--beside", *(f"{tmp_path}/{name}" for name in beside)] if beside else []
    assert said in refusal([*arguments, *earlier], capfd)


def test_nothing_detected_is_recall_zero_not_an_error(
    session: Path, cup: ObjectModel, tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    config = eager_detector_config()
    never = replace(config.detector, minimum_score=1.0)
    blind = save_untrained(tmp_path, cup, replace(config, detector=never))
    capfd.readouterr()
    assert main([*words(session, blind), "--out", str(tmp_path / "blind.json"), "--json"]) == 0
    summary = json.loads(capfd.readouterr().out)
    assert (summary["targets"], summary["missed"], summary["recall_10"]) == (5, 5, 0.0)
    assert summary["rotation_deg"] is None
    assert "missed" in (tmp_path / "blind.html").read_text()
