"""Pinhole matrix and lens distortion from views of the board (Zhang's method, robustly refined)."""

from __future__ import annotations

from dataclasses import dataclass, replace

import cv2
import numpy as np
from numpy.typing import NDArray

from calibration.board import BoardSpec
from calibration.bundle import (
    Bools,
    Floats,
    Linearization,
    Observations,
    Solution,
    camera_moved,
    camera_parameters,
    project_with_derivatives,
    solve,
)
from calibration.detection import MIN_CORNERS, Detection
from dataset.errors import CalibrationError
from dataset.intrinsics import Intrinsics
from dataset.transforms import SE3, cross_matrix

MIN_VIEWS = 5
_MIN_TILT_DEG = 10.0
_MAX_FOCAL_SIGMA = 0.005  # of the focal length
_MAX_RMS_PX = 3.0
_SQUARE_PIXELS = 1e-3  # a sensor's pixels are as square as that: fx = fy
_WRONG_ASPECT = 0.01
_DISTINCT_PX = 5.0
_PIXEL_FLOOR = 1e-3
_FOLDS = 5


@dataclass(frozen=True, eq=False)
class IntrinsicsResult:
    """What the views say about the camera; N views went in.

    Attributes:
        intrinsics: at the mosaic's pixel grid.
        covariance: (4 + n, 4 + n) of fx, fy, cx, cy and the n distortion coefficients.
        rms_px: root mean square distance between seen and predicted corners, mosaic pixels, over the views
            used.
        held_out_px: the same for views the parameters had not seen (5-fold).
        view_rms_px: (N,) the same a view.
        used: (N,) False for views rejected as outliers.
        coverage: fraction of an 8x6 grid over the image in which a corner was seen.
        board_aspect, board_aspect_sigma: height over width of the board's squares, which are described as 1,
            as a camera of square pixels sees it.
        T_cam_board: N poses of the board.
        view, pixels, residual_px: (P,), (P, 2), (P, 2) every corner: its view, where seen, predicted - seen.
    """

    intrinsics: Intrinsics
    covariance: Floats
    rms_px: float
    held_out_px: float
    view_rms_px: Floats
    used: Bools
    coverage: float
    board_aspect: float
    board_aspect_sigma: float
    T_cam_board: SE3
    view: NDArray[np.int64]
    pixels: Floats
    residual_px: Floats

    @property
    def sigma(self) -> Floats:
        """(4 + n,) standard deviations of fx, fy, cx, cy, distortion."""
        return np.sqrt(np.diagonal(self.covariance))


def calibrate_intrinsics(
    detections: list[Detection],
    spec: BoardSpec,
    image_size: tuple[int, int],
    distortion_count: int = 5,
) -> IntrinsicsResult:
    """Estimate a camera from N views of one board.

    Args:
        detections: one a view, corners in mosaic pixels.
        spec: the board.
        image_size: (height, width) of the mosaic.
        distortion_count: OpenCV coefficients to estimate: 0, 4, 5 or 8.

    Raises:
        CalibrationError: fewer than 5 (distinct) views, corners outside the image (mixed resolutions), a
            board that was never tilted or whose squares are not square, or corners no lens explains.
    """
    _check_views(detections, spec, image_size)
    observations = Observations.collect(detections, spec)
    state = _initial(observations, image_size, distortion_count)
    used = np.ones(len(detections), bool)
    state, solution = _refine(state, observations)
    view_rms = observations.view_rms(solution.residual)
    # A view is an outlier when it fits several times worse than the others: motion blur, a bent board, a
    # wrong focus.
    limit = 3.0 * np.median(view_rms) + 0.05
    if (view_rms > limit).any() and np.count_nonzero(view_rms <= limit) >= MIN_VIEWS:
        used = view_rms <= limit
        kept = observations.take(used)
        refit, solution = _refine(state.take(used), kept)
        state = replace(state, K=refit.K, distortion=refit.distortion)
        state = state.with_poses_of(refit, used)
    intrinsics = Intrinsics(state.K, state.distortion, *image_size)
    residual = state.linearize(observations).residual
    corner_used = used[observations.view]
    rms = float(np.sqrt(np.mean(np.sum(residual[corner_used] ** 2, axis=1))))
    aspect, aspect_sigma = _board_aspect(state.take(used), observations.take(used))
    _check_result(state, solution, rms, used)
    return IntrinsicsResult(
        intrinsics=intrinsics,
        covariance=solution.covariance,
        rms_px=rms,
        held_out_px=_held_out(state.take(used), observations.take(used)),
        view_rms_px=observations.view_rms(residual),
        used=used,
        coverage=_coverage(observations.pixels[corner_used], image_size),
        board_aspect=aspect,
        board_aspect_sigma=aspect_sigma,
        T_cam_board=state.T_cam_board,
        view=observations.view,
        pixels=observations.pixels,
        residual_px=residual,
    )


