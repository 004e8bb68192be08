"""A line of the doctor's report, and how the checks word it."""

from __future__ import annotations

from dataclasses import dataclass

from dataset.errors import ToolkitError


@dataclass(frozen=True)
class Check:
    """One line of the doctor's report.

    Attributes:
        name: what was checked.
        ok: whether it will do.
        detail: what was found.
        fix: what to do; empty where it will do.
    """

    name: str
    ok: bool
    detail: str
    fix: str = ""


def unless(ok: bool, fix: str) -> str:
    """The fix of a check, empty where it will do."""
    return "" if ok else fix


def failed(name: str, error: ToolkitError) -> Check:
    """An error of the toolkit says what happened and, after the first semicolon, what to do."""
    what, _, remedy = str(error).partition("; ")
    return Check(name, False, what, remedy or what)
