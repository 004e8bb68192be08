"""Which of the wished-for camera poses an arm reaches, with which joint angles, and in which order.

The arm is a nominal UR5e; a real one is off by millimetres, which `acquisition.clearance` leaves room for.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import ArrayLike, NDArray

from acquisition.clearance import CarriedCamera, is_clear, sweep_clear
from acquisition.kinematics import JOINT_LIMIT, forward, inverse_all, unwrap_near
from dataset.errors import ToolkitError
from dataset.transforms import SE3

Floats = NDArray[np.float64]
Indices = NDArray[np.intp]

VIA = -1
"""Stands in a plan's index for a waypoint that is no view."""

_NEIGHBOURS_TRIED = 24
_SMALLEST_GAIN_RAD = 1e-3
_ROLLS = tuple(np.deg2rad(np.arange(-180, 180, 15)))


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
    worth: ArrayLike = 1.0,
) -> JointPlan:
    """Joint angles for single pictures, each a short and clear straight joint motion from the one before.

    Args:
        T_base_cam: a batch of M views, in any order.
        camera: how it is carried.
        q_start: (6,) where the arm is.
        count: the most views to keep, those whose rotations differ most usefully. All by default.
        worth: (M,) of each view, such as how much it shows of a board; weighs in where `count` chooses.

    Returns:
        The plan, in an order that keeps the motions short; views that only a collision would lead to are
        left out.

    Raises:
        ToolkitError: nothing is reachable.
    """
    candidates = configurations(T_base_cam, camera)[:, 0]
    reachable = np.flatnonzero(np.isfinite(candidates).any(axis=(1, 2)))
    if count is not None and len(reachable) > count:
        worths = np.broadcast_to(np.asarray(worth, dtype=np.float64), len(T_base_cam))
        reachable = reachable[most_diverse(T_base_cam[reachable], count, worths[reachable])]
    start = np.asarray(q_start, dtype=np.float64)
    q, index = _nearest_next(candidates, reachable, start, camera)
    order = shorten(start, q, camera)
    _require_some(q, len(T_base_cam), start, camera)
    return _plan([q[i] for i in order], [index[i] for i in order], len(T_base_cam))


def _nearest_next(
    candidates: Floats, views: Indices, start: Floats, camera: CarriedCamera
) -> tuple[list[Floats], list[int]]:
    """Goes from each configuration to the nearest of any view that is left and can be reached from there."""
    here = start
    left = set(views.tolist())
    q: list[Floats] = []
    index: list[int] = []
    while left:
        rest = np.array(sorted(left))
        near = unwrap_near(candidates[rest], here, JOINT_LIMIT)
        distance = np.abs(near - here).max(axis=-1)
        order = np.argsort(np.where(np.isnan(distance), np.inf, distance), axis=None)[:_NEIGHBOURS_TRIED]
        for view, solution in zip(*np.unravel_index(order, distance.shape), strict=True):
            if np.isfinite(distance[view, solution]) and sweep_clear(here, near[view, solution], camera):
                here = near[view, solution]
                q.append(here)
                index.append(int(rest[view]))
                left.remove(index[-1])
                break
        else:
            break
    return q, index


def shorten(start: Floats, q: list[Floats], camera: CarriedCamera) -> list[int]:
    """A shorter order of configurations (6,) after `start`: 2-opt, turning round a part of the way as long
    as that makes it shorter and the new motions are clear. The length is that of the fastest joint."""
    points = np.array([start, *q])
    length = np.abs(points[:, None] - points[None]).max(axis=-1)
    tour = list(range(len(points)))
    improved = True
    while improved:
        improved = False
        for i in range(1, len(tour) - 1):
            for j in range(i + 1, len(tour)):
                before, first, last = tour[i - 1], tour[i], tour[j]
                after = tour[j + 1] if j + 1 < len(tour) else None
                gain = length[before, first] - length[before, last]
                if after is not None:
                    gain += length[last, after] - length[first, after]
                if gain < _SMALLEST_GAIN_RAD:
                    continue
                new = [(before, last)] + ([] if after is None else [(first, after)])
                turned = [(b, a) for a, b in pairwise(tour[i : j + 1])]  # the same ways, the other way round
                if all(sweep_clear(points[a], points[b], camera) for a, b in [*new, *turned]):
                    tour[i : j + 1] = tour[i : j + 1][::-1]
                    improved = True
    return [i - 1 for i in tour[1:]]


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
    _require_some(best[0], len(T_base_cam), start, camera)
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
        if not sweep_clear(q[-1], waypoint, camera):
            via = unwrap_near(start, q[-1], JOINT_LIMIT)
            if not (sweep_clear(q[-1], via, camera) and sweep_clear(via, waypoint, camera)):
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


def _require_some(q: list[Floats], wished: int, start: Floats, camera: CarriedCamera) -> None:
    """Raises ToolkitError where no view is reached: why that may be."""
    if q:
        return
    if not is_clear(start, camera):
        x, y, z = (forward(start) @ camera.T_flange_tcp).translation
        low, high = camera.workspace
        raise ToolkitError(
            f"no way leads on from where the arm stands, its tool at ({x:.3f}, {y:.3f}, {z:.3f}) m: outside "
            f"the workspace {low} to {high}, or too near to the table or itself; move it inside at the "
            "pendant, bent, above the table"
        )
    raise ToolkitError(
        f"the arm reaches none of {wished} views; check T_tcp_cam_guess, the workspace and where the "
        "board or object is in the rig file, or move it to 0.35-0.6 m from the arm's base"
    )


def _plan(q: list[Floats], index: list[int], wished: int) -> JointPlan:
    missing = np.setdiff1d(np.arange(wished), index)
    return JointPlan(np.array(q), np.array(index, dtype=np.intp), missing)


def most_diverse(poses: SE3, count: int, worth: Floats) -> Indices:
    """Indices of poses whose rotations differ usefully for a hand-eye calibration, in increasing order.

    Farthest-point sampling. Two rotations are as far apart as the sine of the angle between them: a small
    one says little, and at half a turn the axis can no longer be told. Each distance is weighed with the
    pose's worth (N,); the most worthy one comes first.
    """
    chosen = [int(np.argmax(worth))]
    nearest = np.full(len(poses), np.inf)
    for _ in range(count - 1):
        trace = np.einsum("nij,ij->n", poses.rotation, poses[chosen[-1]].rotation)
        angle = np.arccos(np.clip((trace - 1) / 2, -1, 1))
        nearest = np.minimum(nearest, np.sin(np.minimum(angle, np.pi - 1e-9)))
        nearest[chosen] = -1.0
        chosen.append(int((nearest * worth).argmax()))
    return np.sort(np.array(chosen, dtype=np.intp))
