"""`s2p3 demo`: the main job on the simulated lab."""

from __future__ import annotations

from pathlib import Path

from s2p3.commands.arguments import ObjectName
from s2p3.console_output import console, say, show


def demo(
    *,
    out: Path = Path("out/demo"),
    quick: bool = False,
    object: ObjectName = "cup",
    seed: int = 0,
    json: bool = False,
) -> None:
    """Do the whole job on the simulated lab: calibrate, capture, annotate, synthesize, train, evaluate.

    Args:
        out: folder for everything; run it again with the same folder and it goes on where it stopped.
        quick: in under five minutes; it shows the way, not the accuracy.
        object: cup, fork, knife or bottle.
        seed: which lab.
        json: print the result as JSON.
    """
    from s2p3.demo import FULL, QUICK, Demo, Progress

    plan = QUICK if quick else FULL
    progress = Progress(out, {"quick": quick, "object": object, "seed": seed})
    with Demo(out, plan, object, seed) as job:
        progress.run(job.steps(), console)
        result = job.report(progress.seconds)
    show(result, json)
    say(f"{out / 'report.html'} has the pictures, {out / 'result.json'} the numbers")
