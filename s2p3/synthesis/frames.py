"""One frame of a set, from its seed to the bytes that are stored; the same wherever it is rendered."""

from __future__ import annotations

import hashlib
import io
import json
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from dataset import Intrinsics, ToolkitError
from dataset.frames import SUPERPIXEL
from dataset.polarimetry import decode
from dataset.session import compress, mask_box
from s2p3.objects import ObjectModel
from s2p3.synthesis.depth import DepthSensor, sensed
from s2p3.synthesis.domain import Domain
from s2p3.synthesis.drawing import draw_scene
from s2p3.synthesis.informativeness import Informativeness, measure
from s2p3.synthesis.scene import Backend, Scene, SceneImage, render
from s2p3.synthesis.sensor import expose

BITS = 12
MEASURED = 64
"""Images of a set whose informativeness is measured: the first so many."""

_ATTEMPTS = 60  # drawings of one scene until the object is visible enough
_SMALLEST_PX = 60  # visible pixels of an object worth training on

PAPER_CAMERA = Intrinsics(
    np.array([[351.450, 0.0, 303.646], [0.0, 351.477, 251.423], [0.0, 0.0, 1.0]]), np.zeros(0), 512, 612
)
"""The working image of the camera behind PPP-Net's data: a 6 mm lens, 612x512 pixels."""


def session_camera(calibration: str | Path | None = None) -> Intrinsics:
    """The working image (a pixel per super-pixel, without distortion) of a calibrated camera.

    Args:
        calibration: calibration.json, of a colour camera where it does not say; the camera behind the paper's
            data when None.

    Raises:
        ToolkitError: the file cannot be read, or holds no intrinsics.
    """
    if calibration is None:
        return PAPER_CAMERA
    from calibration.result import Calibration

    record = Calibration.load(calibration).intrinsics
    if record is None:
        raise ToolkitError(f"{calibration} holds no intrinsics; run: s2p3 calibrate intrinsics")
    return record.intrinsics.at(SUPERPIXEL[record.mosaic or "colour"]).pinhole


class Drawn(NamedTuple):
    """A frame's scene, the seed of its light paths, and the generator its noise comes from."""

    scene: Scene
    seed: int
    noise: np.random.Generator


