"""Objects: watertight, metric, symmetric as declared; bad meshes refused in one line."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import trimesh
from scipy.spatial import cKDTree

from dataset import SE3, ToolkitError
from dataset.errors import ToolkitWarning
from dataset.session import Session
from s2p3 import object_meshes, objects
from s2p3.materials import Material, load_material
from s2p3.simplify import simplify
from s2p3.synthesis import session_camera, synthesize


@pytest.mark.parametrize(
    ("name", "diameter", "index"),
    [("cup", 0.1387, 1.50), ("fork", 0.1892, 2.75), ("knife", 0.2309, 2.75), ("bottle", 0.1397, 1.52)],
)
def test_built_in_objects_have_the_published_size_and_index(name: str, diameter: float, index: float) -> None:
    model = objects.build(name)
    assert objects.diameter(model.vertices) == pytest.approx(diameter, rel=1e-9)
    assert model.diameter == diameter
    assert model.refractive_index == index
    assert model.extinction == 0.0


@pytest.mark.parametrize("name", objects.NAMES)
def test_built_in_objects_are_closed_centred_and_of_moderate_size(name: str) -> None:
    model = objects.build(name)
    mesh = trimesh.Trimesh(model.vertices, model.faces, process=False)
    assert mesh.is_watertight
    assert mesh.is_winding_consistent
    assert len(np.unique(model.faces)) == len(model.vertices)
    assert mesh.volume > 0
    assert len(mesh.split(only_watertight=False)) == 1
    np.testing.assert_allclose(model.vertices.min(axis=0) + model.vertices.max(axis=0), 0.0, atol=1e-12)
    assert 3000 <= len(model.faces) <= 18000


def test_the_cup_has_one_handle_and_the_bottle_is_hollow() -> None:
    cup, bottle = objects.build("cup"), objects.build("bottle")
    assert trimesh.Trimesh(cup.vertices, cup.faces, process=False).euler_number == 0
    assert cup.vertices[:, 0].max() > 0.0  # the handle, towards +x
    wall = trimesh.Trimesh(bottle.vertices, bottle.faces, process=False)
    assert wall.volume < 0.4 * wall.convex_hull.volume


def test_the_resting_pose_puts_the_lowest_point_on_the_table() -> None:
    for name in objects.NAMES:
        model = objects.build(name)
        assert model.resting.apply(model.vertices)[:, 2].min() == pytest.approx(0.0, abs=1e-12)


def test_declared_symmetries_map_the_surface_onto_itself() -> None:
    bottle = objects.build("bottle")
    tree = cKDTree(bottle.surface_points(60000, seed=1))
    points = bottle.surface_points(500, seed=2)
    for turned in bottle.symmetry.sampled(5):
        distance, _ = tree.query(points @ turned[:3, :3].T)
        assert np.quantile(distance, 0.99) < 0.0015
    assert bottle.symmetry.any
    assert not any(objects.build(name).symmetry.any for name in ("cup", "fork", "knife"))


def test_symmetry_survives_json() -> None:
    half_turn = np.diag([-1.0, -1.0, 1.0, 1.0])
    symmetry = objects.Symmetry(half_turn[None], np.array([0.0, 0.0, 1.0]))
    again = objects.Symmetry.from_json(symmetry.to_json())
    np.testing.assert_array_equal(again.transforms, symmetry.transforms)
    assert again.axis is not None
    np.testing.assert_array_equal(again.axis, [0.0, 0.0, 1.0])
    assert not objects.Symmetry.from_json("").any
    with pytest.raises(ToolkitError, match="symmetries_discrete"):
        objects.Symmetry.from_json("[1, 2]")


def test_surface_points_are_reproducible_and_on_the_surface() -> None:
    cup = objects.build("cup")
    points = cup.surface_points(200, seed=3)
    np.testing.assert_array_equal(points, cup.surface_points(200, seed=3))
    mesh = trimesh.Trimesh(cup.vertices, cup.faces, process=False)
    assert trimesh.proximity.closest_point(mesh, points)[1].max() < 1e-9


def _export(path: Path, vertices: np.ndarray, faces: np.ndarray) -> Path:
    trimesh.Trimesh(vertices, faces, process=False).export(path)
    return path


@pytest.mark.parametrize("suffix", ["ply", "obj", "stl"])
def test_load_reads_back_what_was_exported(tmp_path: Path, suffix: str) -> None:
    vertices, faces = object_meshes.box((0.1, 0.05, 0.02))
    model = objects.load(
        _export(tmp_path / f"block.{suffix}", vertices, faces), made_of=Material(refractive_index=1.4)
    )
    assert (model.name, model.refractive_index, len(model.faces)) == ("block", 1.4, 12)
    assert model.diameter == pytest.approx(np.linalg.norm([0.1, 0.05, 0.02]), rel=1e-5)


def test_load_turns_an_inside_out_mesh(tmp_path: Path) -> None:
    vertices, faces = object_meshes.box((0.1, 0.05, 0.02))
    model = objects.load(_export(tmp_path / "inside_out.ply", vertices, faces[:, ::-1]))
    assert trimesh.Trimesh(model.vertices, model.faces, process=False).volume > 0


def test_load_refuses_bad_meshes_in_one_line_that_names_the_fix(tmp_path: Path) -> None:
    vertices, faces = object_meshes.box((0.1, 0.05, 0.02))
    garbage = tmp_path / "garbage.ply"
    garbage.write_bytes(b"not a mesh")
    cases = [
        (_export(tmp_path / "open.ply", vertices, faces[1:]), "not watertight .3 open edges"),
        (_export(tmp_path / "large.ply", vertices * 1000, faces), "millimetres"),
        (_export(tmp_path / "small.ply", vertices / 1000, faces), "hardly in metres"),
        (tmp_path / "missing.ply", "no such mesh file"),
        (garbage, "cannot be read"),
    ]
    for path, pattern in cases:
        with pytest.raises(ToolkitError, match=pattern) as caught:
            objects.load(path)
        assert "\n" not in str(caught.value)
        assert str(path) in str(caught.value)
    with pytest.raises(ToolkitError, match="spoon"):
        objects.build("spoon")


def test_cutlery_has_thickness_and_the_bottle_an_inside() -> None:
    for name, thinnest in (("fork", 0.0005), ("knife", 0.0002)):
        model = objects.build(name)
        mesh = trimesh.Trimesh(model.vertices, model.faces, process=False)
        assert mesh.volume / (mesh.area / 2) > thinnest  # a sheet without thickness has no volume
    bottle = objects.build("bottle")
    mesh = trimesh.Trimesh(bottle.vertices, bottle.faces, process=False)
    hits, _, _ = mesh.ray.intersects_location([[-0.1, 0.0005, 0.0]], [[1.0, 0.0, 0.0]])
    assert len(hits) == 4  # in and out of the glass, twice
    walls = np.diff(np.sort(hits[:, 0]))
    assert walls[0] == pytest.approx(walls[2], rel=0.05)
    assert 0.001 < walls[0] < 0.004 < walls[1]


_TOML = """
kind = "metal"
refractive_index = 2.75
extinction = 3.8
colour = [0.5, 0.5, 0.5]
roughness = 0.2

