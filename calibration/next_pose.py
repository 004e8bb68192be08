"""Which view of the board to take next: the one that shrinks the hand-eye transform's uncertainty most."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from calibration.board import BoardSpec
from calibration.bundle import Bools, Floats, Observations
from calibration.closed_forms import mean_rotation
from calibration.detection import MIN_CORNERS
from calibration.hand_eye import HandEyeResult
from calibration.hand_eye_model import TRANSFORMS
from dataset.errors import CalibrationError
from dataset.transforms import SE3

Reachable = Callable[[SE3], Bools]
"""Tells of K arm poses which (K,) the arm reaches."""

_LEVER_M = 0.5
"""Distance at which a rotation's error is weighed against a position's (our choice: a camera's distance from
what it looks at)."""

_CANDIDATES = 300
_SEED = 0  # of the draw: the same views give the same advice again
_TILT_RAD = np.radians(40.0)
_TURN_RAD = np.radians(120.0)
_SEEN = 0.6  # of the board's corners that a view must show
_BORDER_PX = 10.0


@dataclass(frozen=True, eq=False)
class NextPose:
    """A view to take.

    Attributes:
        T_base_tcp: where to send the arm.
        T_cam_board: how the board will be seen.
        sigma_m, sigma_rad: standard deviations of T_mount_cam that the view would leave.
        reason: in words: what about the view is new.
    """

    T_base_tcp: SE3
    T_cam_board: SE3
    sigma_m: float
    sigma_rad: float
    reason: str


def next_pose(
    result: HandEyeResult,
    spec: BoardSpec,
    reachable: Reachable | None = None,
) -> NextPose:
    """The best of random views of the board, at the distances and about the tilts of a board well seen.

    Args:
        result: of the views so far.
        spec: the board.
        reachable: tells of K arm poses which (K,) the arm reaches; all of them by default.

    Raises:
        CalibrationError: no candidate shows enough of the board within the arm's reach.
    """
    state = result.fit.state
    views = _candidates(result, spec)
    carried = state.T_mount_cam @ views @ state.T_fixture_board.inverse()  # T_mount_fixture
    T_base_tcp = carried.inverse() if state.mount == "eye_in_hand" else carried
    shown = [_shown(view, result, spec) for view in views]
    good = np.array([len(ids) >= max(MIN_CORNERS, _SEEN * spec.corner_count) for ids in shown])
    if reachable is not None:
        good &= reachable(T_base_tcp)
    if not good.any():
        raise CalibrationError(
            f"next pose: none of {_CANDIDATES} views shows the board within the arm's reach; move the board"
            " nearer to the middle of the arm's reach"
        )
    information = result.fit.solution.reduced_normal[TRANSFORMS, TRANSFORMS]
    covariances = {
        index: np.linalg.inv(information + _worth(result, spec, T_base_tcp[index], shown[index]))[:6, :6]
        for index in np.flatnonzero(good).tolist()
    }

    def spread(index: int) -> float:
        diagonal = np.diagonal(covariances[index])
        return float(diagonal[:3].sum() + _LEVER_M**2 * diagonal[3:].sum())

    index = min(covariances, key=spread)
    covariance = covariances[index]
    return NextPose(
        T_base_tcp[index],
        views[index],
        float(np.sqrt(np.trace(covariance[:3, :3]))),
        float(np.sqrt(np.trace(covariance[3:, 3:]))),
        _reason(result, T_base_tcp[index]),
    )


def _candidates(result: HandEyeResult, spec: BoardSpec) -> SE3:
    """Random T_cam_board: at about the distances seen so far, tilted, turned, off centre."""
    rng, count = np.random.default_rng(_SEED), _CANDIDATES
    seen = result.T_base_cam.inverse() @ result.T_base_board_seen
    middle = np.array([0.5 * spec.size_m[0], 0.5 * spec.size_m[1], 0.0])
    depth = seen.apply(middle)[:, 2]
    size = np.array([result.intrinsics.width, result.intrinsics.height])
    pixels = size * (0.5 + rng.uniform(-0.3, 0.3, (count, 2)))
    rays = result.intrinsics.rays(pixels)
    place = rays / rays[:, 2:] * rng.uniform(0.8 * depth.min(), 1.2 * depth.max(), (count, 1))
    direction = rng.uniform(0, 2 * np.pi, count)
    tilt = _TILT_RAD * np.sqrt(rng.uniform(0, 1, count))
    tilted = SE3.from_rotvec(
        tilt[:, None] * np.stack([np.cos(direction), np.sin(direction), np.zeros(count)], axis=1), place
    )
    turn = np.zeros((count, 3))
    usual = seen.rotation.sum(axis=0)
    turn[:, 2] = np.arctan2(usual[1, 0], usual[0, 0]) + rng.uniform(-_TURN_RAD, _TURN_RAD, count)
    return tilted @ SE3.from_rotvec(turn, np.zeros(3)) @ SE3(np.eye(3), -middle)


def _shown(T_cam_board: SE3, result: HandEyeResult, spec: BoardSpec) -> np.ndarray:
    """The corners inside the picture."""
    ids = np.arange(spec.corner_count)
    pixels = result.intrinsics.project(T_cam_board.apply(spec.object_points(ids)))
    limit = np.array([result.intrinsics.width, result.intrinsics.height]) - 1 - _BORDER_PX
    return ids[np.all((pixels > _BORDER_PX) & (pixels < limit), axis=1)]


def _worth(result: HandEyeResult, spec: BoardSpec, T_base_tcp: SE3, ids: np.ndarray) -> Floats:
    """(12, 12) information of one more view about the transforms, its own arm error eliminated."""
    state = replace(
        result.fit.state,
        T_base_tcp=SE3.stack([T_base_tcp]),
        arm_error=np.zeros((1, 6)),
        velocity=None,
        moving=None,
    )
    corners = Observations(np.zeros(len(ids), np.int64), spec.object_points(ids), np.zeros((len(ids), 2)), 1)
    linear = state.linearize(corners)
    shared = linear.by_shared[..., TRANSFORMS].reshape(-1, 12) / result.pixel_sigma
    own = linear.by_own.reshape(-1, 6) / result.pixel_sigma
    cross = own.T @ shared
    own_information = own.T @ own + np.diag(result.fit.sigmas.arm**-2.0)
    return np.asarray(shared.T @ shared - cross.T @ np.linalg.solve(own_information, cross))


def _reason(result: HandEyeResult, T_base_tcp: SE3) -> str:
    """How the tool is turned against the views so far, in the tool's own axes."""
    mean = mean_rotation(result.fit.state.T_base_tcp.rotation)
    turned = np.degrees(SE3(mean.T @ T_base_tcp.rotation, np.zeros(3)).as_rotvec())
    parts = [f"{value:+.0f} degrees about {axis}" for axis, value in zip("xyz", turned, strict=True)]
    return "the tool turned by " + ", ".join(parts) + " against the mean of the views so far"
