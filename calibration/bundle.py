"""Least squares over many views of the board: a few parameters shared by all views, a few of each view's own.

Intrinsics (shared: K and distortion; own: the board's pose) and hand-eye (shared: the two unknown transforms;
own: where the arm really was) have this shape, so both are solved here: Levenberg-Marquardt with the views'
parameters eliminated by the Schur complement, which costs a 6x6 inverse a view however many views there are
and gives the shared parameters' marginal covariance for nothing. Triggs et al., "Bundle adjustment", 2000,
sec. 6.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol, TypeVar

import cv2
import numpy as np
from numpy.typing import NDArray

from calibration.board import BoardSpec
from calibration.detection import Detection

Floats = NDArray[np.float64]
Bools = NDArray[np.bool_]

_ROBUST_AT_SIGMA = 3.0
_GAUSSIAN_SHRINKAGE = 0.8449
"""Mean of weight * r^2 / sigma^2 over Gaussian corners: 1/4 of the integral of x exp(-x/2) / sqrt(1 +
x/9)."""
_MAX_STEPS = 60
_FX_FY_CX_CY = ([0, 1, 0, 1], [0, 1, 2, 2])


@dataclass(frozen=True, eq=False)
class Observations:
    """All corners of all views in one table, sorted by view.

    Attributes:
        view: (P,) i64, which of the ``view_count`` views a corner belongs to; every view has one at least.
        board: (P, 3) the corner on the board, metres.
        pixels: (P, 2) where it was seen.
    """

    view: NDArray[np.int64]
    board: Floats
    pixels: Floats
    view_count: int

    @staticmethod
    def collect(detections: list[Detection], spec: BoardSpec) -> Observations:
        """From one detection a view."""
        return Observations(
            view=np.repeat(np.arange(len(detections)), [len(d) for d in detections]),
            board=np.concatenate([spec.object_points(d.ids) for d in detections]),
            pixels=np.concatenate([d.pixels for d in detections]),
            view_count=len(detections),
        )

    def take(self, views: Bools | NDArray[np.intp]) -> Observations:
        """Some of the views, renumbered without gaps: a mask (view_count,), or indices in the order wanted,
        one of which may come more than once."""
        views = np.flatnonzero(views) if views.dtype == np.bool_ else np.asarray(views, np.intp)
        starts = np.searchsorted(self.view, np.arange(self.view_count + 1))
        corners = np.concatenate([np.arange(starts[v], starts[v + 1]) for v in views])
        renumbered = np.repeat(np.arange(len(views)), starts[views + 1] - starts[views])
        return Observations(renumbered, self.board[corners], self.pixels[corners], len(views))

    def sum_by_view(self, values: Floats) -> Floats:
        """Sums values (P, ...) over each view's corners: (view_count, ...)."""
        starts = np.searchsorted(self.view, np.arange(self.view_count))
        return np.asarray(np.add.reduceat(values, starts, axis=0))

    def view_rms(self, residual: Floats) -> Floats:
        """Root mean square length of the residuals (P, 2) in each view, pixels: (view_count,)."""
        count = np.bincount(self.view, minlength=self.view_count)
        return np.sqrt(self.sum_by_view(np.sum(residual**2, axis=1)) / count)


@dataclass(frozen=True, eq=False)
class Linearization:
    """Residuals (P, 2) = predicted - seen, and their derivatives by the shared (P, 2, S) and own (P, 2, L)
    parameters."""

    residual: Floats
    by_shared: Floats
    by_own: Floats


S = TypeVar("S", bound="State")


class State(Protocol):
    """A set of parameter values that can be linearized and moved."""

    @property
    def deviation(self) -> Floats:
        """(view_count, L): how far each view's own parameters are from where the prior expects them."""

    @property
    def shared_deviation(self) -> Floats:
        """(S,) how far the shared parameters are from where their prior expects them."""

    def linearize(self, observations: Observations) -> Linearization:
        """Residuals and derivatives at these values."""

    def moved(self: S, shared: Floats, own: Floats) -> S:
        """The state after a step: shared (S,), own (view_count, L)."""


@dataclass(frozen=True, eq=False)
class Solution:
    """Where the solver stopped.

    Attributes:
        residual: (P, 2) pixels.
        weight: (P,) robust weight in (0, 1] of every corner.
        reduced_normal: (S, S) information about ALL shared parameters, the views' own eliminated.
        covariance: (F, F) of the free shared parameters.
        own_covariance: (view_count, L, L) marginal covariance of the views' own parameters.
    """

    residual: Floats
    weight: Floats
    reduced_normal: Floats
    covariance: Floats
    own_covariance: Floats

    def pixel_noise(self, freedom: float) -> float:
        """Standard deviation of a corner's coordinate, pixels, from the residuals and the degrees of freedom
        left. Holds for robust solutions."""
        squares = np.sum(self.weight[:, None] * self.residual**2) / _GAUSSIAN_SHRINKAGE
        return float(np.sqrt(squares / max(freedom, 1.0)))


