"""The simulated controller's dashboard: one line asks, one line answers."""

from __future__ import annotations

import socket
from collections.abc import Callable

from acquisition.simulation.arm import (
    EMERGENCY_MODE,
    IDLE,
    NORMAL_MODE,
    POWER_OFF,
    PROTECTIVE_MODE,
    RUNNING,
)
from acquisition.simulation.controller import Controller

_REMOTE_ONLY = {"stop", "restart safety", "power on", "power off", "brake release"}
_GREETING = "Connected: Universal Robots Dashboard Server"
_SERIAL = "20235500001"
_ROBOT_MODES = {POWER_OFF: "POWER_OFF", IDLE: "IDLE", RUNNING: "RUNNING"}
_SAFETY_MODES = {
    NORMAL_MODE: "NORMAL",
    PROTECTIVE_MODE: "PROTECTIVE_STOP",
    EMERGENCY_MODE: "ROBOT_EMERGENCY_STOP",
}


def serve_dashboard(controller: Controller, connection: socket.socket) -> None:
    """Talks to one dashboard client until it goes away; call it in a thread of its own."""
    connection.sendall(f"{_GREETING}\n".encode())
    with connection.makefile("r", encoding="utf-8", errors="replace") as lines:
        for line in lines:
            connection.sendall(f"{answer(controller, line.strip())}\n".encode())
            if line.strip() == "quit":
                return


def answer(controller: Controller, request: str) -> str:
    """The dashboard's reply to one request, which it also carries out."""
    command = _COMMANDS.get(request.lower())
    if command is not None:
        if controller.local_mode and request.lower() in _REMOTE_ONLY:
            return "Command is not allowed in local mode"
        with controller.lock:
            return command(controller)
    if request.lower().startswith(("popup", "addtolog")):
        return "showing popup" if request.lower().startswith("popup") else "Added log message"
    return f"could not understand: '{request}'"


def _stop(controller: Controller) -> str:
    controller.stop_program()
    return "Stopped"


def _running(controller: Controller) -> str:
    return f"Program running: {str(controller.program_running).lower()}"


def _program_state(controller: Controller) -> str:
    return f"{'PLAYING' if controller.program_running else 'STOPPED'} rtde_control.urp"


def _robot_mode(controller: Controller) -> str:
    return f"Robotmode: {_ROBOT_MODES[controller.arm.robot_mode]}"


def _safety_mode(controller: Controller) -> str:
    return f"Safetymode: {_SAFETY_MODES[controller.arm.safety_mode]}"


def _safety_status(controller: Controller) -> str:
    return f"Safetystatus: {_SAFETY_MODES[controller.arm.safety_mode]}"


def _unlock(controller: Controller) -> str:
    if controller.arm.safety_mode != PROTECTIVE_MODE:
        return "Cannot unlock protective stop"
    controller.clear()
    return "Protective stop releasing"


def _restart_safety(controller: Controller) -> str:
    controller.clear()
    controller.arm.robot_mode = POWER_OFF
    return "Restarting safety"


def _power_on(controller: Controller) -> str:
    if controller.arm.robot_mode == POWER_OFF and not controller.arm.stopped_by_safety:
        controller.arm.robot_mode = IDLE
    return "Powering on"


def _power_off(controller: Controller) -> str:
    controller.stop_program()
    controller.arm.robot_mode = POWER_OFF
    return "Powering off"


def _brake_release(controller: Controller) -> str:
    if controller.arm.robot_mode == IDLE:
        controller.arm.robot_mode = RUNNING
    return "Brake releasing"


def _version(controller: Controller) -> str:
    return f"URSoftware {'.'.join(map(str, controller.software))} (Jan 01 2024)"


_COMMANDS: dict[str, Callable[[Controller], str]] = {
    "stop": _stop,
    "running": _running,
    "programstate": _program_state,
    "robotmode": _robot_mode,
    "safetymode": _safety_mode,
    "safetystatus": _safety_status,
    "unlock protective stop": _unlock,
    "restart safety": _restart_safety,
    "power on": _power_on,
    "power off": _power_off,
    "brake release": _brake_release,
    "polyscopeversion": _version,
    "get serial number": lambda _: _SERIAL,
    "get robot model": lambda _: "UR5",
    "is in remote control": lambda controller: str(not controller.local_mode).lower(),
    "close popup": lambda _: "closing popup",
    "close safety popup": lambda _: "closing safety popup",
    "quit": lambda _: "Disconnected",
}
