"""The process that commands a Universal Robots arm: ur_rtde's control interface behind lines of JSON.

It is a process of its own because the interface can hold the interpreter's lock while it connects, waits up
to 300 s for a controller that died, and has been seen to crash when its link drops. The parent kills it
whenever the arm does not do what it should. Motions start asynchronously; "moving" tells when they ended.

    python -m acquisition.robots.motion_service HOST
"""

from __future__ import annotations

import json
import os
import sys
import threading
import time
from collections.abc import Callable
from typing import Any

from acquisition.process import serve_commands

_PARENT_POLL_S = 0.2
_FAREWELL_S = 1.0  # to end the program on the controller, which stops the arm
_START_SEEN_WITHIN_S = 0.5  # a motion whose start is not seen in the status register by then is over


class MotionService:
    """Carries out requests on one arm."""

    def __init__(self, host: str) -> None:
        import rtde_control

        self._control = rtde_control.RTDEControlInterface(host)

    def handle(self, line: str) -> str:
        """One request, {"do": verb, ...arguments}, to its JSON answer.

        Raises ValueError where the verb is unknown or the controller does not carry it out.
        """
        request: dict[str, Any] = json.loads(line)
        verb = request.pop("do")
        actions: dict[str, Callable[..., Any]] = {
            "set_tcp": self.set_tcp,
            "tcp_offset": self.tcp_offset,
            "move_joints": self.move_joints,
            "move_linear": self.move_linear,
            "follow": self.follow,
            "moving": self.moving,
            "stop": self.stop,
            "inverse_kinematics": self.inverse_kinematics,
        }
        if verb not in actions:
            raise ValueError(f"unknown request {verb}")
        try:
            return json.dumps(actions[verb](**request))
        except RuntimeError as error:  # how the vendor's exceptions arrive
            raise ValueError(f"{verb}: {error}") from error

    def close(self) -> None:
        """Ends the program on the controller, which stops the arm, and disconnects."""
        self._control.stopScript()
        self._control.disconnect()

    # The requests; each returns its answer.

    def set_tcp(self, offset: list[float]) -> bool:
        return bool(self._control.setTcp(offset))

    def tcp_offset(self) -> list[float]:
        return list(self._control.getTCPOffset())

    def move_joints(self, q: list[float], speed: float, acceleration: float) -> bool:
        return self._started(self._control.moveJ(q, speed, acceleration, True))

    def move_linear(self, pose: list[float], speed: float, acceleration: float) -> bool:
        return self._started(self._control.moveL(pose, speed, acceleration, True))

    def follow(self, path: list[list[float]]) -> bool:
        return self._started(self._control.moveJ(path, True))

    def moving(self) -> bool:
        # A program that was ended at the pendant leaves its last word in the register.
        if not self._control.isProgramRunning():
            return False
        return bool(self._control.getAsyncOperationProgressEx().isAsyncOperationRunning())

    def stop(self, deceleration: float) -> bool:
        self._control.stopJ(deceleration)
        return True

    def inverse_kinematics(self, pose: list[float], q_near: list[float]) -> list[float] | None:
        # Asked first: without a solution the controller would abort the whole control program.
        if not self._control.getInverseKinematicsHasSolution(pose, q_near):
            return None
        return list(self._control.getInverseKinematics(pose, q_near))

    def _started(self, accepted: bool) -> bool:
        """Waits for the motion's start to show: "moving" must not read the end of the motion before it."""
        deadline = time.monotonic() + _START_SEEN_WITHIN_S
        while accepted and not self.moving() and time.monotonic() < deadline:
            time.sleep(0.002)
        return accepted


def _end_after(parent: int) -> None:
    """Ends this process soon after its parent; in a thread, as the main one may hang in vendor code."""
    while os.getppid() == parent:
        time.sleep(_PARENT_POLL_S)
    time.sleep(_FAREWELL_S)
    os._exit(1)


def main() -> int:
    """Serves requests until stdin ends or the parent process dies. Returns the exit code."""
    threading.Thread(target=_end_after, args=(os.getppid(),), daemon=True).start()
    try:
        service = MotionService(sys.argv[1])
    except ImportError:
        print("ur_rtde is not installed: pip install 's2p3[ur]'", file=sys.stderr)
        return 2
    except RuntimeError as error:  # how the vendor's exceptions arrive
        print(error, file=sys.stderr)
        return 2
    serve_commands(service.handle)
    service.close()
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
