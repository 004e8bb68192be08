"""Rendering with gradients: mask, normals, depth and object coordinates as functions of the pose.

Forward it is a plain z-buffer, aliased and exact. Backward it has two parts.

*Interior.* Which face a pixel sees is taken as given; where its ray meets that face's plane, and everything
interpolated there, is recomputed from the pose, so that these gradients are exact.

*Silhouettes.* Where the depth jumps between two neighbouring pixels, the visible material point of the front
one (behind a smooth rim: the point of the rim itself) is followed as the pose changes. The distance s it
moves towards the back one is by how much the boundary between them moves, so s * (front - back) is by how
much the image changes: the boundary term of the derivative of an integral over the image. It is added with
value zero, half to each of the two pixels. No edges of the mesh are searched, so that meshes of tiny
triangles cost nothing extra (the idea of edge gradients, Pidhorskyi et al., "Rasterized Edge Gradients",
2024; the rim is ours).

On the CPU both parts run in hand-differentiated kernels; `render_reference` is the same in plain torch.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from s2p3.rendering.cpu_kernels import RIM_PX, CpuRender, MeshArrays, draw_batch, project
from s2p3.rendering.mesh import Mesh

DEPTH_STEP = 0.03
"""Relative difference of depth from which two neighbouring pixels lie on different surfaces (our choice)."""

_GRAZING = 1e-5  # smallest cosine between a ray and a face that is divided by


@dataclass(frozen=True, eq=False)
class RenderMesh:
    """A mesh as tensors on one device, with what the interpolation inside each face needs worked out.

    Attributes:
        vertices: (V, 3); faces: (F, 3) int32 on the CPU, for the rasterizer.
        table: (F, 18) per face: first corner, unit normal, first corner's normal, and the (3, 3) matrix that
            maps an offset from the first corner to the change of the interpolated normal.
        lower, extent: (3,) the NOCS box.
    """

    vertices: Tensor
    faces: NDArray[np.int32]
    table: Tensor
    lower: Tensor
    extent: Tensor

    @staticmethod
    def from_mesh(mesh: Mesh, device: torch.device | str = "cpu") -> RenderMesh:
        corners = mesh.vertices.astype(np.float64)[mesh.faces]
        first = corners[:, 0]
        edge1, edge2 = corners[:, 1] - first, corners[:, 2] - first
        normal = np.cross(edge1, edge2)
        squared = np.maximum((normal**2).sum(axis=1, keepdims=True), 1e-30)
        dual1, dual2 = np.cross(edge2, normal) / squared, np.cross(normal, edge1) / squared
        at = mesh.corner_normals.astype(np.float64)
        change1, change2 = at[:, 1] - at[:, 0], at[:, 2] - at[:, 0]
        slope = change1[:, :, None] * dual1[:, None] + change2[:, :, None] * dual2[:, None]
        table = np.concatenate([first, normal / np.sqrt(squared), at[:, 0], slope.reshape(-1, 9)], axis=1)
        return RenderMesh(
            torch.from_numpy(mesh.vertices).to(device),
            mesh.faces,
            torch.from_numpy(table.astype(np.float32)).to(device),
            torch.from_numpy(mesh.lower).to(device),
            torch.from_numpy(mesh.extent).to(device),
        )

    def arrays(self) -> MeshArrays:
        """The same numbers in the CPU's memory."""
        vertices, table, lower, extent = (
            tensor.cpu().numpy() for tensor in (self.vertices, self.table, self.lower, self.extent)
        )
        return vertices, self.faces, table, lower, extent


@dataclass(frozen=True)
class RenderOutput:
    """B images of H x W pixels, zero where the object is not seen.

    Attributes:
        mask: (B, 1, H, W), 0 or 1.
        normals: (B, 3, H, W), unit, OpenCV camera frame.
        normals_interior: the same values, without the silhouettes' gradients: for losses per visible pixel.
        depth: (B, 1, H, W), z, metres.
        nocs: (B, 3, H, W), position in the bounding box, 0 to 1 along each axis.
    """

    mask: Tensor
    normals: Tensor
    normals_interior: Tensor
    depth: Tensor
    nocs: Tensor


def render(
    mesh: RenderMesh, R: Tensor, t: Tensor, K: Tensor, height: int, width: int, silhouette: bool = True
) -> RenderOutput:
    """Render one object at B poses, each with its own camera.

    Args:
        R, t: (B, 3, 3) and (B, 3), T_cam_obj, metres; gradients flow to these two only.
        K: (B, 3, 3) pinhole intrinsics, pixel centres at integers.
        silhouette: whether outlines have gradients.

    Computes in float32 (float64 where R is), under autocast too. Faces nearer than 1 mm are not drawn; an
    object out of sight gives zeros and zero gradients.
    """
    if R.device.type != "cpu":
        return render_reference(mesh, R, t, K, height, width, silhouette)
    dtype = _precision(R)
    step = DEPTH_STEP if silhouette else float("inf")
    outputs = CpuRender.apply(R.to(dtype), t.to(dtype), K.to(dtype), mesh.arrays(), (height, width), step)
    return RenderOutput(*outputs)


