"""Commands to the motion process, under a watchdog: nobody waits for an arm that stopped or is gone."""

from __future__ import annotations

import contextlib
import json
import socket
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor, wait
from typing import Any

from acquisition.process import ChildProcess
from dataset.errors import DeviceError

SCRIPT_PORT = 30003
DASHBOARD_PORT = 29999

_POLL_S = 0.02
_CONNECT_TIMEOUT_S = 1.0
_START_TIMEOUT_S = 10.0
_ANSWER_TIMEOUT_S = 8.0  # above the 5 s that ur_rtde gives its program to start


class MotionClient:
    """Starts the motion process of one arm when it is needed, asks it, and ends it when it misbehaves.

    Args:
        host: address of the controller.
        check: raises DeviceError where the arm is stopped or lost; called while an answer is awaited.
        on_start: called with this client each time a motion process has come up.
    """

    def __init__(
        self, host: str, check: Callable[[], None], on_start: Callable[[MotionClient], None]
    ) -> None:
        self._host = host
        self._check = check
        self._on_start = on_start
        self._process: ChildProcess | None = None
        self._waiter = ThreadPoolExecutor(1, thread_name_prefix="motion")

    def start(self) -> None:
        """Starts the process where there is none. Raises DeviceError where the arm takes no commands."""
        self._check_or_abort()
        self._ensure_started()

    def ask(self, verb: str, **arguments: Any) -> Any:
        """The answer to a request of `motion_service`; starts the process where there is none.

        Raises:
            DeviceError: the arm stopped or was lost (its typed error), or the request was refused or not
                answered in time. The program on the controller is then stopped and the process killed.
        """
        line = json.dumps({"do": verb, **arguments})
        self._check_or_abort()
        process = self._ensure_started()
        try:
            answer = self._watched(self._waiter.submit(process.command, line, _ANSWER_TIMEOUT_S))
        except BaseException:
            self.abort()
            raise
        return json.loads(answer)

    def abort(self) -> None:
        """Stops the arm by way of the dashboard and kills the motion process."""
        process, self._process = self._process, None
        if process is not None:
            if process.running:
                process.kill()
            process.stop()
        # The arm may be what is gone, and its user is told of that by the error under way.
        with contextlib.suppress(DeviceError):
            dashboard_request(self._host, "stop")

    def close(self) -> None:
        """Ends the motion process, which ends its program on the controller. Idempotent."""
        process, self._process = self._process, None
        if process is not None:
            process.stop(timeout_s=2.0)
        self._waiter.shutdown()

    def _check_or_abort(self) -> None:
        """An arm that stopped must not take its motion up again when somebody presses play."""
        try:
            self._check()
        except DeviceError:
            if self._process is not None:
                self.abort()
            raise

    def _ensure_started(self) -> ChildProcess:
        if self._process is not None and self._process.running:
            return self._process
        _probe(self._host, SCRIPT_PORT)
        if dashboard_request(self._host, "is in remote control") == "false":
            raise DeviceError(
                f"the arm {self._host} is in local mode and takes no commands; switch it to remote "
                "control at the top right of the pendant"
            )
        process = ChildProcess(
            "acquisition.robots.motion_service", [self._host], ready_timeout_s=_START_TIMEOUT_S
        )
        try:
            self._watched(self._waiter.submit(process.start))
        except DeviceError as error:
            process.stop(timeout_s=0.1)
            self._check()
            raise DeviceError(
                f"the arm {self._host} takes no commands ({error}); switch it to remote control at the "
                "pendant, power it on, release the brakes, and close other programs that control it"
            ) from error
        self._process = process
        try:
            self._on_start(self)
        except BaseException:
            self.abort()
            raise
        return process

    def _watched(self, future: Future[Any]) -> Any:
        """The future's result, unless the arm stops or is lost first: then that error."""
        while not wait([future], _POLL_S).done:
            self._check()
        return future.result()


def dashboard_request(host: str, request: str) -> str:
    """One question to the controller's dashboard, and its answer.

    Raises:
        DeviceError: the dashboard does not answer.
    """
    try:
        with (
            socket.create_connection((host, DASHBOARD_PORT), _CONNECT_TIMEOUT_S) as connection,
            connection.makefile("rw", encoding="utf-8", newline="\n") as lines,
        ):
            greeting = lines.readline()
            lines.write(f"{request}\n")
            lines.flush()
            answer = lines.readline()
            if not (greeting and answer):
                raise ConnectionError("it closed the connection")
            return answer.strip()
    except OSError as error:
        raise DeviceError(
            f"the dashboard of the arm {host} does not answer ({error}); enable it under Settings > Security "
            "> Services on the pendant"
        ) from error


def _probe(host: str, port: int) -> None:
    # Before the vendor's client, which would wait for a dead host without an end.
    try:
        socket.create_connection((host, port), _CONNECT_TIMEOUT_S).close()
    except OSError as error:
        raise DeviceError(
            f"port {port} of the arm {host} is closed ({error}); enable the dashboard and the primary "
            "interfaces under Settings > Security > Services on the pendant"
        ) from error
