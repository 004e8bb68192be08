"""What about a result a user should look at, in words: the report, calibration.json and the command line say
it."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from calibration.hand_eye import HandEyeResult
from calibration.intrinsics import IntrinsicsResult

_ODD = 1e-3
_SIGMAS = 3.0
_LITTLE_COVERED = 0.6
_MOST_NAMED = 12


def of_intrinsics(result: IntrinsicsResult, frames: Sequence[int]) -> tuple[str, ...]:
    """Views left out, squares that are not quite square, parts of the image that no corner was seen in.

    Args:
        result: of N views.
        frames: (N,) the session's frame of every view.
    """
    found = _left_out(result.used, result.view_rms_px, frames)
    aspect = result.board_aspect
    if abs(aspect - 1) > max(_ODD, _SIGMAS * result.board_aspect_sigma):
        found.append(
            f"the board's squares are {aspect:.4f} times as high as wide; measure the print both ways"
        )
    if result.coverage < _LITTLE_COVERED:
        found.append(
            f"corners were seen in {100 * result.coverage:.0f} % of the image only; where there are none the"
            " lens is extrapolated"
        )
    return tuple(found)


def of_hand_eye(result: HandEyeResult, frames: Sequence[int]) -> tuple[str, ...]:
    """Views left out, and a board whose size is not quite the one described.

    Args:
        result: of N views.
        frames: (N,) the session's frame of every view.
    """
    found = _left_out(result.used, result.view_rms_px, frames)
    scale = result.board_scale
    if abs(scale - 1) > max(_ODD, _SIGMAS * result.board_scale_sigma):
        found.append(
            f"measured by the arm's motion the board is {100 * (scale - 1):+.2f} % off the size described;"
            " measure it over many squares and correct square_m"
        )
    return tuple(found)


def _left_out(used: NDArray[np.bool_], rms_px: NDArray[np.float64], frames: Sequence[int]) -> list[str]:
    left_out = np.flatnonzero(~used)
    if len(left_out) == 0:
        return []
    named = ", ".join(f"{frames[i]} ({rms_px[i]:.2g} px)" for i in left_out[:_MOST_NAMED])
    more = f" and {len(left_out) - _MOST_NAMED} more" if len(left_out) > _MOST_NAMED else ""
    usual = float(np.median(rms_px[used]))
    return [f"left out as outliers, against {usual:.2g} px of the others: frame {named}{more}"]
