"""Things drawn in a page's 3-D view: the arm, a camera with its picture, the sphere of views."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import trimesh
from numpy.typing import ArrayLike, NDArray

from acquisition.kinematics import DH_A, DH_D, link_transforms
from dataset.pictures import Picture, in_colour
from dataset.transforms import SE3
from dataset.view_sphere import ViewSphere

if TYPE_CHECKING:
    import viser

Segment = tuple[tuple[float, float, float], tuple[float, float, float], float]

_METAL, _JOINT = (205, 208, 214), (96, 150, 205)
_UPPER_ARM_SIDE, _FOREARM_SIDE = 0.138, 0.007  # m, of the tubes beside the Denavit-Hartenberg skeleton
_TUBES: tuple[tuple[Segment, ...], ...] = (
    (((0, 0, 0), (0, 0, 0.09), 0.075),),
    (((0, -0.075, 0), (0, 0.06, 0), 0.06),),
    (((0, 0, _UPPER_ARM_SIDE), (-DH_A[1], 0, _UPPER_ARM_SIDE), 0.052),),
    (((0, 0, _FOREARM_SIDE), (-DH_A[2], 0, _FOREARM_SIDE), 0.042),),
    (((0, -DH_D[3] + 0.02, 0), (0, 0.045, 0), 0.04),),
    (((0, -0.045, 0), (0, DH_D[4] - 0.02, 0), 0.04),),
    (((0, 0, -0.06), (0, 0, 0), 0.034),),
)
_CAPS: tuple[tuple[Segment, ...], ...] = (
    (),
    (((0, 0, -0.065), (0, 0, 0.08), 0.062),),
    (
        ((-DH_A[1], 0, 0.075), (-DH_A[1], 0, 0.21), 0.06),
        ((0, 0, 0.05), (0, 0, 0.195), 0.054),
    ),
    (
        ((-DH_A[2], 0, -0.045), (-DH_A[2], 0, 0.06), 0.05),
        ((0, 0, -0.05), (0, 0, 0.055), 0.043),
    ),
    (((0, 0, -0.05), (0, 0, 0.05), 0.042),),
    (((0, 0, -0.05), (0, 0, 0.05), 0.042),),
    (((0, 0, -0.012), (0, 0, 0.0), 0.04),),
)
"""A UR5e's tubes and joints in the frames of its links, base first: start, end and radius, metres. Lengths
are the published Denavit-Hartenberg ones, thicknesses roughly those of the real arm."""

_UNSEEN, _SEEN = np.array([120, 125, 135]), np.array([[20, 60, 190], [0, 150, 110], [255, 210, 0]])
_ENOUGH = 30
"""Looks from a cell of the view sphere with which it is drawn in full colour (our choice)."""
_LEAST_WIDTH_PX = 400
_SEEN_RAD = 1e-4  # a change of a joint that nobody sees
_TILE = 0.86  # of a cell, so that neighbours can be told apart


class ArmModel:
    """A UR5e as tubes, at joint angles that can be changed.

    Args:
        server: whose scene; the base frame is `parent`, "" for the scene's own.
    """

    def __init__(self, server: viser.ViserServer, parent: str = "") -> None:
        self._q = np.full(6, np.inf)
        self._links = [
            server.scene.add_frame(f"{parent}/arm/link{link}", show_axes=False) for link in range(7)
        ]
        for link, (tubes, caps) in enumerate(zip(_TUBES, _CAPS, strict=True)):
            for name, segments, colour in (("tubes", tubes, _METAL), ("joints", caps, _JOINT)):
                if segments:
                    mesh = _joined([_tube(*segment) for segment in segments])
                    server.scene.add_mesh_simple(
                        f"{parent}/arm/link{link}/{name}", mesh.vertices, mesh.faces, color=colour
                    )

    def move(self, q: NDArray[np.float64]) -> None:
        """To joint angles (6,), radians."""
        if np.abs(q - self._q).max() < _SEEN_RAD:
            return
        self._q = q
        for frame, matrix in zip(self._links, link_transforms(q), strict=True):
            place(frame, SE3.from_matrix(matrix))

    def show(self, visible: bool) -> None:
        """Or hides it."""
        for frame in self._links:
            if frame.visible != visible:
                frame.visible = visible


class ViewTiles:
    """The cells of a view sphere about a point, coloured by how often each was looked from.

    Args:
        server: whose scene.
        views: the sphere.
        centre: (3,) metres.
        radius: metres.
    """

    def __init__(
        self, server: viser.ViserServer, views: ViewSphere, centre: ArrayLike, radius: float
    ) -> None:
        outwards = views.directions
        across = np.cross([0.0, 0.0, 1.0], outwards)
        across /= np.maximum(np.linalg.norm(across, axis=1, keepdims=True), 1e-9)
        rotation = np.stack([across, np.cross(outwards, across), outwards], axis=-1)
        sides = _TILE * radius * views.sizes
        self._counts = np.zeros(len(views), np.int64)
        self._tiles = server.scene.add_batched_meshes_simple(
            "/views",
            np.array([[-0.5, -0.5, 0], [0.5, -0.5, 0], [0.5, 0.5, 0], [-0.5, 0.5, 0]]),
            np.array([[0, 1, 2], [0, 2, 3]]),
            batched_wxyzs=quaternions(rotation),
            batched_positions=np.asarray(centre) + radius * outwards,
            batched_scales=np.concatenate([sides, np.ones((len(sides), 1))], axis=1),
            batched_colors=np.tile(_UNSEEN, (len(sides), 1)).astype(np.uint8),
            batched_opacities=np.full(len(sides), 0.15),
            side="double",
            cast_shadow=False,
            receive_shadow=False,
            lod="off",
        )

    def paint(self, counts: NDArray[np.int64]) -> None:
        """By looks (C,) from each cell."""
        if np.array_equal(counts, self._counts):
            return
        self._counts = counts.copy()
        self._tiles.batched_colors = cell_colours(counts)
        self._tiles.batched_opacities = np.where(counts > 0, 0.75, 0.15).astype(np.float32)


def cell_colours(counts: NDArray[np.int64]) -> NDArray[np.uint8]:
    """(C, 3) RGB of cells with so many looks (C,): grey none, then blue over green to yellow."""
    share = np.log1p(counts) / np.log1p(_ENOUGH)
    ramp = [np.interp(share, [0, 0.6, 1], _SEEN[:, channel]) for channel in range(3)]
    return np.where(counts[:, None] > 0, np.stack(ramp, axis=1), _UNSEEN).astype(np.uint8)


def add_camera(
    server: viser.ViserServer, name: str, K: NDArray[np.float64], height: int, width: int, scale: float
) -> viser.CameraFrustumHandle:
    """A camera's frustum; assign its `image` and `place` it."""
    return server.scene.add_camera_frustum(
        name,
        fov=float(2 * np.arctan2(height / 2, K[1, 1])),
        aspect=width / height,
        scale=scale,
        color=(240, 170, 40),
        thickness=0.03 * scale,
        jpeg_quality=70,
        cast_shadow=False,
    )


