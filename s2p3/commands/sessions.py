"""`s2p3 annotate`, `s2p3 decode` and `s2p3 dataset ...`: what is done with files."""

from __future__ import annotations

from contextlib import suppress
from pathlib import Path
from typing import Literal

import tyro

from s2p3.commands.arguments import ObjectName, OptionalPath
from s2p3.console_output import counting, say, show


def annotate(
    session: tyro.conf.Positional[Path],
    *,
    calibration: Path,
    object: ObjectName,
    mesh: OptionalPath = None,
) -> None:
    """Write the object's pose, mask and box into every frame of a session, from the arm's motion.

    Args:
        session: the recorded sequence.
        calibration: calibration.json with intrinsics, hand-eye and the object's pose.
        object: cup, fork, knife, bottle, or the name of the object in --mesh.
        mesh: PLY, OBJ or STL of the object, metres.
    """
    from calibration import Calibration
    from s2p3.annotation import annotate as write_annotation
    from s2p3.objects import named_object

    model = named_object(object, mesh)
    known = Calibration.load(calibration)
    with counting("annotate") as report:
        done = write_annotation(session, known, model, report)
    say(f"{session}: {object} annotated in {done.frames} frames, visible in {done.visible}")


def info(session: tyro.conf.Positional[Path], *, json: bool = False) -> None:
    """Show what a session holds.

    Args:
        session: the session file.
        json: print it as JSON.
    """
    from dataclasses import asdict

    from dataset.validate import info as summarise

    show(asdict(summarise(session)), json)


def validate(session: tyro.conf.Positional[Path], *, undrawn: bool = False, json: bool = False) -> None:
    """Check a session and report every problem; exit code 2 when there is one.

    Args:
        session: the session file.
        undrawn: leave out the slowest check, which holds every mask against the mesh drawn at its pose.
        json: print it as JSON.
    """
    from dataclasses import asdict

    from dataset.errors import SessionError, ToolkitError
    from dataset.validate import validate as find_problems
    from s2p3.silhouettes import check_masks

    problems = find_problems(session)
    if not undrawn:
        with suppress(ToolkitError):  # what cannot be read has been reported above
            problems.extend(check_masks(session))
    if json:
        show({"problems": [asdict(problem) for problem in problems]}, as_json=True)
    else:
        for problem in problems:
            say(str(problem))
    if problems:
        count = "1 problem" if len(problems) == 1 else f"{len(problems)} problems"
        raise SessionError(f"{session}: {count}, listed above with what to do")
    if not json:
        say(f"{session}: valid")


def repair(session: tyro.conf.Positional[Path]) -> None:
    """Restore the session of a recording that was killed: every frame that had been flushed.

    Args:
        session: the session file.
    """
    from dataset.validate import repair as restore

    with counting("repair") as report:
        done = restore(session, report)
    say(str(done))


def split(
    session: tyro.conf.Positional[Path],
    *,
    by: Literal["frame", "view"] = "view",
    train: float = 0.2,
    val: float = 0.1,
    seed: int = 0,
) -> None:
    """Divide a session's frames into train, val and test; the split is stored in the file.

    Args:
        session: an annotated session.
        by: view keeps views of nearly the same direction on one side; frame draws frames one by one.
        train: share of the frames to train on (the paper: 0.15 to 0.2).
        val: share to tune on.
        seed: the same seed, the same split.
    """
    from dataset.splits import split_session

    show(
        {name: len(indices) for name, indices in split_session(session, by, train, val, seed).items()},
        as_json=False,
    )


def decode(
    raw: tyro.conf.Positional[Path],
    *,
    layout: Literal["mono", "colour"],
    out: Path,
    index: float = 1.5,
) -> None:
    """Turn any raw polarization mosaic into pictures of S0, DoLP, AoLP and the three prior normals.

    Args:
        raw: a PNG or TIFF of the raw mosaic, 8 or 16 bit.
        layout: mono has cells of 2x2 pixels, colour super-pixels of 4x4.
        out: folder for the pictures.
        index: refractive index assumed for the prior normals.
    """
    from s2p3.pictures import decode_picture

    for path in decode_picture(raw, layout, out, index):
        print(path)
