"""The simulated arm itself: joints, tool, what stops it, and the registers it shares with its clients."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from acquisition.kinematics import JOINT_LIMIT, READY, link_transforms
from acquisition.simulation.motion import Motion
from dataset.transforms import SE3

Floats = NDArray[np.float64]

REGISTERS = 48
HOME = READY

# RTDE's safety_status_bits, safety_mode and robot_mode.
NORMAL_BITS, PROTECTIVE_BITS, EMERGENCY_BITS = 1 << 0, 1 << 2 | 1 << 10, 1 << 6 | 1 << 7 | 1 << 10
NORMAL_MODE, PROTECTIVE_MODE, EMERGENCY_MODE = 1, 3, 7
POWER_OFF, IDLE, RUNNING = 3, 5, 7

_STILL = 1e-4  # rad/s


@dataclass
class Registers:
    """The general-purpose registers of RTDE, through which a program and its client talk."""

    input_int: list[int] = field(default_factory=lambda: [0] * REGISTERS)
    input_double: list[float] = field(default_factory=lambda: [0.0] * REGISTERS)
    output_int: list[int] = field(default_factory=lambda: [0] * REGISTERS)
    output_double: list[float] = field(default_factory=lambda: [0.0] * REGISTERS)


class Arm:
    """Six joints on a table whose plane is z = 0, with the tool that the program has set."""

    def __init__(self, q: Floats) -> None:
        self.q = np.array(q, dtype=np.float64)
        self.qd = np.zeros(6)
        self.motion: Motion | None = None
        self.safety_bits, self.safety_mode, self.robot_mode = NORMAL_BITS, NORMAL_MODE, RUNNING
        self.payload = np.zeros(4)  # mass, kg, and its centre in the flange frame, metres
        self.slider = 1.0  # the share of the commanded speed that the pendant allows
        self.last_stop = ""  # why the arm last stopped itself
        self._tool_velocity = np.zeros(3)
        self.set_tcp(np.zeros(6))
        self._update()

    def set_tcp(self, offset: Floats) -> None:
        """The tool centre point in the flange frame, [x y z rx ry rz]."""
        self.tcp_offset = np.array(offset, dtype=np.float64)
        self.T_flange_tcp = SE3.from_pose6(self.tcp_offset)
        self._T_flange_tcp = self.T_flange_tcp.as_matrix()
        self._update()

    @property
    def stopped_by_safety(self) -> bool:
        """Whether a protective or an emergency stop holds the arm."""
        return self.safety_bits != NORMAL_BITS

    @property
    def steady(self) -> bool:
        """Whether the arm is at rest."""
        return bool(np.abs(self.qd).max() < _STILL)

    def begin(self, motion: Motion | None) -> None:
        """Starts a motion in place of the one under way; None ends it where it is."""
        self.motion = motion
        if motion is None:
            self.qd = np.zeros(6)

    def advance(self, dt: float) -> None:
        """One controller period. A joint at its limit, or a link at the table, is a protective stop.

        The speed slider stretches a motion's time; its joint rates `qd` stay those of full speed.
        """
        if self.motion is None:
            self.qd = np.zeros(6)
            return
        before, position = self.q, self.T_base_tcp[:3, 3]
        self.q, self.qd, ended = self.motion.advance(self.q, self.qd, dt * self.slider)
        self._update()
        self._tool_velocity = (self.T_base_tcp[:3, 3] - position) / dt
        reason = self._violation()
        if reason:
            self.q = before
            self._update()
            self.protective_stop(reason)
        elif ended:
            self.begin(None)

    def protective_stop(self, reason: str) -> None:
        """Stops at once, as after a collision."""
        self.safety_bits, self.safety_mode = PROTECTIVE_BITS, PROTECTIVE_MODE
        self.last_stop = reason
        self.begin(None)

    def emergency_stop(self) -> None:
        """Stops at once and cuts the power, as the red button does."""
        self.safety_bits, self.safety_mode, self.robot_mode = EMERGENCY_BITS, EMERGENCY_MODE, POWER_OFF
        self.begin(None)

    def clear(self) -> None:
        """Ends a stop: the operator has made the arm ready again."""
        self.safety_bits, self.safety_mode, self.robot_mode = NORMAL_BITS, NORMAL_MODE, RUNNING

    def joint_speed(self) -> Floats:
        """(6,) rad/s."""
        return self.slider * self.qd

    def tcp_speed(self) -> Floats:
        """(6,) linear and angular velocity of the tool centre point in the base frame, m/s and rad/s."""
        if self.motion is None:
            return np.zeros(6)
        return np.concatenate([self._tool_velocity, self.joint_speed() @ self._links[:6, :3, 2]])

    def _update(self) -> None:
        self._links = link_transforms(self.q)
        self.T_base_tcp: Floats = self._links[6] @ self._T_flange_tcp
        # Compiled code, faster than the toolkit's own by far: this runs in every control period.
        rotvec = Rotation.from_matrix(self.T_base_tcp[:3, :3]).as_rotvec()
        self.tcp_pose = np.concatenate([self.T_base_tcp[:3, 3], rotvec])

    def _violation(self) -> str:
        if np.abs(self.q).max() > JOINT_LIMIT:
            return f"joint {int(np.abs(self.q).argmax()) + 1} is at its limit"
        if min(self._links[2:, 2, 3].min(), self.T_base_tcp[2, 3]) < 0:
            return "a link or the tool reached the table"
        return ""
