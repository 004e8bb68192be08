"""The simulated controller: runs the uploaded program and the arm, and keeps the variables of RTDE."""

from __future__ import annotations

import threading
from collections.abc import Sequence

import numpy as np

from acquisition.simulation.arm import REGISTERS, RUNNING, Arm, Registers
from acquisition.simulation.motion import joint_move
from acquisition.simulation.rtde_server import Value
from acquisition.simulation.script import ControlScript, ProgramEnded

EPOCH_S = 1000.0  # the controller's clock at its start; on purpose unrelated to any other clock
SOFTWARE = (5, 12, 4)
_BUILD = 1101661
_TOOL_SINCE = (5, 5, 1)  # the software that tells tool and payload over RTDE
TRUE_TIME_REGISTER = 46
TRUE_TIME_VARIABLE = f"output_double_register_{TRUE_TIME_REGISTER}"
"""Host monotonic time, in seconds, of the state in the package: what no real arm can tell, for tests and the
simulated scene. ur_rtde's program writes this register only in functions that are not simulated."""

_HAND_SPEED, _HAND_ACCELERATION = 0.5, 2.0  # rad/s, rad/s^2
_STARTUP_S = 0.05  # between the upload of a program and its first line
_STOPPED, _PLAYING, _PAUSED = 1, 2, 4

_VECTORS = (
    "target_q", "target_qd", "target_qdd", "target_current", "target_moment", "actual_q", "actual_qd",
    "actual_qdd", "actual_current", "actual_current_as_torque", "actual_moment", "joint_control_output",
    "actual_TCP_pose", "actual_TCP_speed", "actual_TCP_force", "target_TCP_pose", "target_TCP_speed",
    "joint_temperatures", "actual_joint_voltage", "ft_raw_wrench", "payload_inertia", "tcp_offset",
)  # fmt: skip
_SPATIAL = ("actual_tool_accelerometer", "payload_cog", "elbow_position", "elbow_velocity")
_DOUBLES = (
    "timestamp", "actual_execution_time", "speed_scaling", "target_speed_fraction", "actual_momentum",
    "actual_main_voltage", "actual_robot_voltage", "actual_robot_current", "standard_analog_input0",
    "standard_analog_input1", "standard_analog_output0", "standard_analog_output1", "payload",
    "tcp_force_scalar", "tool_output_current", "tool_temperature", "tool_analog_input0", "tool_analog_input1",
)  # fmt: skip
_SIGNED = ("robot_mode", "safety_mode", "safety_status")
_UNSIGNED = (
    "runtime_state", "robot_status_bits", "safety_status_bits", "output_bit_registers0_to_31",
    "output_bit_registers32_to_63", "tool_mode", "script_control_line",
)  # fmt: skip
OUTPUTS: dict[str, str] = {
    **dict.fromkeys(_VECTORS, "VECTOR6D"),
    **dict.fromkeys(_SPATIAL, "VECTOR3D"),
    **dict.fromkeys(_DOUBLES, "DOUBLE"),
    **dict.fromkeys(_SIGNED, "INT32"),
    **dict.fromkeys(_UNSIGNED, "UINT32"),
    "joint_mode": "VECTOR6INT32",
    "actual_digital_input_bits": "UINT64",
    "actual_digital_output_bits": "UINT64",
    **{f"output_int_register_{i}": "INT32" for i in range(REGISTERS)},
    **{f"output_double_register_{i}": "DOUBLE" for i in range(REGISTERS)},
}
INPUTS: dict[str, str] = {
    "speed_slider_mask": "UINT32",
    "speed_slider_fraction": "DOUBLE",
    "external_force_torque": "VECTOR6D",
    "input_bit_registers0_to_31": "UINT32",
    "input_bit_registers32_to_63": "UINT32",
    "standard_analog_output_0": "DOUBLE",
    "standard_analog_output_1": "DOUBLE",
    **{
        name: "UINT8"
        for port in ("standard_digital_output", "configurable_digital_output", "tool_digital_output")
        for name in (port, f"{port}_mask")
    },
    "standard_analog_output_mask": "UINT8",
    "standard_analog_output_type": "UINT8",
    **{f"input_int_register_{i}": "INT32" for i in range(REGISTERS)},
    **{f"input_double_register_{i}": "DOUBLE" for i in range(REGISTERS)},
}
_TOOL_OUTPUTS = ("tcp_offset", "payload", "payload_cog", "payload_inertia")
_LENGTHS = {"VECTOR6D": 6, "VECTOR3D": 3, "VECTOR6INT32": 6}


