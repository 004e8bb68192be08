"""Ground truth by rasterization: which face a pixel sees, and its depth, normal and object coordinate.

A z-buffer on the CPU with pixel centres at integer coordinates and perspective-correct interpolation. The
vertices may have been brought to pixels by any projection, lens distortion included: between the corners of a
face it is taken as that of a pinhole, an error far below a pixel for faces of a few pixels.
"""

from __future__ import annotations

from dataclasses import dataclass

import numba
import numpy as np
from numpy.typing import ArrayLike, NDArray

from dataset import SE3, Intrinsics
from s2p3.rendering.mesh import Mesh

Region = tuple[int, int, int, int]
"""Left, top, width, height of a block of pixels."""

NEAR_M = 1e-3
"""Faces with a corner nearer to the camera plane than this are not drawn (metres)."""


@dataclass(frozen=True, eq=False)
class Raster:
    """What every pixel of a region sees of one mesh.

    Attributes:
        face: (h, w) int32, index of the visible face, -1 where there is none.
        depth: (h, w) float32, z in the camera frame, metres; 0 where nothing is seen.
        normals: (h, w, 3) float32, unit, OpenCV camera frame; 0 where nothing is seen.
        nocs: (h, w, 3) float32, position in the mesh's bounding box, 0 to 1 along each axis.
        region: the block of the image these arrays cover.
    """

    face: NDArray[np.int32]
    depth: NDArray[np.float32]
    normals: NDArray[np.float32]
    nocs: NDArray[np.float32]
    region: Region

    @property
    def mask(self) -> NDArray[np.bool_]:
        """(h, w), true where the mesh is seen."""
        return self.face >= 0

    @property
    def window(self) -> tuple[slice, slice]:
        """Index of the region in an image of the full size: `image[raster.window]`."""
        x, y, width, height = self.region
        return slice(y, y + height), slice(x, x + width)


def projected_region(mesh: Mesh, T_cam_obj: SE3, intrinsics: Intrinsics, margin_px: int = 2) -> Region:
    """The smallest block of whole pixels, inside the image, that holds the projected mesh plus a margin.

    A mesh that is off screen gives a block of zero width or height; one that reaches behind the camera gives
    the whole image.
    """
    points = T_cam_obj.apply(mesh.vertices)
    if (points[:, 2] <= NEAR_M).any():
        inside = (points[:, 2] > NEAR_M).any()
        return (0, 0, intrinsics.width, intrinsics.height) if inside else (0, 0, 0, 0)
    pixels = intrinsics.project(points)
    size = np.array([intrinsics.width, intrinsics.height])
    low = np.clip(np.floor(pixels.min(axis=0)) - margin_px, 0, size).astype(int)
    high = np.clip(np.ceil(pixels.max(axis=0)) + margin_px + 1, 0, size).astype(int)
    width, height = np.maximum(high - low, 0)
    return int(low[0]), int(low[1]), int(width), int(height)


def rasterize(mesh: Mesh, T_cam_obj: SE3, intrinsics: Intrinsics, region: Region | None = None) -> Raster:
    """Draw a mesh as the camera sees it, lens distortion included.

    Args:
        T_cam_obj: one pose.
        region: the block of the image to draw; the whole image when None.
    """
    points = T_cam_obj.apply(mesh.vertices)
    block = region if region is not None else (0, 0, intrinsics.width, intrinsics.height)
    return rasterize_pixels(mesh, T_cam_obj, intrinsics.project(points), block)


def rasterize_pixels(mesh: Mesh, T_cam_obj: SE3, pixels: ArrayLike, region: Region) -> Raster:
    """Draw a mesh whose vertices have already been projected.

    Args:
        T_cam_obj: one pose; gives depth and turns the normals into the camera frame.
        pixels: (V, 2) image positions of the vertices; not read where the depth is below `NEAR_M`.
        region: the block of the image to draw.
    """
    x, y, width, height = region
    depth_of_vertex = T_cam_obj.apply(mesh.vertices)[:, 2]
    shifted = np.asarray(pixels, dtype=np.float64) - [x, y]
    face = np.full((height, width), -1, np.int32)
    depth = np.zeros((height, width), np.float32)
    normals = np.zeros((height, width, 3), np.float32)
    nocs = np.zeros((height, width, 3), np.float32)
    draw_faces(shifted, depth_of_vertex, mesh.faces, face, depth)
    _interpolate(
        shifted,
        depth_of_vertex,
        mesh.faces,
        mesh.corner_normals,
        (mesh.vertices - mesh.lower) / mesh.extent,
        T_cam_obj.rotation.astype(np.float32),
        face,
        depth,
        normals,
        nocs,
    )
    return Raster(face, depth, normals, nocs, region)


