"""Where a camera should stand: views of a calibration board and of an object, as pure geometry.

All poses are T_base_cam in the OpenCV camera frame (z forward, y down). Whether an arm reaches them is the
business of `acquisition.planning`.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from dataset.errors import ToolkitError
from dataset.intrinsics import Intrinsics
from dataset.transforms import SE3, rotation_error_deg
from dataset.view_sphere import ViewSphere

Floats = NDArray[np.float64]

_GOLDEN_ANGLE = np.pi * (3 - np.sqrt(5))
_BOARD_GRID = 7  # points a side that stand for the board when its visibility is judged
_ATTEMPTS_PER_VIEW = 200
_LEAST_VISIBLE = 0.7


def look_at(eye: ArrayLike, target: ArrayLike, roll: ArrayLike = 0.0, up: ArrayLike = (0.0, 0.0, 1.0)) -> SE3:
    """Cameras at `eye` (..., 3) that look at `target` (..., 3), metres in the base frame.

    Args:
        eye: the cameras' centres.
        target: what they look at.
        roll: (...) radians about the optical axis; 0 shows `up` upwards.
        up: (3,) or (..., 3); where the camera looks along it, the base frame's x axis takes its place.

    Returns:
        T_base_cam, a batch of the shape that the arguments broadcast to.
    """
    eye, target = np.broadcast_arrays(np.asarray(eye, dtype=np.float64), np.asarray(target, dtype=np.float64))
    forward = target - eye
    forward = forward / np.linalg.norm(forward, axis=-1, keepdims=True)
    right = np.cross(forward, np.asarray(up, dtype=np.float64))
    along = np.linalg.norm(right, axis=-1, keepdims=True) < 1e-6
    right = np.where(along, np.cross(forward, (1.0, 0.0, 0.0)), right)
    right = right / np.linalg.norm(right, axis=-1, keepdims=True)
    rotation = np.stack([right, np.cross(forward, right), forward], axis=-1)
    spin = np.zeros((*np.shape(roll), 3))
    spin[..., 2] = roll
    return SE3(rotation, eye) @ SE3.from_rotvec(spin, np.zeros(3))


def hand_eye_views(
    T_base_board: SE3,
    board_size: tuple[float, float],
    intrinsics: Intrinsics,
    count: int,
    seed: int = 0,
    largest_tilt_deg: float = 45.0,
    largest_roll_deg: float = 90.0,
) -> SE3:
    """Random views of a board, spread in tilt, direction, distance and roll, and over the image.

    Args:
        T_base_board: roughly where the board is; its corner is the origin, x and y run along its sides.
        board_size: width and height, metres.
        intrinsics: rough ones do.
        count: how many views.
        seed: of the random choice.
        largest_tilt_deg: between the board's normal and the direction to the camera.
        largest_roll_deg: about the optical axis; more is more diverse and a longer way for the wrist.

    Returns:
        T_base_cam, a batch of `count`, each with at least 70 % of the board in its image. The cameras stand
        on the upper side of the board, whichever way its z axis points.

    Raises:
        ToolkitError: no such views exist; the board does not fit the image.
    """
    rng = np.random.default_rng(seed)
    size = np.array([*board_size, 0.0])
    centre = T_base_board.apply(size / 2)
    normal = T_base_board.rotation[:, 2] * (1.0 if T_base_board.rotation[2, 2] >= 0 else -1.0)
    fill = float(np.max(size[:2] * np.diag(intrinsics.K)[:2] / (intrinsics.width, intrinsics.height)))
    views: list[SE3] = []
    for _ in range(count * _ATTEMPTS_PER_VIEW):
        if len(views) == count:
            return SE3.stack(views)
        tilt = np.deg2rad(largest_tilt_deg) * np.sqrt(rng.random())
        direction = _tilted(normal, tilt, rng.uniform(0, 2 * np.pi))
        distance = fill * rng.uniform(1.05, 1.9)
        target = T_base_board.apply(size * (0.5 + rng.uniform(-0.3, 0.3, 3)))
        view = look_at(
            centre + distance * direction, target, np.deg2rad(largest_roll_deg) * rng.uniform(-1, 1)
        )
        if board_visibility(view, T_base_board, board_size, intrinsics) >= _LEAST_VISIBLE:
            views.append(view)
    raise ToolkitError(
        f"found {len(views)} of {count} views that show a board of {size[0]:.2f} x {size[1]:.2f} m; check "
        "its size, the intrinsics, and whether T_base_board holds metres"
    )


def hemisphere_views(
    centre: ArrayLike,
    radius: tuple[float, float],
    elevation_deg: tuple[float, float],
    count: int,
    seed: int = 0,
) -> SE3:
    """Views of an object evenly spread over a zone of the sphere about it (golden-angle spiral).

    Args:
        centre: (3,) of the object, metres in the base frame.
        radius: nearest and farthest, metres; drawn at random between them.
        elevation_deg: lowest and highest, above the horizon.
        count: how many.
        seed: of the radii.

    Returns:
        T_base_cam, a batch of `count`, the horizon level in the image.
    """
    rng = np.random.default_rng(seed)
    low, high = np.sin(np.deg2rad(elevation_deg))
    height = low + (high - low) * (np.arange(count) + 0.5) / count
    return _on_sphere(
        centre, rng.uniform(*radius, count), _GOLDEN_ANGLE * np.arange(count), np.arcsin(height)
    )


def hemisphere_path(
    centre: ArrayLike,
    radius: tuple[float, float],
    elevation_deg: tuple[float, float],
    azimuth_deg: tuple[float, float] = (-180.0, 180.0),
    rows: int = 5,
    step_deg: float = 8.0,
) -> SE3:
    """A path over a patch of the sphere about an object, row by row and back again (a serpentine).

    Args:
        centre: (3,) of the object, metres in the base frame.
        radius: at the lowest and at the highest row, metres; in between it changes evenly.
        elevation_deg: of the lowest and the highest row, above the horizon.
        azimuth_deg: the rows' ends, about the base frame's z axis, 0 along its x axis, seen from the object.
        rows: how many.
        step_deg: between waypoints on the sphere.

    Returns:
        T_base_cam, a batch of M in the order of travel.
    """
    azimuths, elevations, radii = [], [], []
    for row, part in enumerate(np.linspace(0.0, 1.0, rows)):
        elevation = elevation_deg[0] + part * (elevation_deg[1] - elevation_deg[0])
        span = abs(azimuth_deg[1] - azimuth_deg[0]) * np.cos(np.deg2rad(elevation))
        sweep = np.linspace(*azimuth_deg, 2 + int(span / step_deg))
        azimuths.append(sweep[::-1] if row % 2 else sweep)
        elevations.append(np.full(len(sweep), elevation))
        radii.append(np.full(len(sweep), radius[0] + part * (radius[1] - radius[0])))
    azimuth, elevation_rad = np.deg2rad(np.concatenate(azimuths)), np.deg2rad(np.concatenate(elevations))
    return _on_sphere(centre, np.concatenate(radii), azimuth, elevation_rad)


def board_visibility(
    T_base_cam: SE3, T_base_board: SE3, board_size: tuple[float, float], intrinsics: Intrinsics
) -> Floats:
    """(M,) the fraction of a board that each of M views has in its image; a single pose gives a single one.

    Args:
        T_base_cam: the views.
        T_base_board: as for `hand_eye_views`.
        board_size: width and height, metres.
        intrinsics: of the image.
    """
    grid = np.stack(np.meshgrid(*[np.linspace(0, side, _BOARD_GRID) for side in board_size]), axis=-1)
    points = T_base_board.apply(np.concatenate([grid.reshape(-1, 2), np.zeros((_BOARD_GRID**2, 1))], axis=1))
    T_cam_base = T_base_cam.inverse()
    in_camera = (T_cam_base[:, None] if T_cam_base.batch else T_cam_base).apply(points)
    x, y = np.moveaxis(intrinsics.project(in_camera), -1, 0)  # NaN behind the camera: not in the image
    inside = (x >= 0) & (x <= intrinsics.width - 1) & (y >= 0) & (y <= intrinsics.height - 1)
    return np.asarray(inside.mean(axis=-1))


def seen_cells(T_base_cam: SE3, centre: ArrayLike, sphere: ViewSphere) -> NDArray[np.bool_]:
    """(C,) which cells of the sphere of views about `centre` (3,) the cameras stand in; its mean is the
    coverage."""
    return sphere.count(T_base_cam.translation - np.asarray(centre, dtype=np.float64)) > 0


def rotation_spread_deg(poses: SE3) -> float:
    """The largest rotation between two of the poses, degrees: what a hand-eye calibration lives on."""
    return float(rotation_error_deg(poses[:, None], poses[None, :]).max())


def _on_sphere(centre: ArrayLike, radius: Floats, azimuth: Floats, elevation: Floats) -> SE3:
    level = np.cos(elevation)
    direction = np.stack([level * np.cos(azimuth), level * np.sin(azimuth), np.sin(elevation)], axis=-1)
    centre = np.asarray(centre, dtype=np.float64)
    return look_at(centre + radius[:, None] * direction, centre)


def _tilted(normal: Floats, tilt: float, azimuth: float) -> Floats:
    """The unit vector at an angle to `normal`, radians, in a direction about it."""
    across = np.cross(normal, (1.0, 0.0, 0.0) if abs(normal[0]) < 0.9 else (0.0, 1.0, 0.0))
    across /= np.linalg.norm(across)
    side = np.cos(azimuth) * across + np.sin(azimuth) * np.cross(normal, across)
    return np.asarray(np.cos(tilt) * normal + np.sin(tilt) * side)
