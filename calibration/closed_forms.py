"""OpenCV's closed-form hand-eye solvers, all seven, behind one signature, and RANSAC over them.

One equation serves both mounts. Something carries the camera (the mount) and something carries the board (the
fixture): the tool and the base for an eye in hand, the base and the tool for an eye to hand. Then

    T_fixture_mount @ T_mount_cam @ T_cam_board = T_fixture_board,

with T_fixture_mount = T_base_tcp or its inverse. `arm_reading` makes it from the arm's pose.
"""

from __future__ import annotations

from typing import Literal

import cv2
import numpy as np
from numpy.typing import NDArray

from dataset.transforms import SE3, matrix_to_rotvec

Mount = Literal["eye_in_hand", "eye_to_hand"]
"""`eye_in_hand`: camera on the tool, board fixed. `eye_to_hand`: camera fixed, board on the tool."""

_HAND_EYE = {
    "tsai": cv2.CALIB_HAND_EYE_TSAI,
    "park": cv2.CALIB_HAND_EYE_PARK,
    "horaud": cv2.CALIB_HAND_EYE_HORAUD,
    "andreff": cv2.CALIB_HAND_EYE_ANDREFF,
    "daniilidis": cv2.CALIB_HAND_EYE_DANIILIDIS,
}
_ROBOT_WORLD = {"shah": cv2.CALIB_ROBOT_WORLD_HAND_EYE_SHAH, "li": cv2.CALIB_ROBOT_WORLD_HAND_EYE_LI}
_SAMPLE = 4  # views: three determine both transforms, one more lets a wrong one show
_TRIES = 80  # one of them is clean in 99.4 % of the cases when half of the views are wrong
_SEED = 0  # of the samples: the same views give the same result again
_TYPICAL_M, _TYPICAL_RAD = 3e-3, 5e-3  # of one view's disagreement; only their ratio matters much
_CAP = 9.0


def arm_reading(T_base_tcp: SE3, mount: Mount) -> SE3:
    """T_fixture_mount of N arm poses."""
    return T_base_tcp if mount == "eye_in_hand" else T_base_tcp.inverse()


def closed_forms(T_fixture_mount: SE3, T_cam_board: SE3) -> dict[str, tuple[SE3, SE3]]:
    """Every method's (T_mount_cam, T_fixture_board) from N pairs of poses; a method that fails is left out.

    Sources: Tsai & Lenz 1989, Park & Martin 1994, Horaud & Dornaika 1995, Andreff et al. 1999, Daniilidis
    1999 (A X = X B); Shah 2013, Li et al. 2010 (A X = Z B).
    """
    found: dict[str, tuple[SE3, SE3]] = {}
    for name in _HAND_EYE:
        T_mount_cam = _hand_eye(name, T_fixture_mount, T_cam_board)
        if T_mount_cam is not None:
            found[name] = T_mount_cam, mean_pose(T_fixture_mount @ T_mount_cam @ T_cam_board)
    for name in _ROBOT_WORLD:
        pair = _robot_world(name, T_fixture_mount, T_cam_board)
        if pair is not None:
            found[name] = pair
    return found


def ransac(T_fixture_mount: SE3, T_cam_board: SE3) -> tuple[SE3, SE3] | None:
    """The (T_mount_cam, T_fixture_board) of a few random views that the most views agree with.

    Views are scored by how far they place the board from where the candidate has it, each at most `_CAP`
    times its typical variance (MSAC: Torr & Zisserman 2000). None when no sample has a solution.
    """
    rng = np.random.default_rng(_SEED)
    best: tuple[float, tuple[SE3, SE3]] | None = None
    for _ in range(_TRIES):
        chosen = rng.choice(len(T_fixture_mount), min(_SAMPLE, len(T_fixture_mount)), replace=False)
        sample = T_fixture_mount[chosen], T_cam_board[chosen]
        T_mount_cam = _hand_eye("park", *sample)
        candidates: list[tuple[SE3, SE3 | None]] = [] if T_mount_cam is None else [(T_mount_cam, None)]
        pair = _robot_world("shah", *sample)
        candidates += [] if pair is None else [pair]
        for mount_cam, board in candidates:
            placed = T_fixture_mount @ mount_cam @ T_cam_board
            board = mean_pose(placed[chosen]) if board is None else board
            apart = disagreement(placed, board)
            score = float(np.minimum(apart, _CAP).sum())
            if best is None or score < best[0]:
                best = score, (mount_cam, board)
    return None if best is None else best[1]


def disagreement(placed: SE3, T_fixture_board: SE3) -> NDArray[np.float64]:
    """(N,) squared distance of N placements of the board from one, in typical variances."""
    apart = T_fixture_board.inverse() @ placed
    metres = np.sum((placed.translation - T_fixture_board.translation) ** 2, axis=1)
    radians = np.sum(matrix_to_rotvec(apart.rotation) ** 2, axis=1)
    return np.asarray(metres / _TYPICAL_M**2 + radians / _TYPICAL_RAD**2) / 6.0


def mean_pose(poses: SE3) -> SE3:
    """A robust mean of N poses: the median translation, and the mean rotation."""
    return SE3(mean_rotation(poses.rotation), np.median(poses.translation, axis=0))


def mean_rotation(rotation: NDArray[np.float64]) -> NDArray[np.float64]:
    """The rotation (3, 3) closest to N rotations (N, 3, 3) in the chordal sense (Moakher 2002)."""
    return _nearest_rotation(rotation.sum(axis=0))


def _hand_eye(name: str, T_fixture_mount: SE3, T_cam_board: SE3) -> SE3 | None:
    try:
        # By keyword: positionally the method lands in an output argument and Tsai runs silently.
        rotation, translation = cv2.calibrateHandEye(
            *_as_lists(T_fixture_mount), *_as_lists(T_cam_board), method=_HAND_EYE[name]
        )
    except cv2.error:
        return None
    return _pose(rotation, translation)


def _robot_world(name: str, T_fixture_mount: SE3, T_cam_board: SE3) -> tuple[SE3, SE3] | None:
    try:
        board_R, board_t, camera_R, camera_t = cv2.calibrateRobotWorldHandEye(
            *_as_lists(T_cam_board), *_as_lists(T_fixture_mount.inverse()), method=_ROBOT_WORLD[name]
        )
    except cv2.error:
        return None
    T_board_fixture, T_cam_mount = _pose(board_R, board_t), _pose(camera_R, camera_t)
    if T_board_fixture is None or T_cam_mount is None:
        return None
    return T_cam_mount.inverse(), T_board_fixture.inverse()


def _as_lists(poses: SE3) -> tuple[list[np.ndarray], list[np.ndarray]]:
    return list(poses.rotation), list(poses.translation)


def _pose(rotation: np.ndarray, translation: np.ndarray) -> SE3 | None:
    """The closest rigid transform; some methods return a matrix that is only nearly a rotation, or NaN."""
    if not (np.isfinite(rotation).all() and np.isfinite(translation).all()):
        return None
    return SE3(_nearest_rotation(rotation), translation.ravel())


def _nearest_rotation(matrix: np.ndarray) -> np.ndarray:
    u, _, vt = np.linalg.svd(matrix)
    return np.asarray(u @ np.diag([1.0, 1.0, np.linalg.det(u @ vt)]) @ vt)
