"""The lab's light and the captured object's surface: other than any that synthesis draws from, as in life."""

from __future__ import annotations

import cv2
import numpy as np

from s2p3.objects import ObjectModel
from s2p3.synthesis.lighting import Light, Surface

_LAMPS = 3


def captured_light(rng: np.random.Generator) -> Light:
    """Ceiling lamps and bright walls, in the base frame."""
    azimuth = (
        rng.uniform(0, 2 * np.pi) + np.arange(_LAMPS) * 2 * np.pi / _LAMPS + rng.uniform(-0.5, 0.5, _LAMPS)
    )
    elevation = rng.uniform(np.radians(35), np.radians(75), _LAMPS)
    level = np.cos(elevation)
    directions = np.stack([level * np.cos(azimuth), level * np.sin(azimuth), np.sin(elevation)], axis=1)
    walls = cv2.resize(
        rng.uniform(0.5, 1.5, (5, 10)).astype(np.float32), (128, 64), interpolation=cv2.INTER_CUBIC
    )
    return Light(
        up=np.array([0.0, 0.0, 1.0]),
        ambient=0.3,
        sky=0.8,
        ground=0.35,
        directions=directions,
        irradiance=rng.uniform(0.15, 0.5, _LAMPS),
        glare=rng.uniform(3.0, 10.0, _LAMPS),
        sharpness=rng.uniform(15.0, 50.0, _LAMPS),
        environment=np.clip(walls, 0.2, None),
        R_world_here=np.eye(3),
    )


def captured_surface(model: ObjectModel, refractive_index: float) -> Surface:
    """The object as it really is: another index than its model file says, a little lighter and rougher."""
    assumed = Surface.of(model)
    return Surface(
        refractive_index=refractive_index,
        extinction=assumed.extinction,
        albedo=1.3 * assumed.albedo,
        gloss=0.97,
        sharpness=60.0,
    )
