"""What an evaluation leaves behind: the figures as JSON, the report, the estimates for the BOP toolkit."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

from calibration import html
from dataset.errors import ToolkitError
from dataset.session import Session
from s2p3.evaluation.bop_results import bop_object_id, write_bop_results
from s2p3.evaluation.evaluate import Evaluation
from s2p3.evaluation.report import comparison_section, evaluation_section, groups_section
from s2p3.objects import ObjectModel
from s2p3.writable import check_folder


def check_out(out: Path) -> None:
    """Raises ToolkitError: `write_files` could not write to `out`: a folder, or named .html or .csv."""
    if out.is_dir():
        raise ToolkitError(f"{out} is a folder; name a JSON file, such as {out / 'test.json'}")
    if out.suffix in (".html", ".csv"):
        raise ToolkitError(f"{out}: the figures go into a JSON file; name it {out.with_suffix('.json')}")
    check_folder(out.parent)


def told_apart(paths: Sequence[Path]) -> list[str]:
    """What evaluations are called: each by the shortest end of its path that no other one has, such as
    `after`, or `row-1/test` beside `row-2/test`.

    Raises ToolkitError: one is there twice.
    """
    ways = [(*path.resolve().parent.parts, path.stem) for path in paths]
    for path, way in zip(paths, ways, strict=True):
        if ways.count(way) > 1:
            raise ToolkitError(f"{path} is named twice; name a different file each time")
    return [
        next(
            "/".join(way[-length:])
            for length in range(1, len(way) + 1)
            if [other[-length:] for other in ways].count(way[-length:]) == 1
        )
        for way in ways
    ]


def write_files(
    out: Path,
    name: str,
    session: Path,
    model: ObjectModel,
    evaluation: Evaluation,
    others: Mapping[str, Evaluation],
    scene_id: int = 0,
) -> tuple[Path, ...]:
    """Writes `out` (JSON), and beside it .html and .csv of the same name, which are returned.

    Args:
        out: see `check_out`.
        name: of the evaluation in the report, none of the others'.
        session: the evaluated one.
        others: evaluations by name for the report; overlays show those of the same targets.
        scene_id: see `write_bop_results`.
    """
    page, table = out.with_suffix(".html"), out.with_suffix(".csv")
    out.parent.mkdir(parents=True, exist_ok=True)
    evaluation.save(out)
    runs = {title: other for title, other in others.items() if evaluation.paired_with(other)}
    with Session.open(session) as opened:
        write_bop_results(table, evaluation, scene_id, bop_object_id(opened, model.name))
        sections = [
            evaluation_section(opened, model, runs | {name: evaluation}),
            groups_section(evaluation),
        ]
    if others:
        sections.append(comparison_section(name, evaluation, others))
    title = f"{model.name}: {name}"
    page.write_text(html.page(title, f"{session.name}", sections, str(evaluation.summary)), encoding="utf-8")
    return out, page, table
