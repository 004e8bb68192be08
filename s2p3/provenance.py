"""Which state of the toolkit is running: what every checkpoint and every published number names."""

from __future__ import annotations

import subprocess
from importlib.metadata import version
from pathlib import Path


def checked_out_commit(*published: str) -> str | None:
    """The commit that is checked out, "-dirty" where tracked files differ from it; None without a checkout.

    Args:
        published: paths from the checkout's root that may differ: those that hold the figures themselves.
    """
    besides = [f":(top,exclude){path}" for path in published]
    try:
        name = _git("rev-parse", "--short=10", "HEAD")
        changed = _git("diff", "--name-only", "HEAD", "--", ":(top)", *besides)
    except (OSError, subprocess.SubprocessError):
        return None
    return f"{name}-dirty" if changed else name


def toolkit_state() -> str:
    """The toolkit's version and, of a checkout, its commit."""
    commit = checked_out_commit()
    return version("s2p3") if commit is None else f"{version('s2p3')} {commit}"


def _git(*words: str) -> str:
    command = ["git", *words]
    done = subprocess.run(
        command, cwd=Path(__file__).parent, capture_output=True, text=True, check=True, timeout=10
    )
    return done.stdout.strip()
