"""Fitting a mesh to points on it: point-to-plane ICP (Chen and Medioni 1992) from many starts at once on
points sampled from the surface, then Levenberg-Marquardt on the exact surface.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import trimesh
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from dataset.transforms import SE3

Floats = NDArray[np.float64]

SEED = 0  # of all draws: the same touches give the same pose again

_SAMPLES = 20_000
_FINE_STEPS = 40
_FINE_STARTS = 8


@dataclass(frozen=True, eq=False)
class Surface:
    """Where the centre of a ball can be that touches a mesh.

    Attributes:
        mesh: in the object's frame.
        ball_m: radius of the ball; 0 for a pointed tip.
        tree, points, normals: points sampled there, for fast nearest-point queries.
        centre: of the mesh's box.
        radius: mean distance of the points from it.
    """

    mesh: trimesh.Trimesh
    ball_m: float
    tree: cKDTree
    points: Floats
    normals: Floats
    centre: Floats
    radius: float

    @staticmethod
    def of(mesh: trimesh.Trimesh, ball_m: float) -> Surface:
        """Samples it."""
        points, face = trimesh.sample.sample_surface(mesh, _SAMPLES, seed=SEED)
        points = np.asarray(points) + ball_m * mesh.face_normals[face]
        centre = mesh.bounds.mean(axis=0)
        radius = float(np.linalg.norm(points - centre, axis=1).mean())
        return Surface(mesh, ball_m, cKDTree(points), points, mesh.face_normals[face], centre, radius)

    def rms(self, points_obj: Floats) -> Floats:
        """RMS point-to-plane distance of points (..., n, 3) given in the object's frame: (...)."""
        _, nearest = self.tree.query(points_obj)
        plane = np.sum((points_obj - self.points[nearest]) * self.normals[nearest], axis=-1)
        return np.sqrt(np.mean(plane**2, axis=-1))

    def signed(self, points_obj: Floats) -> tuple[Floats, Floats]:
        """Exact signed distances (n,), positive outside, and the directions (n, 3) in which they grow."""
        closest, distance, face = trimesh.proximity.closest_point(self.mesh, points_obj)
        normals = self.mesh.face_normals[face]
        side = np.where(np.sum((points_obj - closest) * normals, axis=1) < 0, -1.0, 1.0)
        # Towards the closest point rather than along the facet's normal: at an edge or a rim the two differ.
        toward = side[:, None] * (points_obj - closest) / np.maximum(distance, 1e-12)[:, None]
        normals = np.where(distance[:, None] > 1e-9, toward, normals)
        return side * distance - self.ball_m, normals


def coarse_fit(points: Floats, surface: Surface, poses: SE3, steps: int) -> tuple[SE3, Floats]:
    """Point-to-plane ICP from every start at once, against the sampled surface; poses and their residuals."""
    for _ in range(steps):
        in_obj = poses.inverse()[:, None].apply(points)
        _, nearest = surface.tree.query(in_obj)
        normals = surface.normals[nearest]
        residual = np.sum((in_obj - surface.points[nearest]) * normals, axis=-1)
        J = jacobian(in_obj, normals, surface.radius)
        JtJ = np.swapaxes(J, 1, 2) @ J + 1e-3 * points.shape[0] * np.eye(6)
        step = -np.linalg.solve(JtJ, np.swapaxes(J, 1, 2) @ residual[..., None])[..., 0]
        poses = poses @ SE3.exp(limited(step, surface.radius))
    return poses, surface.rms(poses.inverse()[:, None].apply(points))


def finest_fit(points: Floats, surface: Surface, pose: SE3) -> tuple[SE3, Floats, Floats]:
    """The best of several refinements: walls and rims that swap as closest make shallow false minima nearby.

    Returns:
        The pose, the points' signed distances (n,), and the directions (n, 3) in which those grow.
    """
    nudges = np.random.default_rng(SEED).normal(size=(_FINE_STARTS, 6)) * np.array([0.02] * 6)
    nudges[0] = 0.0
    nudges[:, :3] *= surface.radius
    found = [_fine(points, surface, pose @ SE3.exp(nudge)) for nudge in nudges]
    return min(found, key=lambda fit: float(np.sum(fit[1] ** 2)))


def _fine(points: Floats, surface: Surface, pose: SE3) -> tuple[SE3, Floats, Floats]:
    radius = surface.radius

    def evaluate(candidate: SE3) -> tuple[Floats, Floats, Floats]:
        in_obj = candidate.inverse().apply(points)
        distance, normals = surface.signed(in_obj)
        return distance, jacobian(in_obj, normals, radius), normals

    residual, J, normals = evaluate(pose)
    damping = 1e-3
    for _ in range(_FINE_STEPS):
        JtJ = J.T @ J
        step = -np.linalg.solve(JtJ + damping * np.trace(JtJ) / 6 * np.eye(6), J.T @ residual)
        trial = pose @ SE3.exp(limited(step, radius))
        trial_residual, trial_J, trial_normals = evaluate(trial)
        gain = np.sum(residual**2) - np.sum(trial_residual**2)
        if gain > 0:
            pose, residual, J, normals = trial, trial_residual, trial_J, trial_normals
            damping = max(damping * 0.2, 1e-9)
            if gain < 1e-9 * np.sum(residual**2) + 1e-18:
                break
        else:
            damping *= 5.0
            if damping > 1e4:
                break
    return pose, residual, normals


def jacobian(in_obj: Floats, normals: Floats, radius: float) -> Floats:
    """Distance by the twist d in T_base_obj @ exp(d), rotations in units of ``radius``: (..., n, 6).

    The object moving by d moves the points by -(rho + phi x p) in its frame.
    """
    return -np.concatenate([normals, np.cross(in_obj, normals) / radius], axis=-1)


def limited(step: Floats, radius: float) -> Floats:
    """A twist in SI units from one with scaled rotations, no longer than a third of the object."""
    length = np.linalg.norm(step, axis=-1, keepdims=True)
    step = step * np.minimum(1.0, 0.33 * radius / np.maximum(length, 1e-12))
    return step / np.array([1.0, 1.0, 1.0, radius, radius, radius])
