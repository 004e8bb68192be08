"""Where an object stands in the arm's base frame, from points its surface was touched at."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import trimesh
from numpy.typing import ArrayLike, NDArray
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from dataset.errors import CalibrationError
from dataset.transforms import SE3

Floats = NDArray[np.float64]

MIN_POINTS = 6
_SAMPLES = 20_000
_STARTS = 240
_COARSE_STEPS = 12
_PROMISING = 80
_FINE_STEPS = 40
_FINE_STARTS = 8
_TURN_STEPS = 12
_SAME_FIT = 2.0
_TURN_SLIP_RAD = np.radians(4.0)
_NOISE_FLOOR_M = 1e-4  # touching is no better than this (our choice); keeps a perfect fit's covariance honest
_UNOBSERVABLE_RAD = np.radians(3.0)
_UNOBSERVABLE_M = 5e-3
_BAD_FIT_M = 5e-3


@dataclass(frozen=True, eq=False)
class ObjectPoseResult:
    """What n touched points say.

    Attributes:
        T_base_obj: the pose.
        covariance: (6, 6) of the twist [rho, phi] d (m, rad) in T_base_obj @ exp(d). Along a direction the
            points do not determine, the variance is that of "anything goes" (a turn, or the object's size).
        rms_m: root mean square distance of the points to the surface.
        distance_m: (n,) signed distances, positive outside.
        unobservable: what the points leave open, in words; empty when the pose is determined.
        ambiguity_deg: angles by which the object can be turned about the weakest axis without contradicting
            the points (a discrete or continuous symmetry); empty when there are none.
        runner_up_rms_m: the best fit of a clearly different pose; close to rms_m means the points do not
            tell them apart.
    """

    T_base_obj: SE3
    covariance: Floats
    rms_m: float
    distance_m: Floats
    unobservable: tuple[str, ...]
    ambiguity_deg: Floats
    runner_up_rms_m: float


def register_points(
    points_base: ArrayLike,
    vertices: ArrayLike,
    faces: ArrayLike,
    init: SE3 | None = None,
    symmetry_axis: ArrayLike | None = None,
    seed: int = 0,
) -> ObjectPoseResult:
    """Fit a mesh to touched points: many starts, point-to-plane ICP (Chen and Medioni 1992), the best
    refined on the exact surface.

    Args:
        points_base: (n, 3) touched points in the base frame, metres.
        vertices, faces: (V, 3) metres, (F, 3): the object in its own frame.
        init: a rough pose; without one every orientation is tried.
        symmetry_axis: (3,) direction about which the object may be turned freely, if it has one: the turn
            about it is then not reported as a defect of the points.
        seed: of the starts.

    Raises:
        CalibrationError: fewer than 6 points, NaN, points that coincide, or points that do not lie on such
            an object.
    """
    points = _checked(points_base)
    mesh = trimesh.Trimesh(np.asarray(vertices, np.float64), np.asarray(faces), process=False)
    _require_size(points, mesh)
    surface = _Surface.of(mesh, seed)
    coarse, coarse_rms = _coarse(points, surface, _starts(points, surface, init, seed), _COARSE_STEPS)
    promising = np.argsort(coarse_rms)[:_PROMISING]
    coarse, coarse_rms = _coarse(points, surface, coarse[promising], 2 * _COARSE_STEPS)
    best = coarse[int(np.argmin(coarse_rms))]
    limit = max(_BAD_FIT_M, 0.03 * float(np.linalg.norm(mesh.extents)))
    _require_fit(float(coarse_rms.min()), 3 * limit, mesh)
    pose, signed, J = _finest(points, mesh, best, surface.radius, seed)
    rms = float(np.sqrt(np.mean(signed**2)))
    _require_fit(rms, limit, mesh)
    noise = max(float(np.sqrt(np.sum(signed**2) / max(len(points) - 6, 1))), _NOISE_FLOOR_M)
    covariance, weak = _covariance(J, noise, surface.radius)
    ambiguity, weak = _turns_that_fit(points, mesh, surface, pose, weak, noise)
    known_axis = None if symmetry_axis is None else np.asarray(symmetry_axis, np.float64)
    covariance, unobservable = _describe(covariance, weak, ambiguity, known_axis, surface.radius)
    return ObjectPoseResult(
        T_base_obj=pose,
        covariance=covariance,
        rms_m=rms,
        distance_m=signed,
        unobservable=unobservable,
        ambiguity_deg=ambiguity,
        runner_up_rms_m=_runner_up(coarse, coarse_rms, pose, surface.radius),
    )


@dataclass(frozen=True, eq=False)
class _Surface:
    """Points on the mesh with normals, for fast nearest-point queries."""

    tree: cKDTree
    points: Floats
    normals: Floats
    centre: Floats
    radius: float

    @staticmethod
    def of(mesh: trimesh.Trimesh, seed: int) -> _Surface:
        points, face = trimesh.sample.sample_surface(mesh, _SAMPLES, seed=seed)
        points = np.asarray(points)
        centre = mesh.bounds.mean(axis=0)
        radius = float(np.linalg.norm(points - centre, axis=1).mean())
        return _Surface(cKDTree(points), points, mesh.face_normals[face], centre, radius)

    def rms(self, points_obj: Floats) -> Floats:
        """RMS point-to-plane distance of points (..., n, 3) given in the object's frame: (...)."""
        _, nearest = self.tree.query(points_obj)
        plane = np.sum((points_obj - self.points[nearest]) * self.normals[nearest], axis=-1)
        return np.sqrt(np.mean(plane**2, axis=-1))


def _checked(points_base: ArrayLike) -> Floats:
    points = np.asarray(points_base, np.float64)
    if points.ndim != 2 or points.shape[1] != 3:
        raise CalibrationError(
            f"object pose: points of shape {points.shape}; give (n, 3) metres in the base frame"
        )
    if not np.isfinite(points).all():
        bad = np.flatnonzero(~np.isfinite(points).all(axis=1))
        raise CalibrationError(
            f"object pose: point {int(bad[0])} is NaN or infinite; drop it or touch it again"
        )
    if len(points) < MIN_POINTS:
        raise CalibrationError(
            f"object pose: {len(points)} points; at least {MIN_POINTS} are needed, 20-30 spread over the"
            " object are good"
        )
    spread = np.linalg.svd(points - points.mean(axis=0), compute_uv=False) / np.sqrt(len(points))
    if spread[1] < 1e-3:
        raise CalibrationError(
            "object pose: the points lie in one spot or on one line; touch the object on different sides"
        )
    return points


def _require_size(points: Floats, mesh: trimesh.Trimesh) -> None:
    span = float(np.linalg.norm(points - points.mean(axis=0), axis=1).max())
    across = float(np.linalg.norm(mesh.extents))
    if span > across + _BAD_FIT_M:
        raise CalibrationError(
            f"object pose: a point lies {1000 * span:.0f} mm from the points' mean, the mesh is only"
            f" {1000 * across:.0f} mm across; check the mesh's units (metres) and the points for strays"
        )


def _require_fit(rms: float, limit: float, mesh: trimesh.Trimesh) -> None:
    if rms > limit:
        raise CalibrationError(
            f"object pose: the best fit leaves the points {1000 * rms:.1f} mm from the surface; check the"
            " mesh's"
            f" units (it is {1000 * np.linalg.norm(mesh.extents):.0f} mm across), the tool tip's offset,"
            " and that"
            " the right object was touched"
        )


def _starts(points: Floats, surface: _Surface, init: SE3 | None, seed: int) -> SE3:
    """Poses T_base_obj to start from: around ``init``, or all orientations with the centres brought
    together."""
    if init is not None:
        twists = np.random.default_rng(seed).normal(size=(_STARTS // 4, 6))
        twists[0] = 0.0
        return init @ SE3.exp(twists * np.array([0.2 * surface.radius] * 3 + [0.25] * 3))
    rotation = Rotation.random(_STARTS, rng=np.random.default_rng(seed)).as_matrix()
    # The touched side is not the whole object, so the mean of the points is not its centre: their box's is
    # closer.
    centre = 0.5 * (points.min(axis=0) + points.max(axis=0))
    return SE3(rotation, centre - rotation @ surface.centre)


def _coarse(points: Floats, surface: _Surface, poses: SE3, steps: int) -> tuple[SE3, Floats]:
    """Point-to-plane ICP from every start at once, against the sampled surface; poses and their residuals."""
    for _ in range(steps):
        in_obj = poses.inverse()[:, None].apply(points)
        _, nearest = surface.tree.query(in_obj)
        normals = surface.normals[nearest]
        residual = np.sum((in_obj - surface.points[nearest]) * normals, axis=-1)
        J = _jacobian(in_obj, normals, surface.radius)
        JtJ = np.swapaxes(J, 1, 2) @ J + 1e-3 * points.shape[0] * np.eye(6)
        step = -np.linalg.solve(JtJ, np.swapaxes(J, 1, 2) @ residual[..., None])[..., 0]
        poses = poses @ SE3.exp(_limited(step, surface.radius))
    return poses, surface.rms(poses.inverse()[:, None].apply(points))


def _finest(
    points: Floats, mesh: trimesh.Trimesh, pose: SE3, radius: float, seed: int
) -> tuple[SE3, Floats, Floats]:
    """The best of several refinements: walls and rims that swap as closest make shallow false minima
    nearby."""
    nudges = np.random.default_rng(seed).normal(size=(_FINE_STARTS, 6)) * np.array([0.02] * 6)
    nudges[0] = 0.0
    nudges[:, :3] *= radius
    found = [_fine(points, mesh, pose @ SE3.exp(nudge), radius) for nudge in nudges]
    return min(found, key=lambda fit: float(np.sum(fit[1] ** 2)))


def _fine(points: Floats, mesh: trimesh.Trimesh, pose: SE3, radius: float) -> tuple[SE3, Floats, Floats]:
    """The same on the exact surface, Levenberg-Marquardt; returns the pose, signed distances, Jacobian."""

    def evaluate(candidate: SE3) -> tuple[Floats, Floats]:
        in_obj = candidate.inverse().apply(points)
        closest, distance, face = trimesh.proximity.closest_point(mesh, in_obj)
        normals = mesh.face_normals[face]
        side = np.where(np.sum((in_obj - closest) * normals, axis=1) < 0, -1.0, 1.0)
        # Towards the closest point rather than along the facet's normal: at an edge or a rim the two differ.
        toward = side[:, None] * (in_obj - closest) / np.maximum(distance, 1e-12)[:, None]
        normals = np.where(distance[:, None] > 1e-9, toward, normals)
        return side * distance, _jacobian(in_obj, normals, radius)

    residual, J = evaluate(pose)
    damping = 1e-3
    for _ in range(_FINE_STEPS):
        JtJ = J.T @ J
        step = -np.linalg.solve(JtJ + damping * np.trace(JtJ) / 6 * np.eye(6), J.T @ residual)
        trial = pose @ SE3.exp(_limited(step, radius))
        trial_residual, trial_J = evaluate(trial)
        gain = np.sum(residual**2) - np.sum(trial_residual**2)
        if gain > 0:
            pose, residual, J, damping = trial, trial_residual, trial_J, max(damping * 0.2, 1e-9)
            if gain < 1e-9 * np.sum(residual**2) + 1e-18:
                break
        else:
            damping *= 5.0
            if damping > 1e4:
                break
    return pose, residual, J


def _jacobian(in_obj: Floats, normals: Floats, radius: float) -> Floats:
    """Distance by the twist d in T_base_obj @ exp(d), rotations in units of ``radius``: (..., n, 6).

    The object moving by d moves the points by -(rho + phi x p) in its frame.
    """
    return -np.concatenate([normals, np.cross(in_obj, normals) / radius], axis=-1)


def _limited(step: Floats, radius: float) -> Floats:
    """A twist in SI units from one with scaled rotations, no longer than a third of the object."""
    length = np.linalg.norm(step, axis=-1, keepdims=True)
    step = step * np.minimum(1.0, 0.33 * radius / np.maximum(length, 1e-12))
    return step / np.array([1.0, 1.0, 1.0, radius, radius, radius])


def _covariance(J: Floats, noise: float, radius: float) -> tuple[Floats, Floats]:
    """Covariance in SI units, and the twist the points constrain least."""
    values, vectors = np.linalg.eigh(J.T @ J)
    to_si = np.diag([1.0, 1.0, 1.0, 1 / radius, 1 / radius, 1 / radius])
    # Nothing is less certain than "anywhere on the object".
    variance = np.minimum(noise**2 / np.maximum(values, 1e-12), radius**2)
    vectors = to_si @ vectors
    return (vectors * variance) @ vectors.T, vectors[:, 0]


def _turns_that_fit(
    points: Floats, mesh: trimesh.Trimesh, surface: _Surface, pose: SE3, weak: Floats, noise: float
) -> tuple[Floats, Floats]:
    """Angles (deg) about the weakest twist's screw axis at which the points still lie on the surface, and
    that axis as a twist of 1 rad."""
    angle = np.linalg.norm(weak[3:])
    if angle * surface.radius < 0.3 * np.linalg.norm(weak[:3] + np.cross(weak[3:], surface.centre)):
        return np.zeros(0), weak  # the weakest motion is a shift: turning is not what is in doubt
    turn = _pure_turn(weak / angle)
    degrees = np.arange(5.0, 360.0, 5.0)
    fits = np.zeros(len(degrees), bool)
    # The eigenvector gives the axis only roughly: every turned pose is fitted again and counts when it stays
    # turned. What those fits have in common is a better axis, with which the second round starts.
    for _ in range(2):
        turned = pose @ SE3.exp(np.radians(degrees)[:, None] * turn)
        fitted, _ = _coarse(points, surface, turned, _TURN_STEPS)
        slipped = np.linalg.norm((turned.inverse() @ fitted).as_rotvec(), axis=1) > _TURN_SLIP_RAD
        in_obj = fitted.inverse()[:, None].apply(points).reshape(-1, 3)
        distance = trimesh.proximity.closest_point(mesh, in_obj)[1].reshape(len(degrees), -1)
        fits = (np.sqrt(np.mean(distance**2, axis=1)) < _SAME_FIT * noise) & ~slipped
        if not fits.any():
            break
        twists = (pose.inverse() @ fitted[fits]).log()
        twists *= np.sign(twists[:, 3:] @ turn[3:])[:, None]  # beyond half a turn the logarithm turns back
        mean = twists.sum(axis=0)
        turn = _pure_turn(mean / np.linalg.norm(mean[3:]))
    return degrees[fits], turn


def _pure_turn(twist: Floats) -> Floats:
    """The twist without its sliding along its own axis."""
    axis = twist[3:] / np.linalg.norm(twist[3:])
    return np.concatenate([twist[:3] - axis * (axis @ twist[:3]), twist[3:]])


def _describe(
    covariance: Floats, weak: Floats, ambiguity: Floats, symmetry_axis: Floats | None, radius: float
) -> tuple[Floats, tuple[str, ...]]:
    """Words for what is not determined, and the covariance with a full turn's variance where that is open."""
    words: list[str] = []
    axis = weak[3:] / max(float(np.linalg.norm(weak[3:])), 1e-12)
    if len(ambiguity) >= 57:  # of 71
        covariance = covariance + np.pi**2 / 3 * np.outer(weak, weak)
        known = symmetry_axis is not None and abs(axis @ symmetry_axis) > 0.98 * np.linalg.norm(symmetry_axis)
        if not known:
            words.append(f"rotation about the object's {_axis_name(axis)} axis (every turn fits the points)")
    elif len(ambiguity) and np.any((ambiguity > 30) & (ambiguity < 330)):
        turns = ", ".join(f"{a:.0f}" for a in ambiguity[(ambiguity > 30) & (ambiguity < 330)][:6])
        words.append(
            f"turns of {turns} degrees about the object's {_axis_name(axis)} axis fit the points too"
        )
    elif np.sqrt(axis @ covariance[3:, 3:] @ axis) > _UNOBSERVABLE_RAD:
        words.append(f"rotation about the object's {_axis_name(axis)} axis (touch points off that axis)")
    shift_variance, shift = np.linalg.eigh(covariance[:3, :3])
    lever = radius**2 * covariance[3:, 3:].max()  # a turn about an axis off the origin also moves the origin
    if shift_variance[-1] > _UNOBSERVABLE_M**2 + lever:
        words.append(f"position along the object's {_axis_name(shift[:, -1])} axis (touch its two ends)")
    return covariance, tuple(words)


def _runner_up(poses: SE3, rms: Floats, best: SE3, radius: float) -> float:
    """The smallest residual among starts that ended clearly elsewhere (15 degrees or a quarter of the
    object)."""
    apart = best.inverse() @ poses
    elsewhere = (np.linalg.norm(apart.as_rotvec(), axis=1) > np.radians(15.0)) | (
        np.linalg.norm(apart.translation, axis=1) > 0.25 * radius
    )
    return float(rms[elsewhere].min()) if elsewhere.any() else float("inf")


def _axis_name(axis: Floats) -> str:
    largest = int(np.argmax(np.abs(axis)))
    if abs(axis[largest]) > np.cos(np.radians(10.0)):
        return "xyz"[largest]
    axis = axis * np.sign(axis[largest])
    return f"[{axis[0]:.2f} {axis[1]:.2f} {axis[2]:.2f}]"
