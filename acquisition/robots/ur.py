"""A Universal Robots UR5e, through RTDE for its state and ur_rtde for its motion.

The state comes from a reader of our own (lossless); motion runs in a child process under a watchdog. Poses
are always the controller's, never computed; the nominal kinematics only guard the workspace and the tool.
"""

from __future__ import annotations

import threading
import time
from itertools import pairwise

import numpy as np
from numpy.typing import ArrayLike, NDArray

from acquisition.kinematics import forward
from acquisition.robot import MotionStopped, PoseSource, Robot, RobotConfig
from acquisition.robots.motion_client import MotionClient
from acquisition.robots.stream import RtdeStream
from dataset.errors import DeviceError, ToolkitError
from dataset.frames import RobotSample, RobotTrace
from dataset.transforms import SE3, rotation_error_deg

Floats = NDArray[np.float64]

_POLL_S = 0.02
_ARRIVED, _NEARLY_ARRIVED = 0.0005, 0.01  # rad or m; a loaded arm settles in between
_ARRIVAL_SHOWS_WITHIN_S = 1.0
_PLAUSIBLE_M, _PLAUSIBLE_DEG = 0.02, 3.0  # factory calibration differs from the nominal arm by millimetres
_TCP_SHOWS_WITHIN_S = 1.0  # a tool offset that was set reaches the stream some packages later
_PATH_STEP_RAD = 0.05  # between the points of a joint path that are checked against the workspace
_LARGEST_BLEND = 0.4  # of the way to the next waypoint; the controller refuses blends that overlap
_STOP_DECELERATION = 2.0  # rad/s^2


class UrReceiver(PoseSource):
    """A UR5e that is only read: it is guided by hand or from the pendant, and may be in local mode.

    Args:
        config: its `tcp_offset` is required, because only the controlling side can ask for it.

    Raises:
        DeviceError: the arm does not answer, or its pose contradicts the tool offset.
        ToolkitError: the configuration has no tool offset.
    """

    def __init__(self, config: RobotConfig) -> None:
        if config.tcp_offset is None:
            raise ToolkitError(
                "[robot] tcp_offset is missing: a hand-guided capture cannot ask the controller for it; copy "
                "it from the pendant (Installation > TCP) into the rig file"
            )
        self.config = config
        self._tcp_offset = np.array(config.tcp_offset, dtype=np.float64)
        self._stream = RtdeStream(config.host, config.frequency_hz)
        try:
            _check_tool(self._stream.sample(), self._tcp_offset, config.host)
        except BaseException:
            self._stream.close()
            raise

    @property
    def tcp_offset(self) -> Floats:
        return self._tcp_offset.copy()

    def sample(self) -> RobotSample:
        return self._stream.sample()

    def start_trace(self) -> None:
        self._stream.start_trace()

    def take_trace(self) -> RobotTrace:
        return self._stream.take_trace()

    def stop_trace(self) -> RobotTrace:
        return self._stream.stop_trace()

    def wait_until_still(self, timeout_s: float = 10.0) -> None:
        _wait_until_still(self._stream, timeout_s)

    def close(self) -> None:
        self._stream.close()


