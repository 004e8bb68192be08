"""What the simulated camera sees: table, board and object, rendered for where the arm really is at an
exposure.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from acquisition.simulation.patterns import Pixels
from calibration.board import draw
from dataset import pixel_formats
from dataset.transforms import SE3
from s2p3 import objects
from s2p3.board import board_spec
from s2p3.lab.arm_pose import ArmPose
from s2p3.lab.lighting import captured_light, captured_surface
from s2p3.lab.polarizer import HandHeldPolarizer, lamp_through
from s2p3.lab.rig import BOARD
from s2p3.lab.table import Table, render_table, wood_texture
from s2p3.lab.truth import LabTruth
from s2p3.rendering.rasterizer import projected_region, rasterize
from s2p3.synthesis.analytic import shade

_CELL = 2
"""The scene is rendered per 2x2 polarizer cell: one Stokes vector for the four pixels that measure it."""
_PRINT_PX_PER_SQUARE = 220
_PAPER_WHITE, _INK_BLACK = 0.85, 0.04
_REFERENCE_EXPOSURE_US = 4000.0


class LabScene:
    """Table, board, object and light of one lab."""

    def __init__(self, truth: LabTruth) -> None:
        self.truth = truth
        rng = np.random.default_rng(truth.seed + 1)
        spec = board_spec(BOARD)
        printed = draw(spec, _PRINT_PX_PER_SQUARE).astype(np.float32) / 255
        albedo = (_INK_BLACK + (_PAPER_WHITE - _INK_BLACK) * printed).astype(np.float32)
        self._table = Table(wood_texture(rng), albedo, spec.size_m, truth.T_base_board)
        model = objects.build(truth.object_name)
        self._mesh = model.mesh
        self._surface = captured_surface(model, truth.refractive_index)
        self._light = captured_light(rng)
        self._camera = truth.intrinsics.at(_CELL)
        self._rays = self._camera.rays().astype(np.float32)

    def render(self, T_base_cam: SE3) -> NDArray[np.float32]:
        """The radiance (3, 1024, 1224) of S0, S1, S2 in a camera at T_base_cam; 1 is a white, well-lit
        surface.
        """
        image = render_table(self._table, self._rays, T_base_cam)
        T_cam_obj = T_base_cam.inverse() @ self.truth.T_base_object
        region = projected_region(self._mesh, T_cam_obj, self._camera)
        if region[2] and region[3]:
            raster = rasterize(self._mesh, T_cam_obj, self._camera, region)
            window = raster.window
            light = self._light.turned(T_base_cam.inverse())
            stokes = shade(raster.normals, self._rays[window], raster.mask, self._surface, light)
            for shown, drawn in zip(image, stokes, strict=True):
                shown[window][raster.mask] = drawn[raster.mask]
        return image


class LabCamera:
    """The frame source of the simulated camera: the scene, from where the arm carries the sensor."""

    def __init__(self, scene: LabScene, arm: ArmPose, polarizer: HandHeldPolarizer) -> None:
        truth = scene.truth
        self._scene, self._arm, self._polarizer = scene, arm, polarizer
        self._sensor = truth.sensor
        self._rng = np.random.default_rng(truth.seed + 2)

    def frame(
        self, pixel_format: str, height: int, width: int, exposure_us: float, gain_db: float, time_ns: int
    ) -> Pixels:
        """See acquisition.simulation.patterns.FrameSource."""
        truth = self._scene.truth
        exposed_s = time_ns * 1e-9 + exposure_us * 0.5e-6 - truth.exposure_offset_s
        angle = self._polarizer.angle()
        if angle is None:
            stokes = self._scene.render(truth.T_base_flange(self._arm.at(exposed_s)) @ truth.T_tcp_cam)
        else:
            stokes = lamp_through(angle, truth.intrinsics.height // _CELL, truth.intrinsics.width // _CELL)
        signal = exposure_us / _REFERENCE_EXPOSURE_US * 10 ** (gain_db / 20)
        layout = pixel_formats.pixel_format(pixel_format)
        mosaic = self._sensor.expose(stokes, signal, layout.bits, layout.colour, self._rng)[:height, :width]
        return mosaic.astype(np.uint8) if layout.bits == 8 else mosaic


def camera_source(truth: str, arm_host: str, arm_hz: float) -> LabCamera:
    """What the simulated camera's `--source` names."""
    path = Path(truth)
    scene, arm = LabScene(LabTruth.load(path)), ArmPose(arm_host, arm_hz)
    return LabCamera(scene, arm, HandHeldPolarizer(path))
