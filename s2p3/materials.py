"""What an object is made of, and how it is symmetric: a TOML file beside its mesh.

    kind = "plastic"             # plastic, metal or glass
    refractive_index = 1.5
    extinction = 0.0             # imaginary part of the index; the paper takes metals as 0
    colour = [0.6, 0.1, 0.1]     # linear reflectance; synthesis is monochrome and takes its luminance
    roughness = 0.1              # alpha of microfacets, 0.01 polished to 0.5 dull

    [symmetry]
    axis = [0, 0, 1]             # any turn about this direction through the origin
    turns = [[1, 0, 0, 180]]     # single turns: a direction through the origin, and degrees

Everything but the kind and the index may be left out; synthesis then draws colour and roughness at random.
What follows from the turns, such as the way back, is found by itself.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np

from acquisition import typed_toml
from dataset import SE3, ToolkitError
from dataset.symmetry import Symmetry
from s2p3.symmetry import LARGEST_GROUP, closed

Kind = Literal["plastic", "metal", "glass"]

_AS_WRITTEN = 0.01  # turns are rounded to a few digits
_LUMINANCE = np.array([0.2126, 0.7152, 0.0722])  # ITU-R BT.709


@dataclass(frozen=True)
class SymmetryTable:
    """The [symmetry] table."""

    axis: tuple[float, float, float] | None = None
    turns: tuple[tuple[float, float, float, float], ...] = ()

    def __post_init__(self) -> None:
        for direction in ((self.axis,) if self.axis is not None else ()) + tuple(t[:3] for t in self.turns):
            if np.linalg.norm(direction) < 1e-6:
                raise ToolkitError(
                    f"symmetry: {list(direction)} is no direction; give three numbers, not all 0"
                )
        if not len(self.turns) <= len(self._group()) < LARGEST_GROUP:
            raise ToolkitError(
                "symmetry: these turns and their products are not a few that lie apart; give each turn once, "
                'by a whole fraction of 360 degrees, or declare an "axis"'
            )

    def symmetry(self) -> Symmetry:
        """As rigid motions."""
        axis = None if self.axis is None else _unit(self.axis)
        return Symmetry(np.reshape([turn.as_matrix() for turn in self._group()], (-1, 4, 4)), axis)

    def _group(self) -> list[SE3]:
        turns = [
            SE3.from_rotvec(np.radians(angle) * _unit(direction), np.zeros(3))
            for *direction, angle in self.turns
        ]
        return closed(turns, _AS_WRITTEN)


@dataclass(frozen=True)
class Material:
    """A material file."""

    kind: Kind = "plastic"
    refractive_index: float = 1.5
    extinction: float = 0.0
    colour: tuple[float, float, float] | None = None
    roughness: float | None = None
    symmetry: SymmetryTable = SymmetryTable()

    def __post_init__(self) -> None:
        if not 1.0 < self.refractive_index < 10.0:
            raise ToolkitError(
                f"refractive_index = {self.refractive_index:g} is out of range; give a number above 1 and "
                "below 10: priors and L_physics follow from that, metals with less, as gold, are not modelled"
            )
        if self.extinction < 0 or (self.extinction > 0 and self.kind != "metal"):
            raise ToolkitError(
                f"extinction = {self.extinction:g} does not fit {self.kind}; metals have 0 or more, others 0"
            )
        if self.colour is not None and not all(0 <= value <= 1 for value in self.colour):
            raise ToolkitError(f"colour = {list(self.colour)} is no reflectance; give numbers from 0 to 1")
        if self.roughness is not None and not 0 < self.roughness <= 1:
            raise ToolkitError(
                f"roughness = {self.roughness:g} is out of range; give a number from 0.01 to 1"
            )

    @property
    def albedo(self) -> float | None:
        """Luminance of the colour; None where it is left to chance."""
        return None if self.colour is None else float(_LUMINANCE @ np.array(self.colour))


def load_material(path: str | Path) -> Material:
    """Reads a material file.

    Raises:
        ToolkitError: it is missing, not TOML, misspelt, or no such material exists.
    """
    return typed_toml.load(Material, path, "write one as docs/synthesis.md shows")


def _unit(direction: tuple[float, ...] | list[float]) -> np.ndarray:
    vector = np.asarray(direction, dtype=np.float64)
    return vector / np.linalg.norm(vector)
