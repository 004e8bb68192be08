"""Runs benchmarks and keeps what they print, with command, commit and date: docs/benchmarks.md is made of it.

    python tools/bench/publish.py                      run every benchmark of the list, one after another
    python tools/bench/publish.py polarimetry trace    only these
    python tools/bench/publish.py --page               only write the page again

Run it on a quiet machine, from a clean checkout. A figure is never edited by hand.
"""

from __future__ import annotations

import argparse
import json
import shlex
import subprocess
import sys
from datetime import date
from pathlib import Path
from typing import Any

from s2p3.provenance import checked_out_commit

ROOT = Path(__file__).parents[2]
RESULTS = ROOT / "docs" / "benchmarks"
PAGE = ROOT / "docs" / "benchmarks.md"

COMMANDS = {
    "polarimetry": "polarimetry.py --json",
    "renderer": "renderer.py --json",
    "synthesis": "synthesis.py --json",
    "recorder-8": "recorder.py --seconds 60 --bits 8 --json",
    "recorder-12": "recorder.py --seconds 60 --bits 12 --json",
    "recorder-soak": "recorder.py --seconds 600 --bits 8 --soak --json",
    "trace": "trace.py --json",
    "time-alignment": "time_alignment.py --json",
    "hand-eye": "hand_eye.py --json",
    "calibration-study": "calibration_study.py --seeds 10 --json",
    "object-registration": "object_registration.py --json",
    "loader-128": "loader.py --size 128 --json",
    "loader-256": "loader.py --size 256 --json",
    "session-open": "session_open.py --json",
    "inference": "inference.py --json",
    "training": "training.py --json",
}
"""What is published, in the page's order."""

HEAD = """# Benchmarks

Every figure on this page was printed by the command above it, at the commit beside it, on a machine with two
cores and no GPU; times are milliseconds, and ratios compare with a peer in the same run. What a figure means
is said at the top of the script. `python tools/bench/publish.py` runs them again and writes this page;
`pip install --no-deps -r tools/bench/peers.txt` installs the peers.
"""


def main() -> int:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("names", nargs="*", metavar="NAME", help=f"of {', '.join(COMMANDS)}; all when none")
    parser.add_argument("--page", action="store_true", help="run nothing, write the page again")
    options = parser.parse_args()
    if unknown := set(options.names) - set(COMMANDS):
        parser.error(f"no benchmark is called {', '.join(sorted(unknown))}; there are {', '.join(COMMANDS)}")
    failed = [] if options.page else [name for name in options.names or COMMANDS if not publish(name)]
    PAGE.write_text(page(), encoding="utf-8")
    if failed:
        print(f"publish: {', '.join(failed)} failed; their figures are as they were", file=sys.stderr)
    return 1 if failed else 0


def publish(name: str) -> bool:
    """Runs one benchmark and keeps its JSON; False, and what it said on stderr, when it fails."""
    command = f"python tools/bench/{COMMANDS[name]}"
    print(command, flush=True)
    words = [sys.executable, *shlex.split(command)[1:]]
    done = subprocess.run(words, cwd=ROOT, stdout=subprocess.PIPE, text=True, check=False)
    if done.returncode:
        return False
    print(done.stdout, flush=True)
    result = {
        "command": command,
        "commit": checked_out_commit("docs/benchmarks", "docs/benchmarks.md"),
        "date": date.today().isoformat(),
        "figures": json.loads(done.stdout.strip().splitlines()[-1]),
    }
    RESULTS.mkdir(exist_ok=True)
    (RESULTS / f"{name}.json").write_text(json.dumps(result, indent=1) + "\n", encoding="utf-8")
    return True


def page() -> str:
    """The page, from the results that are kept."""
    parts = [HEAD]
    for name in COMMANDS:
        path = RESULTS / f"{name}.json"
        if path.exists():
            result = json.loads(path.read_text(encoding="utf-8"))
            parts += [
                f"## {name.replace('-', ' ').capitalize()}\n",
                f"`{result['command']}` at commit `{result['commit']}`, {result['date']}\n",
                table(result["figures"]),
            ]
    return "\n".join(parts)


def table(figures: dict[str, Any]) -> str:
    """Markdown: one row a figure, or one row an object when the figures are by object."""
    by_object = {key: row for key, row in figures.items() if isinstance(row, dict)}
    lines = []
    plain = {key: value for key, value in figures.items() if key not in by_object}
    if plain:
        lines += ["| figure | value |", "|---|---|"]
        lines += [f"| {key} | {shown(value)} |" for key, value in plain.items()] + [""]
    if by_object:
        columns = list(dict.fromkeys(key for row in by_object.values() for key in row))
        lines += ["| | " + " | ".join(columns) + " |", "|---" * (len(columns) + 1) + "|"]
        for key, row in by_object.items():
            lines.append(f"| {key} | " + " | ".join(shown(row.get(column, "")) for column in columns) + " |")
        lines.append("")
    return "\n".join(lines)


def shown(value: Any) -> str:
    """A figure in a cell."""
    return f"{value:.4g}" if isinstance(value, float) else str(value)


if __name__ == "__main__":
    sys.exit(main())
