"""A child process starts, answers, fails with its own words, and never outlives its parent."""

import os
import signal
import subprocess
import sys
import textwrap
import threading
import time
from collections.abc import Callable
from pathlib import Path

import pytest

from acquisition.process import ChildProcess
from dataset.errors import DeviceError

ECHO = """
import sys, time
from acquisition.process import die_with_parent, serve_commands
die_with_parent()
def handle(line):
    if line == "refuse":
        raise ValueError("not today")
    if line == "think":
        time.sleep(1)
    if line == "crash":
        print("out of steam", file=sys.stderr, flush=True)
        raise SystemExit(3)
    return line.upper()
serve_commands(handle)
if "--deaf" in sys.argv:
    time.sleep(60)
"""


@pytest.fixture
def module(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Callable[[str], str]:
    """Makes a module of the given source importable in a child process and returns its name."""
    monkeypatch.setenv("PYTHONPATH", str(tmp_path))

    def make(source: str) -> str:
        (tmp_path / "peer_for_test.py").write_text(textwrap.dedent(source))
        return "peer_for_test"

    return make


def alive(pid: int) -> bool:
    try:
        state = Path(f"/proc/{pid}/stat").read_text().rsplit(")", 1)[1].split()[0]
    except FileNotFoundError:
        return False
    return state != "Z"


def wait_until_dead(pid: int, timeout_s: float = 5.0) -> bool:
    deadline = time.monotonic() + timeout_s
    while alive(pid) and time.monotonic() < deadline:
        time.sleep(0.02)
    return not alive(pid)


def test_answers_commands_and_ends_with_the_context(module: Callable[[str], str]) -> None:
    with ChildProcess(module(ECHO)) as peer:
        assert peer.command("hello") == "HELLO"
        pid = peer.pid
    assert not alive(pid)
    with pytest.raises(DeviceError, match="not running"):
        peer.command("hello")


def test_refused_command_says_why_and_the_peer_goes_on(module: Callable[[str], str]) -> None:
    with ChildProcess(module(ECHO)) as peer:
        with pytest.raises(DeviceError, match="refused the command 'refuse': not today"):
            peer.command("refuse")
        assert peer.command("on") == "ON"


def test_late_answer_is_not_taken_for_the_next_one(module: Callable[[str], str]) -> None:
    with ChildProcess(module(ECHO)) as peer:
        with pytest.raises(DeviceError, match=r"more than 0\.1 s to answer 'think'"):
            peer.command("think", timeout_s=0.1)
        time.sleep(1.2)
        assert peer.command("next") == "NEXT"


def test_death_is_reported_with_exit_code_and_stderr(module: Callable[[str], str]) -> None:
    with ChildProcess(module(ECHO)) as peer:
        with pytest.raises(DeviceError, match=r"exit code 3.*out of steam"):
            peer.command("crash")
        peer.start()
        assert peer.command("back") == "BACK"


def test_start_reports_a_crash(module: Callable[[str], str]) -> None:
    peer = ChildProcess(module("raise RuntimeError('port 3956 is taken')"))
    with pytest.raises(DeviceError, match="port 3956 is taken"):
        peer.start()
    assert not peer.running


def test_start_gives_up_on_a_silent_peer(module: Callable[[str], str]) -> None:
    peer = ChildProcess(module("import time; time.sleep(60)"), ready_timeout_s=0.3)
    with pytest.raises(DeviceError, match=r"more than 0\.3 s to be ready"):
        peer.start()
    assert not peer.running


def test_kill_and_restart(module: Callable[[str], str]) -> None:
    with ChildProcess(module(ECHO)) as peer:
        peer.kill()
        assert not peer.running
        peer.start()
        assert peer.command("again") == "AGAIN"


@pytest.mark.parametrize("arguments", [[], ["--deaf"]])
def test_dies_when_its_parent_is_killed(module: Callable[[str], str], arguments: list[str]) -> None:
    name = module(ECHO)
    script = (
        "import time\nfrom acquisition.process import ChildProcess\n"
        f"peer = ChildProcess({name!r}, {arguments!r}); peer.start(); print(peer.pid, flush=True)\n"
        "time.sleep(60)"
    )
    with subprocess.Popen([sys.executable, "-c", script], stdout=subprocess.PIPE, text=True) as parent:
        assert parent.stdout is not None
        pid = int(parent.stdout.readline())
        assert alive(pid)
        os.kill(parent.pid, signal.SIGKILL)
    assert wait_until_dead(pid)


def test_outlives_the_thread_that_started_it(module: Callable[[str], str]) -> None:
    peer = ChildProcess(module(ECHO))
    starter = threading.Thread(target=peer.start)
    starter.start()
    starter.join()
    try:
        time.sleep(0.2)
        assert peer.command("still here") == "STILL HERE"
    finally:
        peer.stop()