def add_table(server: viser.ViserServer) -> None:
    """A grid at z = 0 of the scene's frame, 10 cm a square."""
    server.scene.add_grid(
        "/table",
        width=2.4,
        height=2.4,
        plane="xy",
        cell_size=0.1,
        section_size=0.5,
        cell_color=(70, 74, 82),
        section_color=(100, 105, 115),
        shadow_opacity=0.3,
    )


def light(server: viser.ViserServer) -> None:
    """Plain light: shadows would keep a computer without a graphics card busy."""
    server.scene.configure_default_lights(cast_shadow=False)


def place(node: viser.SceneNodeHandle, pose: SE3) -> None:
    """Puts a node of the scene at a pose in its parent's frame."""
    if not np.array_equal(node.position, pose.translation):
        node.position = pose.translation
    wxyz = quaternions(pose.rotation)
    if not np.array_equal(node.wxyz, wxyz):
        node.wxyz = wxyz


def quaternions(rotation: NDArray[np.float64]) -> NDArray[np.float64]:
    """(..., 4) w x y z, viser's order, of rotation matrices (..., 3, 3)."""
    return np.roll(SE3(rotation, np.zeros(rotation.shape[:-1])).as_quaternion(), 1, axis=-1)


def rgb(picture: Picture) -> Picture:
    """(h', w', 3) RGB, which pages show, of a grey or BGR picture; a tiny one enlarged to be seen."""
    coloured = in_colour(picture)[..., ::-1]
    factor = -(-_LEAST_WIDTH_PX // coloured.shape[1])
    return np.ascontiguousarray(coloured.repeat(factor, axis=0).repeat(factor, axis=1))


def _joined(parts: list[trimesh.Trimesh]) -> trimesh.Trimesh:
    joined = trimesh.util.concatenate(parts)
    assert isinstance(joined, trimesh.Trimesh)
    return joined


def _tube(
    start: tuple[float, float, float], end: tuple[float, float, float], radius: float
) -> trimesh.Trimesh:
    return trimesh.creation.cylinder(radius, segment=[start, end], sections=28)
