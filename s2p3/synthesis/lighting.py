"""Light and surfaces of synthetic scenes."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Literal

import cv2
import numpy as np
from numpy.typing import NDArray

from dataset import SE3
from s2p3.objects import ObjectModel

Array = NDArray[np.float64]
Kind = Literal["plastic", "metal", "glass", "matte"]

_PLAIN_ALBEDO = {"plastic": 0.006, "metal": 0.0, "glass": 0.004}
"""Dark enough that specular light prevails, so that nothing cancels its polarization (our choice)."""


@dataclass(frozen=True)
class Surface:
    """How a surface answers light.

    Attributes:
        refractive_index, extinction: complex index n + ik.
        albedo: share of the light that enters the body and comes out again, unpolarized before it leaves.
        gloss: factor on the Fresnel reflection; below 1 for varnishes and rough surfaces.
        sharpness: largest exponent of a lamp's reflection; smooth surfaces have large ones.
        kind: what the path tracer makes of it: a body under a clear surface (plastic), a metal, clear glass,
            or matte: no reflection, and the light that leaves it is unpolarized (paper, cloth).
    """

    refractive_index: float
    extinction: float = 0.0
    albedo: float = 0.0
    gloss: float = 1.0
    sharpness: float = 400.0
    kind: Kind = "plastic"

    @staticmethod
    def of(model: ObjectModel) -> Surface:
        """The plain surface of a known object: black plastic, polished metal, dark glass, unless its material
        says otherwise."""
        albedo = _PLAIN_ALBEDO[model.material] if model.albedo is None else model.albedo
        sharpness = 400.0 if model.roughness is None else sharpness_of(model.roughness)
        return Surface(
            model.refractive_index, model.extinction, albedo, sharpness=sharpness, kind=model.material
        )

    @property
    def roughness(self) -> float:
        """Beckmann's alpha of microfacets that spread a mirrored beam as wide as `sharpness` does.

        The half vector turns half as far as the mirrored direction: exp(-k (2 d)^2 / 2) = exp(-d^2 / a^2).
        """
        return float(1.0 / np.sqrt(2.0 * self.sharpness))


def sharpness_of(roughness: float) -> float:
    """Inverse of `Surface.roughness`."""
    return 0.5 / max(roughness, 1e-3) ** 2


@dataclass(frozen=True, eq=False)
class Light:
    """Distant light in one frame of coordinates. Radiances and irradiances are relative: 1 is bright.

    Attributes:
        up: (3,) unit; away from the ground.
        ambient: irradiance from everywhere, on a surface of any direction.
        sky, ground: radiance that surfaces mirror from above and below the horizon.
        directions: (n, 3) unit, towards the lamps.
        irradiance: (n,) of each lamp on a surface that faces it.
        glare: (n,) radiance at the centre of each lamp's reflection.
        sharpness: (n,) exponent k of its falloff exp(k (cos - 1)).
        environment: (h, w) float32 factor on the sky's radiance, rows from zenith to nadir, columns around.
        R_world_here: (3, 3) rotates directions of this frame into that of the environment's map.
    """

    up: Array
    ambient: float
    sky: float
    ground: float
    directions: Array
    irradiance: Array
    glare: Array
    sharpness: Array
    environment: NDArray[np.float32]
    R_world_here: Array

    def turned(self, T_there_here: SE3) -> Light:
        """The same light in another frame, for example the camera's; only the rotation matters."""
        R = T_there_here.rotation
        return replace(
            self, up=R @ self.up, directions=self.directions @ R.T, R_world_here=self.R_world_here @ R.T
        )

    def scaled(self, factor: float) -> Light:
        """All of it brighter by a factor."""
        return replace(
            self,
            ambient=self.ambient * factor,
            sky=self.sky * factor,
            ground=self.ground * factor,
            irradiance=self.irradiance * factor,
            glare=self.glare * factor,
        )

    def radiance(self, directions: NDArray[np.floating]) -> NDArray[np.float32]:
        """What a mirror that looks along unit directions (..., 3) of this frame sees: (...) float32.

        Ambient light and the lamps' irradiance have no place here: they are what the analytic shading
        integrates by fiat, and what a path tracer finds from this radiance.
        """
        share = np.clip(0.5 + 4.0 * (directions @ self.up), 0.0, 1.0)
        world = np.asarray(directions @ self.R_world_here.T, np.float64)
        rows, columns = self.environment.shape
        row = np.arccos(np.clip(world[..., 2], -1, 1)) / np.pi * (rows - 1)
        turn = np.arctan2(world[..., 1], world[..., 0]) / (2 * np.pi)
        column = (turn - np.floor(turn)) * columns
        around = np.concatenate([self.environment, self.environment[:, :1]], axis=1)
        factor = cv2.remap(
            around, column.astype(np.float32), row.astype(np.float32), cv2.INTER_LINEAR
        ).reshape(row.shape)
        out = self.sky * factor * share + self.ground * (1 - share)
        for direction, glare, sharpness in zip(self.directions, self.glare, self.sharpness, strict=True):
            out = out + glare * np.exp(sharpness * (directions @ direction - 1.0))
        return np.asarray(out, np.float32)
