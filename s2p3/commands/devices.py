"""`s2p3 doctor` and `s2p3 simulate`."""

from __future__ import annotations

import contextlib
import time
from pathlib import Path
from typing import TYPE_CHECKING

from rich.markup import escape

from s2p3.commands.arguments import ObjectName, OptionalPath
from s2p3.console_output import console, say, show

if TYPE_CHECKING:
    from s2p3.doctor_check import Check

_LOOK_S = 10.0


def doctor(*, rig: OptionalPath = None, json: bool = False) -> None:
    """Check what is installed, which device answers, the disk; each failing line says the fix.

    Args:
        rig: rig.toml of the devices to check; without it, only this machine is.
        json: print the checks as JSON.
    """
    from acquisition.rig import Rig
    from dataset.errors import ToolkitError
    from s2p3.doctor import doctor as run_checks

    checks = []
    for check in run_checks(None if rig is None else Rig.load(rig)):
        checks.append(check)
        if not json:
            _print(check)
    if json:
        show(
            {check.name: {"ok": check.ok, "detail": check.detail, "fix": check.fix} for check in checks},
            as_json=True,
        )
    failed = [check.name for check in checks if not check.ok]
    if failed:
        raise ToolkitError(
            f"doctor: {len(failed)} of {len(checks)} checks failed ({', '.join(failed)}); "
            "each line above says the fix"
        )


def _print(check: Check) -> None:
    mark = "[green]ok  [/green]" if check.ok else "[red]FAIL[/red]"
    console.print(f"{mark} {check.name}: {escape(check.detail)}", soft_wrap=True)
    if not check.ok:
        console.print(f"     [bold]Fix:[/bold] {escape(check.fix)}", soft_wrap=True)


def simulate(
    *,
    rig: OptionalPath = None,
    lab: Path = Path("out/lab"),
    object: ObjectName = "cup",
    seed: int = 0,
) -> None:
    """Serve the simulated camera (GigE Vision) and arm (RTDE) until Ctrl-C, for any client.

    Args:
        rig: rig.toml whose addresses to serve at; without it one is written into the lab's folder.
        lab: folder of the lab: its rig.toml, and truth.json, which nobody should peek at.
        object: what lies on the table: cup, fork, knife or bottle.
        seed: which lab; the same seed gives the same hidden truth.
    """
    from acquisition.rig import Rig
    from s2p3.lab import found_lab, running_lab

    given = None if rig is None else Rig.load(rig)
    truth, rig_path = found_lab(lab, object, seed)
    devices = given or Rig.load(rig_path)
    with running_lab(truth, devices) as running:
        say(
            f"camera PHX050S-Q at {devices.camera.address} (GigE Vision), UR5e at {devices.robot.host} (RTDE)"
        )
        say(f"try: arv-tool-0.8, or s2p3 doctor --rig {rig or rig_path}; Ctrl-C ends both")
        with contextlib.suppress(KeyboardInterrupt):
            while True:
                time.sleep(_LOOK_S)
                for warning in running.warnings():
                    say(f"warning: {warning}")
