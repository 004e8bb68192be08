"""Trainings in processes of their own: both end well, or all end with the words of the one that failed."""

from __future__ import annotations

import contextlib
import json
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path

import pytest

from dataset.errors import ToolkitError
from s2p3.side_by_side import Training, _last_step, run_side_by_side


def info(session: Path, log: Path) -> Training:
    """A command that ends well, soon."""
    return Training(("dataset", "info", str(session)), log, 1)


def test_all_run_and_each_leaves_its_output(cup_session: Path, tmp_path: Path) -> None:
    run_side_by_side({name: info(cup_session, tmp_path / name / "log.jsonl") for name in ("one", "two")})
    for name in ("one", "two"):
        assert "synthetic" in (tmp_path / name / "log.out").read_text()


def test_one_that_fails_is_quoted_and_ends_the_others(cup_session: Path, tmp_path: Path) -> None:
    failing = Training(("dataset", "info", str(tmp_path / "no.h5")), tmp_path / "failing.jsonl", 9)
    words = ("train", "student", str(cup_session), "--object", "cup", "--preset", "paper")  # would take hours
    endless = Training((*words, "--out", str(tmp_path / "endless")), tmp_path / "endless" / "log.jsonl", 9)
    before = children()
    with pytest.raises(ToolkitError, match=r"^failing: training failed: s2p3: .*no\.h5 does not exist"):
        run_side_by_side({"endless": endless, "failing": failing})
    assert children() == before


def test_trainings_end_with_a_process_that_is_killed(cup_session: Path, tmp_path: Path) -> None:
    words = ("train", "student", str(cup_session), "--object", "cup", "--preset", "paper")  # would take hours
    log = tmp_path / "log.jsonl"
    training = f"Training({(*words, '--out', str(tmp_path))!r}, pathlib.Path({str(log)!r}), 9)"
    program = (
        "import pathlib; from s2p3.side_by_side import Training, run_side_by_side; "
        f"run_side_by_side({{'endless': {training}}})"
    )
    parent = subprocess.Popen([sys.executable, "-c", program])
    try:
        wait_until(lambda: bool(running(str(tmp_path))))
    finally:
        parent.kill()
        parent.wait()
    wait_until(lambda: not running(str(tmp_path)))


def running(word: str) -> list[int]:
    """Ids of the trainings whose command line holds `word`."""
    found = []
    for path in Path("/proc").glob("[0-9]*/cmdline"):
        with contextlib.suppress(OSError):
            arguments = path.read_text().split("\0")
            if "train" in arguments and word in arguments:
                found.append(int(path.parent.name))
    return found


def wait_until(condition: Callable[[], bool], seconds: float = 60.0) -> None:
    deadline = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < deadline
        time.sleep(0.1)


def children() -> set[str]:
    """Process ids of this process's children."""
    return {pid for task in Path("/proc/self/task").glob("*/children") for pid in task.read_text().split()}


@pytest.mark.parametrize(
    ("text", "step"),
    [
        ("", 0),
        ('{"step": 3}\n{"step": 4}\n', 4),
        ('{"step": 3}\n{"step": 4, "lo', 3),
        ("starting\n", 0),
        ("x" * 5000 + '\n{"step": 12}\n', 12),
    ],
)
def test_the_last_complete_line_of_a_growing_log_counts(tmp_path: Path, text: str, step: int) -> None:
    log = tmp_path / "log.jsonl"
    assert _last_step(log) == 0
    log.write_text(text)
    assert _last_step(log) == step
    assert all(json.loads(line)["step"] for line in text.splitlines() if line.endswith("}"))
