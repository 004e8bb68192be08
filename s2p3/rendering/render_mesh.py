"""What the differentiable renderer draws, and what it gives."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from s2p3.rendering.cpu_kernels import MeshArrays
from s2p3.rendering.mesh import Mesh


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
        normals_interior: the same values, without the boundaries' gradients: for losses per visible pixel.
        depth: (B, 1, H, W), z, metres.
        nocs: (B, 3, H, W), position in the bounding box, 0 to 1 along each axis.
    """

    mask: Tensor
    normals: Tensor
    normals_interior: Tensor
    depth: Tensor
    nocs: Tensor
