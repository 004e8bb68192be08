"""A Universal Robots UR5e in remote control, through RTDE for its state and ur_rtde for its motion.

The state comes from a reader of our own (lossless); motion runs in a child process under a watchdog. Poses
are always the controller's, never computed; the nominal kinematics only guard the workspace and the tool.
"""

from __future__ import annotations

import threading
import time

import numpy as np
from numpy.typing import ArrayLike, NDArray

from acquisition.robot import MotionStopped, Robot, RobotConfig
from acquisition.robots.limits import MotionLimits, joint_angles
from acquisition.robots.motion_client import MotionClient
from acquisition.robots.stream import RtdeStream
from acquisition.robots.ur_receiver import UrReceiver, check_tool, check_unchanged
from dataset.errors import DeviceError
from dataset.frames import RobotSample
from dataset.transforms import SE3

Floats = NDArray[np.float64]

_POLL_S = 0.02
_ARRIVED, _NEARLY_ARRIVED = 0.0005, 0.01  # rad or m; a loaded arm settles in between
_ARRIVAL_SHOWS_WITHIN_S = 1.0
_TCP_SHOWS_WITHIN_S = 1.0  # a tool offset that was set reaches the stream some packages later
_STANDSTILL_S = 3.0  # our choice: an arm that rests this long in the middle of a motion is held by something
_LARGEST_BLEND = 0.4  # of the way to the next waypoint; the controller refuses blends that overlap
_STOP_DECELERATION = 2.0  # rad/s^2


class UrRobot(UrReceiver, Robot):
    """A UR5e in remote control.

    Connecting sets the tool offset that the configuration gives, or learns the active one; no motion starts
    with an unknown tool, or with one that somebody changed since. `follow` is one path of blended joint moves
    that the controller executes by itself, so its smoothness does not depend on the host or the network.

    Args:
        config: where the arm is and its limits.

    Raises:
        DeviceError: the arm does not answer, takes no commands, or its pose contradicts the tool offset.
    """

    def __init__(self, config: RobotConfig) -> None:
        self.config = config
        self._stop_requested = threading.Event()
        self._moving = threading.Lock()
        self._settled = False
        self._stream = RtdeStream(config.host, config.frequency_hz, config.silence_s)
        self._motion = MotionClient(config.host, self._stream.check, self._settle_tool)
        try:
            self._motion.start()
        except BaseException:
            self.close()
            raise

    def close(self) -> None:
        self._motion.close()
        super().close()

    def move_joints(self, q: ArrayLike) -> None:
        target = joint_angles(q, (6,))
        here = self._stream.sample().q
        self._limits.check_joint_path(here, target[None])
        self._move(
            target,
            "move_joints",
            q=target.tolist(),
            speed=float(self._limits.joint_speeds(here, target[None])[0]),
            acceleration=self.config.joint_acceleration,
        )

    def move_linear(self, T_base_tcp: SE3) -> None:
        self._limits.check_positions(T_base_tcp.translation[None])
        self._move(
            T_base_tcp,
            "move_linear",
            pose=T_base_tcp.as_pose6().tolist(),
            speed=self.config.speed,
            acceleration=self.config.acceleration,
        )

    def follow(self, joint_path: ArrayLike, blend: float = 0.02) -> None:
        waypoints = joint_angles(joint_path, (-1, 6))
        here = self._stream.sample().q
        self._limits.check_joint_path(here, waypoints)
        speeds = self._limits.joint_speeds(here, waypoints)
        travel = self._limits.tool_travel(here, waypoints)
        turning = np.abs(np.diff(np.vstack([here, waypoints]), axis=0)).max(axis=1)
        ahead = np.append(travel[1:], 0.0)  # no blend at the last waypoint
        blends = np.minimum(blend, _LARGEST_BLEND * np.minimum(travel, ahead))
        path = [
            [*q, speed, self.config.joint_acceleration, radius]
            for q, speed, radius, turn in zip(
                waypoints.tolist(), speeds.tolist(), blends.tolist(), turning, strict=True
            )
            if turn > 1e-5
        ]
        if path:
            self._move(waypoints[-1], "follow", path=path)

    def inverse_kinematics(self, T_base_tcp: SE3, q_near: ArrayLike) -> Floats | None:
        q = self._motion.ask(
            "inverse_kinematics",
            pose=T_base_tcp.as_pose6().tolist(),
            q_near=joint_angles(q_near, (6,)).tolist(),
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
            self._check_tool_unchanged()
            if not self._motion.ask(verb, **arguments):
                self._stream.check()
                raise DeviceError(
                    f"the arm {self.config.host} refuses to {verb.replace('_', ' ')}; check for a message at "
                    "the pendant, and that the target is within reach"
                )
            try:
                self._await_end()
            except (KeyboardInterrupt, SystemExit):
                self._motion.abort()
                raise
        self._check_arrived(target, verb)

    def _await_end(self) -> None:
        """Returns when the motion under way has ended; every question also asks whether the arm is well."""
        moved = time.monotonic()
        while self._motion.ask("moving"):
            if self._stop_requested.is_set():
                self._motion.ask("stop", deceleration=_STOP_DECELERATION)
                raise MotionStopped(
                    f"the arm {self.config.host} was told to stop on its way; command it again"
                )
            if not self._stream.still():
                moved = time.monotonic()
            elif time.monotonic() - moved > _STANDSTILL_S:
                self._motion.abort()
                raise DeviceError(
                    f"the arm {self.config.host} stands still in the middle of a motion, which was given up; "
                    "check whether its program is paused or the speed slider at the pendant is at zero"
                )
            time.sleep(_POLL_S)

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
        active = self._active_tool(motion)
        if self._settled and wanted is None:
            check_unchanged(active, self._tcp_offset, self.config.host)
        self._tcp_offset, self._settled = active, True
        self._limits = MotionLimits(self.config, self._tcp_offset)
        deadline = time.monotonic() + _TCP_SHOWS_WITHIN_S
        while True:
            try:
                check_tool(self._stream.sample(), self._tcp_offset, self.config.host)
                return
            except DeviceError:
                if time.monotonic() > deadline:
                    raise
                time.sleep(_POLL_S)

    def _active_tool(self, motion: MotionClient) -> Floats:
        active = np.array(motion.ask("tcp_offset"), dtype=np.float64)
        if active.shape != (6,):
            raise DeviceError(
                f"the arm {self.config.host} does not tell its tool offset; restart its program, then connect"
            )
        return active

    def _check_tool_unchanged(self) -> None:
        """Asks the controller's program, as not every controller streams its tool."""
        try:
            active = self._active_tool(self._motion)
        except DeviceError:
            # The program may have ended since, as it does at the pendant: start it once more.
            self._stream.check()
            self._motion.start()
            active = self._active_tool(self._motion)
        check_unchanged(active, self._tcp_offset, self.config.host)


def _distance(sample: RobotSample, target: Floats | SE3) -> float:
    if isinstance(target, SE3):
        return float(np.linalg.norm(sample.T_base_tcp.translation - target.translation))
    return float(np.abs(sample.q - target).max())
