"""Makes docs/adaptation.md of the studies that are kept: `python tools/adaptation/page.py`."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
from plan import ADABN, ADAPTED_TEACHER, BEFORE, DISTILLED, DOLP, TEACHER, WITHOUT_PHYSICS

ROOT = Path(__file__).parents[2]
RESULTS = ROOT / "docs" / "adaptation"
PAGE = ROOT / "docs" / "adaptation.md"

HEAD = """# Does self-supervision help?

Every table on this page was made by the command above it, at the commits beside it. Teacher and student are
trained on path-traced and analytic images of the [domain](synthesis.md#domains) that the section names; the
frames they must cope with are of the domain `captured`. It stands in for a recorded sequence, and has one
advantage over it: exact truth. How far it lies from the other domains is our choice, made while the method
was tuned: what counts here is the difference between rows, not how high they are. Losses and images share
one Fresnel model, so real surfaces will be harder. Students adapt to one set of captured frames, an object's
settings (`tools/adaptation/OBJECT.toml`) were chosen on another, `captured-val`, by its first seed, and the
judge is a third, `captured-test`, which had no part in that. The fork was first judged with the cup's
settings; what came of that is in [Training](training.md#presets-and-any-field-of-them). Boxes and masks
are those of one detector, trained on the domain `synthetic`; a target without a detection counts as failed.
A commit called *dirty* had other lists of rows in the study's script; what trains was the commit's.

The rows: networks *before*; with BatchNorm statistics re-estimated on captured frames (*AdaBN*); a student
that only copies the poses of the teacher (*pose-only distillation*); one that learns from its maps, too
(*without physics*); and the whole method, with the paper's physics or with ours.
"""
CONTROLS = (BEFORE, ADABN, TEACHER, ADAPTED_TEACHER, DISTILLED, WITHOUT_PHYSICS)
"""What the adapted students are compared with."""


def table(result: dict[str, Any]) -> str:
    """One study as Markdown."""
    first = next(iter(result["rows"].values()))
    seeds = ", ".join(str(figures["seed"]) for figures in first)
    minutes = ", ".join(f"{what} {spent:g}" for what, spent in result["minutes"].items())
    return "\n".join(
        [
            f"Minutes on one core: {minutes}.",
            "",
            f"{first[0]['targets']} targets of `{result['judged']}`, seeds {seeds}; "
            f"recall by {first[0]['metric']}, percent.",
            "",
            "| | at 0.1 d, by seed | mean | at 0.05 d | rotation, deg | depth, mm | missed |",
            "|---" * 7 + "|",
            *(_row(row, figures) for row, figures in result["rows"].items()),
            "",
            "Differences of recall at 0.1 d, points, paired, with 95 % intervals, by seed:",
            "",
            "| | " + " | ".join(f"above {other}" for other in CONTROLS) + " |",
            "|---" * (len(CONTROLS) + 1) + "|",
            *(_differences(row, found) for row, found in result["differences"].items()),
            "",
            _summary(result["differences"]),
            "",
            "In the domain trained on, on held-out frames, recall at 0.1 d by seed:",
            "",
            "| | teacher | student |",
            "|---|---|---|",
            *_in_domain(result["in_domain"]),
            "",
        ]
    )


def write_page() -> None:
    """The page, from the results that are kept."""
    parts = [HEAD]
    for path in sorted(RESULTS.glob("*.json")):
        kept = json.loads(path.read_text(encoding="utf-8"))
        parts += [
            f"## {_title(path.stem)}\n",
            f"`{kept['command']}` at `{kept['commit']}`, {kept['date']}; "
            f"{_commits(kept['result']['rows'])}\n",
            table(kept["result"]),
        ]
    PAGE.write_text("\n".join(parts), encoding="utf-8")


def _title(stem: str) -> str:
    name, domain = stem.split("-")
    return f"{name.capitalize()}, trained on `{domain}`"


def _commits(rows: dict[str, list[dict[str, Any]]]) -> str:
    """Which commit trained which rows."""
    trained: dict[str, list[str]] = {}
    for row, figures in rows.items():
        for commit in dict.fromkeys(each["commit"] for each in figures):
            trained.setdefault(commit, []).append(row)
    if len(trained) == 1:
        return f"all trained at `{next(iter(trained))}`"
    return "trained at " + ", ".join(f"`{commit}` ({'; '.join(names)})" for commit, names in trained.items())


def _row(name: str, figures: list[dict[str, Any]]) -> str:
    def mean(figure: str) -> float:
        return float(np.mean([each[figure] for each in figures]))

    return (
        f"| {name} | {_by_seed(figures)} | {mean('recall_10'):.1f} | {mean('recall_5'):.1f} | "
        f"{mean('rotation_deg'):.1f} | {mean('depth_mm'):+.1f} | {mean('missed'):.0f} |"
    )


def _differences(name: str, found: dict[str, list[dict[str, float]]]) -> str:
    cells = [
        "<br>".join(f"{d['value']:+.1f} ({d['low']:+.1f} to {d['high']:+.1f})" for d in found.get(other, []))
        for other in CONTROLS
    ]
    return f"| {name} | {' | '.join(cells)} |"


def _summary(differences: dict[str, dict[str, list[dict[str, float]]]]) -> str:
    """What the paper's method gains, in a sentence."""

    def gain(other: str) -> str:
        found = differences[DOLP][other]
        clear = sum(each["low"] > 0 for each in found)
        mean = np.mean([each["value"] for each in found])
        return f"{mean:+.1f} points against *{other}* (interval above zero for {clear} of {len(found)} seeds)"

    others = [gain(other) for other in (BEFORE, TEACHER, WITHOUT_PHYSICS)]
    return f"The paper's method, in the mean over seeds: {'; '.join(others)}."


def _in_domain(sets: dict[str, dict[str, list[dict[str, Any]]]]) -> list[str]:
    """Each held-out set, and where there are two, both together."""
    networks = (TEACHER, BEFORE)
    found = {name: [rows[row] for row in networks] for name, rows in sets.items()}
    if len(sets) > 1:
        found["together"] = [_pooled(*(rows[row] for rows in sets.values())) for row in networks]
    return [
        f"| {name}, {rows[0][0]['targets']} targets | {' | '.join(map(_by_seed, rows))} |"
        for name, rows in found.items()
    ]


def _pooled(*sets: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """By seed, the recall over the targets of all sets."""
    targets = [figures[0]["targets"] for figures in sets]
    recalls = [[each["recall_10"] for each in figures] for figures in sets]
    return [
        {"targets": sum(targets), "recall_10": recall} for recall in np.average(recalls, 0, weights=targets)
    ]


def _by_seed(figures: list[dict[str, Any]]) -> str:
    return " / ".join(f"{each['recall_10']:.1f}" for each in figures)


if __name__ == "__main__":
    write_page()