class Controller:
    """The controller's state; `lock` guards it against the threads of the ports.

    Args:
        rate_hz: of its control loop.
        drift_ppm: how much faster than the host's clock its own clock runs.
        q: (6,) joint angles at the start, radians.
        software: version of PolyScope that it passes for.
    """

    def __init__(
        self,
        rate_hz: float,
        drift_ppm: float,
        q: Sequence[float],
        software: tuple[int, int, int] = SOFTWARE,
    ) -> None:
        self.software = (*software, _BUILD)
        self.local_mode = False  # as chosen at the pendant: the arm takes no programs
        self.lock = threading.RLock()
        self.period_s = 1.0 / rate_hz
        self.arm = Arm(np.array(q))
        self.registers = Registers()
        self.values: dict[str, Value] = {
            name: 0 if kind not in _LENGTHS else [0] * _LENGTHS[kind] for name, kind in OUTPUTS.items()
        }
        self.values.update(
            actual_main_voltage=48.0,
            actual_robot_voltage=48.0,
            joint_temperatures=[28.0] * 6,
            actual_joint_voltage=[48.0] * 6,
            joint_mode=[253] * 6,
        )
        self.drift(drift_ppm)
        self._clock_s = EPOCH_S
        self._runtime = _STOPPED
        self._script: ControlScript | None = None
        self._startup_s = 0.0

    @property
    def outputs(self) -> dict[str, str]:
        """Type name of every variable that this software offers over RTDE."""
        unknown = () if self.software >= _TOOL_SINCE else _TOOL_OUTPUTS
        return {name: kind for name, kind in OUTPUTS.items() if name not in unknown}

    @property
    def program_running(self) -> bool:
        """Whether an uploaded program is being executed."""
        return self._runtime == _PLAYING

    def step(self, true_time_s: float) -> None:
        """One control period, which ends at `true_time_s` on the host's monotonic clock."""
        with self.lock:
            self._run_program()
            self.arm.advance(self.period_s)
            self._clock_s += self.period_s * self._clock_rate
            self._publish(true_time_s)

    def skip(self, seconds: float) -> None:
        """Lets the controller's clock run on while nothing is computed, when the host was too slow."""
        with self.lock:
            self._clock_s += seconds * self._clock_rate

    def jump_clock(self, seconds: float) -> None:
        """Sets the controller's clock forward, or back as a restart does."""
        with self.lock:
            self._clock_s += seconds

    def drift(self, ppm: float) -> None:
        """Lets the controller's clock run that much faster than the host's from now on."""
        self._clock_rate = 1.0 + 1e-6 * ppm

    def restart(self) -> None:
        """As by the power switch: the clock begins anew; program, registers and tool are gone."""
        with self.lock:
            self.stop_program()
            self.arm = Arm(self.arm.q)
            self.registers = Registers()
            self._clock_s = EPOCH_S

    def switch_to(self, local: bool) -> None:
        """As at the pendant: in local mode the arm takes no programs."""
        with self.lock:
            self.stop_program()
            self.local_mode = local

    def guide(self, q: Sequence[float]) -> None:
        """A hand leads the arm to joint angles (6,), radians, whatever mode it is in."""
        with self.lock:
            self.stop_program()
            self.arm.begin(joint_move(self.arm.q, np.array(q), _HAND_SPEED, _HAND_ACCELERATION))

    def write_input(self, name: str, value: Value) -> None:
        """An input variable that a client wrote."""
        with self.lock:
            if name.startswith("input_int_register_"):
                self.registers.input_int[int(name[19:])] = int(value)  # type: ignore[arg-type]
            elif name.startswith("input_double_register_"):
                self.registers.input_double[int(name[22:])] = float(value)  # type: ignore[arg-type]

    def load_program(self, text: str) -> None:
        """Starts a program that came in through the script port, in place of the one that runs."""
        with self.lock:
            self.stop_program()
            if not self.local_mode and not self.arm.stopped_by_safety and self.arm.robot_mode == RUNNING:
                self._script = ControlScript(self.arm, self.registers, text, self.period_s)
                self._startup_s = _STARTUP_S

    def stop_program(self) -> None:
        """Ends the program and its motion."""
        with self.lock:
            self._script = None
            self._runtime = _STOPPED
            self.arm.begin(None)

    def protective_stop(self) -> None:
        """As after a collision; the controller pauses the program."""
        with self.lock:
            self.arm.protective_stop("the fault console asked for it")

    def emergency_stop(self) -> None:
        """As by the red button."""
        with self.lock:
            self.stop_program()
            self.arm.emergency_stop()

    def clear(self) -> None:
        """The operator ends a stop; the program has to be uploaded again."""
        with self.lock:
            if self.arm.stopped_by_safety:
                self.stop_program()
            self.arm.clear()

    def _run_program(self) -> None:
        if self._script is None:
            return
        if self.arm.stopped_by_safety:
            self._runtime = _PAUSED if self._runtime == _PLAYING else self._runtime
            self._script = None
            return
        if self._startup_s > 0:
            self._startup_s -= self.period_s
            if self._startup_s <= 0:
                self._runtime = _PLAYING
                self._script.start()
            return
        try:
            self._script.step()
        except ProgramEnded:
            self.stop_program()

    def _publish(self, true_time_s: float) -> None:
        arm, values = self.arm, self.values
        q, qd, pose = arm.q.tolist(), arm.joint_speed().tolist(), arm.tcp_pose.tolist()
        speed = arm.tcp_speed().tolist()
        values.update(
            timestamp=self._clock_s,
            actual_q=q,
            target_q=q,
            actual_qd=qd,
            target_qd=qd,
            actual_TCP_pose=pose,
            target_TCP_pose=pose,
            actual_TCP_speed=speed,
            target_TCP_speed=speed,
            tcp_offset=arm.tcp_offset.tolist(),
            payload=float(arm.payload[0]),
            payload_cog=arm.payload[1:].tolist(),
            speed_scaling=arm.slider,
            target_speed_fraction=arm.slider,
            robot_mode=arm.robot_mode,
            safety_mode=arm.safety_mode,
            safety_status=arm.safety_mode,
            safety_status_bits=arm.safety_bits,
            runtime_state=self._runtime,
            robot_status_bits=1 | (2 if self._runtime == _PLAYING else 0),
        )
        self.registers.output_double[TRUE_TIME_REGISTER] = true_time_s
        values.update(zip(_INT_REGISTERS, self.registers.output_int, strict=True))
        values.update(zip(_DOUBLE_REGISTERS, self.registers.output_double, strict=True))


_INT_REGISTERS = [f"output_int_register_{i}" for i in range(REGISTERS)]
_DOUBLE_REGISTERS = [f"output_double_register_{i}" for i in range(REGISTERS)]
