"""How arguments that several verbs share read in `--help`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import tyro

OptionalPath = Annotated[Path | None, tyro.conf.arg(metavar="PATH", help_behavior_hint="(optional)")]
"""A file that need not be given."""

ObjectName = Annotated[str, tyro.conf.arg(metavar="NAME")]
"""Of a built-in object, or of the one in --mesh."""

Sessions = tyro.conf.Positional[
    Annotated[list[Path], tyro.conf.arg(metavar="SESSION [SESSION ...]", help_behavior_hint="(required)")]
]
"""One session or more."""