@dataclass(frozen=True, eq=False)
class Recipe:
    """All that the frames of a set depend on, besides their index.

    Attributes:
        model: the object.
        intrinsics: of the working image, a pinhole.
        domain: what scenes are drawn from.
        backend: what renders them.
        seed: of the set.
        depth: the depth camera beside it, or None.
    """

    model: ObjectModel
    intrinsics: Intrinsics
    domain: Domain
    backend: Backend
    seed: int
    depth: DepthSensor | None = None

    def draw(self, index: int) -> Drawn:
        """Frame `index`: it depends on nothing but the recipe, whoever draws it and in whatever order.

        Raises:
            ToolkitError: the object stayed hidden or out of the picture in every attempt.
        """
        rng = np.random.default_rng([self.seed, index])
        paths = int(np.random.default_rng([self.seed, index, 1]).integers(2**31))
        occluded = bool(
            rng.random() < self.domain.occluder_share
        )  # once, or attempts would favour clear views
        for _ in range(_ATTEMPTS):
            T_cam_obj = self.domain.views.draw(self.model, self.intrinsics, rng)
            parameters = draw_scene(self.domain, self.model, T_cam_obj, rng, occluded)
            scene = Scene(self.model, T_cam_obj, self.intrinsics, parameters)
            enough = scene.visible_fraction >= self.domain.smallest_visible_fraction
            if enough and scene.mask.sum() >= _SMALLEST_PX:
                return Drawn(scene, paths, rng)
        raise ToolkitError(
            f"{self.model.name}: hardly visible in {_ATTEMPTS} drawn views at {self.domain.views.reach}; "
            "check the mesh's unit and the range of distances"
        )

    def render(self, drawn: Drawn) -> tuple[SceneImage, NDArray[np.uint16]]:
        """The frame as a noiseless sensor sees it, and the raw mosaic that ours read."""
        image = render(drawn.scene, self.backend, drawn.seed)
        return image, expose(image.stokes, drawn.scene.parameters, BITS, drawn.noise)

    def depth_mm(self, drawn: Drawn, index: int) -> NDArray[np.uint16]:
        """(h, w) of frame `index` as the depth camera measures it, 0: unknown; (0, 0) without one."""
        if self.depth is None:
            return np.zeros((0, 0), np.uint16)
        rng = np.random.default_rng([self.seed, index, 2])
        millimetres = 1000 * sensed(drawn.scene, self.depth, rng)
        return np.rint(millimetres).clip(0, 65535).astype(np.uint16)

    def part(self, index: int) -> bytes:
        """Frame `index` with its truth, as `Part` reads it."""
        drawn = self.draw(index)
        image, raw = self.render(drawn)
        chunk = compress(raw)
        figures = self._measure(image, raw, index) if index < MEASURED else None
        out = io.BytesIO()
        np.savez(
            out,
            chunk=np.frombuffer(chunk.data, np.uint8),
            crc32=chunk.crc32,
            T_cam_obj=drawn.scene.T_cam_obj.as_matrix(),
            visible_fraction=image.visible_fraction,
            bbox_xywh=mask_box(image.mask),
            mask=np.packbits(image.mask),
            depth=self.depth_mm(drawn, index),
            figures="" if figures is None else figures.to_json(),
            manifest=json.dumps(manifest_of(drawn, index)),
        )
        return out.getvalue()

    def _measure(self, image: SceneImage, raw: NDArray[np.uint16], index: int) -> Informativeness | None:
        """Informativeness of the object's block of a frame, as the sensor read it."""
        window = image.raster.window
        x, y, _, _ = image.raster.region
        K = self.intrinsics.K.copy()
        K[:2, 2] -= [x, y]
        stokes = decode(raw, "mono", BITS)
        visible = image.mask[window] & stokes.valid[window]
        return measure(
            stokes.stack()[:, window[0], window[1]],
            image.raster.normals,
            visible,
            K,
            self.model.refractive_index,
            seed=index,
        )


class Part:
    """A rendered frame on its way into a session.

    Args:
        path: of bytes that `Recipe.part` made.
    """

    def __init__(self, path: Path) -> None:
        with np.load(path, allow_pickle=False) as arrays:
            self._arrays = {name: arrays[name] for name in arrays.files}

    def __getitem__(self, name: str) -> Any:
        return self._arrays[name]

    @cached_property
    def figures(self) -> Informativeness | None:
        """How informative the frame is, where that was measured."""
        text = str(self["figures"])
        return Informativeness.from_json(text) if text else None

    @property
    def manifest(self) -> dict[str, Any]:
        """The frame's entry in the set's manifest."""
        entry: dict[str, Any] = json.loads(str(self["manifest"]))
        return entry


def manifest_of(drawn: Drawn, index: int) -> dict[str, Any]:
    """The seeds of a frame and what was drawn from them: numbers as they are, textures and meshes by size.

    `sha256` covers every bit of the scene: a frame rendered again is of the same scene, or an error.
    """
    scene = drawn.scene
    digest = hashlib.sha256(scene.T_cam_obj.as_matrix().tobytes())
    described = _described(scene.parameters, digest)
    return {
        "index": index,
        "light_path_seed": drawn.seed,
        "T_cam_obj": scene.T_cam_obj.as_matrix().tolist(),
        "visible_fraction": scene.visible_fraction,
        "scene": described,
        "sha256": digest.hexdigest(),
    }


def _described(value: Any, digest: Any) -> Any:
    """A tree of dataclasses for JSON; every bit goes into the digest, large arrays go nowhere else."""
    if hasattr(value, "__dataclass_fields__"):
        return {name: _described(getattr(value, name), digest) for name in value.__dataclass_fields__}
    if isinstance(value, tuple):
        return [_described(item, digest) for item in value]
    if isinstance(value, np.ndarray):
        digest.update(np.ascontiguousarray(value).tobytes())
        return value.tolist() if value.size <= 32 else {"array": list(value.shape)}
    digest.update(repr(value).encode())
    return value
