"""Which of the wished-for camera poses an arm reaches, with which joint angles, and in which order.

The arm is a nominal UR5e on a table. It is clear of the table and of itself when thick points along it are;
the shapes are our choice, on the cautious side. Anything else that stands in the room is not known here.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import ArrayLike, NDArray

from acquisition.kinematics import JOINT_LIMIT, inverse_all, link_transforms, unwrap_near
from dataset.errors import ToolkitError
from dataset.transforms import SE3

Floats = NDArray[np.float64]
Indices = NDArray[np.intp]

VIA = -1
"""Stands in a plan's index for a waypoint that is no view."""

_LINK_RADIUS = 0.06  # m
_UPPER_ARM_OFFSET, _FOREARM_OFFSET = 0.138, 0.007  # m, of the tubes beside the Denavit-Hartenberg skeleton
_COLUMN_HEIGHT, _COLUMN_RADIUS = 0.24, 0.08  # m, of the base and shoulder
_SWEEP_STEP_RAD = 0.08
_NEIGHBOURS_TRIED = 24
_ROLLS = tuple(np.deg2rad(np.arange(-180, 180, 15)))


@dataclass(frozen=True)
class CarriedCamera:
    """The camera on the flange, and how much room it needs.

    Attributes:
        T_flange_tcp: the active tool.
        T_tcp_cam: rough hand-eye transform.
        radius: metres of room around the optical axis.
        length_behind, length_ahead: metres of housing behind, and of lens ahead of, the camera's centre.
        table_z: height of the table in the base frame, metres.
        table_gap: metres that everything stays above the table.
    """

    T_flange_tcp: SE3
    T_tcp_cam: SE3
    radius: float = 0.04
    length_behind: float = 0.05
    length_ahead: float = 0.02
    table_z: float = 0.0
    table_gap: float = 0.03

    def T_base_flange(self, T_base_cam: SE3) -> SE3:
        """Where the flange is when the camera is there."""
        return T_base_cam @ (self.T_flange_tcp @ self.T_tcp_cam).inverse()


@dataclass(frozen=True, eq=False)
class JointPlan:
    """A sequence of arm configurations.

    Attributes:
        q: (K, 6) joint angles, radians, in the order of travel.
        index: (K,) which of the wished-for views each is, VIA for a waypoint in between.
        unreachable: indices of the views that were left out.
    """

    q: Floats
    index: Indices
    unreachable: Indices


def is_clear(q: ArrayLike, camera: CarriedCamera) -> NDArray[np.bool_]:
    """(...) bool: whether joint angles (..., 6) keep arm and camera clear of the table and the arm."""
    links = link_transforms(q)
    origins, axes = links[..., :3, 3], links[..., :3, 2]
    mount = (camera.T_flange_tcp @ camera.T_tcp_cam).as_matrix()
    along = np.array([-camera.length_behind, 0.0, camera.length_ahead])
    housing = mount[:3, 3] + along[:, None] * mount[:3, 2]
    tool = np.einsum("...ij,kj->...ki", links[..., 6, :3, :3], housing) + origins[..., 6:7, :]
    shoulder = origins[..., 1, :] + _UPPER_ARM_OFFSET * axes[..., 1, :]
    elbow = origins[..., 2, :] + _UPPER_ARM_OFFSET * axes[..., 1, :]
    elbow_inner = origins[..., 2, :] + _FOREARM_OFFSET * axes[..., 1, :]
    wrist = origins[..., 3, :] + _FOREARM_OFFSET * axes[..., 1, :]
    floor = camera.table_z + camera.table_gap
    joints = np.concatenate([origins[..., 2:, :], elbow[..., None, :]], axis=-2)
    high = joints[..., 2].min(axis=-1) > floor + _LINK_RADIUS
    high &= tool[..., 2].min(axis=-1) > floor + camera.radius
    top = np.array([0.0, 0.0, _COLUMN_HEIGHT])
    hand = np.concatenate([origins[..., 5:, :], tool], axis=-2)
    room = np.array([_LINK_RADIUS, _LINK_RADIUS, camera.radius, camera.radius, camera.radius])
    base = np.broadcast_to(np.zeros(3), top.shape)
    free = _distance(hand, base, top) > room + _COLUMN_RADIUS
    free &= _distance(hand, shoulder, elbow) > room + _LINK_RADIUS
    forearm = _distance(tool, elbow_inner, wrist) > camera.radius + _LINK_RADIUS
    arm = np.stack([elbow, wrist], axis=-2)
    column = _distance(arm, base, top) > _LINK_RADIUS + _COLUMN_RADIUS
    return np.asarray(high & free.all(axis=-1) & forearm.all(axis=-1) & column.all(axis=-1))


