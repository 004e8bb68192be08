"""Rigid motions that leave an object looking the same, as a session keeps them."""

from __future__ import annotations

import json
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dataset.errors import ToolkitError
from dataset.transforms import SE3

Array = NDArray[np.float64]

SAME_AXIS = np.cos(np.radians(4.0))
"""Of the angle between two directions that count as one."""
SAME_TURN = 0.1
"""Largest difference of the entries of two rotation matrices that count as one."""


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
        if other.axis is not None and (self.axis is None or abs(self.axis @ other.axis) < SAME_AXIS):
            return False
        own = self.sampled()[:, :3, :3]
        return all(
            np.abs(own - motion[:3, :3]).max(axis=(1, 2)).min() < SAME_TURN for motion in other.transforms
        )

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