def render_reference(
    mesh: RenderMesh, R: Tensor, t: Tensor, K: Tensor, height: int, width: int, silhouette: bool = True
) -> RenderOutput:
    """`render` in plain torch, for any device: what the CPU's fast path is tested against."""
    dtype = _precision(R)
    with torch.autocast(device_type=R.device.type, enabled=False):
        R, t, K = R.to(dtype), t.to(dtype), K.to(dtype)
        face = _visible_faces(mesh, R, t, K, height, width)
        seen = torch.nonzero(face.view(-1) >= 0)[:, 0]
        features = _interior(mesh, face.view(-1)[seen], seen, R, t, K, height, width)
        maps = [_scatter(seen, rows, face) for rows in features]
        interior = maps[1]
        if silhouette:
            edges, shift = _boundary(mesh, seen, features, face, R, t, K)
            maps = [_scatter_moving(seen, rows, edges, shift, face) for rows in features]
    mask, normals, depth, nocs = (image.permute(0, 3, 1, 2) for image in maps)
    return RenderOutput(mask, normals, interior.permute(0, 3, 1, 2), depth, nocs)


def _precision(R: Tensor) -> torch.dtype:
    return torch.float64 if R.dtype == torch.float64 else torch.float32


def _scatter(where: Tensor, rows: Tensor, face: Tensor) -> Tensor:
    """Rows (n, C) summed at the flat pixels (n,) of a zero image (B, H, W, C)."""
    image = rows.new_zeros(face.numel(), rows.shape[1]).index_add(0, where, rows)
    return image.view(*face.shape, rows.shape[1])


def _scatter_moving(seen: Tensor, rows: Tensor, edges: Tensor, shift: Tensor, face: Tensor) -> Tensor:
    """`_scatter` of the seen pixels, plus s * (front - back) shared by the two pixels of every edge.

    Args:
        edges: (2, m) flat pixels in front and behind; shift: (m,) the zero-valued s.
    """
    values = _scatter(seen, rows.detach(), face).view(face.numel(), -1)
    change = 0.5 * (values[edges[0]] - values[edges[1]]) * shift[:, None]
    return _scatter(torch.cat([seen, edges.view(-1)]), torch.cat([rows, change, change]), face)


