"""Arguments that several verbs share: how they read in `--help`, and what is asked of them."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import tyro

from dataset.errors import ToolkitError

OptionalPath = Annotated[Path | None, tyro.conf.arg(metavar="PATH", help_behavior_hint="(optional)")]
"""A file that need not be given."""

OptionalNumber = Annotated[float | None, tyro.conf.arg(metavar="NUMBER", help_behavior_hint="(optional)")]
"""A number that need not be given."""

ObjectName = Annotated[str, tyro.conf.arg(metavar="NAME")]
"""Of a built-in object, or of the one in --mesh."""

ObjectNames = Annotated[tuple[str, ...], tyro.conf.arg(metavar="NAME [NAME ...]")]
"""Of one object or more."""

RequiredName = Annotated[str, tyro.conf.arg(metavar="NAME", help_behavior_hint="(required)")]
RequiredPath = Annotated[Path, tyro.conf.arg(metavar="PATH", help_behavior_hint="(required)")]
"""Asked for by the verb itself, because with --describe they are not needed."""

Sessions = tyro.conf.Positional[
    Annotated[list[Path], tyro.conf.arg(metavar="SESSION [SESSION ...]", help_behavior_hint="(required)")]
]
"""One session or more."""


def at_least(smallest: float, **values: float) -> None:
    """Raises ToolkitError, naming the option, where one of the values is smaller."""
    for name, value in values.items():
        if not value >= smallest:
            raise ToolkitError(
                f"--{name.replace('_', '-')} {value:g} is too small; give at least {smallest:g}"
            )
