"""Whether a result can be written: asked before long work, not after it."""

from __future__ import annotations

import os
from pathlib import Path

from dataset.errors import ToolkitError


def check_folder(folder: Path) -> None:
    """Raises ToolkitError: the folder cannot be made, or not be written to."""
    nearest = next(path for path in (folder.absolute(), *folder.absolute().parents) if path.exists())
    if not nearest.is_dir():
        raise ToolkitError(f"{nearest} is a file, and a folder is needed in its place; choose another")
    if not os.access(nearest, os.W_OK):
        raise ToolkitError(f"{nearest}: may not be written to; choose another folder")
