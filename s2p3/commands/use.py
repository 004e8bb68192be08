"""`s2p3 evaluate`, `s2p3 predict` and `s2p3 export`: what a trained model is worth, and what it is for."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import tyro

from s2p3.commands.arguments import ObjectName, OptionalPath, at_least
from s2p3.commands.output import say, show

Network = Annotated[Path, tyro.conf.arg(metavar="FILE")]
"""A checkpoint (.safetensors), or a model exported from one (.onnx)."""


def evaluate(
    session: tyro.conf.Positional[Path],
    *,
    object: ObjectName,
    network: Network,
    detector: Network,
    mesh: OptionalPath = None,
    split: str = "test",
    out: OptionalPath = None,
    beside: Annotated[tuple[Path, ...], tyro.conf.arg(metavar="JSON", help_behavior_hint="(optional)")] = (),
    scene_id: int = 0,
    json: bool = False,
) -> None:
    """Evaluate a teacher or student on an annotated session, in detected boxes; every target counts.

    Args:
        session: an annotated session.
        object: cup, fork, knife, bottle, or the name of the object in --mesh.
        network: checkpoint of a teacher or student, or its ONNX file.
        detector: checkpoint of the detector, or its ONNX file.
        mesh: PLY, OBJ or STL of the object, metres.
        split: name of the split to evaluate on.
        out: JSON file for all figures and a record of every target; beside it come the same name .html, the
            report, and .csv, the estimates as the BOP challenge takes them.
        beside: earlier evaluations (their JSON files) to put into the report; those of the same targets are
            compared, with paired intervals.
        scene_id: of the session in the BOP data set; objects are numbered as its export does.
        json: print the summary as JSON.
    """
    from dataclasses import asdict

    from s2p3.evaluation import Evaluation
    from s2p3.evaluation.evaluate import finite
    from s2p3.evaluation.files import write_files
    from s2p3.learning import evaluate_split
    from s2p3.objects import named_object

    at_least(0, scene_id=scene_id)
    model = named_object(object, mesh)
    others = {path.stem: Evaluation.load(path) for path in beside}
    result = evaluate_split(session, split, model, {"network": network}, detector)["network"]
    against = {name: result.above(other) for name, other in others.items() if result.paired_with(other)}
    if out is not None:
        for path in write_files(out, session, model, result, others, scene_id):
            say(f"wrote {path}")
    summary = asdict(result.summary)
    if json:
        compared = {
            name: {figure: asdict(d) for figure, d in found.items()} for name, found in against.items()
        }
        show(finite(summary | ({"above": compared} if compared else {})), json)
        return
    show(summary, json)
    for name, found in against.items():
        low, high = found["recall_10"].interval
        print(f"recall_10 above {name}  {found['recall_10'].value:+.1f} [{low:+.1f}, {high:+.1f}]")