@numba.njit(cache=True, error_model="numpy")
def draw_faces(
    pixels: NDArray[np.float64],
    depths: NDArray[np.float64],
    faces: NDArray[np.int32],
    face_id: NDArray[np.int32],
    inverse_depth: NDArray[np.float32],
) -> None:
    """Fill a z-buffer in place: face_id (h, w), -1 where empty, and 1 / z (h, w), 0 where empty.

    Args:
        pixels: (V, 2) positions, depths (V,) z of the vertices, faces (F, 3).
    """
    height, width = face_id.shape
    for face in range(faces.shape[0]):
        a, b, c = faces[face]
        if depths[a] <= NEAR_M or depths[b] <= NEAR_M or depths[c] <= NEAR_M:
            continue
        x0, y0 = pixels[a]
        x1, y1 = pixels[b]
        x2, y2 = pixels[c]
        left = max(0, int(np.ceil(max(min(x0, x1, x2), -1.0))))
        right = min(width - 1, int(np.floor(min(max(x0, x1, x2), width + 1.0))))
        top = max(0, int(np.ceil(max(min(y0, y1, y2), -1.0))))
        bottom = min(height - 1, int(np.floor(min(max(y0, y1, y2), height + 1.0))))
        area = (x1 - x0) * (y2 - y0) - (x2 - x0) * (y1 - y0)
        if left > right or top > bottom or abs(area) < 1e-12:
            continue
        r0, r1, r2 = 1.0 / depths[a], 1.0 / depths[b], 1.0 / depths[c]
        step0, step1 = (y1 - y2) / area, (y2 - y0) / area
        for i in range(top, bottom + 1):
            w0 = ((x1 - left) * (y2 - i) - (x2 - left) * (y1 - i)) / area
            w1 = ((x2 - left) * (y0 - i) - (x0 - left) * (y2 - i)) / area
            for j in range(left, right + 1):
                w2 = 1.0 - w0 - w1
                if w0 >= -1e-9 and w1 >= -1e-9 and w2 >= -1e-9:
                    nearness = np.float32(w0 * r0 + w1 * r1 + w2 * r2)
                    if nearness > inverse_depth[i, j]:
                        inverse_depth[i, j] = nearness
                        face_id[i, j] = face
                w0 += step0
                w1 += step1


@numba.njit(cache=True, error_model="numpy")
def _interpolate(
    pixels: NDArray[np.float64],
    depths: NDArray[np.float64],
    faces: NDArray[np.int32],
    corner_normals: NDArray[np.float32],
    coordinates: NDArray[np.float32],
    rotation: NDArray[np.float32],
    face_id: NDArray[np.int32],
    depth: NDArray[np.float32],
    normals: NDArray[np.float32],
    nocs: NDArray[np.float32],
) -> None:
    """Perspective-correct attributes of the visible faces, in place; `depth` arrives as 1 / z, leaves z."""
    height, width = face_id.shape
    for i in range(height):
        for j in range(width):
            face = face_id[i, j]
            if face < 0:
                continue
            a, b, c = faces[face]
            x0, y0 = pixels[a, 0] - j, pixels[a, 1] - i
            x1, y1 = pixels[b, 0] - j, pixels[b, 1] - i
            x2, y2 = pixels[c, 0] - j, pixels[c, 1] - i
            w0 = (x1 * y2 - x2 * y1) / depths[a]
            w1 = (x2 * y0 - x0 * y2) / depths[b]
            w2 = (x0 * y1 - x1 * y0) / depths[c]
            total = w0 + w1 + w2
            w0, w1, w2 = w0 / total, w1 / total, w2 / total
            depth[i, j] = w0 * depths[a] + w1 * depths[b] + w2 * depths[c]
            nx = (
                w0 * corner_normals[face, 0, 0]
                + w1 * corner_normals[face, 1, 0]
                + w2 * corner_normals[face, 2, 0]
            )
            ny = (
                w0 * corner_normals[face, 0, 1]
                + w1 * corner_normals[face, 1, 1]
                + w2 * corner_normals[face, 2, 1]
            )
            nz = (
                w0 * corner_normals[face, 0, 2]
                + w1 * corner_normals[face, 1, 2]
                + w2 * corner_normals[face, 2, 2]
            )
            length = np.sqrt(nx * nx + ny * ny + nz * nz)
            for axis in range(3):
                turned = rotation[axis, 0] * nx + rotation[axis, 1] * ny + rotation[axis, 2] * nz
                normals[i, j, axis] = turned / length
                nocs[i, j, axis] = (
                    w0 * coordinates[a, axis] + w1 * coordinates[b, axis] + w2 * coordinates[c, axis]
                )
