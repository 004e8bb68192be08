"""OpenCV's closed-form hand-eye solvers, all seven, behind one signature."""

from __future__ import annotations

import cv2
import numpy as np

from dataset.transforms import SE3

_HAND_EYE = {
    "tsai": cv2.CALIB_HAND_EYE_TSAI,
    "park": cv2.CALIB_HAND_EYE_PARK,
    "horaud": cv2.CALIB_HAND_EYE_HORAUD,
    "andreff": cv2.CALIB_HAND_EYE_ANDREFF,
    "daniilidis": cv2.CALIB_HAND_EYE_DANIILIDIS,
}
_ROBOT_WORLD = {"shah": cv2.CALIB_ROBOT_WORLD_HAND_EYE_SHAH, "li": cv2.CALIB_ROBOT_WORLD_HAND_EYE_LI}


def closed_forms(T_base_tcp: SE3, T_cam_board: SE3) -> dict[str, tuple[SE3, SE3]]:
    """Every method's (T_tcp_cam, T_base_board) from N pairs of poses; a method that fails is left out."""
    found: dict[str, tuple[SE3, SE3]] = {}
    for name, method in _HAND_EYE.items():
        try:
            # By keyword: positionally the method lands in an output argument and Tsai runs silently.
            rotation, translation = cv2.calibrateHandEye(
                *_as_lists(T_base_tcp), *_as_lists(T_cam_board), method=method
            )
        except cv2.error:
            continue
        T_tcp_cam = _pose(rotation, translation)
        if T_tcp_cam is not None:
            found[name] = T_tcp_cam, mean_pose(T_base_tcp @ T_tcp_cam @ T_cam_board)
    for name, method in _ROBOT_WORLD.items():
        try:
            board_R, board_t, camera_R, camera_t = cv2.calibrateRobotWorldHandEye(
                *_as_lists(T_cam_board), *_as_lists(T_base_tcp.inverse()), method=method
            )
        except cv2.error:
            continue
        T_board_base, T_cam_tcp = _pose(board_R, board_t), _pose(camera_R, camera_t)
        if T_board_base is not None and T_cam_tcp is not None:
            found[name] = T_cam_tcp.inverse(), T_board_base.inverse()
    return found


def mean_pose(poses: SE3) -> SE3:
    """A robust mean of N poses: the median translation, and the rotation closest to all in the chordal
    sense."""
    return SE3(_nearest_rotation(poses.rotation.sum(axis=0)), np.median(poses.translation, axis=0))


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
