"""The differentiable renderer in plain torch, for any device; `differentiable` says what it computes."""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from s2p3.rendering.boundary_kernels import CREASE_COSINE, RIM_PX
from s2p3.rendering.cpu_kernels import draw_batch
from s2p3.rendering.render_mesh import RenderMesh, RenderOutput

DEPTH_STEP = 0.03
"""Relative difference of depth from which two neighbouring pixels lie on different surfaces (our choice)."""

_GRAZING = 1e-5  # smallest cosine between a ray and a face that is divided by


def render_reference(
    mesh: RenderMesh, R: Tensor, t: Tensor, K: Tensor, height: int, width: int, silhouette: bool = True
) -> RenderOutput:
    """`differentiable.render` in plain torch, for any device: what the CPU's fast path is tested against."""
    dtype = torch.float64 if R.dtype == torch.float64 else torch.float32
    with torch.autocast(device_type=R.device.type, enabled=False):
        R, t, K = R.to(dtype), t.to(dtype), K.to(dtype)
        face = _visible_faces(mesh, R, t, K, height, width)
        seen = torch.nonzero(face.view(-1) >= 0)[:, 0]
        features = _interior(mesh, face.view(-1)[seen], seen, R, t, K, height, width)
        maps = [_scatter(seen, rows, face) for rows in features]
        interior = maps[1]
        if silhouette:
            edges, shift = _silhouettes(seen, features, face, R, t, K)
            maps = [_scatter_moving(seen, rows, edges, shift, face) for rows in features]
            folds, change = _creases(mesh, seen, features, face, R, t, K)
            maps[1] = maps[1] + _scatter(folds.view(-1), torch.cat([change, change]), face)
    mask, normals, depth, nocs = (image.permute(0, 3, 1, 2) for image in maps)
    return RenderOutput(mask, normals, interior.permute(0, 3, 1, 2), depth, nocs)


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


def _neighbours(image: Tensor, axis: int) -> tuple[Tensor, Tensor]:
    """The pixels of (B, H, W) that have a next one along the rows (0) or columns (1), and those next ones."""
    dim, size = 2 - axis, image.shape[2 - axis]
    return image.narrow(dim, 0, size - 1), image.narrow(dim, 1, size - 1)


def _moved(point: Tensor, owner: Tensor, axis: Tensor, R: Tensor, t: Tensor, K: Tensor) -> Tensor:
    """How far points of the object (m, 3), in camera coordinates, move along an image axis (m,), in pixels:
    zero in value, with the gradient of the pose."""
    rotation = R.index_select(0, owner)
    in_object = torch.bmm(rotation.detach().transpose(1, 2), (point - t.detach()[owner])[:, :, None])
    point = torch.bmm(rotation, in_object)[:, :, 0] + t.index_select(0, owner)
    focal = torch.diagonal(K[owner], dim1=1, dim2=2).gather(1, axis[:, None])[:, 0]
    along = point.gather(1, axis[:, None])[:, 0] / point[:, 2] * focal
    return along - along.detach()


def _rays(row: Tensor, column: Tensor, K: Tensor) -> Tensor:
    """(m, 3) rays, z = 1, of pixels (m,) of the cameras (m, 3, 3)."""
    x, y = (column - K[:, 0, 2]) / K[:, 0, 0], (row - K[:, 1, 2]) / K[:, 1, 1]
    return torch.stack([x, y, torch.ones_like(x)], dim=1)


