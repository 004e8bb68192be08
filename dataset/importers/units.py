"""Lengths of other data sets: the unit is named by the user, and a result that cannot be is refused."""

from __future__ import annotations

from typing import Literal

import numpy as np
from numpy.typing import NDArray

from dataset.errors import ToolkitError

Unit = Literal["m", "mm"]

UNITS: dict[Unit, float] = {"m": 1.0, "mm": 1e-3}
"""Metres in a unit."""

_SIZES_M = (0.005, 2.0)
_DISTANCES_M = (0.02, 20.0)
"""What an object that a robot handles, and a camera that sees it, can plausibly be (our choice)."""


def check_mesh(name: str, vertices: NDArray[np.float64]) -> None:
    """Raises ToolkitError where a mesh (V, 3), metres, cannot be one of an object on a table."""
    _check(
        f"the mesh of {name}",
        "across",
        float(np.linalg.norm(np.ptp(vertices, axis=0))),
        _SIZES_M,
        "--mesh-units",
    )


def check_distances(name: str, translations: NDArray[np.float64]) -> None:
    """Raises ToolkitError where objects at (N, 3), metres, camera frame, NaN: unknown, cannot be on a
    table."""
    known = translations[np.isfinite(translations).all(axis=1)]
    if len(known):
        distance = float(np.median(np.linalg.norm(known, axis=1)))
        _check(f"{name} would be", "away", distance, _DISTANCES_M, "--pose-units")


def _check(what: str, how: str, value: float, limits: tuple[float, float], option: str) -> None:
    if not limits[0] <= value <= limits[1]:
        raise ToolkitError(
            f"{what} {value:.4g} m {how}, which it cannot be; is {option} the other one (m, mm)?"
        )
