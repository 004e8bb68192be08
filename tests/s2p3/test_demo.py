"""The whole job on the simulated lab, small: every step for real, over the devices' protocols."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from rich.console import Console

from dataset.errors import ToolkitError
from dataset.session import Session
from dataset.validate import validate
from s2p3.demo import Demo, Plan, Progress
from s2p3.demo_report import TARGETS

SMALL = Plan(
    preset="quick", board_views=12, motion_s=8.0, pivots=8, touches=20, sequence_s=10.0, synthetic=24
)
SETTINGS: dict[str, object] = {"object": "cup", "seed": 1}


@pytest.mark.devices
def test_demo_recovers_the_hidden_truth_and_never_reads_it(tmp_path: Path) -> None:
    progress = Progress(tmp_path, SETTINGS)
    with Demo(tmp_path, SMALL, "cup", seed=1) as job:
        steps = job.steps()
        last_recording = [name for name, _, _ in steps].index("sequence")
        progress.run(steps[: last_recording + 1], Console(quiet=True))
        # From here on nobody but the report may know the truth: it is gone.
        truth = tmp_path / "lab" / "truth.json"
        hidden = truth.rename(tmp_path / "lab" / "elsewhere.json")
        progress.run(steps, Console(quiet=True))
        hidden.rename(truth)
        result = job.report(progress.seconds)

    for (part, key), target in TARGETS.items():
        assert result[part][key] <= target.limit, f"{part}.{key}"
    assert result["intrinsics"]["reproj_px"] < 0.1
    assert result["frames"]["captured"] >= SMALL.board_views
    recall = result["recall"]
    assert recall["targets"] > 0
    assert 0 <= recall["before"] <= 100
    assert 0 <= recall["after"] <= 100
    assert json.loads((tmp_path / "result.json").read_text()) == result
    assert "Recovered, against the hidden truth" in (tmp_path / "report.html").read_text()
    for recording in ("board", "board_motion", "tool_tip", "touches", "sequence", "synthetic"):
        assert validate(tmp_path / f"{recording}.h5") == [], recording
    with Session.open(tmp_path / "sequence.h5") as session:
        splits = session.splits
        assert sum(map(len, splits.values())) == len(session)


def test_steps_done_before_are_not_repeated(tmp_path: Path) -> None:
    done: list[str] = []
    steps = [(name, name, lambda name=name: done.append(name)) for name in ("first", "second")]
    Progress(tmp_path, SETTINGS).run(steps[:1], Console(quiet=True))
    Progress(tmp_path, SETTINGS).run(steps, Console(quiet=True))
    assert done == ["first", "second"]


def test_a_failed_step_is_repeated(tmp_path: Path) -> None:
    attempts: list[int] = []

    def fail_once() -> None:
        attempts.append(1)
        if len(attempts) == 1:
            raise ToolkitError("the cable came loose; plug it in")

    with pytest.raises(ToolkitError):
        Progress(tmp_path, SETTINGS).run([("step", "step", fail_once)], Console(quiet=True))
    Progress(tmp_path, SETTINGS).run([("step", "step", fail_once)], Console(quiet=True))
    assert len(attempts) == 2


def test_a_folder_with_another_demo_is_refused(tmp_path: Path) -> None:
    Progress(tmp_path, SETTINGS)
    with pytest.raises(ToolkitError, match="other settings"):
        Progress(tmp_path, {**SETTINGS, "seed": 2})
