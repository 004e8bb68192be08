"""The simulated arm as a process: a Universal Robots UR5e controller that unmodified clients can drive.

It serves RTDE (port 30004), the script port (30003, 30002) and the dashboard (29999) on any address of the
loopback network, so that several arms can live beside each other: ``python -m acquisition.simulation.robot
--host 127.0.0.5``. Commands on stdin, one a line: ``pstop``, ``estop``, ``clear``, ``stall`` and ``unstall``
(the stream falls silent and comes back), ``drop`` (every RTDE connection is cut), ``slow SECONDS`` (packages
leave up to that much late), ``jump SECONDS`` (the controller's clock is set), ``state``.
"""

from __future__ import annotations

import argparse
import contextlib
import os
import re
import socket
import sys
import threading
import time
from collections.abc import Callable

from acquisition.process import ChildProcess, die_with_parent, serve_commands
from acquisition.robots.rtde import PORT as RTDE_PORT
from acquisition.simulation.arm import HOME
from acquisition.simulation.controller import INPUTS, OUTPUTS, SOFTWARE_VERSION, Controller
from acquisition.simulation.dashboard import serve_dashboard
from acquisition.simulation.rtde_server import RtdeServer
from dataset.errors import DeviceError, ToolkitError

SCRIPT_PORTS = (30003, 30002)
DASHBOARD_PORT = 29999

_PROGRAM_END = re.compile(r"^end[ \t]*\r?\n", re.MULTILINE)
_PRIORITY = -10  # where it is permitted: a real controller is not held up by the host's other work
_LARGEST_LAG_S = 0.5  # beyond it the arm lost time; it goes on from now instead of catching up


class SimulatedRobot(ChildProcess):
    """The simulated arm, started and stopped as a context manager.

    Args:
        host: loopback address to serve at; each arm needs its own.
        rate_hz: of the control loop, and the highest rate a client gets.
        drift_ppm: how much faster than the host's clock the controller's clock runs.
    """

    def __init__(self, host: str = "127.0.0.1", rate_hz: float = 500.0, drift_ppm: float = 0.0) -> None:
        self.host = host
        arguments = ["--host", host, "--rate", f"{rate_hz}", "--drift-ppm", f"{drift_ppm}"]
        super().__init__("acquisition.simulation.robot", arguments)


def main() -> int:
    """Serves until stdin ends or the parent process dies. Returns the exit code."""
    die_with_parent()
    with contextlib.suppress(PermissionError):
        os.nice(_PRIORITY)
    parser = argparse.ArgumentParser(description="A simulated UR5e controller on the loopback network.")
    parser.add_argument("--host", default="127.0.0.1", help="address to serve at (127.0.0.1)")
    parser.add_argument("--rate", type=float, default=500.0, help="control rate, Hz (500)")
    parser.add_argument("--drift-ppm", type=float, default=0.0, help="error of the controller's clock (0)")
    options = parser.parse_args()
    controller = Controller(options.rate, options.drift_ppm, HOME)
    rtde = RtdeServer(OUTPUTS, INPUTS, controller.write_input, SOFTWARE_VERSION, options.rate)
    try:
        _listen(options.host, RTDE_PORT, rtde.serve)
        for port in SCRIPT_PORTS:
            _listen(options.host, port, lambda connection: _serve_scripts(controller, connection))
        _listen(options.host, DASHBOARD_PORT, lambda connection: serve_dashboard(controller, connection))
    except ToolkitError as error:
        print(error, file=sys.stderr)
        return 2
    threading.Thread(target=_run, args=(controller, rtde), daemon=True).start()
    serve_commands(lambda line: handle_fault(controller, rtde, line))
    return 0


def handle_fault(controller: Controller, rtde: RtdeServer, line: str) -> str:
    """Carries out one command of the fault console. Raises ValueError for one that it does not know."""
    verb, *arguments = line.split()
    switches: dict[str, Callable[[], None]] = {
        "pstop": controller.protective_stop,
        "estop": controller.emergency_stop,
        "clear": controller.clear,
        "drop": rtde.drop,
    }
    if verb in switches and not arguments:
        switches[verb]()
    elif verb in ("stall", "unstall") and not arguments:
        rtde.stalled = verb == "stall"
    elif verb == "slow" and len(arguments) == 1:
        rtde.lateness_s = max(0.0, float(arguments[0]))
    elif verb == "jump" and len(arguments) == 1:
        controller.jump_clock(float(arguments[0]))
    elif verb == "state" and not arguments:
        arm = controller.arm
        return f"safety_bits={arm.safety_bits} program={controller.program_running} stop={arm.last_stop!r}"
    else:
        raise ValueError(
            f"unknown command '{line}'; use pstop, estop, clear, stall, unstall, drop, slow S, jump S, state"
        )
    return ""


def _run(controller: Controller, rtde: RtdeServer) -> None:
    """The control loop, paced by the host's monotonic clock. The state is that of the planned time."""
    period_s = controller.period_s
    planned_s = time.monotonic()
    while True:
        planned_s += period_s
        lag_s = time.monotonic() - planned_s
        if lag_s > _LARGEST_LAG_S:
            lost = int(lag_s / period_s) * period_s
            controller.skip(lost)
            planned_s += lost
        elif lag_s < 0:
            time.sleep(-lag_s)
        controller.step(planned_s)
        rtde.publish(controller.values, time.monotonic())


def _serve_scripts(controller: Controller, connection: socket.socket) -> None:
    """Takes whole programs (`def ... end`) from a script connection; single lines have no effect here."""
    text = ""
    while chunk := connection.recv(65536):
        text += chunk.decode("utf-8", errors="replace")
        while "\n" in text:
            if not text.startswith("def "):
                text = text.partition("\n")[2]
                continue
            end = _PROGRAM_END.search(text)
            if end is None:
                break
            program, text = text[: end.end()], text[end.end() :]
            controller.load_program(program)


def _listen(host: str, port: int, serve: Callable[[socket.socket], None]) -> None:
    listener = socket.socket()
    listener.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
    try:
        listener.bind((host, port))
    except OSError as error:
        raise DeviceError(
            f"cannot serve a simulated arm at {host}:{port} ({error}); is another one running there? "
            "Use another --host such as 127.0.0.7"
        ) from error
    listener.listen(16)
    threading.Thread(target=_accept, args=(listener, serve), daemon=True).start()


def _accept(listener: socket.socket, serve: Callable[[socket.socket], None]) -> None:
    while True:
        connection, _ = listener.accept()
        connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        threading.Thread(target=_converse, args=(connection, serve), daemon=True).start()


def _converse(connection: socket.socket, serve: Callable[[socket.socket], None]) -> None:
    with connection, contextlib.suppress(OSError, DeviceError):  # however the client goes away
        serve(connection)


if __name__ == "__main__":
    raise SystemExit(main())