def solve(
    state: S,
    observations: Observations,
    pixel_sigma: float,
    own_sigma: Floats,
    free: Bools,
    shared_information: Floats | None = None,
) -> tuple[S, Solution]:
    """Minimise the corners' whitened residuals plus the views' whitened deviations from their prior.

    Corners count by the soft-L1 loss, so that a misplaced one does not pull; deviations by their square.

    Args:
        state: where to start.
        pixel_sigma: standard deviation of a corner's coordinate, pixels.
        own_sigma: (view_count, L) prior of the views' own parameters; inf where there is none.
        free: (S,) which shared parameters may move.
        shared_information: (S, S) of a prior on the shared parameters; none when None.

    Returns:
        The state at the minimum, and residuals and covariances there.
    """
    information = np.zeros((len(free), len(free))) if shared_information is None else shared_information
    problem = _Problem(observations, pixel_sigma, own_sigma**-2.0, free, information)
    normal = problem.build(state)
    damping = 1e-4
    for _ in range(_MAX_STEPS):
        shared, own, predicted = problem.step(normal, damping)
        trial = state.moved(shared, own)
        trial_normal = problem.build(trial)
        if np.isfinite(trial_normal.cost) and trial_normal.cost <= normal.cost:
            gain = normal.cost - trial_normal.cost
            state, normal, damping = trial, trial_normal, max(damping * 0.1, 1e-12)
            if gain < 1e-9 * (1.0 + normal.cost):
                break
        else:
            damping *= 10.0
            if damping > 1e8 or predicted < 1e-9 * (1.0 + normal.cost):
                break
    return state, problem.solution(normal)


def jackknife_variance(
    state: State,
    observations: Observations,
    pixel_sigma: float,
    own_sigma: Floats,
    free: Bools,
    shared_information: Floats,
    groups: int,
) -> Floats:
    """(F,) variances of the free shared parameters at a minimum, from leaving out one stretch of views after
    the other (the block jackknife, Künsch 1989), to first order.

    Unlike `Solution.covariance` it takes the views of a stretch for dependent: an arm's error is much the
    same from one view to the next. Few groups widen it as Student's t does.

    Args:
        state, observations, pixel_sigma, own_sigma, free, shared_information: as in `solve`; the views in the
            order they were taken.
        groups: how many stretches.
    """
    problem = _Problem(observations, pixel_sigma, own_sigma**-2.0, free, shared_information)
    information, gradient = problem.by_view(state)
    prior = shared_information[np.ix_(free, free)]
    total = information.sum(axis=0) + prior
    moved = []
    for stretch in np.array_split(np.arange(observations.view_count), groups):
        rest = total - information[stretch].sum(axis=0)
        moved.append(solve_scaled(rest, gradient[stretch].sum(axis=0)))
    spread = np.sum((np.stack(moved) - np.mean(moved, axis=0)) ** 2, axis=0) * (groups - 1) / groups
    inverse = _inverse_scaled(total)
    by_prior = np.diagonal(inverse @ prior @ inverse)
    return np.asarray(spread * (groups - 1) / (groups - 3) + by_prior)


@dataclass(frozen=True, eq=False)
class _Normal:
    """The arrowhead normal equations at one state."""

    cost: float
    residual: Floats
    weight: Floats
    shared: Floats
    own: Floats
    cross: Floats
    gradient_shared: Floats
    gradient_own: Floats


