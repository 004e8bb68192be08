"""The analytic backend: every visible point shaded by itself, without shadows or inter-reflection."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numba
import numpy as np
from numpy.typing import NDArray

from s2p3.synthesis.analytic import shade
from s2p3.synthesis.lighting import Light
from s2p3.synthesis.scene import Scene, stretched

Image = NDArray[np.float32]

_COARSE = 4


@dataclass(frozen=True)
class Analytic:
    """Fresnel reflection of lamps and surroundings: 50 to 100 ms a frame of 612 x 512."""

    name: str = "analytic"

    def describe(self) -> dict[str, object]:
        """See `Backend`."""
        return {"name": self.name}

    def radiance(self, scene: Scene, seed: int = 0) -> Image:
        """See `Backend`; nothing is sampled, so the seed has no effect."""
        light = scene.parameters.light.turned(scene.T_cam_table)
        image = _background(scene, light)
        for layer in scene.layers:
            window = layer.raster.window
            seen = shade(layer.raster.normals, scene.rays[window], layer.front, layer.surface, light)
            for channel, values in zip(image, seen, strict=True):
                channel[window][layer.front] = values[layer.front]
        return image


def table_albedo(scene: Scene) -> Image:
    """(h, w) float32 albedo of the table where the camera sees it; 0 where rays miss it."""
    T_table_cam, parameters = scene.T_cam_table.inverse(), scene.parameters
    albedo = np.zeros(scene.rays.shape[:2], np.float32)
    _table_albedo(
        scene.rays,
        T_table_cam.rotation.astype(np.float32),
        T_table_cam.translation.astype(np.float32),
        parameters.texture,
        np.float32(parameters.texture.shape[0] / parameters.texture_m),
        albedo,
    )
    return albedo


def _background(scene: Scene, light: Light) -> Image:
    """(3, h, w): the table where rays meet it, the wall behind elsewhere.

    Light on the table changes slowly over the image and is linear in its albedo: it is shaded on every fourth
    pixel, for black and for white, and interpolated.
    """
    (height, width), parameters = scene.rays.shape[:2], scene.parameters
    albedo = table_albedo(scene)
    size = (width // _COARSE, height // _COARSE)
    coarse = cv2.resize(scene.rays, size, interpolation=cv2.INTER_AREA).astype(np.float32, copy=False)
    normals = np.broadcast_to(scene.T_cam_table.rotation[:, 2].astype(np.float32), coarse.shape)
    everywhere = np.ones(coarse.shape[:2], bool)
    black, white = (
        shade(
            normals, coarse, everywhere, parameters.table, light, np.full(coarse.shape[:2], tone, np.float32)
        )
        for tone in (0.0, 1.0)
    )
    image = np.stack(
        [
            albedo * stretched(w - b, height, width) + stretched(b, height, width)
            for b, w in zip(black, white, strict=True)
        ]
    )
    wall = albedo == 0
    image[0][wall] = stretched(parameters.wall, height, width)[wall]
    image[1:, wall] = 0
    return image


@numba.njit(cache=True, fastmath=True)
def _table_albedo(
    rays: Image, R_table_cam: Image, t_table_cam: Image, texture: Image, texels_per_m: float, out: Image
) -> None:
    """Albedo (h, w) of the plane z = 0 by mirrored bilinear look-up; untouched where no ray meets it."""
    size = texture.shape[0]
    for i in range(rays.shape[0]):
        for j in range(rays.shape[1]):
            dx, dy, dz = rays[i, j, 0], rays[i, j, 1], rays[i, j, 2]
            down = R_table_cam[2, 0] * dx + R_table_cam[2, 1] * dy + R_table_cam[2, 2] * dz
            if down > np.float32(-0.01):
                continue
            reach = -t_table_cam[2] / down
            x = t_table_cam[0] + reach * (
                R_table_cam[0, 0] * dx + R_table_cam[0, 1] * dy + R_table_cam[0, 2] * dz
            )
            y = t_table_cam[1] + reach * (
                R_table_cam[1, 0] * dx + R_table_cam[1, 1] * dy + R_table_cam[1, 2] * dz
            )
            u, v = _mirrored(x * texels_per_m, size), _mirrored(y * texels_per_m, size)
            a, b = int(u), int(v)
            s, t = u - np.float32(a), v - np.float32(b)
            near = texture[b, a] * (1 - s) + texture[b, a + 1] * s
            far = texture[b + 1, a] * (1 - s) + texture[b + 1, a + 1] * s
            out[i, j] = max(near * (1 - t) + far * t, np.float32(1e-4))


@numba.njit(cache=True, fastmath=True, inline="always")
def _mirrored(position: float, size: int) -> float:
    """A position folded into [0, size - 1), back and forth; the texture's middle is at 0."""
    span = np.float32(size - 1.001)
    folded = np.abs(position + np.float32(0.5) * span) / span
    whole = np.floor(folded)
    part = folded - whole
    return (part if int(whole) % 2 == 0 else np.float32(1) - part) * span
