"""Draws scenes from a domain: surfaces, light, textures, clutter."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
from numpy.typing import NDArray

from dataset import SE3
from s2p3 import object_meshes
from s2p3.objects import ObjectModel
from s2p3.rendering import Mesh
from s2p3.synthesis.domain import Domain
from s2p3.synthesis.lighting import Light, Surface, sharpness_of
from s2p3.synthesis.scene import Clutter, SceneParameters

Image = NDArray[np.float32]

_OCCLUDER = (0.08, 0.5)  # size, in diameters of the object
_DARK = 0.03
"""Bodies that return less light than this are prevailingly specular: a plastic reflects 4 % at least."""


def draw_scene(
    domain: Domain,
    model: ObjectModel,
    T_cam_obj: SE3,
    rng: np.random.Generator,
    occluded: bool | None = None,
) -> SceneParameters:
    """Everything else about a scene with the object seen at T_cam_obj.

    Args:
        occluded: whether something stands between camera and object; by the domain's share when None.
    """
    if occluded is None:
        occluded = rng.random() < domain.occluder_share
    specular = model.material == "metal" or rng.random() < domain.specular_share
    if model.albedo is not None:
        specular = model.albedo < _DARK
    surface = _object_surface(domain, model, specular, rng)
    light = _light(rng.uniform(*(domain.specular_sky if specular else domain.diffuse_sky)), domain, rng)
    patches = int(rng.integers(2, 6))
    table = Surface(rng.uniform(1.35, 1.65), gloss=rng.uniform(*domain.table_gloss), sharpness=20.0)
    parameters = SceneParameters(
        surface=surface,
        light=light,
        table=table,
        texture=_texture(rng),
        texture_m=rng.uniform(0.4, 1.5),
        wall=_smooth(rng, (3, 24), 256, 0.03, 0.9),
        haze_dolp=_smooth(rng, (patches,), patches, 0.0, rng.uniform(*domain.haze_dolp)),
        haze_angle=_smooth(rng, (3,), 3, 0.0, np.pi),
        clutter=_clutter(domain, model, T_cam_obj, occluded, rng),
        dolp_scale=rng.uniform(*domain.dolp_scale),
        blur_px=rng.uniform(*domain.blur_px),
        level=rng.uniform(*domain.level),
        full_well=rng.uniform(*domain.full_well),
        read_noise=rng.uniform(*domain.read_noise),
    )
    if rng.random() >= domain.matte_table_share:
        return parameters
    matte = replace(table, kind="matte", gloss=0.0)
    return replace(parameters, table=matte, haze_dolp=np.zeros_like(parameters.haze_dolp))


def _object_surface(domain: Domain, model: ObjectModel, specular: bool, rng: np.random.Generator) -> Surface:
    index = model.refractive_index * rng.uniform(*domain.index_scale)
    albedo = _object_albedo(model.material, specular, rng)
    gloss = rng.uniform(0.85, 1.0)
    sharpness = float(np.exp(rng.uniform(np.log(15), np.log(200))))
    if model.albedo is not None:
        albedo = min(model.albedo * rng.uniform(0.85, 1.15), 1.0)
    if model.roughness is not None:
        sharpness = sharpness_of(model.roughness) * float(np.exp(rng.uniform(-0.3, 0.3)))
    return Surface(index, model.extinction, albedo, gloss, sharpness, model.material)


def _object_albedo(material: str, specular: bool, rng: np.random.Generator) -> float:
    if material == "metal":
        return 0.0
    if specular:
        return float(np.exp(rng.uniform(np.log(0.001), np.log(0.012))))
    return float(rng.uniform(0.2, 0.8))


def _light(sky: float, domain: Domain, rng: np.random.Generator) -> Light:
    count = int(rng.integers(domain.lamps[0], domain.lamps[1] + 1))
    directions = rng.normal(size=(count, 3))
    directions[:, 2] = np.abs(directions[:, 2]) + 0.15
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    map_ = _smooth(rng, (4, 8, 16), 64, 0.25, 1.6)
    return Light(
        up=np.array([0.0, 0.0, 1.0]),
        ambient=rng.uniform(*domain.ambient),
        sky=sky,
        ground=sky * rng.uniform(0.35, 0.9),
        directions=directions,
        irradiance=rng.uniform(0.05, 0.4, count),
        glare=rng.uniform(*domain.lamp_glare, count),
        sharpness=rng.uniform(*domain.lamp_sharpness, count),
        environment=np.concatenate([map_, map_[:, ::-1]], axis=1),  # mirrored: no seam
        R_world_here=np.eye(3),
    )


def _texture(rng: np.random.Generator, size: int = 256) -> Image:
    """An albedo of stripes, checks or blotches over fractal noise."""
    noise = _smooth(rng, (4, 8, 16, 32, 64, 128), size, 0.0, 1.0)
    y, x = np.mgrid[:size, :size].astype(np.float32) / size
    angle, frequency = rng.uniform(0, np.pi), rng.uniform(3, 20)
    wave = np.sin(2 * np.pi * frequency * (x * np.cos(angle) + y * np.sin(angle)) + rng.uniform(0, 6) * noise)
    other = np.sin(2 * np.pi * frequency * (y * np.cos(angle) - x * np.sin(angle)))
    pattern = (noise, 0.5 + 0.5 * wave, 0.5 + 0.5 * np.sign(wave), 0.5 + 0.5 * np.sign(wave * other))
    figure = pattern[rng.integers(len(pattern))]
    share = rng.uniform(0, 0.8)
    low, high = np.sort(rng.uniform(0.02, 0.65, 2))
    return (low + (high - low) * (share * figure + (1 - share) * noise)).astype(np.float32)


def _smooth(rng: np.random.Generator, cells: tuple[int, ...], size: int, low: float, high: float) -> Image:
    """(size, size) noise with so many cells per octave, coarse ones stronger, stretched to [low, high]."""
    out = np.zeros((size, size), np.float32)
    for octave, count in enumerate(cells):
        grid = rng.random((count, count), dtype=np.float32)
        out += cv2.resize(grid, (size, size), interpolation=cv2.INTER_CUBIC) * np.float32(0.6**octave)
    least, most = float(out.min()), float(out.max())
    scaled: Image = np.float32(low) + (out - least) * np.float32((high - low) / max(most - least, 1e-9))
    return scaled


def _clutter(
    domain: Domain, model: ObjectModel, T_cam_obj: SE3, occluded: bool, rng: np.random.Generator
) -> tuple[Clutter, ...]:
    footprint = float(np.linalg.norm(model.vertices[:, :2], axis=1).max())
    items = []
    for _ in range(int(rng.integers(domain.clutter[0], domain.clutter[1] + 1))):
        mesh, radius, height = _item(0.03, 0.12, rng)
        distance = footprint + radius + rng.uniform(0.005, 0.15)
        around = rng.uniform(0, 2 * np.pi)
        place = [distance * np.cos(around), distance * np.sin(around), height / 2]
        items.append(
            Clutter(mesh, SE3.from_rotvec([0, 0, rng.uniform(0, 2 * np.pi)], place), _item_surface(rng))
        )
    if occluded:
        size = model.diameter * np.exp(rng.uniform(*np.log(_OCCLUDER)))
        mesh, _, _ = _item(0.6 * size, size, rng)
        target = model.vertices[rng.integers(len(model.vertices))]
        eye = T_cam_obj.inverse().translation
        between = model.resting.apply(target + rng.uniform(0.25, 0.55) * (eye - target))
        items.append(Clutter(mesh, SE3.from_rotvec(rng.normal(size=3), between), _item_surface(rng)))
    return tuple(items)


def _item(smallest: float, largest: float, rng: np.random.Generator) -> tuple[Mesh, float, float]:
    """A box or an ellipsoid, the radius of its footprint and its height."""
    x, y, z = rng.uniform(smallest, largest, 3)
    shape = object_meshes.box if rng.random() < 0.5 else object_meshes.ellipsoid
    return Mesh.from_arrays(*shape((x, y, z))), 0.5 * float(np.hypot(x, y)), float(z)


def _item_surface(rng: np.random.Generator) -> Surface:
    return Surface(
        rng.uniform(1.3, 2.0),
        albedo=rng.uniform(0.0, 0.7),
        gloss=rng.uniform(0.0, 1.0),
        sharpness=rng.uniform(8, 80),
    )
