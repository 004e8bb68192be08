"""The ground-truth rasterizer against analytic geometry: a tilted plane and a sphere."""

from __future__ import annotations

import numpy as np
import pytest

from dataset import SE3, Intrinsics
from s2p3 import object_meshes, objects
from s2p3.rendering import Mesh, projected_region, rasterize, rasterize_pixels

CAMERA = Intrinsics(np.array([[300.0, 0, 79.5], [0, 310.0, 63.0], [0, 0, 1]]), np.zeros(0), 128, 160)
TILTED = SE3.from_rotvec([0.5, -0.4, 0.3], [0.01, -0.02, 0.6])


def test_pixel_centres_are_integers() -> None:
    square = np.array([[-1.0, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]])
    mesh = Mesh.from_arrays(square, [[0, 2, 1], [0, 3, 2]])
    pixels = np.array([[2.1, 3.1], [5.9, 3.1], [5.9, 6.9], [2.1, 6.9]])
    raster = rasterize_pixels(mesh, SE3.from_rotvec(np.zeros(3), [0, 0, 5.0]), pixels, (0, 0, 10, 9))
    rows, columns = np.nonzero(raster.mask)
    assert (columns.min(), columns.max(), rows.min(), rows.max()) == (3, 5, 4, 6)


def test_a_tilted_plane_has_exact_depth_normal_and_nocs() -> None:
    size = np.array([0.2, 0.1, 0.001])
    box = Mesh.from_arrays(*object_meshes.box((0.2, 0.1, 0.001)))
    raster = rasterize(box, TILTED, CAMERA)
    normal = TILTED.rotation @ [0, 0, 1]
    side = -np.sign(normal @ TILTED.translation)  # which of the two large faces looks at the camera
    seen = raster.mask & (np.abs(raster.normals @ (side * normal)) > 0.999)
    assert seen.sum() > 2000
    rays = CAMERA.rays()
    top = TILTED.apply([0, 0, side * size[2] / 2])
    distance = (top @ normal) / (rays[seen] @ normal)
    points = rays[seen] * distance[:, None]
    np.testing.assert_allclose(raster.depth[seen], points[:, 2], atol=1e-6)
    np.testing.assert_allclose(raster.normals[seen], np.broadcast_to(side * normal, points.shape), atol=1e-6)
    in_box = TILTED.inverse().apply(points) / size + 0.5
    np.testing.assert_allclose(raster.nocs[seen][:, :2], in_box[:, :2], atol=1e-5)


def test_a_sphere_is_smooth_and_covers_its_projection() -> None:
    mesh = Mesh.from_arrays(*object_meshes.ellipsoid((0.1, 0.1, 0.1)))
    raster = rasterize(mesh, SE3.from_rotvec(np.zeros(3), [0.02, 0.01, 0.5]), CAMERA)
    points = CAMERA.rays() / CAMERA.rays()[..., 2:] * raster.depth[..., None]
    expected = points[raster.mask] - [0.02, 0.01, 0.5]
    expected /= np.linalg.norm(expected, axis=1, keepdims=True)
    angle = np.degrees(np.arccos(np.clip((expected * raster.normals[raster.mask]).sum(axis=1), -1, 1)))
    assert np.median(angle) < 1.0
    half_angle = np.arcsin(0.05 / np.linalg.norm([0.02, 0.01, 0.5]))
    axis = np.array([0.02, 0.01, 0.5]) / np.linalg.norm([0.02, 0.01, 0.5])
    inside = CAMERA.rays() @ axis > np.cos(half_angle)
    assert (inside & raster.mask).sum() / (inside | raster.mask).sum() > 0.97


def test_creases_stay_sharp_and_curved_walls_smooth() -> None:
    box = Mesh.from_arrays(*object_meshes.box((1, 1, 1)))
    assert np.abs(box.corner_normals).max(axis=2).min() == pytest.approx(1.0)
    cup = objects.build("cup")
    on_wall = np.abs(np.hypot(*cup.vertices[:, :2].T) - 0.0453) < 0.02
    normals = cup.mesh.corner_normals[on_wall[cup.faces].all(axis=1)]
    assert np.ptp(normals, axis=1).max() > 0.05  # corners of one face differ: interpolated, not flat


def test_a_region_is_a_window_of_the_whole_image() -> None:
    cup = objects.build("cup")
    region = projected_region(cup.mesh, TILTED, CAMERA)
    whole, part = rasterize(cup.mesh, TILTED, CAMERA), rasterize(cup.mesh, TILTED, CAMERA, region)
    assert part.face.size < whole.face.size
    assert whole.mask.sum() == part.mask.sum()
    np.testing.assert_array_equal(whole.face[part.window], part.face)
    np.testing.assert_allclose(whole.normals[part.window], part.normals, atol=1e-5)


def test_lens_distortion_moves_the_picture_as_the_camera_model_says() -> None:
    distorted = Intrinsics(CAMERA.K, np.array([-0.3, 0.1, 0.002, -0.001]), CAMERA.height, CAMERA.width)
    pose = SE3.from_rotvec([1.2, 0.3, 0.1], [0.1, 0.05, 0.5])
    mesh = objects.build("cup").mesh
    raster = rasterize(mesh, pose, distorted)
    points = pose.apply(raster.nocs[raster.mask] * mesh.extent + mesh.lower)
    rows, columns = np.nonzero(raster.mask)
    error = np.linalg.norm(distorted.project(points) - np.c_[columns, rows], axis=1)
    assert error.max() < 0.05
    assert (raster.mask != rasterize(mesh, pose, CAMERA).mask).sum() > 50


@pytest.mark.parametrize("translation", [[3.0, 0, 0.5], [0, 0, -0.5], [0.25, 0.0, 0.5], [0, 0, 0.03]])
def test_off_screen_clipped_and_behind_the_camera(translation: list[float]) -> None:
    mesh = objects.build("cup").mesh
    pose = SE3.from_rotvec([1.0, 0.2, 0.0], translation)
    raster = rasterize(mesh, pose, CAMERA)
    part = rasterize(mesh, pose, CAMERA, projected_region(mesh, pose, CAMERA))
    assert part.mask.sum() == raster.mask.sum()
    assert np.isfinite(raster.normals).all()
    assert (raster.depth[raster.mask] > 0).all()
    if translation[2] < 0 or translation[0] > 1:
        assert not raster.mask.any()
