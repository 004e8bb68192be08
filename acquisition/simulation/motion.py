"""How the simulated arm gets from one place to another: paths in joint space and their timing.

A path is a fine polyline of joint angles over a path parameter. Its timing is the fastest one that respects a
speed limit at every node and one acceleration along the path, found in a forward and a backward pass; for a
single straight move that is the trapezoidal profile of the real controller. Our choice: the corners of a
blended path are quadratic Bezier curves, and acceleration along the path and across it is limited separately.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import ArrayLike, NDArray

from acquisition.kinematics import (
    JOINT_SPEED_LIMIT,
    forward,
    inverse_all,
    jacobian,
    unwrap_near,
)
from dataset.errors import ToolkitError
from dataset.transforms import SE3

Floats = NDArray[np.float64]

_LINE_NODES = 65  # of a long joint segment; the profile's corners fall between two of them
_LINE_STEP_RAD = 0.01  # a shorter segment needs fewer
_CORNER_NODES = 9
_LINEAR_STEP_M, _LINEAR_STEP_RAD = 0.004, 0.02
_ROTATION_LEVER_M = 0.5  # our choice: turning by one radian counts as half a metre of tool travel
_LARGEST_IK_STEP = 0.35  # rad between neighbouring nodes of a line; beyond it the arm jumps to another branch


class OutOfReach(ToolkitError):
    """The commanded pose or line leaves what the arm can reach."""


class Motion(Protocol):
    """Something that moves the arm, one controller period at a time."""

    def advance(self, q: Floats, qd: Floats, dt: float) -> tuple[Floats, Floats, bool]:
        """From joint angles and rates to those `dt` seconds later, and whether the motion has ended."""


@dataclass
class PathMotion:
    """Travels along nodes `q` (N, 6) at path parameter `u` (N,), passing node i with rate `rate[i]`."""

    u: Floats
    q: Floats
    rate: Floats

    def __post_init__(self) -> None:
        span = np.diff(self.u)
        self._times = np.concatenate([[0.0], np.cumsum(2 * span / (self.rate[:-1] + self.rate[1:]))])
        self._acceleration = np.diff(self.rate**2) / (2 * span)
        self._slope = np.diff(self.q, axis=0) / span[:, None]
        self._elapsed = 0.0

    @property
    def duration_s(self) -> float:
        """Seconds from start to end."""
        return float(self._times[-1])

    def advance(self, q: Floats, qd: Floats, dt: float) -> tuple[Floats, Floats, bool]:
        """See `Motion`; the arm's own state is not used: it is where the path says."""
        self._elapsed += dt
        if self._elapsed >= self._times[-1]:
            return self.q[-1], np.zeros(6), True
        i = int(self._times.searchsorted(self._elapsed, side="right")) - 1
        t, acceleration = self._elapsed - self._times[i], self._acceleration[i]
        travelled = (self.rate[i] + 0.5 * acceleration * t) * t
        slope = self._slope[i]
        return self.q[i] + travelled * slope, (self.rate[i] + acceleration * t) * slope, False


@dataclass
class Stopping:
    """Slows down with the fastest joint decelerating at `deceleration` rad/s^2, the others in proportion."""

    deceleration: float

    def advance(self, q: Floats, qd: Floats, dt: float) -> tuple[Floats, Floats, bool]:
        """See `Motion`."""
        fastest = float(np.abs(qd).max())
        if fastest <= self.deceleration * dt:
            return q, np.zeros(6), True
        slower = qd * (1 - self.deceleration * dt / fastest)
        return q + 0.5 * dt * (qd + slower), slower, False


@dataclass
class JointSpeed:
    """Approaches joint rates `target` (6,), rad/s, at `acceleration`; ends after `duration_s`."""

    target: Floats
    acceleration: float
    duration_s: float

    def advance(self, q: Floats, qd: Floats, dt: float) -> tuple[Floats, Floats, bool]:
        """See `Motion`."""
        new = qd + np.clip(self.target - qd, -self.acceleration * dt, self.acceleration * dt)
        self.duration_s -= dt
        return q + 0.5 * dt * (qd + new), new, self.duration_s <= 0


