"""What touched points leave open about an object's pose: its covariance, and the open directions in words."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from calibration.surface_fit import Surface, coarse_fit, jacobian
from calibration.words import axis_name
from dataset.transforms import SE3

Floats = NDArray[np.float64]

_TURN_STEPS = 12
_SAME_FIT = 2.0
_TURN_SLIP_RAD = np.radians(4.0)
_SAME_TURN_RAD = np.radians(12.0)
_UNOBSERVABLE_RAD = np.radians(3.0)
_UNOBSERVABLE_M = 5e-3
_OPEN = 0.5
"""A direction whose standard deviation is half of "anywhere on the object" is not determined at all."""


@dataclass(frozen=True, eq=False)
class Tip:
    """The tip that touched.

    Attributes:
        ball_m: its radius, metres; 0 for a point.
        covariance: (3, 3) of its place in the tool's frame, metres squared: an error that all touches share.
        rotation: (n, 3, 3) of the tool in the base frame at every touch; None where it is not known, and the
            covariance is then not accounted for.
    """

    ball_m: float = 0.0
    covariance: Floats = field(default_factory=lambda: np.zeros((3, 3)))
    rotation: Floats | None = None


@dataclass(frozen=True, eq=False)
class Openness:
    """How well a pose is determined.

    Attributes:
        covariance: (6, 6) of the twist [rho, phi] (m, rad) in T_base_obj @ exp(twist).
        by_tip: (6, 6) what of it is the tip's error, which all touches with that tip share.
        weak: (6,) the twist constrained least, and `open_directions` how many are not constrained at all.
    """

    covariance: Floats
    by_tip: Floats
    weak: Floats
    open_directions: int


def openness(
    in_obj: Floats, normals: Floats, pose: SE3, noise: float, freedom: int, surface: Surface, tip: Tip
) -> Openness:
    """The covariance of a fit.

    Args:
        in_obj: (n, 3) points in the object's frame, at the pose fitted.
        normals: (n, 3) directions in which their distances grow.
        pose: fitted.
        noise: standard deviation of a distance.
        freedom: degrees of freedom it was estimated with: few of them widen the result as Student's t does.
        surface, tip: what was touched, and with what.
    """
    radius = surface.radius
    J = jacobian(in_obj, normals, radius)
    values, vectors = np.linalg.eigh(J.T @ J)
    wide = noise**2 * (freedom / (freedom - 2) if freedom > 2 else 3.0)
    # Nothing is less certain than "anywhere on the object".
    variance = np.minimum(wide / np.maximum(values, 1e-12), radius**2)
    covariance = (vectors * variance) @ vectors.T
    by_tip = np.zeros((6, 6))
    if tip.rotation is not None:
        inverse = (vectors * np.where(variance < radius**2, 1 / np.maximum(values, 1e-12), 0.0)) @ vectors.T
        touch_by_tip = np.einsum("ni,ij,njk->nk", normals, pose.rotation.T, tip.rotation)
        carried = inverse @ J.T @ touch_by_tip
        by_tip = carried @ tip.covariance @ carried.T
    to_si = np.diag([1.0, 1.0, 1.0, 1 / radius, 1 / radius, 1 / radius])
    return Openness(
        to_si @ (covariance + by_tip) @ to_si,
        to_si @ by_tip @ to_si,
        to_si @ vectors[:, 0],
        int(np.count_nonzero(np.sqrt(variance) > _OPEN * radius)),
    )


def turns_that_fit(
    points: Floats, surface: Surface, pose: SE3, weak: Floats, noise: float
) -> tuple[Floats, Floats]:
    """Angles (deg) about the weakest twist's screw axis at which the points still lie on the surface, and
    that axis as a twist of 1 rad."""
    angle = np.linalg.norm(weak[3:])
    if angle * surface.radius < 0.3 * np.linalg.norm(weak[:3] + np.cross(weak[3:], surface.centre)):
        return np.zeros(0), weak  # the weakest motion is a shift: turning is not what is in doubt
    turn = _pure_turn(weak / angle)
    degrees = np.arange(5.0, 360.0, 5.0)
    fits = np.zeros(len(degrees), bool)
    # The eigenvector gives the axis only roughly: every turned pose is fitted again and counts when it stays
    # turned. What those fits have in common is a better axis, with which the second round starts.
    for _ in range(2):
        turned = pose @ SE3.exp(np.radians(degrees)[:, None] * turn)
        fitted, _ = coarse_fit(points, surface, turned, _TURN_STEPS)
        slipped = np.linalg.norm((turned.inverse() @ fitted).as_rotvec(), axis=1) > _TURN_SLIP_RAD
        in_obj = fitted.inverse()[:, None].apply(points).reshape(-1, 3)
        distance = surface.signed(in_obj)[0].reshape(len(degrees), -1)
        fits = (np.sqrt(np.mean(distance**2, axis=1)) < _SAME_FIT * noise) & ~slipped
        if not fits.any():
            break
        twists = (pose.inverse() @ fitted[fits]).log()
        twists *= np.sign(twists[:, 3:] @ turn[3:])[:, None]  # beyond half a turn the logarithm turns back
        mean = twists.sum(axis=0)
        turn = _pure_turn(mean / np.linalg.norm(mean[3:]))
    return degrees[fits], turn


def _known(angles_deg: Floats, turn: Floats, symmetry_turns: SE3 | None) -> NDArray[np.bool_]:
    """(K,) whether the object turned so far about an axis is one of its symmetries, or nearly."""
    turned = SE3.exp(np.radians(angles_deg)[:, None] * turn)
    known = np.zeros(len(angles_deg), bool)
    for symmetry in () if symmetry_turns is None else symmetry_turns:
        known |= np.linalg.norm((symmetry.inverse() @ turned).as_rotvec(), axis=1) < _SAME_TURN_RAD
    return known


def _pure_turn(twist: Floats) -> Floats:
    """The twist without its sliding along its own axis."""
    axis = twist[3:] / np.linalg.norm(twist[3:])
    return np.concatenate([twist[:3] - axis * (axis @ twist[:3]), twist[3:]])


def describe(
    found: Openness,
    turn: Floats,
    ambiguity: Floats,
    symmetry_axis: Floats | None,
    symmetry_turns: SE3 | None,
    radius: float,
) -> tuple[Floats, tuple[str, ...]]:
    """Words for what is not determined, and the covariance with a full turn's variance where that is open.

    Args:
        found: the fit's.
        turn, ambiguity: of `turns_that_fit`.
        symmetry_axis: of a body of revolution: a turn about it is no defect of the points.
        symmetry_turns: n other motions that leave the object looking the same.
        radius: of the object.
    """
    covariance = found.covariance
    words: list[str] = []
    axis = turn[3:] / max(float(np.linalg.norm(turn[3:])), 1e-12)
    rolled = len(ambiguity) >= 57  # of 71
    if rolled:
        covariance = covariance + np.pi**2 / 3 * np.outer(turn, turn)
        known = symmetry_axis is not None and abs(axis @ symmetry_axis) > 0.98 * np.linalg.norm(symmetry_axis)
        if not known:
            words.append(f"rotation about the object's {axis_name(axis)} axis (every turn fits the points)")
    else:
        unlike = ambiguity[(ambiguity > 30) & (ambiguity < 330) & ~_known(ambiguity, turn, symmetry_turns)]
        if len(unlike):
            turns = ", ".join(f"{angle:.0f}" for angle in unlike[:6])
            about = axis_name(axis)
            words.append(f"turns of {turns} degrees about the object's {about} axis fit the points too")
    turn_variance, turn_axes = np.linalg.eigh(found.covariance[3:, 3:])
    for variance, about in zip(turn_variance, turn_axes.T, strict=True):
        if variance > _UNOBSERVABLE_RAD**2 and not (rolled and abs(about @ axis) > 0.9):
            words.append(f"rotation about the object's {axis_name(about)} axis (touch points off that axis)")
    shift_variance, shifts = np.linalg.eigh(covariance[:3, :3])
    lever = radius**2 * covariance[3:, 3:].max()  # a turn about an axis off the origin also moves the origin
    if found.open_directions > 1:
        lever = 0.0
    for variance, along in zip(shift_variance, shifts.T, strict=True):
        if variance > _UNOBSERVABLE_M**2 + lever:
            words.append(f"position along the object's {axis_name(along)} axis (touch its two ends)")
    return covariance, tuple(words)
