"""What the toolkit asks of a robot arm.

`PoseSource` reads an arm that somebody else moves: a hand, the pendant. `Robot` also moves it. Poses are
T_base_tcp of the *active* tool centre point, metres and radians; joints are radians.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass
from types import TracebackType
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike, NDArray

from dataset.errors import DeviceError, ToolkitError
from dataset.frames import RobotSample, RobotTrace
from dataset.transforms import SE3

if TYPE_CHECKING:
    from typing_extensions import Self

Floats = NDArray[np.float64]


class ProtectiveStop(DeviceError):
    """The arm stopped itself: it hit something, or left what its safety limits allow."""


class EmergencyStop(DeviceError):
    """Somebody pressed an emergency stop."""


class MotionStopped(DeviceError):
    """Another thread stopped the arm with `Robot.stop`: whoever moves it has no further move to make."""


@dataclass(frozen=True)
class RobotConfig:
    """How to reach an arm and how fast it may move.

    Attributes:
        host: address of the controller.
        frequency_hz: rate of the trace; 500 for an e-Series arm, 125 for a CB3.
        silence_s: how long the arm's state may fail to come before a motion or a recording is given up; a
            simulated arm on a busy host needs more than a real one.
        speed: of the tool, in every kind of move, m/s.
        acceleration: of the tool in linear moves, m/s^2.
        joint_speed: of the fastest joint in joint moves, rad/s.
        joint_acceleration: of the fastest joint in joint moves, rad/s^2.
        tcp_offset: [x y z rx ry rz] of the tool centre point in the flange frame, metres and rotation vector;
            None takes the one that is active on the controller.
        workspace: lower and upper corner of the box in the base frame, metres, that the tool centre point
            must not leave.

    Raises:
        ToolkitError: a speed that is not positive or above what the arm permits, an empty box, or a tool
            offset that is not six numbers.
    """

    host: str
    frequency_hz: float = 500.0
    silence_s: float = 0.1
    speed: float = 0.25
    acceleration: float = 0.5
    joint_speed: float = 0.5
    joint_acceleration: float = 0.5
    tcp_offset: tuple[float, ...] | None = None
    workspace: tuple[tuple[float, float, float], tuple[float, float, float]] = (
        (-1.0, -1.0, 0.0),
        (1.0, 1.0, 1.3),
    )

    def __post_init__(self) -> None:
        limits = {"frequency_hz": 500, "silence_s": 10, "speed": 3, "acceleration": 150, "joint_speed": np.pi}
        for name, largest in {**limits, "joint_acceleration": 40}.items():
            value = getattr(self, name)
            if not 0 < value <= largest:
                raise ToolkitError(
                    f"[robot] {name} = {value:g} is outside (0, {largest:g}]; correct the rig file"
                )
        if self.tcp_offset is not None and len(self.tcp_offset) != 6:
            raise ToolkitError(
                f"[robot] tcp_offset has {len(self.tcp_offset)} numbers; give six: x y z (m) rx ry rz (rad)"
            )
        if not np.all(np.less(*self.workspace)):
            raise ToolkitError("[robot] workspace: the lower corner is not below the upper one; swap them")


class PoseSource(ABC):
    """An arm that is read. Use it as a context manager: leaving it releases every thread and process."""

    @property
    @abstractmethod
    def tcp_offset(self) -> Floats:
        """(6,) the active tool centre point in the flange frame, [x y z rx ry rz], metres and radians."""

    @property
    @abstractmethod
    def payload(self) -> Floats:
        """(4,) what the arm believes to carry: mass, kg, and its centre of gravity in the flange
        frame, metres; NaN where the arm does not tell."""

    @abstractmethod
    def sample(self) -> RobotSample:
        """The newest state. Raises DeviceError rather than return one that is no longer current."""

    @abstractmethod
    def start_trace(self) -> None:
        """Begins to keep every sample. Raises DeviceError where a trace is already running.

        A tool that is changed from here on makes the other methods raise; samples of it are not kept.
        """

    @abstractmethod
    def take_trace(self) -> RobotTrace:
        """The samples since the trace began or since they were last taken; the trace goes on.

        Where the arm was lost, they are the samples until then. Raises DeviceError where none was started.
        """

    @abstractmethod
    def stop_trace(self) -> RobotTrace:
        """Ends the trace and returns every sample that was not taken yet.

        Raises DeviceError where none was started, or the arm was lost or its controller restarted meanwhile.
        """

    @abstractmethod
    def wait_until_still(self, timeout_s: float = 10.0) -> None:
        """Returns when the arm has been at rest for a moment. Raises DeviceError where it keeps moving."""

    @abstractmethod
    def close(self) -> None:
        """Stops a motion that is under way and releases the arm. Idempotent."""

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        self.close()


class Robot(PoseSource):
    """An arm that is read and moved.

    The moves return when the arm has arrived, or when `stop` ended them. They raise ToolkitError, before
    anything moves, for a target outside the workspace; ProtectiveStop, EmergencyStop or DeviceError when the
    arm stops or is lost on the way. Ctrl-C during a move stops the arm and is passed on.
    """

    @abstractmethod
    def move_joints(self, q: ArrayLike) -> None:
        """To joint angles (6,), radians, every joint starting and ending together."""

    @abstractmethod
    def move_linear(self, T_base_tcp: SE3) -> None:
        """To a pose of the tool, along a straight line."""

    @abstractmethod
    def follow(self, joint_path: ArrayLike, blend: float = 0.02) -> None:
        """Through joint angles (M, 6), radians, without stopping on the way.

        The corner at each waypoint is rounded within `blend` metres of it, so the arm passes near the
        waypoints, not through them; it stops at the last. The recorded trace says where it was, not the plan.
        """

    @abstractmethod
    def inverse_kinematics(self, T_base_tcp: SE3, q_near: ArrayLike) -> Floats | None:
        """(6,) joint angles, radians, that reach the pose, nearest to `q_near`; None where none exist."""

    @abstractmethod
    def stop(self) -> None:
        """Brings the arm to rest. A move that waits in another thread raises MotionStopped."""
