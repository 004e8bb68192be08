"""The control program that ur_rtde uploads, as the simulated controller runs it.

The client writes a command number and its arguments into input registers; the program answers through output
registers: state 1 is "ready", 2 is "done with the command". The numbers and the meaning of the registers are
those of the program in ur_rtde 1.6. It may be asked to use the upper half of the registers.
"""

from __future__ import annotations

import math
import re
from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from acquisition.kinematics import JOINT_LIMIT, forward, inverse
from acquisition.simulation.arm import Arm, Registers
from acquisition.simulation.motion import (
    JointSpeed,
    Motion,
    OutOfReach,
    Servo,
    Stopping,
    ToolSpeed,
    joint_move,
    joint_path,
    linear_move,
)
from dataset.transforms import SE3

Floats = NDArray[np.float64]

_READY, _DONE = 1, 2
_OFFSET = re.compile(r"# int register offset\n\s*(\d+)")
_WAYPOINT = re.compile(r"(movej|movel)\((p?)\[([^\]]*)\],a=([^,]*),v=([^,]*),r=([^)]*)\)")
_PATH_MARK = "# inject move path\n"


class ProgramEnded(Exception):
    """The program finished, or a runtime exception ended it."""


class ControlScript:
    """One run of the uploaded program; `step` is called once per controller period."""

    def __init__(self, arm: Arm, registers: Registers, text: str, period_s: float) -> None:
        self._arm = arm
        self._registers = registers
        self._period_s = period_s
        offset = _OFFSET.search(text)
        self._offset = int(offset.group(1)) if offset else 0
        self._path = _WAYPOINT.findall(text, max(text.find(_PATH_MARK), 0))
        self._executing = False
        self._waiting = False  # for the arm to finish the command's motion
        self._asynchronous = False  # a motion runs on after its command was answered
        self._progress_writes = 0
        self._operation = 0
        self._commands: dict[int, Callable[[], bool]] = {
            1: self._move_joints, 2: self._move_joints_to_pose,
            3: self._move_linear, 4: self._move_linear_to_joints,
            15: self._stop_servoing, 16: self._stop_servoing, 17: self._accept, 18: self._accept,
            19: self._accept, 28: self._target_waypoint, 29: self._set_tcp, 30: self._inverse_near,
            31: self._protective_stop, 33: self._stop_move, 34: self._stop_move,
            36: self._has_solution_here, 37: self._joints_within_limits,
            39: self._pose_trans, 40: self._tcp_offset, 43: self._forward_here, 44: self._forward,
            45: self._move_path, 46: self._inverse_here, 47: self._steady,
            60: self._has_solution_here, 61: self._has_solution_near, 255: self._end,
        }  # fmt: skip
        self._immediate: dict[int, Callable[[], bool]] = {
            9: self._speed_joints, 10: self._speed_tool, 11: self._servo_joints, 24: self._servo_tool,
            26: self._step_time, 27: self._joints, 38: self._torques, 58: self._flange_pose,
        }  # fmt: skip

    def start(self) -> None:
        """What the program does before its loop: reports that it is ready and that nothing runs."""
        self._write_progress(running=False)
        self._registers.output_int[self._offset] = _READY

    def step(self) -> None:
        """One turn of the program's loop.

        Raises:
            ProgramEnded: the client ended it, or a command failed as it would on the controller.
        """
        if self._asynchronous and self._arm.motion is None:
            self._end_asynchronous()
        if self._waiting:
            if self._arm.motion is None:
                self._waiting = False
                self._answer(_DONE)
            return
        command = self._registers.input_int[self._offset]
        if command in self._immediate:
            self._immediate[command]()
            self._answer(_READY)
        elif command == 0:
            self._executing = False
            self._answer(_READY)
        elif not self._executing:
            if command not in self._commands:
                raise ProgramEnded(f"command {command} is not simulated")
            self._executing = True
            self._waiting = self._commands[command]()
            if not self._waiting:
                self._answer(_DONE)

    # Registers

    def _answer(self, state: int) -> None:
        self._registers.output_int[self._offset] = state

    def _doubles(self, first: int, count: int = 6) -> Floats:
        start = first + self._offset
        return np.array(self._registers.input_double[start : start + count])

    def _double(self, index: int) -> float:
        return self._registers.input_double[index + self._offset]

    def _return(self, values: Floats) -> bool:
        self._registers.output_double[self._offset : self._offset + len(values)] = map(float, values)
        return False

    def _return_flag(self, flag: bool) -> bool:
        self._registers.output_int[self._offset + 1] = int(flag)
        return False

    def _accept(self) -> bool:
        return False

    # Motion: each returns whether the command is done only when the arm has arrived

    def _move(self, motion: Motion | None) -> bool:
        if self._asynchronous:
            self._end_asynchronous()
        self._arm.begin(motion)
        if self._registers.input_int[self._offset + 1] != 1:
            return True
        self._operation = (self._operation + 1) % 128
        self._asynchronous = True
        self._write_progress(running=True)
        return False

    def _end_asynchronous(self) -> None:
        self._asynchronous = False
        self._write_progress(running=False)

    def _write_progress(self, running: bool) -> None:
        self._progress_writes = (self._progress_writes + 1) % 128
        word = self._operation << 24 | self._progress_writes << 16 | (0x8000 if running else 0)
        self._registers.output_int[self._offset + 2] = word

    def _move_joints(self) -> bool:
        return self._move(joint_move(self._arm.q, self._doubles(0), self._double(6), self._double(7)))

    def _move_joints_to_pose(self) -> bool:
        q = self._solve(self._doubles(0), self._arm.q)
        return self._move(joint_move(self._arm.q, q, self._double(6), self._double(7)))

    def _move_linear(self) -> bool:
        return self._move_line(self._T_base_flange(self._doubles(0)))

    def _move_linear_to_joints(self) -> bool:
        return self._move_line(forward(self._doubles(0)))

    def _move_line(self, T_base_flange: SE3) -> bool:
        tool = self._arm.T_flange_tcp
        try:
            motion = linear_move(self._arm.q, T_base_flange, tool, self._double(6), self._double(7))
        except OutOfReach as error:
            self._arm.protective_stop(str(error))
            return True
        return self._move(motion)

    def _move_path(self) -> bool:
        """A path of joint moves, blended. Linear moves in a path are not simulated."""
        q = self._arm.q
        waypoints = []
        for kind, is_pose, numbers, *_ in self._path:
            if kind != "movej":
                raise ProgramEnded("a path of linear moves is not simulated")
            values = np.array([float(number) for number in numbers.split(",")])
            q = self._solve(values, q) if is_pose else values
            waypoints.append(q)
        if not waypoints:
            return False
        acceleration, speed, blend = np.array([[float(x) for x in entry[3:]] for entry in self._path]).T
        return self._move(joint_path(self._arm.q, waypoints, speed, acceleration, blend))

    def _stop_move(self) -> bool:
        return self._move(None if self._arm.steady else Stopping(max(self._double(0), 0.1)))

    def _stop_servoing(self) -> bool:
        self._arm.begin(None if self._arm.steady else Stopping(max(self._double(0), 0.1)))
        return True

    def _speed_joints(self) -> bool:
        self._arm.begin(JointSpeed(self._doubles(0), self._double(6), self._double(7) or math.inf))
        return False

    def _speed_tool(self) -> bool:
        self._arm.begin(ToolSpeed(self._doubles(0), self._double(6), self._double(7) or math.inf))
        return False

    def _servo_joints(self) -> bool:
        self._arm.begin(Servo(self._doubles(0), self._double(9)))
        return False

    def _servo_tool(self) -> bool:
        self._arm.begin(Servo(self._solve(self._doubles(0), self._arm.q), self._double(9)))
        return False

    def _protective_stop(self) -> bool:
        self._arm.protective_stop("the program asked for it")
        return True

    def _end(self) -> bool:
        raise ProgramEnded("the client ended it")

    # Questions

    def _T_base_flange(self, tcp_pose: Floats) -> SE3:
        return SE3.from_pose6(tcp_pose) @ self._arm.T_flange_tcp.inverse()

    def _solve(self, tcp_pose: Floats, q_near: Floats) -> Floats:
        q = inverse(self._T_base_flange(tcp_pose), q_near)
        if q is None:
            raise ProgramEnded("get_inverse_kin: no solution")
        return q

    def _inverse_here(self) -> bool:
        return self._return(self._solve(self._doubles(0), self._arm.q))

    def _inverse_near(self) -> bool:
        return self._return(self._solve(self._doubles(0), self._doubles(6)))

    def _has_solution_here(self) -> bool:
        return self._return_flag(inverse(self._T_base_flange(self._doubles(0)), self._arm.q) is not None)

    def _has_solution_near(self) -> bool:
        return self._return_flag(inverse(self._T_base_flange(self._doubles(0)), self._doubles(6)) is not None)

    def _joints_within_limits(self) -> bool:
        return self._return_flag(bool(np.abs(self._doubles(0)).max() <= JOINT_LIMIT))

    def _set_tcp(self) -> bool:
        self._arm.set_tcp(self._doubles(0))
        return False

    def _tcp_offset(self) -> bool:
        return self._return(self._arm.tcp_offset)

    def _forward_here(self) -> bool:
        return self._return(self._arm.tcp_pose)

    def _forward(self) -> bool:
        return self._return((forward(self._doubles(0)) @ SE3.from_pose6(self._doubles(6))).as_pose6())

    def _pose_trans(self) -> bool:
        return self._return((SE3.from_pose6(self._doubles(0)) @ SE3.from_pose6(self._doubles(6))).as_pose6())

    def _target_waypoint(self) -> bool:
        return self._return(self._arm.tcp_pose)

    def _flange_pose(self) -> bool:
        return self._return(forward(self._arm.q).as_pose6())

    def _steady(self) -> bool:
        return self._return_flag(self._arm.steady)

    def _step_time(self) -> bool:
        return self._return(np.array([self._period_s]))

    def _joints(self) -> bool:
        return self._return(self._arm.q)

    def _torques(self) -> bool:
        return self._return(np.zeros(6))