@dataclass
class ToolSpeed:
    """Moves the flange with a twist (6,) [m/s, rad/s] in the base frame; ends after `duration_s`."""

    twist: Floats
    acceleration: float
    duration_s: float

    def advance(self, q: Floats, qd: Floats, dt: float) -> tuple[Floats, Floats, bool]:
        """See `Motion`."""
        J = jacobian(q)
        rates = J.T @ np.linalg.solve(J @ J.T + 1e-6 * np.eye(6), self.twist)
        joints = JointSpeed(np.clip(rates, -JOINT_SPEED_LIMIT, JOINT_SPEED_LIMIT), 10.0, self.duration_s)
        self.duration_s -= dt
        return joints.advance(q, qd, dt)


@dataclass
class Servo:
    """Follows a joint target that the client keeps moving, as a first-order lag of `lookahead_s`."""

    target: Floats
    lookahead_s: float

    def advance(self, q: Floats, qd: Floats, dt: float) -> tuple[Floats, Floats, bool]:
        """See `Motion`; it never ends by itself."""
        wanted = (self.target - q) / max(self.lookahead_s, 2 * dt)
        new = np.clip(wanted, -JOINT_SPEED_LIMIT, JOINT_SPEED_LIMIT)
        return q + new * dt, new, False


def joint_move(q_start: Floats, q_end: ArrayLike, speed: float, acceleration: float) -> PathMotion | None:
    """A straight line in joint space, the fastest joint at `speed` rad/s; None without a distance."""
    return joint_path(q_start, np.atleast_2d(q_end), [speed], [acceleration], [0.0])


def joint_path(
    q_start: Floats, waypoints: ArrayLike, speeds: ArrayLike, accelerations: ArrayLike, blends_m: ArrayLike
) -> PathMotion | None:
    """A polyline through waypoints (N, 6) with corners rounded within `blends_m` of tool travel.

    `speeds`, rad/s, and `accelerations`, rad/s^2, (N,) belong to the segment that ends at each waypoint. A
    waypoint whose blend is zero is a stop.
    """
    corners = np.vstack([q_start, np.asarray(waypoints, dtype=np.float64)])
    lengths = np.abs(np.diff(corners, axis=0)).max(axis=1)
    moving = np.concatenate([[True], lengths > 1e-9])
    corners = corners[moving]
    if len(corners) < 2:
        return None
    keep = moving[1:]
    speed = np.asarray(speeds, dtype=np.float64)[keep]
    fractions = _blend_fractions(corners, np.asarray(blends_m, dtype=np.float64)[keep])
    nodes, segment, stops = _round_corners(corners, fractions)
    u = np.concatenate([[0.0], np.cumsum(np.abs(np.diff(nodes, axis=0)).max(axis=1))])
    limit = np.minimum(speed, JOINT_SPEED_LIMIT)[segment]
    acceleration = np.asarray(accelerations, dtype=np.float64)[keep][segment]
    tangent = np.diff(nodes, axis=0) / np.diff(u)[:, None]
    bend = np.zeros(len(u))
    bend[1:-1] = np.abs(np.diff(tangent, axis=0)).max(axis=1) / (0.5 * (u[2:] - u[:-2]))
    with np.errstate(divide="ignore"):
        limit = np.minimum(limit, np.sqrt(acceleration / bend))
    limit[stops] = 0.0
    return PathMotion(u, nodes, _fastest_rates(u, limit, acceleration))


