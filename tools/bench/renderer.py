"""The differentiable renderer: its cost, its gradients, and whether they lead back to the true pose.

    python tools/bench/renderer.py --json

For each built-in object, and a trefoil knot that nothing here was tuned on, one thread, the object's diameter
spanning two thirds of the image, as in a box enlarged by half:

    ms_per_image_128, ms_per_image_256   forward and backward of all maps, per image of a batch of eight:
                                         median of the process's own time, for the machine may be shared
    fd_cos_rot, fd_cos_trans             cosine between the mask's gradients and central finite differences of
                                         a mask rendered sixteen times finer, over 48 random poses
    recovered_pct, recovered_add_pct     of `--views` random poses, those found again from 10 deg and 5 % of
                                         the diameter off, on pictures of up to 256x256 pixels: see
                                         `pose_recovery.recovered`. recovered_128_pct: of up to 128x128
    mitsuba_projective_ms_128            the peer: Mitsuba's direct_projective for one mask and its gradient,
                                         16 samples per pixel (--without-mitsuba leaves it out)
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Callable
from dataclasses import replace

import mitsuba_projective
import numpy as np
import torch
from pose_recovery import Pose, recovered, rotation, views
from timing import cpu_time, in_turns
from torch import Tensor
from torch.nn.functional import avg_pool2d, cosine_similarity, interpolate

from s2p3 import objects
from s2p3.objects import ObjectModel
from s2p3.rendering.differentiable import RenderMesh, render

SEED = 0
BATCH = 8
GRADIENT_VIEWS = 48


def trefoil(sections: int = 240, sides: int = 20) -> tuple[np.ndarray, np.ndarray]:
    """A knotted tube 12 cm across: vertices (V, 3) and faces (F, 3)."""
    t = np.linspace(0, 2 * np.pi, sections, endpoint=False)[:, None]
    centre = np.hstack([np.sin(t) + 2 * np.sin(2 * t), np.cos(t) - 2 * np.cos(2 * t), -np.sin(3 * t)])
    tangent = np.roll(centre, -1, axis=0) - np.roll(centre, 1, axis=0)
    side = np.cross(tangent, [0, 0, 1.0])
    side /= np.linalg.norm(side, axis=1, keepdims=True)
    up = np.cross(side, tangent)
    up /= np.linalg.norm(up, axis=1, keepdims=True)
    a = np.linspace(0, 2 * np.pi, sides, endpoint=False)[None, :, None]
    ring = centre[:, None] + 0.45 * (np.cos(a) * side[:, None] + np.sin(a) * up[:, None])
    i, j = (x.ravel() for x in np.meshgrid(np.arange(sections), np.arange(sides), indexing="ij"))
    here, next_ring = i * sides, (i + 1) % sections * sides
    p, q, r, s = here + j, here + (j + 1) % sides, next_ring + j, next_ring + (j + 1) % sides
    return 0.018 * ring.reshape(-1, 3), np.vstack([np.c_[p, r, q], np.c_[q, r, s]]).astype(np.int32)


def forward_backward(mesh: RenderMesh, diameter: float, size: int) -> Callable[[], None]:
    """One forward and backward pass of everything the renderer gives, as from a loss of every map."""
    R, t, K = views(diameter, BATCH, SEED, size)
    generator = torch.Generator().manual_seed(SEED)
    gradients = [torch.randn(BATCH, channels, size, size, generator=generator) for channels in (1, 3, 1, 3)]

    def run() -> None:
        pose = R.clone().requires_grad_(), t.clone().requires_grad_()
        o = render(mesh, *pose, K, size, size)
        torch.autograd.grad((o.mask, o.normals, o.depth, o.nocs), pose, gradients)

    return run


def gradient_cosines(mesh: RenderMesh, diameter: float, count: int, size: int = 128) -> tuple[float, float]:
    """Cosines (rotation, translation) of the mask's gradients with finite differences."""
    ours, differences = [], []
    sizes = torch.tensor([0.01] * 3 + [0.003 * diameter] * 3)
    for seed in range(count):
        R, t, K = views(diameter, 1, seed, size)
        rough = torch.randn(1, 1, 5, 5, generator=torch.Generator().manual_seed(seed))
        weight = interpolate(rough, (size, size), mode="bicubic")

        def loss(step: Tensor, finer: int, pose: Pose = (R, t, K), weight: Tensor = weight) -> Tensor:
            R, t, K = pose
            K = K.clone()
            K[:, :2] *= finer
            K[:, :2, 2] += (finer - 1) / 2
            turned = rotation(step[None, :3]) @ R
            mask = render(mesh, turned, t + step[None, 3:], K, size * finer, size * finer).mask
            return (avg_pool2d(mask, finer) * weight).sum()

        step = torch.zeros(6, requires_grad=True)
        ours.append(torch.autograd.grad(loss(step, 1), step)[0])
        with torch.no_grad():
            change = [loss(d, 4) - loss(-d, 4) for d in torch.diag(sizes)]
        differences.append(torch.stack(change) / (2 * sizes))
    gradients, finite = torch.stack(ours), torch.stack(differences)
    rot, trans = (
        float(cosine_similarity(gradients[:, part].flatten(), finite[:, part].flatten(), dim=0))
        for part in (slice(0, 3), slice(3, 6))
    )
    return rot, trans


def measure(model: ObjectModel, count: int, rounds: int) -> dict[str, float]:
    """The figures of the module's docstring, of one object, but for the peer's."""
    mesh = RenderMesh.from_mesh(model.mesh)
    passes = {str(size): forward_backward(mesh, model.diameter, size) for size in (128, 256)}
    times = in_turns(passes, rounds, clock=cpu_time)
    rot, trans = gradient_cosines(mesh, model.diameter, min(count, GRADIENT_VIEWS))
    return {
        "ms_per_image_128": times["128"] / BATCH,
        "ms_per_image_256": times["256"] / BATCH,
        "fd_cos_rot": rot,
        "fd_cos_trans": trans,
        **recovered(mesh, model, count, SEED + 1),
    }


def build(name: str) -> ObjectModel:
    """A built-in object, or the trefoil."""
    if name != "trefoil":
        return objects.build(name)
    vertices, faces = trefoil()
    diameter = objects.diameter(vertices)
    return replace(objects.build("cup"), name=name, vertices=vertices, faces=faces, diameter=diameter)


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    names = (*objects.NAMES, "trefoil")
    parser.add_argument("--objects", nargs="+", choices=names, default=names, metavar="NAME")
    parser.add_argument("--views", type=int, default=144, help="poses to recover")
    parser.add_argument("--rounds", type=int, default=20, help="how often each pass is timed")
    parser.add_argument("--without-mitsuba", action="store_true", help="leave the peer out")
    parser.add_argument("--json", action="store_true", help="print one JSON object")
    options = parser.parse_args()
    if min(options.views, options.rounds) < 1:
        parser.error("--views and --rounds count from 1")
    torch.set_num_threads(1)
    figures = {}
    for name in options.objects:
        model = build(name)
        row = measure(model, options.views, options.rounds)
        if not options.without_mitsuba:
            peer = {"peer": mitsuba_projective.forward_backward(model)}
            row["mitsuba_projective_ms_128"] = in_turns(peer, rounds=3, warm_up=1, clock=cpu_time)["peer"]
        figures[name] = {key: round(x, 3) for key, x in row.items()}
        if not options.json:
            print(f"{name:8s}", *(f"{key} {x:.3f}" for key, x in row.items()), flush=True)
    if options.json:
        print(json.dumps(figures))


if __name__ == "__main__":
    main()
