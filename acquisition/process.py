"""A child process that serves its parent: how it starts, takes commands, and ends with its parent.

Simulated devices run this way, and vendors' code that may hang or crash. The two speak in lines of text. The
child prints ``ready`` when it serves; after that, every line on its stdin is a command and is answered by one
line, ``ok [text]`` or ``error text``. Its stdin reaching the end means that nobody needs it any more.
"""

import contextlib
import ctypes
import os
import queue
import signal
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Sequence
from types import FrameType, TracebackType
from typing import IO, TYPE_CHECKING

from dataset.errors import DeviceError, ToolkitError

if TYPE_CHECKING:
    from typing_extensions import Self

_READY = "ready"
_PR_SET_PDEATHSIG = 1  # linux/prctl.h


class ChildProcess:
    """Runs ``python -m module arguments``; a context manager that starts and stops it.

    The process leads its own session, so that Ctrl-C in the terminal reaches the toolkit first and a device
    outlives the clean-up of its clients.
    """

    def __init__(self, module: str, arguments: Sequence[str] = (), *, ready_timeout_s: float = 30.0) -> None:
        self.module = module
        self._command = [sys.executable, "-m", module, *arguments]
        self._ready_timeout_s = ready_timeout_s
        self._process: subprocess.Popen[str] | None = None
        self._lines: queue.Queue[str | None] = queue.Queue()
        self._log: IO[str] | None = None
        self._lock = threading.Lock()

    def __enter__(self) -> "Self":
        self.start()
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        self.stop()

    @property
    def running(self) -> bool:
        """True while the process is alive."""
        return self._process is not None and self._process.poll() is None

    @property
    def pid(self) -> int:
        """Process id. Raises DeviceError when it was not started."""
        return self._started().pid

    def start(self) -> None:
        """Starts the process and returns when it serves.

        Raises DeviceError, quoting the end of its stderr, when it ends or stays silent instead.
        """
        if self.running:
            raise DeviceError(f"{self.module} is already running; stop it before starting it again")
        self.stop()
        # A file, not a pipe: nobody has to read it for the child to go on.
        self._log = tempfile.TemporaryFile("w+", encoding="utf-8")  # noqa: SIM115 - closed by stop()
        self._lines = queue.Queue()
        self._process = subprocess.Popen(
            self._command,
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=self._log,
            text=True,
            start_new_session=True,
        )
        threading.Thread(target=_collect, args=(self._process.stdout, self._lines), daemon=True).start()
        try:
            self._wait_for(lambda line: line == _READY, self._ready_timeout_s, "to be ready")
        except BaseException:
            self.stop()
            raise

    def command(self, line: str, timeout_s: float = 5.0) -> str:
        """Sends one command line and returns the text of its answer.

        Raises DeviceError when the child refuses the command, has ended, or does not answer in time.
        """
        process = self._started()
        with self._lock:
            self._discard_late_answers()
            try:
                assert process.stdin is not None
                process.stdin.write(line.strip() + "\n")
                process.stdin.flush()
            except (BrokenPipeError, ValueError) as error:
                raise DeviceError(self._ended(f"to accept '{line}'")) from error
            answer = self._wait_for(
                lambda text: text.split(" ", 1)[0] in ("ok", "error"), timeout_s, f"to answer '{line}'"
            )
        verdict, _, text = answer.partition(" ")
        if verdict == "error":
            raise DeviceError(f"{self.module} refused the command '{line}': {text}")
        return text

    def stop(self, timeout_s: float = 5.0) -> None:
        """Closes the child's stdin and waits for its end; kills it when it does not end. Idempotent."""
        process, self._process = self._process, None
        if process is not None:
            with contextlib.suppress(BrokenPipeError):
                assert process.stdin is not None
                process.stdin.close()
            try:
                process.wait(timeout_s)
            except subprocess.TimeoutExpired:
                process.kill()
                process.wait()
        if self._log is not None:
            self._log.close()
            self._log = None

    def kill(self) -> None:
        """Ends the process without warning, as a power cut would; `start` brings the device back."""
        process = self._started()
        process.kill()
        process.wait()

    def stderr_tail(self, lines: int = 8) -> str:
        """The last lines that the child wrote to its stderr, joined by ' | '."""
        if self._log is None:
            return ""
        size = os.fstat(self._log.fileno()).st_size
        # pread: the child writes through the same open file, whose position must not move.
        raw = os.pread(self._log.fileno(), 8192, max(0, size - 8192))
        text = raw.decode("utf-8", errors="replace").strip().splitlines()
        return " | ".join(part.strip() for part in text[-lines:] if part.strip())

    def _started(self) -> "subprocess.Popen[str]":
        if self._process is None:
            raise DeviceError(f"{self.module} is not running; start it first")
        return self._process

    def _discard_late_answers(self) -> None:
        with contextlib.suppress(queue.Empty):
            while self._lines.get_nowait() is not None:
                continue
            self._lines.put(None)

    def _wait_for(self, accept: Callable[[str], bool], timeout_s: float, purpose: str) -> str:
        deadline = time.monotonic() + timeout_s
        while True:
            try:
                line = self._lines.get(timeout=max(0.0, deadline - time.monotonic()))
            except queue.Empty:
                raise DeviceError(
                    f"{self.module} took more than {timeout_s:g} s {purpose}; its stderr: "
                    f"{self.stderr_tail() or 'empty'}"
                ) from None
            if line is None:
                raise DeviceError(self._ended(purpose))
            if accept(line):
                return line

    def _ended(self, purpose: str) -> str:
        code = self._started().wait()
        return (
            f"{self.module} ended (exit code {code}) when it was expected {purpose}; "
            f"its stderr: {self.stderr_tail() or 'empty'}"
        )


def die_with_parent(parent: int | None = None) -> None:
    """Called first by a child: ends this process when the one that started it dies, however it dies.

    Args:
        parent: id of that process; without it, one that died before this call goes unnoticed.
    """
    parent = os.getppid() if parent is None else parent

    # The kernel sends the signal when the starting *thread* ends, which need not be the end of its process.
    def on_parent_thread_end(number: int, frame: FrameType | None) -> None:
        if os.getppid() != parent:
            os._exit(1)

    signal.signal(signal.SIGHUP, on_parent_thread_end)
    libc = ctypes.CDLL(None, use_errno=True)
    if libc.prctl(_PR_SET_PDEATHSIG, int(signal.SIGHUP), 0, 0, 0) != 0:
        raise ToolkitError(f"prctl(PR_SET_PDEATHSIG) failed: {os.strerror(ctypes.get_errno())}")
    if os.getppid() != parent:
        os._exit(1)


def serve_commands(handle: Callable[[str], str]) -> None:
    """Called by a child that serves: announces ``ready``, answers command lines until stdin ends.

    `handle` takes a command line and returns the text of the answer; a ToolkitError or ValueError that it
    raises becomes an ``error`` answer. Returns at the end of stdin or at Ctrl-C.
    """
    print(_READY, flush=True)
    with contextlib.suppress(KeyboardInterrupt):
        for line in sys.stdin:
            if not line.strip():
                continue
            try:
                answer = f"ok {handle(line.strip())}"
            except (ToolkitError, ValueError) as error:
                answer = f"error {error}"
            print(" ".join(answer.split()), flush=True)


def _collect(stream: IO[str] | None, lines: "queue.Queue[str | None]") -> None:
    assert stream is not None
    with stream:
        for line in stream:
            lines.put(line.strip())
    lines.put(None)