@dataclass(frozen=True, eq=False)
class _Problem:
    observations: Observations
    pixel_sigma: float
    own_information: Floats
    free: Bools
    shared_information: Floats

    def build(self, state: State) -> _Normal:
        linear = state.linearize(self.observations)
        square = np.sum(linear.residual**2, axis=1) / self.pixel_sigma**2
        scaled = square / _ROBUST_AT_SIGMA**2
        weight = 1.0 / np.sqrt(1.0 + scaled)
        loss = 2.0 * _ROBUST_AT_SIGMA**2 * (np.sqrt(1.0 + scaled) - 1.0)
        information = weight / self.pixel_sigma**2
        by_view = self.observations.sum_by_view
        own_T = np.swapaxes(linear.by_own, 1, 2) * information[:, None, None]
        shared_T = np.swapaxes(linear.by_shared, 1, 2) * information[:, None, None]
        residual = linear.residual[..., None]
        deviation = state.deviation
        shared_deviation = state.shared_deviation
        shared_pull = self.shared_information @ shared_deviation
        shared_cost = float(shared_deviation @ shared_pull)
        return _Normal(
            cost=float(loss.sum() + np.sum(self.own_information * deviation**2)) + shared_cost,
            residual=linear.residual,
            weight=weight,
            shared=np.sum(shared_T @ linear.by_shared, axis=0) + self.shared_information,
            own=by_view(own_T @ linear.by_own)
            + self.own_information[:, :, None] * np.eye(self.own_information.shape[1]),
            cross=by_view(own_T @ linear.by_shared),
            gradient_shared=np.sum(shared_T @ residual, axis=0)[:, 0] + shared_pull,
            gradient_own=by_view(own_T @ residual)[..., 0] + self.own_information * deviation,
        )

    def by_view(self, state: State) -> tuple[Floats, Floats]:
        """Information (V, F, F) and gradient (V, F) that each view contributes on the free shared parameters,
        its own eliminated. At a minimum, where the own gradients vanish."""
        linear = state.linearize(self.observations)
        scaled = np.sum(linear.residual**2, axis=1) / (self.pixel_sigma * _ROBUST_AT_SIGMA) ** 2
        information = (1.0 / np.sqrt(1.0 + scaled) / self.pixel_sigma**2)[:, None, None]
        shared = linear.by_shared[..., self.free]
        shared_T = np.swapaxes(shared, 1, 2) * information
        own_T = np.swapaxes(linear.by_own, 1, 2) * information
        sums = self.observations.sum_by_view
        own = sums(own_T @ linear.by_own)
        own += self.own_information[:, :, None] * np.eye(self.own_information.shape[1])
        cross = sums(own_T @ shared)
        left = sums(shared_T @ shared) - np.swapaxes(cross, 1, 2) @ np.linalg.solve(own, cross)
        return left, sums(shared_T @ linear.residual[..., None])[..., 0]

    def step(self, normal: _Normal, damping: float) -> tuple[Floats, Floats, float]:
        """Shared and own step, and the decrease of the cost the linear model predicts."""
        free = self.free
        own = _damped(normal.own, damping)
        shared = _damped(normal.shared[np.ix_(free, free)], damping)
        cross = normal.cross[:, :, free]
        eliminated = np.linalg.solve(own, np.concatenate([cross, normal.gradient_own[..., None]], axis=2))
        reduced = shared - np.einsum("vls,vlt->st", cross, eliminated[..., :-1])
        gradient = normal.gradient_shared[free] - np.einsum("vls,vl->s", cross, eliminated[..., -1])
        step_free = -solve_scaled(reduced, gradient)
        step_own = -eliminated[..., -1] - eliminated[..., :-1] @ step_free
        step_shared = np.zeros(len(free))
        step_shared[free] = step_free
        predicted = -float(step_free @ normal.gradient_shared[free] + np.sum(step_own * normal.gradient_own))
        return step_shared, step_own, predicted

    def solution(self, normal: _Normal) -> Solution:
        own_inverse = np.linalg.pinv(normal.own, hermitian=True)
        gain = own_inverse @ normal.cross
        reduced = normal.shared - np.einsum("vls,vlt->st", normal.cross, gain)
        covariance = _inverse_scaled(reduced[np.ix_(self.free, self.free)])
        gain = gain[:, :, self.free]
        own_covariance = own_inverse + gain @ covariance @ np.swapaxes(gain, 1, 2)
        return Solution(normal.residual, normal.weight, reduced, covariance, own_covariance)


def _damped(matrix: Floats, damping: float) -> Floats:
    diagonal = np.einsum("...ii->...i", matrix)
    return matrix + (damping * diagonal + 1e-12)[..., None] * np.eye(matrix.shape[-1])


def _inverse_scaled(matrix: Floats) -> Floats:
    scale = 1.0 / np.sqrt(np.maximum(np.diagonal(matrix), 1e-300))
    return (
        np.linalg.pinv(matrix * scale[:, None] * scale, rcond=1e-14, hermitian=True) * scale[:, None] * scale
    )


def solve_scaled(matrix: Floats, vector: Floats) -> Floats:
    """x (S,) with matrix (S, S) x = vector (S,); along what a singular matrix leaves open x is zero."""
    # Focal lengths (1e3) beside distortion coefficients (1e-2): equilibrate before solving.
    scale = 1.0 / np.sqrt(np.maximum(np.diagonal(matrix), 1e-300))
    return scale * np.linalg.lstsq(matrix * scale[:, None] * scale, scale * vector, rcond=1e-14)[0]


def camera_parameters(K: Floats, distortion: Floats) -> Floats:
    """(4 + n,) fx, fy, cx, cy and the n distortion coefficients, ordered as in a camera's covariance."""
    return np.concatenate([K[_FX_FY_CX_CY], distortion])


def camera_moved(K: Floats, distortion: Floats, step: Floats) -> tuple[Floats, Floats]:
    """K and distortion after a step (4 + n,) of the `camera_parameters`."""
    moved = K.copy()
    moved[_FX_FY_CX_CY] += step[:4]
    return moved, distortion + step[4:]


def project_with_derivatives(points: Floats, K: Floats, distortion: Floats) -> tuple[Floats, Floats, Floats]:
    """Camera-frame points (P, 3) to pixels (P, 2), with derivatives by the point (P, 2, 3) and by
    fx, fy, cx, cy and the n distortion coefficients (P, 2, 4 + n)."""
    pixels, J = cv2.projectPoints(points[:, None], np.zeros(3), np.zeros(3), K, distortion)
    # Columns of OpenCV's Jacobian: rotation 3, translation 3 (the point's own, at zero rotation), f 2, c 2,
    # distortion.
    J = J.reshape(len(points), 2, -1)
    by_camera = np.asarray(J[..., 6 : 10 + len(distortion)], np.float64)
    return np.asarray(pixels[:, 0], np.float64), np.asarray(J[..., 3:6], np.float64), by_camera
