"""Runs trainings side by side, a process and a thread each: two threads sharing one training are slower.

They end with the process that started them, however it ends.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
import time
from collections.abc import Mapping
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path

from dataset.errors import ToolkitError
from s2p3.console_output import progress_bars

_POLL_S = 1.0
_TAIL_BYTES = 4096
_COMMAND_LINE = """
import sys
from acquisition.process import die_with_parent
die_with_parent({parent})
from s2p3.cli import main
sys.exit(main())
"""


@dataclass(frozen=True)
class Training:
    """One command and how to see how far it is.

    Attributes:
        words: of the `s2p3` command line.
        log: JSON lines with a "step" that the training appends to.
        steps: how many it takes.
        after: name of the training that it needs, or whose core it takes over; None starts at once.
    """

    words: tuple[str, ...]
    log: Path
    steps: int
    after: str | None = None


def run_side_by_side(trainings: Mapping[str, Training]) -> None:
    """Runs all trainings at once and shows how far each is.

    Raises:
        ToolkitError: one of them failed, with the last line it wrote; the others are stopped, and go on from
            their checkpoints next time.
    """
    running: dict[str, subprocess.Popen[bytes]] = {}
    done: set[str] = set()
    with progress_bars(trainings) as report, ExitStack() as stack:
        while len(done) < len(trainings):
            for name, training in trainings.items():
                if name not in running and (training.after in done or training.after not in trainings):
                    running[name] = _start(training, stack)
            time.sleep(_POLL_S)
            for name, process in running.items():
                training, code = trainings[name], process.poll()
                if code:
                    raise ToolkitError(f"{name}: training failed: {_last_words(_output(training))}")
                if code == 0:
                    done.add(name)
                report(name, training.steps if code == 0 else _last_step(training.log), training.steps, {})


def _start(training: Training, stack: ExitStack) -> subprocess.Popen[bytes]:
    training.log.parent.mkdir(parents=True, exist_ok=True)
    command = [sys.executable, "-c", _COMMAND_LINE.format(parent=os.getpid()), *training.words]
    with _output(training).open("wb") as stream:
        process = subprocess.Popen(command, stdin=subprocess.DEVNULL, stdout=stream, stderr=subprocess.STDOUT)
    stack.callback(_end, process)
    return process


def _end(process: subprocess.Popen[bytes]) -> None:
    process.terminate()
    try:
        process.wait(10)
    except subprocess.TimeoutExpired:
        process.kill()
        process.wait()


def _output(training: Training) -> Path:
    return training.log.with_suffix(".out")


def _last_step(log: Path) -> int:
    """The step on the last complete line of a log that is being written; 0 where there is none."""
    if not log.exists():
        return 0
    with log.open("rb") as stream:
        stream.seek(max(0, log.stat().st_size - _TAIL_BYTES))
        lines = stream.read().split(b"\n")
    complete = [line for line in lines[:-1] if line.startswith(b"{")]
    return int(json.loads(complete[-1])["step"]) if complete else 0


def _last_words(output: Path) -> str:
    lines = [line.strip() for line in output.read_text(errors="replace").splitlines() if line.strip()]
    return lines[-1] if lines else f"see {output}"
