"""Light and surfaces of analytic scenes."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from dataset import SE3
from s2p3.objects import ObjectModel

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Surface:
    """How a surface answers light.

    Attributes:
        refractive_index, extinction: complex index n + ik.
        albedo: share of the light that enters the body and comes out again, unpolarized before it leaves.
        gloss: factor on the Fresnel reflection; below 1 for varnishes and rough surfaces.
        sharpness: largest exponent of a lamp's reflection; smooth surfaces have large ones.
    """

    refractive_index: float
    extinction: float = 0.0
    albedo: float = 0.0
    gloss: float = 1.0
    sharpness: float = 400.0

    @staticmethod
    def of(model: ObjectModel) -> Surface:
        """The plain surface of a known object: black plastic, polished steel, dark glass. Specular light
        prevails on all three, so that nothing cancels its polarization (our choice)."""
        albedo = {"steel": 0.0, "glass": 0.004}.get(model.material, 0.006)
        return Surface(model.refractive_index, model.extinction, albedo)


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
