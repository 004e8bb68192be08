"""Rigid motions that leave an object looking the same: declared by its user, proposed from its mesh."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass, field
from itertools import product
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import ConvexHull, cKDTree

from dataset import SE3, ToolkitError

Array = NDArray[np.float64]

TOLERANCE = 0.005
"""A turn is proposed as a symmetry where no surface point leaves the surface by more, in diameters."""

_FOLDS = (8, 6, 5, 4, 3, 2)
_ODD_TURNS = 2 * np.pi * np.array([0.0901699, 0.2360680, 0.3819660, 0.4721360])  # of no small fold
_PROBES = 1_500
_MOST_CANDIDATES = 40
LARGEST_GROUP = 60
"""Motions, the identity among them: those of a dodecahedron."""

_SAME_AXIS = np.cos(np.radians(4.0))
_SAME_TURN = 0.1  # of rotation matrices' entries


@dataclass(frozen=True, eq=False)
class Symmetry:
    """Rigid motions that leave an object looking the same; none by default.

    Attributes:
        transforms: (n, 4, 4) float64, object <- object, the identity not listed.
        axis: (3,) unit direction through the origin about which any rotation is a symmetry, or None.
    """

    transforms: Array = field(default_factory=lambda: np.zeros((0, 4, 4)))
    axis: Array | None = None

    @property
    def any(self) -> bool:
        """Whether the object has a symmetry: its metric is then ADD-S, otherwise ADD."""
        return self.axis is not None or len(self.transforms) > 0

    def sampled(self, steps: int = 72) -> Array:
        """The symmetries as a finite list (m, 4, 4), the identity first; the continuous axis in `steps`."""
        discrete = np.concatenate([np.eye(4)[None], self.transforms])
        if self.axis is None:
            return discrete
        turns = 2 * np.pi * np.arange(steps) / steps
        around = SE3.from_rotvec(turns[:, None] * self.axis, np.zeros((steps, 3))).as_matrix()
        return (around[:, None] @ discrete[None]).reshape(-1, 4, 4)

    def covers(self, other: Symmetry) -> bool:
        """Whether every rotation that `other` allows is one of these, nearly."""
        if other.axis is not None and (self.axis is None or abs(self.axis @ other.axis) < _SAME_AXIS):
            return False
        own = self.sampled()[:, :3, :3]
        return all(
            np.abs(own - motion[:3, :3]).max(axis=(1, 2)).min() < _SAME_TURN for motion in other.transforms
        )

    @property
    def toml(self) -> str:
        """The table of a material file that declares it."""
        turns = [SE3.from_matrix(motion) for motion in self.transforms]
        return _table(None if self.axis is None else _rounded(self.axis), _named(turns))

    def to_json(self) -> str:
        """The two keys of the BOP challenge's models_info.json, in metres."""
        continuous = [] if self.axis is None else [{"axis": self.axis.tolist(), "offset": [0.0, 0.0, 0.0]}]
        discrete = [matrix.ravel().tolist() for matrix in self.transforms]
        return json.dumps({"symmetries_discrete": discrete, "symmetries_continuous": continuous})

    @staticmethod
    def from_json(text: str) -> Symmetry:
        """Inverse of `to_json`; an empty text means no symmetry.

        Raises:
            ToolkitError: not such a JSON text; several axes, or one beside the origin.
        """
        try:
            data: dict[str, Any] = json.loads(text) if text else {}
            discrete = np.array(data.get("symmetries_discrete", []), dtype=np.float64).reshape(-1, 4, 4)
            continuous = data.get("symmetries_continuous", [])
            axis = np.array(continuous[0]["axis"], dtype=np.float64) if continuous else None
            centred = not any(
                np.any(np.cross(one["axis"], one.get("offset", np.zeros(3)))) for one in continuous
            )
        except (ValueError, KeyError, TypeError, AttributeError) as error:
            raise ToolkitError(
                f"object symmetry: cannot read {text[:60]!r} ({error}); expected JSON with "
                "symmetries_discrete (16 numbers each) and symmetries_continuous (axis, offset)"
            ) from error
        if len(continuous) > 1 or not centred:
            raise ToolkitError(
                "object symmetry: one axis at most, through the mesh's origin, can be used; move the origin, "
                "or declare single turns"
            )
        return Symmetry(discrete, axis if axis is None else axis / np.linalg.norm(axis))


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
        upended = [turn for turn in turns if (turn.rotation @ revolution) @ revolution < -_SAME_AXIS][:1]
        return Proposal(_rounded(revolution), _named(upended), worst, offset)
    return Proposal(None, _named(closed(turns)), worst, offset)


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
        if len(axes) < _MOST_CANDIDATES and all(abs(float(unit @ other)) < _SAME_AXIS for other in axes):
            axes.append(unit)
    return axes


def closed(turns: Sequence[SE3], same: float = _SAME_TURN) -> list[SE3]:
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
