"""Where an object stands in the arm's base frame, from points its surface was touched at."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import trimesh
from numpy.typing import ArrayLike, NDArray
from scipy.spatial.transform import Rotation

from calibration.fusion import turned_alike
from calibration.object_observability import Tip, describe, openness, turns_that_fit
from calibration.surface_fit import SEED, Surface, coarse_fit, finest_fit
from calibration.words import axis_name
from dataset.errors import CalibrationError
from dataset.transforms import SE3, adjoint

Floats = NDArray[np.float64]

MIN_POINTS = 6
_STARTS = 240
_COARSE_STEPS = 12
_PROMISING = 80
_NOISE_FLOOR_M = 1e-4  # touching is no better than this (our choice); keeps a perfect fit's covariance honest
_BAD_FIT_M = 2.5e-3
_BAD_FIT_SHARE = 0.015
"""Of the mesh's size: a large object's mesh is not as exact."""
_DOUBTFUL_FIT_M = 1.5e-3
"""From here on it is worth asking whether the mirror image fits better (our choice)."""
_AS_GOOD = 1.25
"""A rival whose residual is no more than that many times the best's fits as well (our choice)."""
_SMALLEST_SHARE = 0.02
"""Of the mesh's size: points that span less were touched on something smaller."""


@dataclass(frozen=True, eq=False)
class ObjectPoseResult:
    """What n touched points say.

    Attributes:
        T_base_obj: the pose.
        covariance: (6, 6) of the twist [rho, phi] d (m, rad) in T_base_obj @ exp(d). Along a direction the
            points do not determine, the variance is that of "anything goes" (a turn, or the object's size).
        tip_covariance: (6, 6) the part of it that is the tip's error, shared by all touched with that tip.
        rms_m: root mean square distance of the points to the surface.
        distance_m: (n,) signed distances, positive outside.
        unobservable: what the points leave open, in words; empty when the pose is determined.
        rivals: poses elsewhere that fit as well, in words; only a search without a guess finds them.
        runner_up_rms_m: the best fit of a clearly different pose that is no symmetry of the object; close
            to rms_m means the points do not tell them apart.
    """

    T_base_obj: SE3
    covariance: Floats
    tip_covariance: Floats
    rms_m: float
    distance_m: Floats
    unobservable: tuple[str, ...]
    rivals: tuple[str, ...]
    runner_up_rms_m: float

    def turned_towards(self, reference: SE3, turns: SE3) -> ObjectPoseResult:
        """The same result as the one of its equal poses T_base_obj @ turn that is turned least against a
        reference; the object looks the same after each of the n `turns`."""
        among = SE3.stack([SE3.identity(), *turns])
        angle = np.linalg.norm((reference.inverse() @ self.T_base_obj @ among).as_rotvec(), axis=1)
        turn = among[int(np.argmin(angle))]
        into = adjoint(turn.inverse())
        return replace(
            self,
            T_base_obj=self.T_base_obj @ turn,
            covariance=into @ self.covariance @ into.T,
            tip_covariance=into @ self.tip_covariance @ into.T,
        )


def register_points(
    points_base: ArrayLike,
    vertices: ArrayLike,
    faces: ArrayLike,
    init: SE3 | None = None,
    symmetry_axis: ArrayLike | None = None,
    tip: Tip | None = None,
    symmetry_turns: SE3 | None = None,
) -> ObjectPoseResult:
    """Fit a mesh to touched points: many starts, point-to-plane ICP (Chen and Medioni 1992), the best
    refined on the exact surface.

    Args:
        points_base: (n, 3) touched points in the base frame, metres: the tip, or its ball's centre.
        vertices, faces: (V, 3) metres, (F, 3): the object in its own frame.
        init: a rough pose; without one every orientation is tried.
        symmetry_axis: (3,) direction about which the object may be turned freely, if it has one: the turn
            about it is then not reported as a defect of the points.
        tip: its ball's radius, and how well it is known; a point known exactly when None.
        symmetry_turns: n rigid motions in the object's frame that leave it looking the same, reported no
            more than that turn.

    Raises:
        CalibrationError: fewer than 6 points, NaN, points that coincide, a mesh in another unit or mirrored,
            or points that do not lie on such an object.
    """
    tip = Tip() if tip is None else tip
    points = _checked(points_base, tip)
    mesh = trimesh.Trimesh(np.asarray(vertices, np.float64), np.asarray(faces), process=False)
    _require_mesh(mesh)
    _require_size(points, mesh)
    surface = Surface.of(mesh, tip.ball_m)
    coarse, coarse_rms = _nearest_fits(points, surface, init)
    best = coarse[int(np.argmin(coarse_rms))]
    limit = max(_BAD_FIT_M, _BAD_FIT_SHARE * float(np.linalg.norm(mesh.extents)))
    if coarse_rms.min() > 3 * limit:
        _require_fit(float(coarse_rms.min()), limit, points, surface)
    pose, signed, normals = finest_fit(points, surface, best)
    rms = float(np.sqrt(np.mean(signed**2)))
    _require_fit(rms, limit, points, surface)
    freedom = max(len(points) - 6, 1)
    noise = max(float(np.sqrt(np.sum(signed**2) / freedom)), _NOISE_FLOOR_M)
    in_obj = pose.inverse().apply(points)
    found = openness(in_obj, normals, pose, noise, freedom, surface, tip)
    ambiguity, turn = turns_that_fit(points, surface, pose, found.weak, noise)
    known_axis = None if symmetry_axis is None else np.asarray(symmetry_axis, np.float64)
    covariance, unobservable = describe(found, turn, ambiguity, known_axis, symmetry_turns, surface.radius)
    alike = coarse if known_axis is None else turned_alike(coarse, pose, known_axis)
    rival, rival_rms = _rival(alike, coarse_rms, pose, symmetry_turns, surface.radius)
    as_good = len(ambiguity) == 0 and rival_rms < _AS_GOOD * max(float(coarse_rms.min()), _NOISE_FLOOR_M)
    return ObjectPoseResult(
        T_base_obj=pose,
        covariance=covariance,
        tip_covariance=found.by_tip,
        rms_m=rms,
        distance_m=signed,
        unobservable=unobservable,
        rivals=(_as_good(pose.inverse() @ rival),) if as_good else (),
        runner_up_rms_m=rival_rms,
    )


