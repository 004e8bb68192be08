"""What can go wrong with an arm, at the command of whoever tests: one line of text, one fault."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from acquisition.robots.rtde import PORT as RTDE_PORT
from acquisition.simulation.controller import Controller
from acquisition.simulation.ports import Ports
from acquisition.simulation.rtde_server import RtdeServer

Numbers = list[float]


class FaultConsole:
    """Carries out fault commands on one simulated controller."""

    def __init__(self, controller: Controller, rtde: RtdeServer, ports: Ports) -> None:
        self._controller = controller
        self._rtde = rtde
        self._ports = ports
        self._verbs: dict[str, tuple[int, Callable[[Numbers], object]]] = {
            "pstop": (0, lambda _: controller.protective_stop()),
            "estop": (0, lambda _: controller.emergency_stop()),
            "clear": (0, lambda _: controller.clear()),
            "slider": (1, lambda x: self._slide(x[0])),
            "guide": (6, lambda q: controller.guide(q)),
            "tcp": (6, lambda offset: controller.arm.set_tcp(np.array(offset))),
            "payload": (4, lambda load: setattr(controller.arm, "payload", np.array(load))),
            "local": (0, lambda _: controller.switch_to(local=True)),
            "remote": (0, lambda _: controller.switch_to(local=False)),
            "stall": (0, lambda _: setattr(rtde, "stalled", True)),
            "unstall": (0, lambda _: setattr(rtde, "stalled", False)),
            "hang": (0, lambda _: setattr(rtde, "hung", True)),
            "unhang": (0, lambda _: setattr(rtde, "hung", False)),
            "slow": (1, lambda s: setattr(rtde, "lateness_s", max(0.0, s[0]))),
            "drop": (0, lambda _: rtde.drop()),
            "mute": (0, lambda _: setattr(ports, "muted", True)),
            "unmute": (0, lambda _: setattr(ports, "muted", False)),
            "drift": (1, lambda ppm: controller.drift(ppm[0])),
            "jump": (1, lambda s: controller.jump_clock(s[0])),
            "restart": (0, lambda _: self._restart()),
        }

    def handle(self, line: str) -> str:
        """Carries out one command and returns what there is to say.

        Raises ValueError for a command that it does not know, or with another count of numbers.
        """
        verb, *arguments = line.split()
        if verb == "state" and not arguments:
            return self._state()
        if verb not in self._verbs:
            raise ValueError(f"unknown command '{line}'; use {', '.join(self._verbs)}, or state")
        count, act = self._verbs[verb]
        if len(arguments) != count:
            raise ValueError(f"'{verb}' takes {count} numbers, not {len(arguments)}")
        with self._controller.lock:
            act([float(argument) for argument in arguments])
        return ""

    def _slide(self, share: float) -> None:
        if not 0 <= share <= 1:
            raise ValueError(f"the speed slider goes from 0 to 1, not to {share:g}")
        self._controller.arm.slider = share

    def _restart(self) -> None:
        self._controller.restart()
        self._ports.cut()

    def _state(self) -> str:
        controller, arm = self._controller, self._controller.arm
        opened = self._ports.opened
        control = sum(count for port, count in opened.items() if port != RTDE_PORT)
        return (
            f"safety_bits={arm.safety_bits} program={controller.program_running} stop={arm.last_stop!r} "
            f"connections={opened[RTDE_PORT]} control_connections={control}"
        )