def configurations(T_base_cam: SE3, camera: CarriedCamera, rolls: ArrayLike = (0.0,)) -> Floats:
    """Every clear arm configuration for each view.

    Args:
        T_base_cam: a batch of M views.
        camera: how it is carried.
        rolls: (R,) radians; each view may also be turned by any of these about its optical axis.

    Returns:
        (M, R, 8, 6) joint angles in (-pi, pi], rows of NaN where a configuration does not exist or collides.
        The 8 are the arm's ways of bending shoulder, wrist and elbow.
    """
    turns = np.zeros((len(np.atleast_1d(rolls)), 3))
    turns[:, 2] = rolls
    rolled = T_base_cam[:, None] @ SE3.from_rotvec(turns, np.zeros(3))[None]
    q = inverse_all(camera.T_base_flange(rolled))
    possible = np.asarray(np.isfinite(q).all(axis=-1))
    possible[possible] = is_clear(q[possible], camera)
    return np.where(possible[..., None], q, np.nan)


def plan_stills(
    T_base_cam: SE3,
    camera: CarriedCamera,
    q_start: ArrayLike,
    count: int | None = None,
) -> JointPlan:
    """Joint angles for single pictures, each a short and clear straight joint motion from the one before.

    Args:
        T_base_cam: a batch of M views, in any order.
        camera: how it is carried.
        q_start: (6,) where the arm is.
        count: the most views to keep, those that differ most in rotation. All by default.

    Returns:
        The plan, ordered greedily by joint distance; views that only a collision would lead to are left out.

    Raises:
        ToolkitError: nothing is reachable.
    """
    candidates = configurations(T_base_cam, camera)[:, 0]
    reachable = np.flatnonzero(np.isfinite(candidates).any(axis=(1, 2)))
    if count is not None and len(reachable) > count:
        reachable = reachable[_most_diverse(T_base_cam[reachable], count)]
    here = np.asarray(q_start, dtype=np.float64)
    left = set(reachable.tolist())
    q, index = [], []
    while left:
        views = np.array(sorted(left))
        near = unwrap_near(candidates[views], here, JOINT_LIMIT)
        distance = np.abs(near - here).max(axis=-1)
        order = np.argsort(np.where(np.isnan(distance), np.inf, distance), axis=None)[:_NEIGHBOURS_TRIED]
        for view, solution in zip(*np.unravel_index(order, distance.shape), strict=True):
            if np.isfinite(distance[view, solution]) and _sweep_clear(here, near[view, solution], camera):
                here = near[view, solution]
                q.append(here)
                index.append(int(views[view]))
                left.remove(index[-1])
                break
        else:
            break
    return _plan(q, index, len(T_base_cam))


def plan_path(
    T_base_cam: SE3,
    camera: CarriedCamera,
    q_start: ArrayLike,
    rolls: ArrayLike = _ROLLS,
) -> JointPlan:
    """Joint angles through views in their order, for `Robot.follow`.

    The roll of the camera about its axis is free within `rolls`; the arm keeps one way of bending its
    shoulder, wrist and elbow, the one that reaches most views, so that it never turns over. Of all the
    sequences of rolls the one with the least sum of squared joint steps is taken (Viterbi). Where
    an obstacle is between two waypoints the arm goes by way of `q_start`.

    Args:
        T_base_cam: a batch of M views in the order of travel.
        camera: how it is carried.
        q_start: (6,) where the arm is; somewhere above the scene.
        rolls: (R,) radians.

    Returns:
        The plan.

    Raises:
        ToolkitError: nothing is reachable.
    """
    start = np.asarray(q_start, dtype=np.float64)
    candidates = configurations(T_base_cam, camera, rolls)
    plans = [
        _join(*_smoothest(candidates[:, :, bend], start), start, camera)
        for bend in range(candidates.shape[2])
    ]
    best = max(plans, key=lambda plan: sum(view != VIA for view in plan[1]))
    return _plan(*best, len(T_base_cam))