def linear_move(
    q_start: Floats, T_base_flange: SE3, T_flange_tcp: SE3, speed: float, acceleration: float
) -> PathMotion | None:
    """A straight line of the tool, at `speed` m/s, to a flange pose.

    Raises:
        OutOfReach: the line leaves the workspace or passes a singularity.
    """
    start, end = forward(q_start) @ T_flange_tcp, T_base_flange @ T_flange_tcp
    distance = float(np.linalg.norm(end.translation - start.translation))
    angle = float(np.linalg.norm((start.inverse() @ end).as_rotvec()))
    length = max(distance, angle * _ROTATION_LEVER_M)
    if length < 1e-9:
        return None
    count = 2 + int(max(distance / _LINEAR_STEP_M, angle / _LINEAR_STEP_RAD, 16))
    line = start.interpolate(end, np.linspace(0, 1, count)) @ T_flange_tcp.inverse()
    nodes = np.empty((count, 6))
    nodes[0] = q_start
    for i, solutions in enumerate(inverse_all(line)[1:], start=1):
        candidates = unwrap_near(solutions, nodes[i - 1])
        step = np.abs(candidates - nodes[i - 1]).max(axis=1)
        if not (step < _LARGEST_IK_STEP).any():
            raise OutOfReach(f"the line leaves the arm's reach after {100 * i / count:.0f} % of the way")
        nodes[i] = candidates[np.nanargmin(step)]
    u = np.linspace(0, length, count)
    slope = np.abs(np.gradient(nodes, u, axis=0)).max(axis=1)
    limit = np.minimum(speed, JOINT_SPEED_LIMIT / np.maximum(slope, 1e-9))
    limit[[0, -1]] = 0.0
    return PathMotion(u, nodes, _fastest_rates(u, limit, np.full(count, acceleration)))


def _blend_fractions(corners: Floats, blends_m: Floats) -> Floats:
    """(N-1, 2) what part of the segments before and after each inner corner its blend takes."""
    position = forward(corners).translation
    travel = np.maximum(np.linalg.norm(np.diff(position, axis=0), axis=1), 1e-6)
    around = np.stack([travel[:-1], travel[1:]], axis=1)
    return np.asarray(np.minimum(blends_m[:-1, None] / around, 0.5))


def _round_corners(corners: Floats, fractions: Floats) -> tuple[Floats, NDArray[np.intp], NDArray[np.intp]]:
    """The fine polyline: its nodes (M, 6), the segment each belongs to, and the nodes where the arm stops."""
    pieces: list[Floats] = [corners[:1]]
    segments: list[NDArray[np.intp]] = [np.zeros(1, dtype=np.intp)]
    stops = [0]
    t = np.linspace(0, 1, _CORNER_NODES)[1:, None]
    count = 1

    def add(nodes: Floats, segment: int) -> None:
        nonlocal count
        steps = np.abs(np.diff(np.vstack([pieces[-1][-1:], nodes]), axis=0)).max(axis=1)
        nodes = nodes[steps > 1e-12]
        if len(nodes):
            pieces.append(nodes)
            segments.append(np.full(len(nodes), segment, dtype=np.intp))
            count += len(nodes)

    def add_line(end: Floats, segment: int) -> None:
        begin = pieces[-1][-1]
        steps = np.clip(int(np.abs(end - begin).max() / _LINE_STEP_RAD), 2, _LINE_NODES - 1)
        add(begin + np.linspace(0, 1, steps + 1)[1:, None] * (end - begin), segment)

    for i in range(1, len(corners)):
        corner = corners[i]
        blended = i < len(corners) - 1 and fractions[i - 1, 0] > 0
        if not blended:
            add_line(corner, i - 1)
            stops.append(count - 1)
            continue
        before, after = fractions[i - 1]
        enter = corner + before * (corners[i - 1] - corner)
        leave = corner + after * (corners[i + 1] - corner)
        add_line(enter, i - 1)
        add((1 - t) ** 2 * enter + 2 * t * (1 - t) * corner + t**2 * leave, i)
    return np.vstack(pieces), np.concatenate(segments), np.array(stops)


def _fastest_rates(u: Floats, limit: Floats, acceleration: Floats) -> Floats:
    """(N,) the largest rates at the nodes within the limits, reachable from before and able to slow down."""
    square = np.concatenate([[0.0], limit[1:-1] ** 2, [0.0]])
    gain = 2 * np.minimum(acceleration[:-1], acceleration[1:]) * np.diff(u)
    for i in range(1, len(u)):
        square[i] = min(square[i], square[i - 1] + gain[i - 1])
    for i in range(len(u) - 2, -1, -1):
        square[i] = min(square[i], square[i + 1] + gain[i])
    return np.sqrt(square)
