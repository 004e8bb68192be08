"""What an evaluation leaves behind: the figures as JSON, the report, the estimates for the BOP toolkit."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

from calibration import html
from dataset.errors import ToolkitError
from dataset.session import Session
from s2p3.evaluation.bop_results import bop_object_id, write_bop_results
from s2p3.evaluation.evaluate import Evaluation
from s2p3.evaluation.report import comparison_section, evaluation_section, groups_section
from s2p3.objects import ObjectModel


def write_files(
    out: Path,
    session: Path,
    model: ObjectModel,
    evaluation: Evaluation,
    others: Mapping[str, Evaluation],
    scene_id: int = 0,
) -> tuple[Path, ...]:
    """Writes `out` (JSON), and beside it .html and .csv of the same name, which are returned.

    Args:
        session: the evaluated one.
        others: evaluations by name for the report; overlays show those of the same targets.
        scene_id: see `write_bop_results`.

    Raises ToolkitError: `out` is named .html or .csv, or another evaluation is of its name.
    """
    if out.suffix in (".html", ".csv"):
        raise ToolkitError(f"{out}: the figures go into a JSON file; name it {out.with_suffix('.json')}")
    if out.stem in others:
        raise ToolkitError(f"{out}: one of the evaluations beside it is called {out.stem}, too; rename one")
    page, table = out.with_suffix(".html"), out.with_suffix(".csv")
    out.parent.mkdir(parents=True, exist_ok=True)
    evaluation.save(out)
    runs = {name: other for name, other in others.items() if evaluation.paired_with(other)}
    with Session.open(session) as opened:
        write_bop_results(table, evaluation, scene_id, bop_object_id(opened, model.name))
        sections = [
            evaluation_section(opened, model, runs | {out.stem: evaluation}),
            groups_section(evaluation),
        ]
    if others:
        sections.append(comparison_section(out.stem, evaluation, others))
    title = f"{model.name}: {out.stem}"
    page.write_text(html.page(title, f"{session.name}", sections, str(evaluation.summary)), encoding="utf-8")
    return out, page, table
