"""`s2p3 evaluate`, `s2p3 predict` and `s2p3 export`: what a trained model is worth, and what it is for."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import tyro

from dataset.frames import Mosaic
from s2p3.commands.arguments import ObjectName, OptionalPath, at_least
from s2p3.console_output import progress_bars, say, show

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
            compared, with paired intervals. Each is called by its file's name, with folders where names are
            alike.
        scene_id: of the session in the BOP data set; objects are numbered as its export does.
        json: print the summary as JSON.
    """
    from dataclasses import asdict

    from s2p3.captured_stages import evaluate_split
    from s2p3.evaluation import Evaluation
    from s2p3.evaluation.evaluate import finite
    from s2p3.evaluation.files import check_out, told_apart, write_files
    from s2p3.objects import named_object

    at_least(0, scene_id=scene_id)
    model = named_object(object, mesh)
    if out is not None:
        check_out(out)
    names = told_apart([*beside, *([] if out is None else [out])])
    others = {name: Evaluation.load(path) for name, path in zip(names, beside, strict=False)}
    with progress_bars() as report:
        result = evaluate_split(session, split, model, {"network": network}, detector, report)["network"]
    against = {name: result.above(other) for name, other in others.items() if result.paired_with(other)}
    if out is not None:
        for path in write_files(out, names[-1], session, model, result, others, scene_id):
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


def predict(
    source: tyro.conf.Positional[Path],
    *,
    object: ObjectName,
    network: Network,
    detector: Network,
    mesh: OptionalPath = None,
    calibration: OptionalPath = None,
    split: Annotated[str | None, tyro.conf.arg(metavar="NAME", help_behavior_hint="(optional)")] = None,
    count: Annotated[int | None, tyro.conf.arg(metavar="INT", help_behavior_hint="(optional)")] = None,
    mosaic: Annotated[
        Mosaic | None, tyro.conf.arg(metavar="{mono,colour}", help_behavior_hint="(optional)")
    ] = None,
    bits: Annotated[int | None, tyro.conf.arg(metavar="INT", help_behavior_hint="(optional)")] = None,
    out: OptionalPath = None,
) -> None:
    """Estimate the object's pose in recorded or live frames; one JSON line for every frame on stdout.

    Args:
        source: a session (.h5), a rig.toml for its live camera, or a folder of raw mosaics.
        object: cup, fork, knife, bottle, or the name of the object in --mesh.
        network: checkpoint of a teacher or student, or its ONNX file, which is quicker.
        detector: checkpoint of the detector, or its ONNX file.
        mesh: PLY, OBJ or STL of the object, metres.
        calibration: calibration.json, for a folder and a live camera.
        split: of a session, the split to predict on; all frames by default.
        count: frames at most; a live camera goes on until Ctrl-C by default.
        mosaic: of a folder, mono for cells of 2x2 pixels, colour for super-pixels of 4x4; by default as
            calibrated.
        bits: of a folder, significant bits of a value; needed for 16-bit files.
        out: folder for the same lines, poses.jsonl, and an overlay of every frame.
    """
    import json

    from s2p3.evaluation import Estimator, Finder
    from s2p3.evaluation.predictions import opened_source, predictions, saved
    from s2p3.objects import named_object

    at_least(1, **({} if count is None else {"count": count}), **({} if bits is None else {"bits": bits}))
    model = named_object(object, mesh)
    find, estimate = Finder.load(detector, model.name), Estimator.load(network, model)
    with opened_source(source, calibration, split, count, mosaic, bits) as shots:
        found = predictions(shots, find, estimate)
        for prediction in found if out is None else saved(found, model, out):
            print(json.dumps(prediction.to_json()), flush=True)


def export(
    checkpoint: tyro.conf.Positional[Path],
    *,
    out: OptionalPath = None,
    image_size: tuple[int, int] = (612, 512),
) -> None:
    """Export a teacher, student or detector to ONNX, and check that it gives what the checkpoint gives.

    Args:
        checkpoint: NAME.safetensors.
        out: NAME.onnx; beside the checkpoint by default.
        image_size: width and height of the polarization image, which a detector's file is made for.
    """
    from s2p3.evaluation.export import export as write

    at_least(32, image_size=min(image_size))
    path = checkpoint.with_suffix(".onnx") if out is None else out
    worst = write(checkpoint, path, image_size)
    say(f"{path}: differs from {checkpoint} by at most {worst:.1e} of the largest output")
