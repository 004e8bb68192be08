"""The depth image a second sensor would have taken of a synthetic scene, for the RGB-D baselines.

`ideal` measures every surface. `tof` is our stand-in for a time-of-flight camera, after the S2P3 paper's
account of its failures: silhouettes have no depth, polished metal is measured too far away and in part not at
all, and light goes through glass to what lies behind. How strongly is our choice; real sensors differ.
"""

from __future__ import annotations

from typing import Literal

import cv2
import numpy as np
from numpy.typing import NDArray

from s2p3.synthesis.scene import Scene

DepthSensor = Literal["ideal", "tof"]
Image = NDArray[np.float32]

_NOISE = 0.004  # of the depth
_STEP_M = 0.012  # a larger step within 3x3 pixels is a silhouette
_METAL_M, _METAL_LOST = 0.05, 0.3  # how much too far, and share that is not measured at all
_GLASS_SEEN, _GLASS_M = 0.25, 0.015  # share of glass that is measured, and how much too far
_PATCH_PX = 6  # size of the patches in which a sensor errs alike


def scene_depth(scene: Scene) -> Image:
    """(h, w) float32 z of the nearest surface, metres; 0 where there is only the wall."""
    depth = table_depth(scene)
    for layer in scene.layers:
        depth[layer.raster.window][layer.front] = layer.raster.depth[layer.front]
    return depth


def table_depth(scene: Scene) -> Image:
    """The same of the bare table."""
    T_cam_table = scene.T_cam_table
    normal, towards = T_cam_table.rotation[:, 2], scene.rays.astype(np.float64)
    slope = towards @ normal
    reach = np.where(slope < -0.01, (T_cam_table.translation @ normal) / np.minimum(slope, -0.01), 0.0)
    return (reach * towards[..., 2]).clip(0).astype(np.float32)


def sensed(scene: Scene, sensor: DepthSensor, rng: np.random.Generator) -> Image:
    """(h, w) float32 metres as the sensor measures them; 0: unknown."""
    depth = scene_depth(scene)
    if sensor == "ideal":
        return depth
    measured, behind = depth.copy(), table_depth(scene)
    luck, excess = _patches(rng, depth.shape), _patches(rng, depth.shape) ** 2
    for layer in scene.layers:
        window, true = layer.raster.window, layer.raster.depth
        if layer.surface.kind == "metal":
            found = np.where(luck[window] < _METAL_LOST, 0, true + _METAL_M * excess[window])
        elif layer.surface.kind == "glass":
            found = np.where(luck[window] < _GLASS_SEEN, true + _GLASS_M, behind[window])
        else:
            continue
        measured[window][layer.front] = found[layer.front]
    measured *= (1 + _NOISE * rng.standard_normal(measured.shape)).astype(np.float32)
    kernel = np.ones((3, 3), np.uint8)
    step = cv2.dilate(depth, kernel) - cv2.erode(depth, kernel)
    measured[step > _STEP_M] = 0
    return measured


def _patches(rng: np.random.Generator, shape: tuple[int, ...]) -> Image:
    """Smooth random values, uniform in 0 to 1."""
    coarse = rng.random([-(-side // _PATCH_PX) + 1 for side in shape], dtype=np.float32)
    smooth = cv2.resize(coarse, (shape[1], shape[0])).ravel()
    uniform: Image = np.empty(smooth.shape, np.float32)  # by rank: enlarging pulled the values to the middle
    uniform[np.argsort(smooth, kind="stable")] = (np.arange(smooth.size) + 0.5) / smooth.size
    return uniform.reshape(shape)