def board_pose(detection: Detection, spec: BoardSpec, intrinsics: Intrinsics) -> SE3:
    """T_cam_board from one view.

    Raises:
        CalibrationError: the corners admit no pose.
    """
    points = spec.object_points(detection.ids)
    count, rotations, translations, _ = cv2.solvePnPGeneric(
        points, detection.pixels, intrinsics.K, intrinsics.distortion, flags=cv2.SOLVEPNP_IPPE
    )
    if count == 0:
        raise CalibrationError(
            f"board pose: {len(detection)} corners admit no pose; drop this view, or check the board's"
            " description"
        )
    # IPPE returns the better of its two solutions first; a frontal view may need the refinement to settle.
    best: tuple[float, SE3] | None = None
    for rotation, translation in zip(rotations, translations, strict=True):
        r, t = cv2.solvePnPRefineLM(
            points, detection.pixels, intrinsics.K, intrinsics.distortion, rotation, translation
        )
        pose = SE3.from_rotvec(r.ravel(), t.ravel())
        error = intrinsics.project(pose.apply(points)) - detection.pixels
        cost = float(np.mean(error**2)) if np.isfinite(error).all() else np.inf
        if best is None or cost < best[0]:
            best = (cost, pose)
    assert best is not None
    return best[1]


@dataclass(frozen=True, eq=False)
class _State:
    """Shared: fx, fy, cx, cy, distortion, the aspect of the board. Own: its pose in each view."""

    K: Floats
    distortion: Floats
    T_cam_board: SE3
    aspect: float = 1.0

    @property
    def deviation(self) -> Floats:
        return np.zeros((len(self.T_cam_board), 6))

    @property
    def shared_deviation(self) -> Floats:
        """Against a prior about zero: only differences of parameters have one."""
        return np.append(camera_parameters(self.K, self.distortion), self.aspect - 1.0)

    def free(self, aspect: bool = False) -> Bools:
        """(S,) the camera, and the board's aspect if asked for."""
        free = np.ones(5 + len(self.distortion), bool)
        free[-1] = aspect
        return free

    def linearize(self, observations: Observations) -> Linearization:
        pose = self.T_cam_board[observations.view]
        board = observations.board * [1.0, self.aspect, 1.0]
        points = pose.apply(board)
        predicted, by_point, by_camera = project_with_derivatives(points, self.K, self.distortion)
        by_twist = np.concatenate(
            [np.broadcast_to(np.eye(3), (len(points), 3, 3)), -cross_matrix(board)], axis=2
        )
        by_board = by_point @ pose.rotation
        by_aspect = by_board[..., 1:2] * observations.board[:, 1, None, None]
        return Linearization(
            predicted - observations.pixels,
            np.concatenate([by_camera, by_aspect], axis=2),
            by_board @ by_twist,
        )

    def moved(self, shared: Floats, own: Floats) -> _State:
        K, distortion = camera_moved(self.K, self.distortion, shared[:-1])
        return _State(K, distortion, self.T_cam_board @ SE3.exp(own), self.aspect + float(shared[-1]))

    def take(self, views: Bools) -> _State:
        return replace(self, T_cam_board=self.T_cam_board[views])

    def with_poses_of(self, other: _State, where: Bools) -> _State:
        rotation, translation = self.T_cam_board.rotation.copy(), self.T_cam_board.translation.copy()
        rotation[where], translation[where] = other.T_cam_board.rotation, other.T_cam_board.translation
        return replace(self, T_cam_board=SE3(rotation, translation))


