"""One synthetic scene: an object on a textured table, clutter, light, and the camera's imperfections."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import cv2
import numba
import numpy as np
from numpy.typing import NDArray

from dataset import SE3, Intrinsics
from dataset.polarimetry import Stokes, sample_mosaic, white_level
from s2p3.objects import ObjectModel
from s2p3.rendering import Mesh, Raster, projected_region, rasterize
from s2p3.synthesis.analytic import shade
from s2p3.synthesis.lighting import Light, Surface

Image = NDArray[np.float32]
Image16 = NDArray[np.uint16]

_COARSE = 4
_NOISE_COUNT = 1 << 22


@dataclass(frozen=True, eq=False)
class Clutter:
    """Something else in the scene: a mesh where it stands, T_table_item, and its surface."""

    mesh: Mesh
    T_table_item: SE3
    surface: Surface


@dataclass(frozen=True, eq=False)
class SceneParameters:
    """All that a rendering depends on besides object, camera and pose. Light and places are in the table's
    frame: z up, the table at z = 0.

    Attributes:
        surface: the object's.
        light: in the table's frame.
        table: its surface; the albedo comes from the texture.
        texture: (n, n) float32 albedo of `texture_m` x `texture_m` metres of table, mirrored beyond.
        wall: (n, n) float32 radiance of what lies behind the table, stretched over the image.
        haze_dolp, haze_angle: (m, m) float32, stretched over the image: degree and angle (radians) of
            additional polarization of table and wall, so that polarized does not mean object.
        clutter: other things; they may occlude the object.
        dolp_scale: factor on S1, S2: polarizers leak.
        blur_px: standard deviation of the optics' blur, working pixels.
        level: mean intensity of the image, white = 1: the exposure.
        full_well, read_noise: electrons of what one value is read from (a pixel, or the four of a colour
            super-pixel together).
    """

    surface: Surface
    light: Light
    table: Surface
    texture: Image
    texture_m: float
    wall: Image
    haze_dolp: Image
    haze_angle: Image
    clutter: tuple[Clutter, ...]
    dolp_scale: float
    blur_px: float
    level: float
    full_well: float
    read_noise: float


@dataclass(frozen=True, eq=False)
class SceneImage:
    """A rendered scene with its truth.

    Attributes:
        stokes: what a noiseless sensor sees, white = 1 per polarizer.
        raster: the object's truth within its block of the image, occluders ignored.
        mask: (h, w) bool, where the object is visible.
        visible_fraction: visible share of the object's pixels in the image.
    """

    stokes: Stokes
    raster: Raster
    mask: NDArray[np.bool_]
    visible_fraction: float


def render_scene(
    model: ObjectModel,
    T_cam_obj: SE3,
    intrinsics: Intrinsics,
    parameters: SceneParameters,
    rays: Image | None = None,
) -> SceneImage:
    """Render the object resting on the table, seen at T_cam_obj.

    Args:
        rays: (h, w, 3) float32, `intrinsics.rays()` where the caller has them already.
    """
    if rays is None:
        rays = intrinsics.rays().astype(np.float32)
    T_cam_table = T_cam_obj @ model.resting.inverse()
    light = parameters.light.turned(T_cam_table)
    image = _background(rays, T_cam_table, parameters, light)
    raster = rasterize(model.mesh, T_cam_obj, intrinsics, projected_region(model.mesh, T_cam_obj, intrinsics))
    _paint(
        image,
        raster,
        raster.mask,
        shade(raster.normals, rays[raster.window], raster.mask, parameters.surface, light),
    )
    depth = np.full(image.shape[1:], np.inf, np.float32)
    depth[raster.window][raster.mask] = raster.depth[raster.mask]
    mask = np.isfinite(depth)
    for item in parameters.clutter:
        T_cam_item = T_cam_table @ item.T_table_item
        other = rasterize(
            item.mesh, T_cam_item, intrinsics, projected_region(item.mesh, T_cam_item, intrinsics)
        )
        front = other.mask & (other.depth < depth[other.window])
        _paint(image, other, front, shade(other.normals, rays[other.window], front, item.surface, light))
        depth[other.window][front] = other.depth[front]
        mask[other.window][front] = False
    seen = int(raster.mask.sum())
    return SceneImage(_camera(image, parameters), raster, mask, float(mask.sum()) / seen if seen else 0.0)


def expose(stokes: Stokes, parameters: SceneParameters, bits: int, rng: np.random.Generator) -> Image16:
    """A raw mosaic (2h, 2w) uint16 of a monochrome polarization sensor: shot and read noise, quantization."""
    intensity = sample_mosaic(stokes, "mono")
    start = int(rng.integers(_NOISE_COUNT - intensity.size))
    out = np.empty(intensity.shape, np.uint16)
    _read_out(
        intensity.ravel(),
        _noise()[start : start + intensity.size],
        np.float32(parameters.full_well),
        np.float32(parameters.read_noise**2),
        np.float32(white_level(bits)),
        out.ravel(),
    )
    return out


@lru_cache(maxsize=1)
def _noise() -> Image:
    """A long row of normal deviates; each frame reads it from another place: cheaper than drawing."""
    return np.random.default_rng(0).standard_normal(_NOISE_COUNT, dtype=np.float32)


def _paint(image: Image, raster: Raster, where: NDArray[np.bool_], stokes: Image) -> None:
    for channel, values in zip(image, stokes, strict=True):
        channel[raster.window][where] = values[where]


def _background(rays: Image, T_cam_table: SE3, parameters: SceneParameters, light: Light) -> Image:
    """(3, h, w): the table where rays meet it, the wall behind elsewhere, with the haze of polarization.

    Light on the table changes slowly over the image and is linear in its albedo: it is shaded on every fourth
    pixel, for black and for white, and interpolated.
    """
    height, width = rays.shape[:2]
    T_table_cam = T_cam_table.inverse()
    albedo = np.zeros((height, width), np.float32)
    _table_albedo(
        rays,
        T_table_cam.rotation.astype(np.float32),
        T_table_cam.translation.astype(np.float32),
        parameters.texture,
        np.float32(parameters.texture.shape[0] / parameters.texture_m),
        albedo,
    )
    size = (width // _COARSE, height // _COARSE)
    coarse = cv2.resize(rays, size, interpolation=cv2.INTER_AREA).astype(np.float32, copy=False)
    normals = np.broadcast_to(T_cam_table.rotation[:, 2].astype(np.float32), coarse.shape)
    everywhere = np.ones(coarse.shape[:2], bool)
    black, white = (
        shade(
            normals, coarse, everywhere, parameters.table, light, np.full(coarse.shape[:2], tone, np.float32)
        )
        for tone in (0.0, 1.0)
    )
    image = np.stack(
        [albedo * _stretched(w - b, rays) + _stretched(b, rays) for b, w in zip(black, white, strict=True)]
    )
    wall = albedo == 0
    image[0][wall] = _stretched(parameters.wall, rays)[wall]
    image[1:, wall] = 0
    doubled = 2 * _stretched(parameters.haze_angle, coarse)
    strength = _stretched(parameters.haze_dolp, coarse)
    image[1] += image[0] * _stretched(strength * np.cos(doubled), rays)
    image[2] += image[0] * _stretched(strength * np.sin(doubled), rays)
    return image


def _stretched(map_: Image, like: Image) -> Image:
    """A smooth map (m, n) enlarged to the height and width of another array."""
    size = (like.shape[1], like.shape[0])
    return cv2.resize(map_, size, interpolation=cv2.INTER_LINEAR).astype(np.float32, copy=False)


def _camera(image: Image, parameters: SceneParameters) -> Stokes:
    """Exposure, leaking polarizers and blur; light stays physical: no more polarized than bright."""
    if parameters.blur_px > 0:
        for channel in image:
            cv2.GaussianBlur(channel, (0, 0), parameters.blur_px, dst=channel)
    image *= np.float32(2 * parameters.level / max(float(image[0].mean()), 1e-9))
    image[1:] *= np.float32(parameters.dolp_scale)
    return Stokes(image[0], image[1], image[2], np.ones(image.shape[1:], dtype=bool))


@numba.njit(cache=True)
def _read_out(
    intensity: Image, noise: Image, full_well: float, read_variance: float, white: float, out: Image16
) -> None:
    for i in range(intensity.size):
        electrons = max(intensity[i], np.float32(0)) * full_well
        electrons += noise[i] * np.sqrt(electrons + read_variance)
        out[i] = np.uint16(min(max(electrons / full_well * white + np.float32(0.5), np.float32(0)), white))


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