[symmetry]
axis = [0, 0, 2]
turns = [[1, 0, 0, 180]]
"""


def test_a_material_file_beside_the_mesh_is_read(tmp_path: Path) -> None:
    mesh = _export(tmp_path / "rod.ply", *object_meshes.box((0.02, 0.02, 0.1)))
    plain = objects.named_object("rod", mesh)
    assert (plain.material, plain.refractive_index, plain.albedo) == ("plastic", 1.5, None)
    assert not plain.symmetry.any
    (tmp_path / "rod.toml").write_text(_TOML)
    rod = objects.named_object("rod", mesh)
    assert (rod.material, rod.refractive_index, rod.extinction, rod.roughness) == ("metal", 2.75, 3.8, 0.2)
    assert rod.albedo == pytest.approx(0.5)
    assert rod.symmetry.axis is not None
    np.testing.assert_allclose(rod.symmetry.axis, [0, 0, 1])
    np.testing.assert_allclose(rod.symmetry.transforms[0], np.diag([1.0, -1, -1, 1]), atol=1e-12)
    other = tmp_path / "other.toml"
    other.write_text('kind = "glass"\nrefractive_index = 1.46\n')
    assert objects.named_object("rod", mesh, other).material == "glass"
    spare = objects.named_object("fork", material=other)
    assert (spare.material, spare.diameter) == ("glass", objects.build("fork").diameter)


@pytest.mark.parametrize(
    ("text", "pattern"),
    [
        ("kind = 'wood'", "plastic.*metal.*glass"),
        ("refractive_index = 0.9", "above 1"),
        ('kind = "metal"\nrefractive_index = 0.2', "metals with less, as gold, are not modelled"),
        ("extinction = 2.0", "metals"),
        ("colour = [2.0, 0, 0]", "0 to 1"),
        ("roughness = 0.0", "roughness"),
        ("refractiv_index = 1.5", "refractive_index"),
        ("[symmetry]\naxis = [0, 0, 0]", "direction"),
        ("[symmetry]\nturns = [[0, 0, 1, 2]]", "whole fraction"),
        ("[symmetry]\nturns = [[0, 0, 1, 7]]", "whole fraction"),
        ("kind = ", "TOML"),
    ],
)
def test_a_wrong_material_file_is_told_in_one_line(tmp_path: Path, text: str, pattern: str) -> None:
    file = tmp_path / "bad.toml"
    file.write_text(text)
    with pytest.raises(ToolkitError, match=pattern) as caught:
        objects.named_object("cup", material=file)
    assert "\n" not in str(caught.value)
    assert str(file) in str(caught.value)
    with pytest.raises(ToolkitError, match="no such file"):
        objects.named_object("cup", material=tmp_path / "missing.toml")


def test_what_follows_from_a_turn_is_a_symmetry_too(tmp_path: Path) -> None:
    file = tmp_path / "gear.toml"
    file.write_text("[symmetry]\nturns = [[0, 0, 1, 90]]\n")
    turns = SE3.from_matrix(load_material(file).symmetry.symmetry().transforms).as_rotvec()
    np.testing.assert_allclose(np.sort(np.linalg.norm(turns, axis=1)), np.radians([90, 90, 180]), atol=1e-9)


_FLIP = np.diag([1.0, -1, -1, 1])[None, None]


def test_a_declared_symmetry_is_held_against_the_shape() -> None:
    bottle, cup = objects.build("bottle"), objects.build("cup")
    assert bottle.has_its_symmetry()
    assert cup.has_its_symmetry()  # it has none
    assert not replace(cup, symmetry=bottle.symmetry).has_its_symmetry()
    assert not replace(bottle, symmetry=objects.Symmetry(*_FLIP)).has_its_symmetry()
    assert replace(_block((0.1, 0.05, 0.02)), symmetry=objects.Symmetry(*_FLIP)).has_its_symmetry()


def test_a_session_tells_of_a_symmetry_that_the_mesh_lacks(tmp_path: Path) -> None:
    bottle = objects.build("bottle")
    path = tmp_path / "bottle.h5"
    synthesize(bottle, 1, session_camera(), 0, path)
    mesh = _export(tmp_path / "bottle.ply", bottle.vertices, bottle.faces)
    with Session.open(path) as session:
        assert len(objects.poses_of(session, bottle).visible_fraction) == 1
        with pytest.raises(ToolkitError, match=r"symmetry.*material file.*axis = \[0, 0, 1\]"):
            objects.poses_of(session, objects.named_object("bottle", mesh))
        turning = replace(bottle, symmetry=objects.Symmetry(*_FLIP, axis=bottle.symmetry.axis))
        with pytest.warns(ToolkitWarning, match="lacks a symmetry that the one given has"):
            objects.poses_of(session, turning)
        (tmp_path / "bottle.toml").write_text("[symmetry]\naxis = [0, 0, -1]\n")
        with pytest.warns(ToolkitWarning, match="refractive index"):
            objects.poses_of(session, objects.named_object("bottle", mesh))


@pytest.mark.parametrize(
    "continuous",
    ['{"axis": [0, 0, 1], "offset": [20, 0, 0]}', '{"axis": [0, 0, 1]}, {"axis": [1, 0, 0]}'],
)
def test_a_symmetry_that_cannot_be_used_is_refused(continuous: str) -> None:
    with pytest.raises(ToolkitError, match="one axis at most, through the mesh's origin"):
        objects.Symmetry.from_json(f'{{"symmetries_continuous": [{continuous}]}}')
    along = '{"symmetries_continuous": [{"axis": [0, 0, 1], "offset": [0, 0, 20]}]}'
    assert objects.Symmetry.from_json(along).axis is not None


def _block(size: tuple[float, float, float]) -> objects.ObjectModel:
    vertices, faces = object_meshes.box(size)
    return objects.ObjectModel(
        "block", vertices, faces, "plastic", 1.5, 0.0, objects.Symmetry(), objects.diameter(vertices)
    )


@pytest.mark.parametrize(
    ("size", "turns"), [((0.1, 0.05, 0.02), 3), ((0.1, 0.1, 0.02), 7), ((0.1, 0.1, 0.1), 23)]
)
def test_symmetries_of_boxes_are_proposed_whole(size: tuple[float, float, float], turns: int) -> None:
    proposal = _block(size).proposed_symmetry()
    assert proposal.axis is None
    assert len(proposal.turns) == turns
    assert proposal.offset_m < 0.001


def test_symmetries_are_proposed_for_the_bottle_only_and_accepted_by_hand(tmp_path: Path) -> None:
    for name in ("cup", "fork", "knife"):
        assert not objects.build(name).proposed_symmetry().any
    bottle = objects.build("bottle")
    proposal = bottle.proposed_symmetry()
    assert proposal.axis == (0.0, 0.0, 1.0)
    assert proposal.turns == ()
    mesh = _export(tmp_path / "flask.ply", bottle.vertices, bottle.faces)
    assert not objects.named_object("flask", mesh).symmetry.any  # proposed is not assumed
    (tmp_path / "flask.toml").write_text(proposal.toml)
    assert objects.named_object("flask", mesh).symmetry.any
    beside = replace(bottle, vertices=bottle.vertices + np.array([0.01, 0.0, 0.0]))
    assert beside.proposed_symmetry().offset_m == pytest.approx(0.01, abs=0.0005)


def test_a_simplified_mesh_is_closed_and_within_its_bound() -> None:
    cup = objects.build("cup")
    fine = trimesh.Trimesh(cup.vertices, cup.faces, process=False).subdivide()
    model = replace(cup, vertices=np.asarray(fine.vertices), faces=np.asarray(fine.faces, np.int32))
    fewer = simplify(model, 0.0002)
    assert len(fewer.model.faces) < 0.3 * len(model.faces)
    assert 0 < fewer.error_m <= 0.0002
    mesh = trimesh.Trimesh(fewer.model.vertices, fewer.model.faces, process=False)
    assert mesh.is_watertight
    _, distance, _ = trimesh.proximity.closest_point(mesh, model.surface_points(300, seed=5))
    assert distance.max() <= fewer.error_m * 1.05
    with pytest.raises(ToolkitError, match="positive"):
        simplify(model, 0.0)