def _interior(
    mesh: RenderMesh, face: Tensor, seen: Tensor, R: Tensor, t: Tensor, K: Tensor, height: int, width: int
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Mask (n, 1), normal (n, 3), depth (n, 1) and NOCS (n, 3) of the n seen pixels: each pixel's ray cut
    with the plane of its face."""
    corner, plane, normal, slope = mesh.table.index_select(0, face).to(R.dtype).split([3, 3, 3, 9], dim=1)
    owner = torch.div(seen, height * width, rounding_mode="floor")
    row, column = torch.div(seen, width, rounding_mode="floor") % height, seen % width
    camera = torch.stack([K[:, 0, 0], K[:, 1, 1], K[:, 0, 2], K[:, 1, 2]], dim=1)[owner]
    rays = torch.stack([column, row], dim=1).to(R.dtype)
    rays = torch.cat([(rays - camera[:, 2:]) / camera[:, :2], torch.ones_like(rays[:, :1])], dim=1)  # z = 1
    rotation = R.index_select(0, owner)
    directions = torch.bmm(rays[:, None], rotation)[:, 0]
    origin = -(t[:, None] @ R)[:, 0].index_select(0, owner)
    incline = (plane * directions).sum(1)
    incline = torch.where(incline.abs() < _GRAZING, torch.full_like(incline, -_GRAZING), incline)
    depth = (plane * (corner - origin)).sum(1, keepdim=True) / incline[:, None]
    point = origin + depth * directions
    normal = normal + torch.bmm(slope.view(-1, 3, 3), (point - corner)[:, :, None])[:, :, 0]
    normal = torch.bmm(rotation, torch.nn.functional.normalize(normal, dim=1)[:, :, None])[:, :, 0]
    return torch.ones_like(depth), normal, depth, (point - mesh.lower) / mesh.extent


def _boundary(
    mesh: RenderMesh,
    seen: Tensor,
    features: tuple[Tensor, Tensor, Tensor, Tensor],
    face: Tensor,
    R: Tensor,
    t: Tensor,
    K: Tensor,
) -> tuple[Tensor, Tensor]:
    """Neighbouring pixels across a jump of depth, (2, m) front and back, and how far the front one's surface
    moves towards the back one, (m,): zero in value, with the gradient of the pose."""
    _, height, width = face.shape
    rank = torch.zeros_like(face).view(-1).index_copy(0, seen, torch.arange(len(seen), device=face.device))
    depth = torch.full_like(face, torch.inf, dtype=R.dtype).view(-1)
    depth = depth.index_copy(0, seen, features[2].detach()[:, 0]).view_as(face)
    index = torch.arange(face.numel(), device=face.device).view_as(face)
    fronts, backs, signs = [], [], []
    for dim in (2, 1):
        size = face.shape[dim]
        here, there = depth.narrow(dim, 0, size - 1), depth.narrow(dim, 1, size - 1)
        step = torch.maximum(here, there) > torch.minimum(here, there) * (1 + DEPTH_STEP)
        first, second = index.narrow(dim, 0, size - 1)[step], index.narrow(dim, 1, size - 1)[step]
        first_is_front = (here < there)[step]
        fronts.append(torch.where(first_is_front, first, second))
        backs.append(torch.where(first_is_front, second, first))
        signs.append(torch.where(first_is_front, 1.0, -1.0).to(R.dtype))
    front, back = torch.cat(fronts), torch.cat(backs)
    owner = torch.div(front, height * width, rounding_mode="floor")
    axis = torch.cat([torch.full_like(chosen, k) for k, chosen in enumerate(fronts)])
    _, normals, depths, nocs = (rows.detach() for rows in features)
    point = nocs[rank[front]] * mesh.extent + mesh.lower
    rotation, camera = R.index_select(0, owner), K[owner]
    inside = _inner_neighbour(front, back, axis, face, depths[rank[front], 0], depths, rank)
    deeper = _depth_of_rim(normals, rank, front, inside, axis, camera, height, width)
    in_camera = torch.bmm(rotation.detach(), point[:, :, None])[:, :, 0] + t.detach()[owner]
    in_camera = in_camera * (1 + deeper)[:, None] - t.detach()[owner]
    point = torch.bmm(rotation.detach().transpose(1, 2), in_camera[:, :, None])
    moved = torch.bmm(rotation, point)[:, :, 0] + t.index_select(0, owner)
    chosen_axis = axis[:, None]
    focal = torch.diagonal(camera, dim1=1, dim2=2).gather(1, chosen_axis)[:, 0]
    along = moved.gather(1, chosen_axis)[:, 0] / moved[:, 2] * focal
    shift = (along - along.detach()) * torch.cat(signs)
    return torch.stack([front, back]), shift


def _inner_neighbour(
    front: Tensor, back: Tensor, axis: Tensor, face: Tensor, depth: Tensor, depths: Tensor, rank: Tensor
) -> Tensor:
    """The next pixel inside, opposite to the one behind, (m,); -1 where it is another surface or no pixel."""
    _, height, width = face.shape
    inside = 2 * front - back
    position = torch.where(axis == 0, front % width, torch.div(front, width, rounding_mode="floor") % height)
    towards = torch.where(axis == 0, inside - front, torch.div(inside - front, width, rounding_mode="trunc"))
    limit = torch.where(axis == 0, width, height)
    valid = (position + towards >= 0) & (position + towards < limit)
    inside = torch.where(valid, inside, front)
    valid &= face.view(-1)[inside] >= 0
    inside = torch.where(valid, inside, front)
    valid &= (depths[rank[inside], 0] - depth).abs() <= DEPTH_STEP * depth
    return torch.where(valid, inside, -1)


def _depth_of_rim(
    normals: Tensor,
    rank: Tensor,
    front: Tensor,
    inside: Tensor,
    axis: Tensor,
    K: Tensor,
    height: int,
    width: int,
) -> Tensor:
    """How much deeper than the front pixel, as a fraction, a smooth rim lies (m,); 0 at a sharp edge. See the
    fast path's kernel of the same name."""

    def cosine_at(pixel: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        x = (pixel % width - K[:, 0, 2]) / K[:, 0, 0]
        y = (torch.div(pixel, width, rounding_mode="floor") % height - K[:, 1, 2]) / K[:, 1, 1]
        ray = torch.stack([x, y, torch.ones_like(x)], dim=1)
        scale = ray.norm(dim=1)
        return -(normals[rank[pixel]] * ray).sum(1) / scale, ray / scale[:, None], scale

    cosine, ray, scale = cosine_at(front)
    inner, _, _ = cosine_at(torch.where(inside >= 0, inside, front))
    smooth = (inside >= 0) & (cosine > 0.02) & (cosine <= 0.7) & (inner > cosine)
    pixels = cosine * cosine / (inner * inner - cosine * cosine)
    smooth &= pixels <= RIM_PX
    chosen = axis[:, None]
    across = normals[rank[front]].gather(1, chosen) + cosine[:, None] * ray.gather(1, chosen)
    across = across[:, 0].abs() / (1 - cosine * cosine).sqrt()
    focal = torch.diagonal(K, dim1=1, dim2=2).gather(1, chosen)[:, 0]
    return torch.where(smooth, 2 * pixels.clamp_max(1) * across / (focal * cosine * scale), 0.0)


def _visible_faces(mesh: RenderMesh, R: Tensor, t: Tensor, K: Tensor, height: int, width: int) -> Tensor:
    """(B, H, W) int64 index of the visible face, -1 where there is none; drawn on the CPU."""
    faces = np.empty((R.shape[0], height, width), np.int32)
    vertices, triangles = mesh.arrays()[:2]
    draw_batch(*project(vertices, *(x.detach().cpu().numpy() for x in (R, t, K))), triangles, faces)
    return torch.from_numpy(faces).to(R.device, torch.int64)