class UrRobot(Robot):
    """A UR5e in remote control.

    Connecting sets the tool offset that the configuration gives, or learns the active one; no motion starts
    with an unknown tool. `follow` is one path of blended joint moves that the controller executes by itself,
    so its smoothness does not depend on the host or the network.

    Args:
        config: where the arm is and its limits.

    Raises:
        DeviceError: the arm does not answer, takes no commands, or its pose contradicts the tool offset.
    """

    def __init__(self, config: RobotConfig) -> None:
        self.config = config
        self._tcp_offset: Floats | None = None
        self._stop_requested = threading.Event()
        self._moving = threading.Lock()
        self._stream = RtdeStream(config.host, config.frequency_hz)
        self._motion = MotionClient(config.host, self._stream.check, self._settle_tool)
        try:
            self._settle_tool(self._motion)
        except BaseException:
            self.close()
            raise

    @property
    def tcp_offset(self) -> Floats:
        assert self._tcp_offset is not None
        return self._tcp_offset.copy()

    def sample(self) -> RobotSample:
        return self._stream.sample()

    def start_trace(self) -> None:
        self._stream.start_trace()

    def take_trace(self) -> RobotTrace:
        return self._stream.take_trace()

    def stop_trace(self) -> RobotTrace:
        return self._stream.stop_trace()

    def wait_until_still(self, timeout_s: float = 10.0) -> None:
        _wait_until_still(self._stream, timeout_s)

    def close(self) -> None:
        self._motion.close()
        self._stream.close()

    def move_joints(self, q: ArrayLike) -> None:
        target = _joints(q, (6,))
        self._check_path(target[None])
        self._move(
            target,
            "move_joints",
            q=target.tolist(),
            speed=self.config.joint_speed,
            acceleration=self.config.joint_acceleration,
        )

    def move_linear(self, T_base_tcp: SE3) -> None:
        self._check_inside(T_base_tcp.translation[None])
        self._move(
            T_base_tcp,
            "move_linear",
            pose=T_base_tcp.as_pose6().tolist(),
            speed=self.config.speed,
            acceleration=self.config.acceleration,
        )

    def follow(self, joint_path: ArrayLike, blend: float = 0.02) -> None:
        waypoints = _joints(joint_path, (-1, 6))
        self._check_path(waypoints)
        before = np.vstack([self._stream.sample().q, waypoints[:-1]])
        turning = np.abs(waypoints - before).max(axis=1)
        travel = np.linalg.norm(
            self._nominal_tcp(waypoints).translation - self._nominal_tcp(before).translation, axis=1
        )
        speeds = np.minimum(self.config.joint_speed, self.config.speed * turning / np.maximum(travel, 1e-9))
        ahead = np.append(travel[1:], 0.0)  # no blend at the last waypoint
        blends = np.minimum(blend, _LARGEST_BLEND * np.minimum(travel, ahead))
        path = [
            [*q, max(speed, 1e-3), self.config.joint_acceleration, radius]
            for q, speed, radius, turn in zip(waypoints.tolist(), speeds, blends, turning, strict=True)
            if turn > 1e-5
        ]
        if path:
            self._move(waypoints[-1], "follow", path=path)

    def inverse_kinematics(self, T_base_tcp: SE3, q_near: ArrayLike) -> Floats | None:
        q = self._motion.ask(
            "inverse_kinematics",
            pose=T_base_tcp.as_pose6().tolist(),
            q_near=_joints(q_near, (6,)).tolist(),
        )
        return None if q is None else np.array(q)

    def stop(self) -> None:
        self._stop_requested.set()
        try:
            # The thread in a move sees the request and ends it; until the arm rests, no other begins.
            with self._moving:
                self.wait_until_still()
        finally:
            self._stop_requested.clear()

    def _move(self, target: Floats | SE3, verb: str, **arguments: object) -> None:
        """Starts a motion and waits for its end."""
        with self._moving:
            if not self._motion.ask(verb, **arguments):
                # The program on the controller ended since, as it does at the pendant: start it once more.
                self._stream.check()
                self._motion.abort()
                if not self._motion.ask(verb, **arguments):
                    self._stream.check()
                    raise DeviceError(
                        f"the arm {self.config.host} refuses to {verb.replace('_', ' ')}; check for a "
                        "message at the pendant, and that the target is within reach"
                    )
            try:
                while self._motion.ask("moving"):
                    if self._stop_requested.is_set():
                        self._motion.ask("stop", deceleration=_STOP_DECELERATION)
                        raise MotionStopped(
                            f"the arm {self.config.host} was told to stop on its way; command it again"
                        )
                    time.sleep(_POLL_S)
            except (KeyboardInterrupt, SystemExit):
                self._motion.abort()
                raise
        self._check_arrived(target, verb)

    def _check_arrived(self, target: Floats | SE3, verb: str) -> None:
        # The stream can lag behind the motion process, and then still shows the last centimetre of the way.
        deadline = time.monotonic() + _ARRIVAL_SHOWS_WITHIN_S
        while True:
            self._stream.check()
            away = _distance(self._stream.sample(), target)
            if away < _ARRIVED:
                return
            if time.monotonic() > deadline:
                break
            time.sleep(_POLL_S)
        if away > _NEARLY_ARRIVED:
            raise DeviceError(
                f"the arm {self.config.host} ended {verb.replace('_', ' ')} {away:.3f} m or rad before its "
                "target; check the pendant for a message, or whether another program commands the arm"
            )

    def _settle_tool(self, motion: MotionClient) -> None:
        """Makes the configured tool active, or takes the active one; checks it against the pose."""
        wanted = self.config.tcp_offset
        if wanted is not None and not motion.ask("set_tcp", offset=list(wanted)):
            raise DeviceError(
                f"the arm {self.config.host} does not accept the tool offset {wanted}; check tcp_offset in "
                "the rig file"
            )
        active = np.array(motion.ask("tcp_offset"), dtype=np.float64)
        if active.shape != (6,):
            raise DeviceError(
                f"the arm {self.config.host} does not tell its tool offset; restart its program, then connect"
            )
        self._tcp_offset = active
        deadline = time.monotonic() + _TCP_SHOWS_WITHIN_S
        while True:
            try:
                _check_tool(self._stream.sample(), active, self.config.host)
                return
            except DeviceError:
                if time.monotonic() > deadline:
                    raise
                time.sleep(_POLL_S)

    def _nominal_tcp(self, q: Floats) -> SE3:
        return forward(q) @ SE3.from_pose6(self.tcp_offset)

    def _check_path(self, waypoints: Floats) -> None:
        """Checks the tool along straight lines in joint space from where the arm is through the waypoints."""
        here = self._stream.sample()
        start = here.q[None] if self._inside(here.T_base_tcp.translation[None]).all() else waypoints[:1]
        corners = np.vstack([start, waypoints])
        points = [corners[-1:]]
        for begin, end in pairwise(corners):
            count = 1 + int(np.abs(end - begin).max() / _PATH_STEP_RAD)
            points.append(begin + np.linspace(0, 1, count, endpoint=False)[:, None] * (end - begin))
        self._check_inside(self._nominal_tcp(np.vstack(points)).translation)

    def _check_inside(self, positions: Floats) -> None:
        outside = ~self._inside(positions)
        if outside.any():
            x, y, z = positions[np.argmax(outside)]
            low, high = self.config.workspace
            raise ToolkitError(
                f"the motion would take the tool to ({x:.3f}, {y:.3f}, {z:.3f}) m, outside the workspace "
                f"{low} to {high}; change the target, or workspace under [robot] in the rig file"
            )

    def _inside(self, positions: Floats) -> NDArray[np.bool_]:
        low, high = (np.array(corner) for corner in self.config.workspace)
        return np.asarray(((positions >= low) & (positions <= high)).all(axis=1))