def _silhouettes(
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
    for along in (0, 1):
        here, there = _neighbours(depth, along)
        step = torch.maximum(here, there) > torch.minimum(here, there) * (1 + DEPTH_STEP)
        first, second = (pixels[step] for pixels in _neighbours(index, along))
        first_is_front = (here < there)[step]
        fronts.append(torch.where(first_is_front, first, second))
        backs.append(torch.where(first_is_front, second, first))
        signs.append(torch.where(first_is_front, 1.0, -1.0).to(R.dtype))
    front, back = torch.cat(fronts), torch.cat(backs)
    owner = torch.div(front, height * width, rounding_mode="floor")
    axis = torch.cat([torch.full_like(chosen, k) for k, chosen in enumerate(fronts)])
    normals, depths = features[1].detach(), features[2].detach()
    inside = _inner_neighbour(front, back, axis, face, depths[rank[front], 0], depths, rank)
    deeper = _depth_of_rim(normals, rank, front, inside, axis, K[owner], height, width)
    row, column = (
        0.5 * (torch.div(front, width, rounding_mode="floor") % height)
        + 0.5 * (torch.div(back, width, rounding_mode="floor") % height),
        0.5 * (front % width) + 0.5 * (back % width),
    )
    point = _rays(row, column, K[owner]) * (depths[rank[front], 0] * (1 + deeper))[:, None]
    return torch.stack([front, back]), _moved(point, owner, axis, R, t, K) * torch.cat(signs)


def _creases(
    mesh: RenderMesh,
    seen: Tensor,
    features: tuple[Tensor, Tensor, Tensor, Tensor],
    face: Tensor,
    R: Tensor,
    t: Tensor,
    K: Tensor,
) -> tuple[Tensor, Tensor]:
    """Neighbouring pixels between which the surface folds, (2, m), and half the change of the normals' image
    as the fold moves, (m, 3): zero in value, with the gradient of the pose. See the fast path's kernel."""
    _, height, width = face.shape
    normals = _scatter(seen, features[1].detach(), face)
    depth = _scatter(seen, features[2].detach(), face)[..., 0]
    index = torch.arange(face.numel(), device=face.device).view_as(face)
    pairs = []
    for along in (0, 1):
        here, there = _neighbours(depth, along)
        dim, size = 2 - along, face.shape[2 - along]
        cosine = (normals.narrow(dim, 0, size - 1) * normals.narrow(dim, 1, size - 1)).sum(-1)
        joined = torch.maximum(here, there) <= torch.minimum(here, there) * (1 + DEPTH_STEP)
        chosen = joined & (here > 0) & (there > 0) & (cosine <= CREASE_COSINE)
        pairs.append(torch.stack([pixels[chosen] for pixels in _neighbours(index, along)]))
    pair = torch.cat(pairs, dim=1)
    axis = torch.cat([torch.full_like(some[0], k) for k, some in enumerate(pairs)])
    owner = torch.div(pair[0], height * width, rounding_mode="floor")
    rotation, shift, camera = R.detach()[owner], t.detach()[owner], K[owner]
    row, column = torch.div(pair, width, rounding_mode="floor") % height, pair % width
    rays = [_rays(row[k].to(R.dtype), column[k].to(R.dtype), camera) for k in (0, 1)]
    tables = [mesh.table.index_select(0, face.view(-1)[pixels]).to(R.dtype) for pixels in pair]
    inverse = [_inverse_depth(table, rotation, shift, ray) for table in tables for ray in rays]
    before, after = inverse[0] - inverse[2], inverse[1] - inverse[3]
    crossing = before * after < 0
    at = torch.where(crossing, before / (before - after), 0.5)
    on_second = ~crossing & (before + after < 0)
    start, end = (torch.where(on_second, inverse[2 + k], inverse[k]) for k in (0, 1))
    z = 1 / (start + at * (end - start))
    ends = depth.view(-1)[pair]
    between = (ends.amin(0) <= z * (1 + DEPTH_STEP)) & (z <= ends.amax(0) * (1 + DEPTH_STEP))
    point = (rays[0] + at[:, None] * (rays[1] - rays[0])) * z[:, None]
    in_object = torch.bmm(rotation.transpose(1, 2), (point - shift)[:, :, None])[:, :, 0]
    first, second = (_normal_at(table, in_object) for table in tables)
    jump = torch.bmm(rotation, (first - second)[:, :, None])[:, :, 0]
    keep = torch.nonzero(between)[:, 0]
    moved = _moved(point[keep], owner[keep], axis[keep], R, t, K)
    return pair[:, keep], 0.5 * jump[keep] * moved[:, None]


def _inverse_depth(table: Tensor, rotation: Tensor, shift: Tensor, ray: Tensor) -> Tensor:
    """1 / z (m,) at which rays meet the planes of faces, m of each."""
    plane = torch.bmm(rotation, table[:, 3:6, None])[:, :, 0]
    incline = (plane * ray).sum(1)
    incline = torch.where(incline.abs() < _GRAZING, torch.full_like(incline, -_GRAZING), incline)
    return incline / ((table[:, 3:6] * table[:, :3]).sum(1) + (plane * shift).sum(1))


def _normal_at(table: Tensor, point: Tensor) -> Tensor:
    """Unit normals (m, 3) interpolated, or extrapolated, to points (m, 3); all in the object's frame."""
    offset = torch.bmm(table[:, 9:].view(-1, 3, 3), (point - table[:, :3])[:, :, None])[:, :, 0]
    return torch.nn.functional.normalize(table[:, 6:9] + offset, dim=1)


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
    rotation, shift, camera = (x.detach().cpu().numpy() for x in (R, t, K))
    draw_batch(vertices, rotation, shift, camera, triangles, faces)
    return torch.from_numpy(faces).to(R.device, torch.int64)
