"""The simulated arm as a process: a Universal Robots UR5e controller that unmodified clients can drive.

It serves RTDE (port 30004), the script port (30003, 30002) and the dashboard (29999) on any address of the
loopback network, so that several arms can live beside each other: ``python -m acquisition.simulation.robot
--host 127.0.0.5``. Faults are commanded on stdin, one a line; `acquisition.simulation.faults` has them all.
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

from acquisition.process import ChildProcess, die_with_parent, serve_commands
from acquisition.robots.rtde import PORT as RTDE_PORT
from acquisition.simulation.arm import HOME
from acquisition.simulation.controller import INPUTS, SOFTWARE, Controller
from acquisition.simulation.dashboard import serve_dashboard
from acquisition.simulation.faults import FaultConsole
from acquisition.simulation.ports import Ports
from acquisition.simulation.rtde_server import RtdeServer
from dataset.errors import ToolkitError

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
        software: version of PolyScope that it passes for; one before 5.5.1 does not tell tool and payload.
    """

    def __init__(
        self,
        host: str = "127.0.0.1",
        rate_hz: float = 500.0,
        drift_ppm: float = 0.0,
        software: tuple[int, int, int] = SOFTWARE,
    ) -> None:
        self.host = host
        arguments = ["--host", host, "--rate", f"{rate_hz}", "--drift-ppm", f"{drift_ppm}"]
        arguments += ["--software", ".".join(map(str, software))]
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
    parser.add_argument("--software", type=_version, default=SOFTWARE, help="PolyScope version (5.12.4)")
    options = parser.parse_args()
    controller = Controller(options.rate, options.drift_ppm, HOME, options.software)
    rtde = RtdeServer(controller.outputs, INPUTS, controller.write_input, controller.software, options.rate)
    ports = Ports(options.host)
    try:
        ports.listen(RTDE_PORT, rtde.serve)
        for port in SCRIPT_PORTS:
            ports.listen(port, lambda connection: _serve_scripts(controller, connection))
        ports.listen(DASHBOARD_PORT, lambda connection: serve_dashboard(controller, connection))
    except ToolkitError as error:
        print(error, file=sys.stderr)
        return 2
    threading.Thread(target=_run, args=(controller, rtde), daemon=True).start()
    serve_commands(FaultConsole(controller, rtde, ports).handle)
    return 0


def _version(text: str) -> tuple[int, int, int]:
    major, minor, bugfix = map(int, text.split("."))
    return major, minor, bugfix


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


if __name__ == "__main__":
    raise SystemExit(main())
