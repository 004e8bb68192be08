"""Rendering with gradients: mask, normals, depth and object coordinates as functions of the pose.

Forward it is a plain z-buffer, aliased and exact. Backward it has three parts.

*Interior.* Which face a pixel sees is taken as given; where its ray meets that face's plane, and everything
interpolated there, is recomputed from the pose, so that these gradients are exact.

*Silhouettes.* Where the depth jumps between two neighbouring pixels, the surface in front (behind a smooth
rim: the rim itself) is followed as the pose changes. The distance s it moves towards the pixel behind is by
how much the boundary between the two moves, so s * (front - back) is by how much the image changes: the
boundary term of the derivative of an integral over the image. It is added with value zero, half to each of
the two pixels. No edges of the mesh are searched, so that meshes of tiny triangles cost nothing extra (the
idea of edge gradients, Pidhorskyi et al., "Rasterized Edge Gradients", 2024; the rim is ours).

*Creases* (ours). Where the depth does not jump but the normals do, the line in which the planes of the two
faces meet is followed in the same way. Without it the normals of a thin plate, all creases, have gradients
of any direction.

On the CPU all of it runs in hand-differentiated kernels; `render_reference` is the same in plain torch.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import fields

import torch
from torch import Tensor

from dataset import ToolkitError
from s2p3.rendering.cpu_kernels import CpuRender
from s2p3.rendering.reference import DEPTH_STEP, render_reference
from s2p3.rendering.render_mesh import RenderMesh, RenderOutput

__all__ = ["DEPTH_STEP", "RenderMesh", "RenderOutput", "render", "render_each", "render_reference"]


def render(
    mesh: RenderMesh, R: Tensor, t: Tensor, K: Tensor, height: int, width: int, silhouette: bool = True
) -> RenderOutput:
    """Render one object at B poses, each with its own camera.

    Args:
        R, t: (B, 3, 3) and (B, 3), T_cam_obj, metres; gradients flow to these two only.
        K: (B, 3, 3) pinhole intrinsics, pixel centres at integers.
        silhouette: whether outlines and creases have gradients.

    Computes in float32 (float64 where R is), under autocast too. Faces nearer than 1 mm are not drawn; an
    object out of sight gives zeros and zero gradients.

    Raises:
        ToolkitError: other shapes.
    """
    batch = len(R)
    if R.shape != (batch, 3, 3) or t.shape != (batch, 3) or K.shape != (batch, 3, 3):
        raise ToolkitError(
            f"render: R, t and K must be (B, 3, 3), (B, 3), (B, 3, 3), got "
            f"{tuple(R.shape)}, {tuple(t.shape)}, {tuple(K.shape)}"
        )
    K = K.detach()
    if R.device.type != "cpu":
        return render_reference(mesh, R, t, K, height, width, silhouette)
    dtype = torch.float64 if R.dtype == torch.float64 else torch.float32
    step = DEPTH_STEP if silhouette else float("inf")
    outputs = CpuRender.apply(R.to(dtype), t.to(dtype), K.to(dtype), mesh.arrays(), (height, width), step)
    return RenderOutput(*outputs)


def render_each(
    meshes: Sequence[RenderMesh],
    R: Tensor,
    t: Tensor,
    K: Tensor,
    height: int,
    width: int,
    silhouette: bool = True,
) -> RenderOutput:
    """`render` of B objects, each at its own pose: `meshes` holds one for every pose, the same one again
    where an object occurs again.

    Raises:
        ToolkitError: other shapes, or not as many meshes as poses.
    """
    if not len(meshes) == len(R) > 0:
        raise ToolkitError(f"render_each: {len(meshes)} meshes at {len(R)} poses; give one for each")
    places: dict[int, list[int]] = {}
    for place, mesh in enumerate(meshes):
        places.setdefault(id(mesh), []).append(place)
    parts = [
        render(meshes[own[0]], R[own], t[own], K[own], height, width, silhouette) for own in places.values()
    ]
    order = torch.tensor([place for own in places.values() for place in own], device=R.device).argsort()
    return RenderOutput(
        *(torch.cat([getattr(part, field.name) for part in parts])[order] for field in fields(RenderOutput))
    )