def _smoothest(candidates: Floats, start: Floats) -> tuple[Floats, Indices]:
    """One of the candidates (M, R, 6) for each view that has any: waypoints (K, 6), their views (K,)."""
    views = np.flatnonzero(np.isfinite(candidates).all(axis=-1).any(axis=-1))
    if not len(views):
        return np.empty((0, 6)), views
    layers = [solutions[np.isfinite(solutions).all(axis=-1)] for solutions in candidates[views]]
    cost = np.abs(_short_way(layers[0] - start)).max(axis=-1) ** 2
    origins = []
    for before, after in pairwise(layers):
        step = np.abs(_short_way(after[:, None] - before[None])).max(axis=-1)
        total = step**2 + cost
        origins.append(total.argmin(axis=1))
        cost = total.min(axis=1)
    chosen = [int(cost.argmin())]
    for origin in reversed(origins):
        chosen.append(int(origin[chosen[-1]]))
    waypoints = np.array([layer[i] for layer, i in zip(layers, reversed(chosen), strict=True)])
    waypoints = _wind(waypoints, start)
    within = (np.abs(waypoints) <= JOINT_LIMIT).all(axis=1)
    return waypoints[within], views[within]


def _join(
    waypoints: Floats, views: Indices, start: Floats, camera: CarriedCamera
) -> tuple[list[Floats], list[int]]:
    """Keeps the waypoints that a clear straight motion joins to the one before, or two via the start."""
    q, index = [start], [VIA]
    for waypoint, view in zip(waypoints, views, strict=True):
        if not _sweep_clear(q[-1], waypoint, camera):
            via = unwrap_near(start, q[-1], JOINT_LIMIT)
            if not (_sweep_clear(q[-1], via, camera) and _sweep_clear(via, waypoint, camera)):
                continue
            q.append(via)
            index.append(VIA)
        q.append(waypoint)
        index.append(int(view))
    return q[1:], index[1:]


def _short_way(difference: Floats) -> Floats:
    """Angle differences in [-pi, pi]."""
    return np.asarray(difference - 2 * np.pi * np.round(difference / (2 * np.pi)))


def _wind(q: Floats, start: Floats) -> Floats:
    """Makes a sequence (K, 6) continuous across whole turns, within the limits and near to the start."""
    q = np.unwrap(q, axis=0)
    turns = 2 * np.pi * np.arange(-2, 3)
    shifted = q[..., None] + turns
    beyond = np.maximum(np.abs(shifted).max(axis=0) - JOINT_LIMIT, 0.0)
    away = np.abs(shifted[0] - start[:, None])
    best = np.argmin(1e3 * beyond + away, axis=-1)
    return np.asarray(q + turns[best])


def _plan(q: list[Floats], index: list[int], wished: int) -> JointPlan:
    if not q:
        raise ToolkitError(
            f"the arm reaches none of {wished} views; check T_tcp_cam_guess and where the board or object is "
            "in the rig file, or move it to 0.35-0.6 m from the arm's base"
        )
    missing = np.setdiff1d(np.arange(wished), index)
    return JointPlan(np.array(q), np.array(index, dtype=np.intp), missing)


def _sweep_clear(q_from: Floats, q_to: Floats, camera: CarriedCamera) -> bool:
    count = 2 + int(np.abs(q_to - q_from).max() / _SWEEP_STEP_RAD)
    return bool(is_clear(q_from + np.linspace(0, 1, count)[1:, None] * (q_to - q_from), camera).all())


def _most_diverse(poses: SE3, count: int) -> Indices:
    """Farthest-point sampling by the angle between orientations."""
    chosen = [0]
    nearest = np.full(len(poses), np.inf)
    for _ in range(count - 1):
        trace = np.einsum("nij,ij->n", poses.rotation, poses[chosen[-1]].rotation)
        nearest = np.minimum(nearest, np.arccos(np.clip((trace - 1) / 2, -1, 1)))
        chosen.append(int(nearest.argmax()))
    return np.sort(np.array(chosen, dtype=np.intp))


def _distance(points: Floats, start: Floats, end: Floats) -> Floats:
    """(..., K) distances from points (..., K, 3) to the segment between `start` and `end` (..., 3)."""
    along = (end - start)[..., None, :]
    offset = points - start[..., None, :]
    part = np.clip((offset * along).sum(axis=-1) / (along * along).sum(axis=-1), 0, 1)
    return np.asarray(np.linalg.norm(offset - part[..., None] * along, axis=-1))
