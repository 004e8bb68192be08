"""Mitsuba's projective integrator as a peer: the silhouette's gradient of one mask, 128 x 128, one thread."""

from __future__ import annotations

import os
import tempfile
from collections.abc import Callable
from pathlib import Path

import numpy as np
import trimesh

from s2p3.objects import ObjectModel
from s2p3.synthesis.mitsuba_engine import find_engine


def forward_backward(model: ObjectModel, size: int = 128, samples: int = 16) -> Callable[[], object]:
    """A function that renders the object as a lamp, which is its mask, and differentiates a weighted sum of
    the picture by a shift of the object.

    Samples per pixel are the same for the picture, its interior and its outline; indirect light is left out.
    """
    engine = find_engine()
    if engine.llvm:
        os.environ.setdefault("DRJIT_LIBLLVM_PATH", engine.llvm)
    import drjit as dr
    import mitsuba as mi

    mi.set_variant("llvm_ad_mono")
    dr.set_thread_count(1)
    mi.set_log_level(mi.LogLevel.Error)
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "object.ply"
        trimesh.Trimesh(model.vertices, model.faces, process=False).export(path)
        look = mi.ScalarTransform4f().look_at([0, 0, -0.6], [0, 0, 0], [0, -1, 0])
        film = {"type": "hdrfilm", "width": size, "height": size, "pixel_format": "luminance"}
        film |= {"rfilter": {"type": "box"}, "sample_border": True}
        fov_deg = float(np.degrees(2 * np.arctan(0.75 * model.diameter / 0.6)))
        lamp = {"type": "area", "radiance": {"type": "uniform", "value": 1.0}}
        scene = mi.load_dict(
            {
                "type": "scene",
                "integrator": {"type": "direct_projective", "sppc": samples, "sppp": samples, "sppi": 0},
                "sensor": {"type": "perspective", "fov": fov_deg, "to_world": look, "film": film},
                "object": {"type": "ply", "filename": str(path), "emitter": lamp},
            }
        )
    parameters = mi.traverse(scene)
    at_rest = dr.detach(mi.Float(parameters["object.vertex_positions"]))
    along_x = dr.tile(mi.Float([1.0, 0.0, 0.0]), len(at_rest) // 3)
    weights = np.random.default_rng(0).normal(size=(size, size, 1)).astype(np.float32)

    def run() -> object:
        shift = mi.Float(0.0)
        dr.enable_grad(shift)
        parameters["object.vertex_positions"] = at_rest + shift * along_x
        parameters.update()
        image = mi.render(scene, parameters, spp=samples)
        dr.backward(dr.sum(image * mi.TensorXf(weights), axis=None))
        return np.array(dr.grad(shift))

    return run
