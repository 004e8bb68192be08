"""How noisy was what? Variances of several error sources from one set of residuals.

Views i give residuals r_i (6,) with covariance C_i = sum_k theta_k Q_ki: the shapes Q_ki are known (what a
millimetre of the arm does to view i), the variances theta_k are not. They are estimated by restricted maximum
likelihood (Patterson & Thompson 1971), which accounts for the unknowns fitted to the same residuals, under a
weak log-normal prior (our choice) that keeps a source finite when the data say nothing of it.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import minimize
from scipy.special import gammaln

Floats = NDArray[np.float64]

PRIOR_LOG_SIGMA = 1.5
"""Standard deviation of a source's log standard deviation about its typical value: a factor of 4.5."""

_LBFGS = {"maxiter": 60}
_REACH = 7.0  # of a log standard deviation: a factor of a thousand, beyond which matrices turn singular
_FLOOR = 1e-14 * np.eye(6)
_TAILS = (3.0, 5.0, 9.0, 20.0, 100.0)  # degrees of freedom of Student's t; 100 is as good as Gaussian


@dataclass(frozen=True, eq=False)
class NoiseSource:
    """One source of error: its shape (N, 6, 6) per unit variance, and its typical standard deviation."""

    name: str
    shape: Floats
    typical_sigma: float


def covariances(sources: list[NoiseSource], sigmas: Floats) -> Floats:
    """(N, 6, 6) covariance of every view's residual for standard deviations (K,)."""
    total = np.zeros_like(sources[0].shape)
    for source, sigma in zip(sources, sigmas, strict=True):
        total += sigma**2 * source.shape
    return total + _FLOOR


def estimate_sigmas(
    residual: Floats, by_unknowns: Floats, weight: Floats, sources: list[NoiseSource], start: Floats
) -> Floats:
    """(K,) standard deviations of the sources.

    Args:
        residual: (N, 6) at some values of the unknowns; need not be the minimum.
        by_unknowns: (N, 6, U) its derivative.
        weight: (N,) of each view; its covariance counts 1 / weight as large.
        sources: K of them.
        start: (K,) standard deviations to start from.
    """
    shapes = np.stack([source.shape for source in sources])
    typical = np.log([source.typical_sigma for source in sources])

    def cost(log_sigma: Floats) -> tuple[float, Floats]:
        """Negative restricted log-likelihood plus prior, and its gradient (Harville 1977, sec. 3)."""
        variance = np.exp(2.0 * log_sigma)
        C = (np.einsum("k,knij->nij", variance, shapes) + _FLOOR) / weight[:, None, None]
        inverse = np.linalg.inv(C)
        whitened = inverse @ by_unknowns
        normal = np.einsum("niu,niv->uv", by_unknowns, whitened)
        scale = 1.0 / np.sqrt(np.maximum(np.diagonal(normal), 1e-300))
        unscaled = normal * scale[:, None] * scale
        normal_inverse = np.linalg.pinv(unscaled, hermitian=True) * scale[:, None] * scale
        fitted = by_unknowns @ (normal_inverse @ np.einsum("niu,ni->u", whitened, residual))
        left = np.einsum("nij,nj->ni", inverse, residual - fitted)
        projection = inverse - whitened @ normal_inverse @ np.swapaxes(whitened, 1, 2)
        logdet = np.linalg.slogdet(unscaled)[1] - 2.0 * np.log(scale).sum()
        value = np.linalg.slogdet(C)[1].sum() + logdet + np.sum((residual - fitted) * left)
        by_variance = np.einsum("nij,knij,n->k", projection, shapes, 1.0 / weight, optimize=True)
        by_variance -= np.einsum("ni,knij,nj,n->k", left, shapes, left, 1.0 / weight, optimize=True)
        off = (log_sigma - typical) / PRIOR_LOG_SIGMA
        gradient = by_variance * variance + off / PRIOR_LOG_SIGMA
        return 0.5 * float(value + off @ off), gradient

    bounds = [(centre - _REACH, centre + _REACH) for centre in typical]
    found = minimize(cost, np.log(start), jac=True, method="L-BFGS-B", bounds=bounds, options=_LBFGS)
    return np.asarray(np.exp(found.x), np.float64)


def student_weights(square: Floats, dimension: int) -> Floats:
    """(N,) weights of views with squared Mahalanobis distances (N,): Student's t with the tails that fit
    them best, so that Gaussian data are not robbed and heavy tails do not pull."""

    def likelihood(nu: float) -> float:
        constant = gammaln((nu + dimension) / 2) - gammaln(nu / 2) - dimension / 2 * np.log(nu)
        return float(len(square) * constant - (nu + dimension) / 2 * np.log1p(square / nu).sum())

    nu = max(_TAILS, key=likelihood)
    return (nu + dimension) / (nu + square)
