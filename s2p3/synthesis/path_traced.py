"""The path-traced backend: Mitsuba 3 follows polarized light through shadows, reflections and glass."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from dataset import Intrinsics
from s2p3.synthesis import denoise
from s2p3.synthesis.analytic_scene import table_albedo
from s2p3.synthesis.mitsuba_engine import Engine, find_engine
from s2p3.synthesis.mitsuba_scene import scene_dict, sensor_dict
from s2p3.synthesis.scene import Scene

Image = NDArray[np.float32]

SAMPLES = 32
"""Paths per pixel; 16 are the least that the denoiser makes a clean image of."""

_LUMINANCE = np.array([0.2126, 0.7152, 0.0722], np.float32)  # equal channels in the monochrome variant
_SQUARE_PX = 0.02  # error of taking pixels as square that is not worth an interpolation


@dataclass(frozen=True)
class PathTraced:
    """Path tracing, denoised: 5 to 10 CPU seconds a frame of 612 x 512.

    Attributes:
        engine: the variant of Mitsuba, see `find_engine`.
        samples: paths per pixel.
    """

    engine: Engine
    samples: int = SAMPLES

    @staticmethod
    def here(samples: int = SAMPLES) -> PathTraced:
        """With whatever works on this machine.

        Raises:
            ToolkitError: nothing does.
        """
        return PathTraced(find_engine(), samples)

    @property
    def name(self) -> str:
        """See `Backend`."""
        return "path-traced"

    def describe(self) -> dict[str, object]:
        """See `Backend`."""
        versions = self.engine.describe() | denoise.describe()
        return {"name": self.name, "samples": self.samples, **versions}

    def radiance(self, scene: Scene, seed: int) -> Image:
        """See `Backend`. On one machine, the same bits for the same scene and seed."""
        s0, s1, s2 = self.noisy(scene, seed)
        polarizers = np.float32(0.5) * np.stack([s0 + s1, s0 + s2, s0 - s1, s0 - s2])
        i0, i45, i90, i135 = denoise.denoise(polarizers, *_guides(scene))
        return np.stack([0.5 * (i0 + i45 + i90 + i135), i0 - i90, i45 - i135])

    def noisy(self, scene: Scene, seed: int) -> Image:
        """(3, h, w) float32 Stokes radiance as the path tracer leaves it."""
        mi = self.engine.start()
        sensor = sensor_dict(mi, scene.intrinsics, scene.T_cam_table.inverse(), self.samples)
        stokes = render_stokes(mi, scene_dict(mi, scene) | {"sensor": sensor}, seed)
        return in_ray_frames(to_rectangular(stokes, scene.intrinsics), scene.rays)


def render_stokes(mi: Any, scene: dict[str, Any], seed: int) -> Image:
    """(3, h, w) float32 S0, S1, S2 in Mitsuba's frames of reference: horizontal across each ray."""
    film = np.array(mi.render(mi.load_dict(scene), seed=seed), np.float32)
    channels = film[:, :, -12:-3].reshape(*film.shape[:2], 3, 3) @ _LUMINANCE  # S0 to S2, each as RGB
    return np.ascontiguousarray(np.moveaxis(channels, -1, 0))


def in_ray_frames(stokes: Image, rays: Image) -> Image:
    """Stokes images (3, h, w) turned from Mitsuba's frames of reference to ours.

    Mitsuba measures angles from the direction across each ray that is level in the camera. We turn the
    camera's axes with the ray (see `s2p3.physics`). Off the optical axis the two differ, by a few degrees in
    the corners of a wide image.

    Args:
        rays: (h, w, 3) float32 unit, camera frame.
    """
    x, y, z = np.moveaxis(rays.astype(np.float64), -1, 0)
    # the camera's right and down, turned with the ray; and the level direction, z and x exchanged
    level = np.stack([z, np.zeros_like(z), -x]) / np.hypot(x, z)
    right = np.stack([1 - x * x / (1 + z), -x * y / (1 + z), -x])
    down = np.stack([-x * y / (1 + z), 1 - y * y / (1 + z), -y])
    cosine, sine = (level * right).sum(axis=0), -(level * down).sum(axis=0)
    c, s = cosine**2 - sine**2, 2 * cosine * sine
    s0, s1, s2 = stokes
    return np.stack([s0, c * s1 - s * s2, s * s1 + c * s2]).astype(np.float32)


def to_rectangular(stokes: Image, intrinsics: Intrinsics) -> Image:
    """Stretches rows where the two focal lengths differ by something that shows."""
    fx, fy, cy = intrinsics.K[0, 0], intrinsics.K[1, 1], intrinsics.K[1, 2]
    if abs(fy / fx - 1) * intrinsics.height / 2 < _SQUARE_PX:
        return stokes
    stretch = np.array([[1.0, 0.0, 0.0], [0.0, fy / fx, cy * (1 - fy / fx)]])
    size = (intrinsics.width, intrinsics.height)
    return np.stack(
        [cv2.warpAffine(image, stretch, size, borderMode=cv2.BORDER_REPLICATE) for image in stokes]
    )


def _guides(scene: Scene) -> tuple[Image, Image]:
    """Albedo (h, w) and normals (h, w, 3) of what each pixel's centre sees, free of noise."""
    albedo = table_albedo(scene)
    normals = np.zeros_like(scene.rays)
    normals[albedo > 0] = scene.T_cam_table.rotation[:, 2]
    for layer in scene.layers:
        window, body = layer.raster.window, layer.surface.albedo
        albedo[window][layer.front] = 1.0 if layer.surface.kind in ("metal", "glass") else body
        normals[window][layer.front] = layer.raster.normals[layer.front]
    return np.clip(albedo, 0, 1), normals
