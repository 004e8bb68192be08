"""One synthetic scene: an object on a textured table, clutter, light, and the camera's imperfections."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Protocol

import cv2
import numpy as np
from numpy.typing import NDArray

from dataset import SE3, Intrinsics
from dataset.polarimetry import Stokes
from s2p3.objects import ObjectModel
from s2p3.rendering import Mesh, Raster, projected_region, rasterize
from s2p3.synthesis.lighting import Light, Surface

Image = NDArray[np.float32]

_COARSE = 4  # pixels between which smooth maps are interpolated


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
        wall: (n, n) float32 radiance of what lies behind the table: stretched over the image (analytic), or
            around the horizon (path-traced).
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
class Layer:
    """One thing as the camera sees it: its truth within its block of the image, and where in the block it is
    in front of the layers before it."""

    raster: Raster
    front: NDArray[np.bool_]
    surface: Surface


@dataclass(frozen=True, eq=False)
class Scene:
    """A scene and who looks at it; what can be seen follows exactly, whoever renders it.

    Attributes:
        model: the object; it rests on the table.
        T_cam_obj: its pose.
        intrinsics: the camera, a pinhole.
        parameters: everything else.
    """

    model: ObjectModel
    T_cam_obj: SE3
    intrinsics: Intrinsics
    parameters: SceneParameters

    @cached_property
    def rays(self) -> Image:
        """(h, w, 3) float32 unit viewing rays."""
        return self.intrinsics.rays().astype(np.float32)

    @cached_property
    def T_cam_table(self) -> SE3:
        """Where the table is."""
        return self.T_cam_obj @ self.model.resting.inverse()

    @cached_property
    def layers(self) -> tuple[Layer, ...]:
        """The object, then the clutter; later ones cover earlier ones."""
        things = [(self.model.mesh, self.T_cam_obj, self.parameters.surface)]
        for item in self.parameters.clutter:
            things.append((item.mesh, self.T_cam_table @ item.T_table_item, item.surface))
        depth = np.full((self.intrinsics.height, self.intrinsics.width), np.inf, np.float32)
        layers = []
        for mesh, T_cam_item, surface in things:
            region = projected_region(mesh, T_cam_item, self.intrinsics)
            raster = rasterize(mesh, T_cam_item, self.intrinsics, region)
            front = raster.mask & (raster.depth < depth[raster.window])
            depth[raster.window][front] = raster.depth[front]
            layers.append(Layer(raster, front, surface))
        return tuple(layers)

    @cached_property
    def mask(self) -> NDArray[np.bool_]:
        """(h, w) bool: where the object is visible."""
        return self._owner == 1

    @property
    def covered(self) -> NDArray[np.bool_]:
        """(h, w) bool: where anything stands before table and wall."""
        return self._owner > 0

    @property
    def visible_fraction(self) -> float:
        """Share of the object's silhouette that is visible: neither covered nor outside the image."""
        return float(self.mask.sum()) / max(self._silhouette_px, 1)

    @property
    def _silhouette_px(self) -> int:
        """Pixels of the object's silhouette, those outside the image included."""
        raster, camera = self.layers[0].raster, self.intrinsics
        rows, columns = raster.window
        if min(rows.start, columns.start) <= 0 or rows.stop >= camera.height or columns.stop >= camera.width:
            canvas, mesh = camera.surrounded, self.model.mesh
            raster = rasterize(mesh, self.T_cam_obj, canvas, projected_region(mesh, self.T_cam_obj, canvas))
        return int(raster.mask.sum())

    @cached_property
    def _owner(self) -> NDArray[np.uint8]:
        """(h, w): 0 the background, 1 the object, 2 and up the clutter."""
        owner = np.zeros((self.intrinsics.height, self.intrinsics.width), np.uint8)
        for number, layer in enumerate(self.layers, start=1):
            owner[layer.raster.window][layer.front] = number
        return owner


class Backend(Protocol):
    """What turns a scene into light."""

    @property
    def name(self) -> str:
        """As the command line calls it."""
        ...

    def describe(self) -> dict[str, object]:
        """Everything its result depends on besides scene and seed, for JSON."""
        ...

    def radiance(self, scene: Scene, seed: int) -> Image:
        """(3, h, w) float32 S0, S1, S2 that reach the camera, in any unit, without the background's haze."""
        ...


@dataclass(frozen=True, eq=False)
class SceneImage:
    """A rendered scene with its truth.

    Attributes:
        stokes: what a noiseless sensor sees, white = 1 per polarizer.
        raster: the object's truth within its block of the image, occluders ignored.
        mask: (h, w) bool, where the object is visible.
        visible_fraction: share of the object's silhouette that is visible.
    """

    stokes: Stokes
    raster: Raster
    mask: NDArray[np.bool_]
    visible_fraction: float


def render(scene: Scene, backend: Backend, seed: int = 0) -> SceneImage:
    """What the camera measures but for the sensor's noise: light, haze, optics and exposure.

    Args:
        seed: of whatever the backend samples.
    """
    image = backend.radiance(scene, seed)
    _add_haze(image, scene)
    return SceneImage(
        _camera(image, scene.parameters), scene.layers[0].raster, scene.mask, scene.visible_fraction
    )


def stretched(map_: Image, height: int, width: int) -> Image:
    """A smooth map (m, n) enlarged to (height, width)."""
    return cv2.resize(map_, (width, height), interpolation=cv2.INTER_LINEAR).astype(np.float32, copy=False)


def _add_haze(image: Image, scene: Scene) -> None:
    """Polarizes what lies behind object and clutter further; it stays no more polarized than bright."""
    parameters, (height, width) = scene.parameters, image.shape[1:]
    if not parameters.haze_dolp.any():
        return
    background = image[:, ~scene.covered]
    size = (height // _COARSE, width // _COARSE)
    doubled = 2 * stretched(parameters.haze_angle, *size)
    strength = stretched(parameters.haze_dolp, *size)
    for channel, part in ((1, strength * np.cos(doubled)), (2, strength * np.sin(doubled))):
        background[channel] += background[0] * stretched(part, height, width)[~scene.covered]
    image[:, ~scene.covered] = background


def _camera(image: Image, parameters: SceneParameters) -> Stokes:
    """Exposure, leaking polarizers and blur; light stays physical: no more polarized than bright."""
    excess = np.hypot(image[1], image[2]) / np.maximum(image[0], 1e-9)
    image[1:] /= np.maximum(excess, 1)
    if parameters.blur_px > 0:
        for channel in image:
            cv2.GaussianBlur(channel, (0, 0), parameters.blur_px, dst=channel)
    image *= np.float32(2 * parameters.level / max(float(image[0].mean()), 1e-9))
    image[1:] *= np.float32(parameters.dolp_scale)
    return Stokes(image[0], image[1], image[2], np.ones(image.shape[1:], dtype=bool))