def _initial(observations: Observations, image_size: tuple[int, int], distortion_count: int) -> _State:
    views = [observations.view == v for v in range(observations.view_count)]
    board = [observations.board[v].astype(np.float32) for v in views]
    pixels = [observations.pixels[v].astype(np.float32) for v in views]
    K = np.asarray(cv2.initCameraMatrix2D(board, pixels, image_size[::-1], 0), np.float64)
    if not (np.isfinite(K).all() and 0.1 < K[0, 0] / image_size[1] < 20 and K[1, 1] > 0):
        raise CalibrationError(
            "intrinsics: the views do not determine a focal length; record views with the board tilted"
            " by 20-40 degrees about both of its axes"
        )
    camera = Intrinsics(K, np.zeros(0), *image_size)
    poses = [_pose_of(observations, v, camera) for v in views]
    return _State(K, np.zeros(distortion_count), SE3.stack(poses))


def _pose_of(observations: Observations, corners: Bools, camera: Intrinsics) -> SE3:
    ok, rotation, translation = cv2.solvePnP(
        observations.board[corners], observations.pixels[corners], camera.K, camera.distortion
    )
    if not ok:
        raise CalibrationError(
            "intrinsics: a view's corners admit no pose; check squares_x and squares_y of the board"
        )
    return SE3.from_rotvec(rotation.ravel(), translation.ravel())


def _refine(
    state: _State, observations: Observations, aspect: bool = False, information: Floats | None = None
) -> tuple[_State, Solution]:
    """Solve, take the corners' noise from the residuals, and solve again with it."""
    free = state.free(aspect)
    no_prior = np.full((observations.view_count, 6), np.inf)
    pixel_sigma = 1.0
    for _ in range(3):
        state, solution = solve(state, observations, pixel_sigma, no_prior, free, information)
        freedom = 2 * len(observations.view) - np.count_nonzero(free) - 6 * observations.view_count
        pixel_sigma = max(solution.pixel_noise(freedom), _PIXEL_FLOOR)
    return solve(state, observations, pixel_sigma, no_prior, free, information)


def _board_aspect(state: _State, observations: Observations) -> tuple[float, float]:
    """The board's aspect and its standard deviation: what a camera with square pixels makes of it.

    Raises:
        CalibrationError: the squares are not square, and that explains the pictures.
    """
    information = np.zeros((len(state.free()), len(state.free())))
    information[:2, :2] = np.array([[1, -1], [-1, 1]]) / (_SQUARE_PIXELS * state.K[0, 0]) ** 2
    found, solution = _refine(state, observations, True, information)
    sigma = float(np.sqrt(solution.covariance[-1, -1]))
    rms = float(np.sqrt(np.mean(np.sum(solution.residual**2, axis=1))))
    if abs(found.aspect - 1) > max(_WRONG_ASPECT, 6 * sigma) and rms < _MAX_RMS_PX:
        raise CalibrationError(
            f"intrinsics: the board's squares are {found.aspect:.3f} times as high as wide; it was stretched"
            " by the printer: print it at 100 %, without fitting to the page, and measure both directions"
        )
    return found.aspect, sigma