def _nearest_fits(points: Floats, surface: Surface, init: SE3 | None) -> tuple[SE3, Floats]:
    """The most promising of many starts, fitted, and their residuals."""
    coarse, rms = coarse_fit(points, surface, _starts(points, surface, init), _COARSE_STEPS)
    return coarse_fit(points, surface, coarse[np.argsort(rms)[:_PROMISING]], 2 * _COARSE_STEPS)


def _checked(points_base: ArrayLike, tip: Tip) -> Floats:
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
    if not 0 <= tip.ball_m < 0.05:
        raise CalibrationError(
            f"object pose: a tip of radius {tip.ball_m:g} m; give metres, 0.002 for a ball of 4 mm diameter"
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


def _require_mesh(mesh: trimesh.Trimesh) -> None:
    if len(mesh.faces) == 0 or not np.isfinite(mesh.vertices).all() or not mesh.area > 0:
        raise CalibrationError(
            "object pose: the mesh is empty or holds NaN; export it again as triangles, in metres"
        )


def _require_size(points: Floats, mesh: trimesh.Trimesh) -> None:
    span = float(np.linalg.norm(points - points.mean(axis=0), axis=1).max())
    across = float(np.linalg.norm(mesh.extents))
    if span > across + _BAD_FIT_M:
        raise CalibrationError(
            f"object pose: a point lies {1000 * span:.0f} mm from the points' mean, the mesh is only"
            f" {1000 * across:.0f} mm across; check the mesh's units (metres) and the points for strays"
        )
    if span < _SMALLEST_SHARE * across:
        raise CalibrationError(
            f"object pose: the points span {1000 * span:.0f} mm of a mesh {across:.3g} m across; check"
            " the mesh's units (metres, not millimetres), or touch it all over"
        )


def _require_fit(rms: float, limit: float, points: Floats, surface: Surface) -> None:
    if rms <= min(limit, _DOUBTFUL_FIT_M):
        return
    mesh = surface.mesh
    flipped = trimesh.Trimesh(mesh.vertices * [-1, 1, 1], mesh.faces[:, ::-1], process=False)
    mirrored = float(_nearest_fits(points, Surface.of(flipped, surface.ball_m), None)[1].min())
    if mirrored < 0.3 * rms:
        raise CalibrationError(
            f"object pose: the points fit the mesh's mirror image ({1000 * mirrored:.1f} mm) and not the mesh"
            f" ({1000 * rms:.1f} mm); export it again with the right handedness"
        )
    if rms > limit:
        raise CalibrationError(
            f"object pose: the best fit leaves the points {1000 * rms:.1f} mm from the surface; check the"
            f" mesh's units (it is {1000 * np.linalg.norm(mesh.extents):.0f} mm across), the tool tip's"
            " offset and radius, and that the right object was touched"
        )


def _starts(points: Floats, surface: Surface, init: SE3 | None) -> SE3:
    """Poses T_base_obj to start from: around ``init``, or all orientations with the centres brought
    together."""
    if init is not None:
        twists = np.random.default_rng(SEED).normal(size=(_STARTS // 4, 6))
        twists[0] = 0.0
        return init @ SE3.exp(twists * np.array([0.2 * surface.radius] * 3 + [0.25] * 3))
    rotation = Rotation.random(_STARTS, rng=np.random.default_rng(SEED)).as_matrix()
    # The touched side is not the whole object, so the mean of the points is not its centre: their box's is
    # closer.
    centre = 0.5 * (points.min(axis=0) + points.max(axis=0))
    return SE3(rotation, centre - rotation @ surface.centre)


def _rival(poses: SE3, rms: Floats, best: SE3, turns: SE3 | None, radius: float) -> tuple[SE3, float]:
    """Of the starts that ended clearly elsewhere (15 degrees or a quarter of the object), symmetries aside,
    the one with the smallest residual, and that; infinite when there is none."""
    elsewhere = np.ones(len(poses), bool)
    for same in [best] if turns is None else [best, *(best @ turns)]:
        apart = same.inverse() @ poses
        elsewhere &= (np.linalg.norm(apart.as_rotvec(), axis=1) > np.radians(15.0)) | (
            np.linalg.norm(apart.translation, axis=1) > 0.25 * radius
        )
    index = int(np.argmin(np.where(elsewhere, rms, np.inf)))
    return poses[index], float(rms[index]) if elsewhere.any() else float("inf")


def _as_good(apart: SE3) -> str:
    """What is left open by a rival pose, seen from the best."""
    turn, shift_mm = apart.as_rotvec(), 1e3 * float(np.linalg.norm(apart.translation))
    degrees = np.degrees(np.linalg.norm(turn))
    return (
        f"which of two poses it is: one turned by {degrees:.0f} degrees about the object's {axis_name(turn)}"
        f" axis and shifted by {shift_mm:.0f} mm fits as well"
    )