def _distance(sample: RobotSample, target: Floats | SE3) -> float:
    if isinstance(target, SE3):
        return float(np.linalg.norm(sample.T_base_tcp.translation - target.translation))
    return float(np.abs(sample.q - target).max())


def _joints(q: ArrayLike, shape: tuple[int, ...]) -> Floats:
    joints = np.asarray(q, dtype=np.float64)
    if joints.ndim != len(shape) or joints.shape[-1] != 6 or not len(joints):
        raise ToolkitError(
            f"joint angles of shape {joints.shape}; give {'(6,)' if shape == (6,) else '(M, 6)'}"
        )
    if not (np.abs(joints) <= 2 * np.pi).all():
        raise ToolkitError("joint angles must be finite and within one turn either way; are they in degrees?")
    return joints


def _wait_until_still(stream: RtdeStream, timeout_s: float) -> None:
    deadline = time.monotonic() + timeout_s
    while not stream.still():
        stream.sample()
        if time.monotonic() > deadline:
            raise DeviceError(
                f"the arm {stream.host} still moves after {timeout_s:g} s; stop what moves it, or wait longer"
            )
        time.sleep(_POLL_S)


def _check_tool(sample: RobotSample, tcp_offset: Floats, host: str) -> None:
    """Raises DeviceError where the reported pose is not that of the tool offset on a UR5e."""
    nominal = forward(sample.q) @ SE3.from_pose6(tcp_offset)
    away = float(np.linalg.norm(nominal.translation - sample.T_base_tcp.translation))
    turned = float(rotation_error_deg(nominal, sample.T_base_tcp))
    if away > _PLAUSIBLE_M or turned > _PLAUSIBLE_DEG:
        raise DeviceError(
            f"the pose of the arm {host} is {1000 * away:.0f} mm and {turned:.1f} deg from that of a UR5e "
            f"with the tool offset {np.round(tcp_offset, 4).tolist()}; check tcp_offset in the rig file "
            "against the active tool at the pendant, and that the arm is a UR5e"
        )
