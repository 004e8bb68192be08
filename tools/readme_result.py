"""Writes what the demo measured into README.md: `python tools/readme_result.py out/demo`.

The block between the two HTML comments is made from the folder's result.json and steps.json, with the commit
that is checked out and the command that repeats it. It is never edited by hand.
"""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from s2p3.demo_report import TARGETS
from s2p3.provenance import checked_out_commit

ROOT = Path(__file__).parents[1]
BEGIN, END = "<!-- demo:begin -->", "<!-- demo:end -->"


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("folder", type=Path, help="the demo's --out folder")
    parser.add_argument("--readme", type=Path, default=ROOT / "README.md", help="file to rewrite")
    options = parser.parse_args()
    try:
        result = json.loads((options.folder / "result.json").read_text(encoding="utf-8"))
        settings = json.loads((options.folder / "steps.json").read_text(encoding="utf-8"))["settings"]
        text = options.readme.read_text(encoding="utf-8")
        block = result_block(result, settings, checked_out_commit("README.md"))
        options.readme.write_text(with_block(text, block), encoding="utf-8")
    except (OSError, ValueError, KeyError) as error:
        print(f"readme_result: {options.folder} holds no finished demo ({error}); run s2p3 demo first")
        return 2
    print(block)
    return 0


def result_block(result: Mapping[str, Any], settings: Mapping[str, Any], commit: str) -> str:
    """Markdown of one demo: where it comes from, what was recovered, recall, and time."""
    recall, frames = result["recall"], result["frames"]
    rows = [
        (target.label, f"{result[part][key]:.2g} {target.unit}", f"{target.limit:g} {target.unit}")
        for (part, key), target in TARGETS.items()
    ]
    return "\n".join(
        [
            f"`{command(settings)}` at commit `{commit}`, in {result['seconds']['total'] / 60:.0f} minutes.",
            "",
            "| recovered, against the lab's hidden truth | off by | asked: within |",
            "|---|---|---|",
            *(f"| {' | '.join(row)} |" for row in rows),
            "",
            f"{frames['captured']} frames captured, {frames['dropped']} dropped (and in the ledger); "
            f"board reprojection {result['intrinsics']['reproj_px']:.3f} px.",
            "",
            f"| {recall['metric']} | teacher | student before | student after self-supervision |",
            "|---|---|---|---|",
            f"| {recall['targets']} held-out targets, {recall['missed']} missed | {recall['teacher']:.1f} "
            f"| {recall['before']:.1f} | **{recall['after']:.1f}** |",
        ]
    )


def command(settings: Mapping[str, Any]) -> str:
    """The command that repeats a demo."""
    quick = " --quick" if settings["quick"] else ""
    return f"s2p3 demo{quick} --object {settings['object']} --seed {settings['seed']}"


def with_block(text: str, block: str) -> str:
    """`text` with the part between the two comments replaced.

    Raises ValueError where the comments are missing or out of order.
    """
    head, begin, rest = text.partition(BEGIN)
    _, end, tail = rest.partition(END)
    if not (begin and end):
        raise ValueError(f"no {BEGIN} followed by {END} in the file to rewrite")
    return f"{head}{BEGIN}\n{block}\n{END}{tail}"


if __name__ == "__main__":
    sys.exit(main())