def _held_out(state: _State, observations: Observations) -> float:
    """RMS corner error in views left out of the estimate; their board poses are fitted, the camera is not."""
    squares: list[Floats] = []
    views = np.arange(observations.view_count)
    for fold in range(min(_FOLDS, observations.view_count)):
        test = views % _FOLDS == fold
        if np.count_nonzero(~test) < MIN_VIEWS - 1:
            continue
        trained, _ = _refine(state.take(~test), observations.take(~test))
        unseen = observations.take(test)
        posed = replace(trained, T_cam_board=state.T_cam_board[test])
        frozen = np.zeros(len(state.free()), bool)
        _, solution = solve(posed, unseen, 0.1, np.full((unseen.view_count, 6), np.inf), frozen)
        squares.append(np.sum(solution.residual**2, axis=1))
    return float(np.sqrt(np.mean(np.concatenate(squares)))) if squares else float("nan")


def _coverage(pixels: Floats, image_size: tuple[int, int]) -> float:
    height, width = image_size
    cells, _, _ = np.histogram2d(pixels[:, 1], pixels[:, 0], bins=(6, 8), range=((0, height), (0, width)))
    return float(np.mean(cells > 0))


def _check_views(detections: list[Detection], spec: BoardSpec, image_size: tuple[int, int]) -> None:
    if len(detections) < MIN_VIEWS:
        raise CalibrationError(
            f"intrinsics: {len(detections)} views show the board; at least {MIN_VIEWS} are needed, 15-25"
            " are good"
        )
    height, width = image_size
    for index, detection in enumerate(detections):
        if len(detection) < MIN_CORNERS or not np.isfinite(detection.pixels).all():
            raise CalibrationError(
                f"intrinsics: view {index} has fewer than {MIN_CORNERS} finite corners; drop it"
            )
        if (detection.pixels < -0.5).any() or (detection.pixels > [width - 0.5, height - 0.5]).any():
            raise CalibrationError(
                f"intrinsics: view {index} has corners outside a {width}x{height} image; all views must come"
                " from one camera at one resolution"
            )
    distinct = _distinct_views(detections, spec)
    if distinct < MIN_VIEWS:
        raise CalibrationError(
            f"intrinsics: only {distinct} of {len(detections)} views differ by more than {_DISTINCT_PX:g} px;"
            " the same view repeated adds nothing: move and tilt the board (or the camera) between views"
        )


def _distinct_views(detections: list[Detection], spec: BoardSpec) -> int:
    seen: list[Floats] = []
    for detection in detections:
        corners = np.full((spec.corner_count, 2), np.nan)
        spec.object_points(detection.ids)  # an id of another board must not pass as an index
        corners[detection.ids] = detection.pixels
        distances = [np.linalg.norm(corners - other, axis=1) for other in seen]
        if all(np.isnan(d).all() or np.nanmedian(d) > _DISTINCT_PX for d in distances):
            seen.append(corners)
    return len(seen)


def _check_result(state: _State, solution: Solution, rms: float, used: Bools) -> None:
    if not rms < _MAX_RMS_PX:
        raise CalibrationError(
            f"intrinsics: corners are {rms:.1f} px from any lens' prediction; is the board flat, and"
            " described correctly (squares_x, squares_y, marker_m / square_m)?"
        )
    normals = state.T_cam_board[used].rotation[..., 2]
    tilt = np.degrees(np.arccos(np.clip((normals @ normals.T).min(), -1, 1)))
    if tilt < _MIN_TILT_DEG:
        raise CalibrationError(
            f"intrinsics: the board's tilt varies by only {tilt:.1f} degrees, so focal length and distance"
            " cannot be told apart; record views tilted by 20-40 degrees about both axes"
        )
    sigma = np.sqrt(np.diagonal(solution.covariance)[:2]) / np.diagonal(state.K)[:2]
    if not (sigma < _MAX_FOCAL_SIGMA).all():
        raise CalibrationError(
            f"intrinsics: the focal length is known to only {100 * sigma.max():.1f} %; add views with"
            " stronger tilt and closer to the image's borders"
        )
