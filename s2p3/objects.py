"""Objects whose pose is estimated: a watertight metric mesh, what it is made of, and how it is symmetric.

Diameters and refractive indices of the built-in objects are those of PPP-Net's instance-level data and of the
S2P3 paper's table of refractive indices; the shapes themselves are our own (see `object_meshes`).
"""

from __future__ import annotations

import json
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.spatial import ConvexHull
from scipy.spatial.distance import pdist

from dataset import SE3, ToolkitError
from dataset.session import ObjectRecord
from s2p3 import object_meshes
from s2p3.rendering.mesh import Mesh

if TYPE_CHECKING:
    import trimesh

_LARGEST_M = 2.0


@dataclass(frozen=True, eq=False)
class Symmetry:
    """Rigid motions that leave an object looking the same; none by default.

    Attributes:
        transforms: (n, 4, 4) float64, object <- object, the identity not listed.
        axis: (3,) unit direction through the origin about which any rotation is a symmetry, or None.
    """

    transforms: NDArray[np.float64] = field(default_factory=lambda: np.zeros((0, 4, 4)))
    axis: NDArray[np.float64] | None = None

    @property
    def any(self) -> bool:
        """Whether the object has a symmetry: its metric is then ADD-S, otherwise ADD."""
        return self.axis is not None or len(self.transforms) > 0

    def sampled(self, steps: int = 72) -> NDArray[np.float64]:
        """The symmetries as a finite list (m, 4, 4), the identity first; the continuous axis in `steps`."""
        discrete = np.concatenate([np.eye(4)[None], self.transforms])
        if self.axis is None:
            return discrete
        turns = 2 * np.pi * np.arange(steps) / steps
        around = SE3.from_rotvec(turns[:, None] * self.axis, np.zeros((steps, 3))).as_matrix()
        return (around[:, None] @ discrete[None]).reshape(-1, 4, 4)

    def to_json(self) -> str:
        """The two keys of the BOP challenge's models_info.json, in metres."""
        continuous = [] if self.axis is None else [{"axis": self.axis.tolist(), "offset": [0.0, 0.0, 0.0]}]
        discrete = [matrix.ravel().tolist() for matrix in self.transforms]
        return json.dumps({"symmetries_discrete": discrete, "symmetries_continuous": continuous})

    @staticmethod
    def from_json(text: str) -> Symmetry:
        """Inverse of `to_json`; an empty text means no symmetry.

        Raises:
            ToolkitError: not such a JSON text.
        """
        try:
            data: dict[str, Any] = json.loads(text) if text else {}
            discrete = np.array(data.get("symmetries_discrete", []), dtype=np.float64).reshape(-1, 4, 4)
            continuous = data.get("symmetries_continuous", [])
            axis = np.array(continuous[0]["axis"], dtype=np.float64) if continuous else None
        except (ValueError, KeyError, TypeError, AttributeError) as error:
            raise ToolkitError(
                f"object symmetry: cannot read {text[:60]!r} ({error}); expected JSON with "
                "symmetries_discrete (16 numbers each) and symmetries_continuous (axis, offset)"
            ) from error
        return Symmetry(discrete, axis if axis is None else axis / np.linalg.norm(axis))


@dataclass(frozen=True, eq=False)
class ObjectModel:
    """One known object.

    Attributes:
        name: what sessions and reports call it.
        vertices: (V, 3) float64, metres, object frame.
        faces: (F, 3) int32, counter-clockwise seen from outside.
        material: "plastic", "steel" or "glass"; how synthesis shades it.
        refractive_index: real part n of the refractive index.
        extinction: imaginary part k; 0 as in the paper.
        symmetry: rigid motions that leave it unchanged.
        diameter: largest distance between two of its points, metres.
    """

    name: str
    vertices: NDArray[np.float64]
    faces: NDArray[np.int32]
    material: str
    refractive_index: float
    extinction: float
    symmetry: Symmetry
    diameter: float

    @cached_property
    def mesh(self) -> Mesh:
        """The same mesh prepared for rendering."""
        return Mesh.from_arrays(self.vertices, self.faces)

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
        rng = np.random.default_rng(seed)
        corners = self.vertices[self.faces]
        areas = np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1)
        chosen = corners[rng.choice(len(areas), size=count, p=areas / areas.sum())]
        u, v = rng.random((2, count, 1))
        root = np.sqrt(u)
        return (1 - root) * chosen[:, 0] + root * (1 - v) * chosen[:, 1] + root * v * chosen[:, 2]


@dataclass(frozen=True)
class _Design:
    """What is fixed about a built-in object besides its shape."""

    material: str
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
    "fork": _Design("steel", 2.75, 0.1892),
    "knife": _Design("steel", 2.75, 0.2309),
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


def named_object(name: str, mesh: str | Path | None = None) -> ObjectModel:
    """A built-in object, or, given a mesh file, an object of that name loaded from it.

    Raises:
        ToolkitError: see `build` and `load`.
    """
    return build(name) if mesh is None else load(mesh, name=name)


def load(
    path: str | Path,
    *,
    name: str | None = None,
    material: str = "plastic",
    refractive_index: float = 1.5,
    extinction: float = 0.0,
    symmetry: Symmetry | None = None,
) -> ObjectModel:
    """An object from a PLY, OBJ or STL file in metres; its frame is the file's.

    Raises:
        ToolkitError: the file is missing or unreadable, the mesh is empty, too large to be in metres, or not
            watertight.
    """
    path = Path(path)
    mesh = _read(path)
    vertices = np.asarray(mesh.vertices, dtype=np.float64)
    faces = np.asarray(mesh.faces, dtype=np.int32)
    size = diameter(vertices)
    if size > _LARGEST_M:
        raise ToolkitError(
            f"{path}: the mesh is {size:.1f} m across, so it is probably in millimetres; "
            "scale it by 0.001 and export it in metres"
        )
    if not (mesh.is_watertight and mesh.is_winding_consistent):
        raise ToolkitError(
            f"{path}: the mesh is not watertight ({_open_edges(faces)} open edges); "
            "close its holes (a mesh editor's 'make watertight' or 'fill holes') and export it again"
        )
    if mesh.volume < 0:
        faces = np.ascontiguousarray(faces[:, ::-1])
    return ObjectModel(
        name or path.stem,
        vertices,
        faces,
        material,
        refractive_index,
        extinction,
        symmetry or Symmetry(),
        size,
    )


def diameter(vertices: ArrayLike) -> float:
    """The largest distance between two of the points (V, 3), in their unit."""
    points = np.asarray(vertices, dtype=np.float64)
    if np.ptp(points, axis=0).min() > 0 and len(points) > 4:
        points = points[ConvexHull(points).vertices]
    return float(pdist(points).max())


def _read(path: Path) -> trimesh.Trimesh:
    import trimesh

    if not path.is_file():
        raise ToolkitError(f"{path}: no such mesh file; give a PLY, OBJ or STL, or one of {', '.join(NAMES)}")
    try:
        mesh = trimesh.load_mesh(path, process=False)
        mesh.merge_vertices(merge_tex=True, merge_norm=True)
    except Exception as error:  # trimesh's readers raise whatever a malformed file provokes
        raise ToolkitError(f"{path}: cannot be read as a mesh ({error}); give a PLY, OBJ or STL") from error
    if len(mesh.faces) == 0:
        raise ToolkitError(f"{path}: holds no faces; export a triangle mesh")
    return mesh


def _open_edges(faces: NDArray[np.int32]) -> int:
    edges = np.sort(np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]]), axis=1)
    _, uses = np.unique(edges, axis=0, return_counts=True)
    return int((uses != 2).sum())
