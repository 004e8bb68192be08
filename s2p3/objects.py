"""Objects whose pose is estimated: a watertight metric mesh, what it is made of, and how it is symmetric.

Diameters and refractive indices of the built-in objects are those of PPP-Net's instance-level data and of the
S2P3 paper's table of refractive indices; the shapes themselves are our own (see `object_meshes`).
"""

from __future__ import annotations

import hashlib
import warnings
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from dataset import SE3, ToolkitError
from dataset.errors import ToolkitWarning
from dataset.meshes import diameter, load_mesh
from dataset.session import ObjectPoses, ObjectRecord, Session
from dataset.symmetry import Symmetry
from s2p3 import object_meshes
from s2p3.materials import Kind, Material, load_material
from s2p3.rendering.mesh import Mesh
from s2p3.symmetry import Proposal, as_toml, holds, propose

if TYPE_CHECKING:
    pass

SAME_SIZE = 0.01
"""Share of the diameter by which two meshes of one object may differ: one may be simplified."""

SAME_INDEX = 0.005
"""Difference of two refractive indices that counts as none: finer than anybody knows one."""

_LARGEST_M, _SMALLEST_M = 2.0, 0.005
_PROPOSAL_POINTS = 150_000


@dataclass(frozen=True, eq=False)
class ObjectModel:
    """One known object.

    Attributes:
        name: what sessions and reports call it.
        vertices: (V, 3) float64, metres, object frame.
        faces: (F, 3) int32, counter-clockwise seen from outside.
        material: "plastic", "metal" or "glass"; how synthesis shades it.
        refractive_index: real part n of the refractive index.
        extinction: imaginary part k; 0 as in the paper, also for metals.
        symmetry: rigid motions that leave it unchanged.
        diameter: largest distance between two of its points, metres.
        albedo: share of light that its body returns; None lets synthesis draw it.
        roughness: alpha of microfacets; None lets synthesis draw it.
    """

    name: str
    vertices: NDArray[np.float64]
    faces: NDArray[np.int32]
    material: Kind
    refractive_index: float
    extinction: float
    symmetry: Symmetry
    diameter: float
    albedo: float | None = None
    roughness: float | None = None

    @cached_property
    def mesh(self) -> Mesh:
        """The same mesh prepared for rendering."""
        return Mesh.from_arrays(self.vertices, self.faces)

    @cached_property
    def fingerprint(self) -> str:
        """A short hash of all that trainings depend on: name, shape, symmetry, refractive index."""
        record = self.to_record()
        what = f"{self.name} {record.sha256} {record.symmetry} {self.diameter} {self.refractive_index}"
        return hashlib.sha256(what.encode()).hexdigest()[:16]

    def to_record(self) -> ObjectRecord:
        """As a session stores it."""
        return ObjectRecord(
            self.name,
            self.vertices,
            self.faces,
            self.material,
            self.refractive_index,
            self.extinction,
            self.symmetry.to_json(),
            self.diameter,
        )

    @property
    def resting(self) -> SE3:
        """T_table_obj: as it stands or lies on a table z = 0, its origin above the table's. The object frame
        is taken as upright, z up."""
        return SE3(np.eye(3), np.array([0.0, 0.0, -float(self.vertices[:, 2].min())]))

    def surface_points(self, count: int, seed: int = 0) -> NDArray[np.float64]:
        """(count, 3) points drawn uniformly over the surface, the same for the same seed."""
        return self._drawn(count, seed)[0]

    def has_its_symmetry(self) -> bool:
        """Whether the declared motions map the surface onto itself, to `symmetry.TOLERANCE`."""
        return holds(self.symmetry, self._drawn(_PROPOSAL_POINTS, 0), self.diameter)

    def proposed_symmetry(self) -> Proposal:
        """What the mesh looks symmetric under: for its user to accept, never assumed."""
        return propose(self._drawn(_PROPOSAL_POINTS, 0), self.vertices, self.diameter)

    def _drawn(self, count: int, seed: int) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Points over the surface and the unit normals of their faces, each (count, 3)."""
        rng = np.random.default_rng(seed)
        corners = self.vertices[self.faces]
        normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        areas = np.linalg.norm(normals, axis=1)
        face = rng.choice(len(areas), size=count, p=areas / areas.sum())
        chosen = corners[face]
        u, v = rng.random((2, count, 1))
        root = np.sqrt(u)
        points = (1 - root) * chosen[:, 0] + root * (1 - v) * chosen[:, 1] + root * v * chosen[:, 2]
        return points, normals[face] / areas[face, None]


@dataclass(frozen=True)
class _Design:
    """What is fixed about a built-in object besides its shape."""

    material: Kind
    refractive_index: float
    diameter: float
    axis: tuple[float, float, float] | None = None


_BUILDERS = {
    "cup": object_meshes.cup,
    "fork": object_meshes.fork,
    "knife": object_meshes.knife,
    "bottle": object_meshes.bottle,
}
_DESIGNS = {
    "cup": _Design("plastic", 1.50, 0.1387),
    "fork": _Design("metal", 2.75, 0.1892),
    "knife": _Design("metal", 2.75, 0.2309),
    "bottle": _Design("glass", 1.52, 0.1397, axis=(0.0, 0.0, 1.0)),
}
NAMES = tuple(_BUILDERS)
"""The objects `build` knows."""


def build(name: str) -> ObjectModel:
    """One of the built-in objects; its frame has its origin at the bounding box's centre and z up.

    Raises:
        ToolkitError: no such object.
    """
    if name not in _BUILDERS:
        raise ToolkitError(
            f"object {name!r} is unknown; built in are {', '.join(NAMES)}, or give a mesh file"
        )
    design = _DESIGNS[name]
    vertices, faces = _BUILDERS[name]()
    vertices = vertices - 0.5 * (vertices.min(axis=0) + vertices.max(axis=0))
    vertices = vertices * (design.diameter / diameter(vertices))
    axis = None if design.axis is None else np.array(design.axis)
    return ObjectModel(
        name,
        vertices,
        faces,
        design.material,
        design.refractive_index,
        0.0,
        Symmetry(axis=axis),
        design.diameter,
    )


def named_object(
    name: str, mesh: str | Path | None = None, material: str | Path | None = None
) -> ObjectModel:
    """A built-in object, or, given a mesh file, an object of that name loaded from it.

    Args:
        mesh: PLY, OBJ or STL in metres.
        material: material file; without one, that beside the mesh (mug.toml beside mug.ply) where there is
            one. A built-in object given one keeps its shape and symmetry.

    Raises:
        ToolkitError: see `build`, `load` and `materials.load_material`.
    """
    if mesh is None:
        model = build(name)
        return model if material is None else _made_of(model, load_material(material))
    beside = Path(mesh).with_suffix(".toml")
    file = material if material is not None else beside if beside.is_file() else None
    return load(mesh, name=name, made_of=Material() if file is None else load_material(file))


def poses_of(session: Session, model: ObjectModel) -> ObjectPoses:
    """The poses of an object in a session.

    Raises:
        SessionError: it was not annotated.
        ToolkitError: it was annotated with a mesh of another size, or placed otherwise in its frame, so that
            its poses are not this object's; or the session knows a symmetry that the object lacks.

    Warns (ToolkitWarning) where the session has another refractive index, or lacks a symmetry.
    """
    poses, record = session.object_poses(model.name), session.object(model.name)
    theirs, ours = (np.stack([v.min(axis=0), v.max(axis=0)]) for v in (record.vertices, model.vertices))
    apart = float(np.abs(theirs - ours).max())
    if apart > SAME_SIZE * model.diameter:
        raise ToolkitError(
            f"{session.path}: its {model.name!r} has another mesh than the one given (their boxes are "
            f"{1000 * apart:.1f} mm apart); give the mesh it was annotated with, or annotate again"
        )
    symmetry = Symmetry.from_json(record.symmetry)
    if not model.symmetry.covers(symmetry):
        raise ToolkitError(
            f"{session.path}: its {model.name!r} has a symmetry that the mesh given lacks; write it into the "
            f"material file beside the mesh: {' '.join(as_toml(symmetry).splitlines())}"
        )
    if abs(record.refractive_index - model.refractive_index) > SAME_INDEX:
        warnings.warn(
            f"{session.path}: its {model.name!r} has the refractive index {record.refractive_index:g}; "
            f"{model.refractive_index:g} is used, which a material file beside the mesh can change",
            ToolkitWarning,
            stacklevel=1,  # said once, however often the poses are read
        )
    if not symmetry.covers(model.symmetry):
        warnings.warn(
            f"{session.path}: its {model.name!r} lacks a symmetry that the one given has, which is used",
            ToolkitWarning,
            stacklevel=1,
        )
    return poses


def _made_of(model: ObjectModel, material: Material) -> ObjectModel:
    return replace(
        model,
        material=material.kind,
        refractive_index=material.refractive_index,
        extinction=material.extinction,
        albedo=material.albedo,
        roughness=material.roughness,
    )


def load(path: str | Path, *, name: str | None = None, made_of: Material | None = None) -> ObjectModel:
    """An object from a PLY, OBJ or STL file in metres; its frame is the file's.

    Args:
        made_of: its material and symmetry; a plastic of index 1.5 without symmetry when None.

    Raises:
        ToolkitError: the file is missing or unreadable, the mesh is empty, hardly in metres by its size, or
            not watertight.
    """
    path = Path(path)
    mesh = load_mesh(path, f"give a PLY, OBJ or STL, or one of {', '.join(NAMES)}")
    mesh.merge_vertices(merge_tex=True, merge_norm=True)
    vertices = np.asarray(mesh.vertices, dtype=np.float64)
    faces = np.asarray(mesh.faces, dtype=np.int32)
    if not np.isfinite(vertices).all():
        raise ToolkitError(f"{path}: has corners that are no numbers; export the mesh again")
    size = diameter(vertices)
    if size > _LARGEST_M:
        raise ToolkitError(
            f"{path}: the mesh is {size:.1f} m across, so it is probably in millimetres; "
            "scale it by 0.001 and export it in metres"
        )
    if size < _SMALLEST_M:
        raise ToolkitError(
            f"{path}: the mesh is {1000 * size:.3g} mm across, so it is hardly in metres; "
            "scale it to its real size and export it in metres"
        )
    if not (mesh.is_watertight and mesh.is_winding_consistent):
        raise ToolkitError(
            f"{path}: the mesh is not watertight ({_open_edges(faces)} open edges); "
            "close its holes (a mesh editor's 'make watertight' or 'fill holes') and export it again"
        )
    if mesh.volume < 0:
        faces = np.ascontiguousarray(faces[:, ::-1])
    made_of = made_of or Material()
    return ObjectModel(
        name or path.stem,
        vertices,
        faces,
        made_of.kind,
        made_of.refractive_index,
        made_of.extinction,
        made_of.symmetry.symmetry(),
        size,
        made_of.albedo,
        made_of.roughness,
    )


def _open_edges(faces: NDArray[np.int32]) -> int:
    edges = np.sort(np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]]), axis=1)
    _, uses = np.unique(edges, axis=0, return_counts=True)
    return int((uses != 2).sum())
