"""Shading with Fresnel's equations: from normals to a Stokes image, without shadows or inter-reflection.

Unpolarized light from lamps and surroundings is reflected at the surface (specular: Fresnel's R_s and R_p of
the viewing angle, polarized along phi + 90 deg) or enters the body, is depolarized, and comes out through
the surface (diffuse: the transmittances 1 - R_s and 1 - R_p, polarized along phi). Conventions as in
`s2p3.physics`.
"""

from __future__ import annotations

from typing import Any

import numba
import numpy as np
from numpy.typing import NDArray

from s2p3.synthesis.lighting import Light, Surface

Image = NDArray[np.float32]

_GRAZING = np.float32(0.02)  # smallest cosine shaded: interpolated normals may point away at a silhouette


def shade(
    normals: Image,
    rays: Image,
    mask: NDArray[np.bool_],
    surface: Surface,
    light: Light,
    albedo: Image | None = None,
) -> Image:
    """Radiance that reaches a camera from surfaces it sees.

    Args:
        normals: (h, w, 3) float32 unit normals, camera frame.
        rays: (h, w, 3) float32 unit viewing rays, camera frame.
        mask: (h, w), where to shade.
        surface: what everything in the mask is made of.
        light: in the camera frame, see `Light.turned`.
        albedo: (h, w) float32, instead of the surface's.

    Returns:
        (3, h, w) float32 radiance S0, S1, S2; zero outside the mask.
    """
    height, width = mask.shape
    out = np.zeros((3, height, width), np.float32)
    painted = albedo is not None
    _shade(
        np.ascontiguousarray(normals, dtype=np.float32),
        np.ascontiguousarray(rays, dtype=np.float32),
        np.ascontiguousarray(mask),
        albedo if albedo is not None else np.full((1, 1), surface.albedo, np.float32),
        painted,
        np.array(
            [surface.refractive_index, surface.extinction, surface.gloss, surface.kind != "matte"], np.float32
        ),
        np.array([light.ambient, light.sky, light.ground, *light.up], np.float32),
        _lamps(light, surface.sharpness),
        np.ascontiguousarray(light.environment, dtype=np.float32),
        np.ascontiguousarray(light.R_world_here, dtype=np.float32),
        out,
    )
    return out


def _lamps(light: Light, sharpest: float) -> Image:
    """(n, 6): direction, irradiance, glare, exponent. A blunter surface spreads the same light wider."""
    exponent = np.minimum(light.sharpness, sharpest)
    glare = light.glare * exponent / np.maximum(light.sharpness, 1e-9)
    columns = np.column_stack([light.directions.reshape(-1, 3), light.irradiance, glare, exponent])
    return columns.astype(np.float32)


@numba.njit(cache=True, fastmath=True)
def _shade(
    normals: Image,
    rays: Image,
    mask: NDArray[np.bool_],
    albedo: Image,
    painted: bool,
    surface: Image,
    sky: Image,
    lamps: Image,
    environment: Image,
    to_world: Image,
    out: Image,
) -> None:
    height, width = mask.shape
    n, k, gloss, polarizing = surface[0], surface[1], surface[2], surface[3]
    one, half, zero = np.float32(1), np.float32(0.5), np.float32(0)
    for i in range(height):
        for j in range(width):
            if not mask[i, j]:
                continue
            nx, ny, nz = normals[i, j, 0], normals[i, j, 1], normals[i, j, 2]
            dx, dy, dz = rays[i, j, 0], rays[i, j, 1], rays[i, j, 2]
            facing = -(nx * dx + ny * dy + nz * dz)
            cosine = min(max(facing, _GRAZING), one)
            sine2 = one - cosine * cosine
            real = n * n - k * k - sine2
            modulus = np.sqrt(real * real + np.float32(4) * n * n * k * k)
            a = np.sqrt(half * (modulus + real))
            cross = np.float32(2) * a * cosine
            r_s = (modulus - cross + cosine * cosine) / (modulus + cross + cosine * cosine)
            along = modulus * cosine * cosine + sine2 * sine2
            r_p = r_s * (along - cross * sine2) / (along + cross * sine2)

            rx, ry, rz = (
                dx + np.float32(2) * facing * nx,
                dy + np.float32(2) * facing * ny,
                dz + np.float32(2) * facing * nz,
            )
            irradiance, mirrored = sky[0], zero
            for m in range(lamps.shape[0]):
                lx, ly, lz = lamps[m, 0], lamps[m, 1], lamps[m, 2]
                irradiance += lamps[m, 3] * max(nx * lx + ny * ly + nz * lz, zero)
                exponent = lamps[m, 5] * (rx * lx + ry * ly + rz * lz - one)
                if exponent > np.float32(-12):
                    mirrored += lamps[m, 4] * np.exp(exponent)
            mirrored += _surroundings(rx, ry, rz, sky, environment, to_world)

            body = (albedo[i, j] if painted else albedo[0, 0]) * irradiance
            diffuse = body * (one - half * (r_s + r_p))
            specular = gloss * mirrored * half * (r_s + r_p)
            polarized = polarizing * half * (r_s - r_p) * (body - gloss * mirrored)  # positive along phi

            shift = nz + (dx * nx + dy * ny) / (one + dz)
            ax, ay = nx - dx * shift, -(ny - dy * shift)
            length = ax * ax + ay * ay + np.float32(1e-12)
            out[0, i, j] = diffuse + specular
            out[1, i, j] = polarized * (ax * ax - ay * ay) / length
            out[2, i, j] = polarized * np.float32(2) * ax * ay / length


@numba.njit(cache=True, fastmath=True, inline="always")
def _surroundings(rx: float, ry: float, rz: float, sky: Image, environment: Image, to_world: Image) -> Any:
    """Radiance from a direction: ground below the horizon, the environment's map above, blended between."""
    height = rx * sky[3] + ry * sky[4] + rz * sky[5]
    share = min(max(np.float32(0.5) + np.float32(4) * height, np.float32(0)), np.float32(1))
    if share <= np.float32(0):
        return sky[2]
    wx = to_world[0, 0] * rx + to_world[0, 1] * ry + to_world[0, 2] * rz
    wy = to_world[1, 0] * rx + to_world[1, 1] * ry + to_world[1, 2] * rz
    wz = to_world[2, 0] * rx + to_world[2, 1] * ry + to_world[2, 2] * rz
    rows, columns = environment.shape
    row = np.arccos(min(max(wz, np.float32(-1)), np.float32(1))) / np.float32(np.pi) * np.float32(rows - 1)
    turn = np.arctan2(wy, wx) / np.float32(2 * np.pi)
    column = (turn - np.floor(turn)) * np.float32(columns)
    i, j = min(int(row), rows - 2), int(column) % columns
    v, u = row - np.float32(i), column - np.float32(int(column))
    j1 = (j + 1) % columns
    top = environment[i, j] * (np.float32(1) - u) + environment[i, j1] * u
    bottom = environment[i + 1, j] * (np.float32(1) - u) + environment[i + 1, j1] * u
    factor = top * (np.float32(1) - v) + bottom * v
    return sky[1] * factor * share + sky[2] * (np.float32(1) - share)
