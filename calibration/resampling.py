"""How much a hand-eye result hangs on the views it happened to get: the bootstrap over views."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from calibration.bundle import Floats
from calibration.hand_eye import HandEyeResult

DRAWS = 100
_LEVEL = 95.0
_SEED = 0  # the same views give the same intervals again


@dataclass(frozen=True, eq=False)
class Intervals:
    """95 % intervals of T_mount_cam as twists [rho, phi] (m, rad) on the right of the estimate, (6,) each."""

    low: Floats
    high: Floats

    @property
    def half_mm(self) -> Floats:
        """(3,) half the width in position, millimetres."""
        return 500.0 * (self.high - self.low)[:3]

    @property
    def half_deg(self) -> Floats:
        """(3,) half the width in rotation, degrees."""
        return np.degrees(0.5 * (self.high - self.low)[3:])


def bootstrap(result: HandEyeResult, draws: int = DRAWS) -> Intervals:
    """Percentile intervals from ``draws`` recordings drawn from the views with replacement.

    Unlike the covariance they assume no model of the noise. The spread is widened by sqrt(n / (n - 2)), the
    usual correction of two poses' worth of unknowns in n views (Efron & Tibshirani 1993, sec. 5.3).
    """
    rng = np.random.default_rng(_SEED)
    count = result.observations.view_count
    apart = np.empty((draws, 6))
    for draw in range(draws):
        views = np.sort(rng.integers(0, count, count))
        state, _ = result.fit.again(result.fit.state.take(views), result.observations.take(views))
        apart[draw] = (result.T_mount_cam.inverse() @ state.T_mount_cam).log()
    apart *= np.sqrt(count / (count - 2.0))
    low, high = np.percentile(apart, (50 - _LEVEL / 2, 50 + _LEVEL / 2), axis=0)
    return Intervals(low, high)
