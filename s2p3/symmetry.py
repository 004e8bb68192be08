"""Symmetries of an object: proposed from its mesh, declared in a material file, closed to a group."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import product

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import ConvexHull, cKDTree

from dataset import SE3
from dataset.symmetry import SAME_AXIS, SAME_TURN, Symmetry

Array = NDArray[np.float64]

TOLERANCE = 0.005
"""A turn is proposed as a symmetry where no surface point leaves the surface by more, in diameters."""

_FOLDS = (8, 6, 5, 4, 3, 2)
_ODD_TURNS = 2 * np.pi * np.array([0.0901699, 0.2360680, 0.3819660, 0.4721360])  # of no small fold
_PROBES = 1_500
_MOST_CANDIDATES = 40
LARGEST_GROUP = 60
"""Motions, the identity among them: those of a dodecahedron."""


@dataclass(frozen=True)
class Proposal:
    """What a mesh looks symmetric under. Whether it counts is its user's to say: paint and print break
    symmetries that a shape has.

    Attributes:
        axis: unit direction of a surface of revolution, or None.
        turns: (x, y, z, degrees) of every single turn; with an `axis`, one that exchanges its ends.
        deviation_m: how far the worst point of the surface leaves the surface under them.
        offset_m: how far their common centre lies beside the origin; what is declared turns about the origin.
    """

    axis: tuple[float, ...] | None
    turns: tuple[tuple[float, ...], ...]
    deviation_m: float
    offset_m: float

    def __str__(self) -> str:
        what = []
        if self.axis is not None:
            what.append(f"any turn about {_listed(self.axis)}")
        if self.turns:
            what.append(f"{len(self.turns)} single turns" if len(self.turns) > 1 else "one single turn")
        beside = f", centred {1000 * self.offset_m:.1f} mm beside the origin" if self.offset_m > 0.001 else ""
        return f"looks the same after {' and '.join(what)} (within {1000 * self.deviation_m:.2f} mm{beside})"

    @property
    def any(self) -> bool:
        """Whether there is something to propose."""
        return self.axis is not None or len(self.turns) > 0

    @property
    def toml(self) -> str:
        """The table of a material file that accepts it."""
        return _table(self.axis, self.turns)


def propose(surface: tuple[Array, Array], vertices: Array, diameter: float) -> Proposal:
    """Looks for turns about the surface's centroid that map a closed surface onto itself.

    Args:
        surface: points (n, 3) spread evenly over it, and its unit normals there.
        vertices: (V, 3) of the mesh.
        diameter: of the object, metres.

    Axes tried are those of the coordinates, the principal ones, and the prevailing normals and corners of the
    convex hull (our choice: enough for prisms, boxes, cylinders and what is built of them).
    """
    centre = surface[0].mean(axis=0)
    likeness = _Likeness(surface[0] - centre, surface[1], TOLERANCE * diameter)
    revolution: Array | None = None
    turns: list[SE3] = []
    worst, offset = 0.0, 0.0
    for axis in _candidates(surface[0] - centre, vertices - centre):
        turn = SE3.from_rotvec(_ODD_TURNS[:, None] * axis, np.zeros((len(_ODD_TURNS), 3)))
        found = likeness.worst([turn[i] for i in range(len(_ODD_TURNS))])
        if found is not None and revolution is None:
            revolution = axis
        elif found is None:
            for fold in _FOLDS:
                turned = SE3.from_rotvec(2 * np.pi / fold * axis, np.zeros(3))
                found = likeness.worst([turned])
                if found is not None:
                    turns.append(turned)
                    break
        if found is not None:
            worst = max(worst, found)
            offset = max(offset, float(np.linalg.norm(centre - (centre @ axis) * axis)))
    if revolution is not None:
        upended = [turn for turn in turns if (turn.rotation @ revolution) @ revolution < -SAME_AXIS][:1]
        return Proposal(_rounded(revolution), _named(upended), worst, offset)
    return Proposal(None, _named(closed(turns)), worst, offset)


def as_toml(symmetry: Symmetry) -> str:
    """The table of a material file that declares it."""
    axis = None if symmetry.axis is None else _rounded(symmetry.axis)
    return _table(axis, _named([SE3.from_matrix(motion) for motion in symmetry.transforms]))


def holds(symmetry: Symmetry, surface: tuple[Array, Array], diameter: float) -> bool:
    """Whether a surface looks the same after every motion of `symmetry`; arguments as `propose`."""
    motions = [SE3.from_matrix(motion) for motion in symmetry.transforms]
    if symmetry.axis is not None:
        motions += [SE3.from_rotvec(turn * symmetry.axis, np.zeros(3)) for turn in _ODD_TURNS]
    return _Likeness(*surface, TOLERANCE * diameter).worst(motions) is not None


class _Likeness:
    """How far a turned surface lies from itself.

    Args:
        points, normals: (n, 3) over the surface, about the centre of the turns.
        limit: metres; beyond it, it is another shape.
    """

    def __init__(self, points: Array, normals: Array, limit: float) -> None:
        self._tree = cKDTree(points)
        self._points, self._normals, self._limit = points, normals, limit
        probes = points[:: max(1, len(points) // _PROBES)]
        distance, _ = self._tree.query(probes, k=5)
        self._near = max(3 * float(np.median(distance[:, -1])), limit)
        self._groups = (probes[:60], probes[60:])  # few points tell most wrong turns

    def worst(self, turns: Sequence[SE3]) -> float | None:
        """Largest distance of a turned point from the surface, metres; None where it exceeds the limit."""
        largest = 0.0
        for turn, probes in product(turns, self._groups):
            turned = turn.apply(probes)
            distance, nearest = self._tree.query(turned, distance_upper_bound=self._near)
            if np.isinf(distance).any():
                return None
            # beside the nearest sample, but perhaps still on its face
            beside = np.abs(((turned - self._points[nearest]) * self._normals[nearest]).sum(axis=1))
            largest = max(largest, float(beside.max()))
            if largest > self._limit:
                return None
        return largest


def _candidates(points: Array, vertices: Array) -> list[Array]:
    """Directions worth trying, the likeliest first, none twice."""
    _, principal = np.linalg.eigh(points.T @ points)
    hull = ConvexHull(vertices)
    corners = vertices[hull.vertices]
    faces = vertices[hull.simplices]
    areas = np.linalg.norm(np.cross(faces[:, 1] - faces[:, 0], faces[:, 2] - faces[:, 0]), axis=1)
    by_area = hull.equations[np.argsort(-areas), :3]
    by_reach = corners[np.argsort(-np.linalg.norm(corners, axis=1))]
    axes: list[Array] = []
    for axis in np.concatenate([np.eye(3), principal.T, by_area[:400], by_reach[:200]]):
        unit = axis / max(float(np.linalg.norm(axis)), 1e-12)
        if len(axes) < _MOST_CANDIDATES and all(abs(float(unit @ other)) < SAME_AXIS for other in axes):
            axes.append(unit)
    return axes


def closed(turns: Sequence[SE3], same: float = SAME_TURN) -> list[SE3]:
    """Every product of some rotations but the identity, theirs first: with two of a cube's turns, all 23.

    Stops looking beyond LARGEST_GROUP.

    Args:
        same: difference of two rotation matrices' entries up to which they count as one.
    """
    known = [SE3.identity()]
    frontier = known
    while frontier and len(known) <= LARGEST_GROUP:
        reached = [turn @ old for turn, old in product(turns, frontier)]
        frontier = []
        for motion in reached:
            if all(np.abs(motion.rotation - old.rotation).max() > same for old in known):
                known.append(motion)
                frontier.append(motion)
    return known[1:]


def _named(turns: list[SE3]) -> tuple[tuple[float, ...], ...]:
    """Direction and degrees of each."""
    vectors = [turn.as_rotvec() for turn in turns]
    angles = [float(np.linalg.norm(vector)) for vector in vectors]
    return tuple(
        (*_rounded(vector / angle, signed=True), round(float(np.degrees(angle)), 4))
        for vector, angle in zip(vectors, angles, strict=True)
    )


def _rounded(axis: Array, signed: bool = False) -> tuple[float, ...]:
    """The axis to four digits; unless signed, with its largest component positive."""
    sign = 1.0 if signed else np.sign(axis[np.argmax(np.abs(axis))])
    return tuple(round(float(value), 4) + 0.0 for value in sign * axis)


def _table(axis: tuple[float, ...] | None, turns: Sequence[tuple[float, ...]]) -> str:
    lines = ["[symmetry]"]
    if axis is not None:
        lines.append(f"axis = {_listed(axis)}")
    if turns:
        lines.append(f"turns = [{', '.join(map(_listed, turns))}]")
    return "\n".join(lines)


def _listed(values: tuple[float, ...]) -> str:
    return "[" + ", ".join(f"{value:g}" for value in values) + "]"
