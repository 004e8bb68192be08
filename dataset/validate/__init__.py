"""Whether a session can be trusted: a summary, every problem at once, and the repair of a damaged file."""

from __future__ import annotations

from pathlib import Path

from dataset.session.files import READ_ERRORS, attribute, open_for_reading
from dataset.validate import annotation, content, structure
from dataset.validate.problems import Problem, View
from dataset.validate.repair import RepairResult, repair
from dataset.validate.summary import SessionInfo, info

__all__ = ["Problem", "RepairResult", "SessionInfo", "info", "repair", "validate"]

_CHECKS = (
    structure.check_reachable,
    structure.check_attributes,
    structure.check_datasets,
    structure.check_seals,
    content.check_frame_columns,
    content.check_ledger,
    content.check_pixels,
    content.check_depth,
    content.check_robot,
    content.check_clocks,
    annotation.check_calibration,
    annotation.check_objects,
    annotation.check_poses,
    annotation.check_splits,
)


def validate(path: str | Path) -> list[Problem]:
    """Checks structure, types, units, checksums, clocks, the ledger, rotations, masks and splits.

    Returns:
        Every problem found; an empty list for a session that can be trusted.

    Raises:
        SessionError: the file cannot even be opened.
    """
    path = Path(path)
    file, unfinished = open_for_reading(path)
    with file:
        view = View(path, file)
        problems = []
        if unfinished or not attribute(file, "complete"):
            problems.append(Problem("/", "the recording is incomplete", f"run: s2p3 dataset repair {path}"))
        for check in _CHECKS:
            try:
                problems.extend(check(view))
            except READ_ERRORS as error:
                name = check.__name__.removeprefix("check_").replace("_", " ")
                what = f"the {name} cannot be checked ({error})"
                problems.append(Problem("/", what, "copy the file again from its source"))
        return problems + view.unreadable
