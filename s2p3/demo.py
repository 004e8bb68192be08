"""The main job on the simulated lab, step by step: each step leaves its file and is not repeated when the
demo is run again.

Two things are kept apart on purpose. The steps see what a real lab would see: devices on the wire, files,
calibration results. Only `compare` opens the simulated lab's hidden truth, to say how far off everything was.
"""

from __future__ import annotations

import json
import time
from collections.abc import Callable
from contextlib import ExitStack
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import torch
from rich.console import Console

from acquisition.capture import (
    capture_board,
    capture_board_motion,
    capture_sequence,
    capture_tool_tip,
    capture_touches,
)
from acquisition.recorder import Progress as Recorded
from acquisition.rig import Rig
from calibration import BoardSpec, Calibration
from calibration.steps import add_hand_eye, add_intrinsics, add_time_offset
from calibration.touch_steps import add_object, add_tool_tip
from dataset.errors import ToolkitError
from dataset.splits import split_session
from dataset.whole_files import replacing
from s2p3 import objects
from s2p3.annotation import annotate
from s2p3.board import board_spec
from s2p3.captured_stages import adapt, evaluate_split
from s2p3.console_output import counting, progress_bars, recording, say
from s2p3.demo_report import compare, write_report
from s2p3.evaluation import Evaluation
from s2p3.lab import LabTruth, Operator, RunningLab, found_lab, running_lab
from s2p3.presets import PRESETS
from s2p3.side_by_side import Training, run_side_by_side
from s2p3.synthesis import SYNTHETIC, Views, session_camera, synthesize

Step = tuple[str, str, Callable[[], None]]

_TRAIN_SHARE, _VAL_SHARE = 0.4, 0.1
"""Of the captured frames: seen without labels, and kept for tuning; the rest is the test (our choice)."""


@dataclass(frozen=True)
class Plan:
    """How much of everything; the demo's answer to "how long have I got"."""

    preset: str
    """Of `s2p3.presets`, for the trainings."""
    board_views: int
    motion_s: float
    """Seconds of filming the board while the arm moves, for the clock offset."""
    pivots: int
    """Poses about the tip, for its place on the tool."""
    touches: int
    """Points on the object touched with the tip."""
    sequence_s: float
    """Seconds of filming the object."""
    synthetic: int
    """Synthetic frames to train on."""


FULL = Plan(
    preset="fast", board_views=24, motion_s=14.0, pivots=20, touches=40, sequence_s=110.0, synthetic=1200
)
QUICK = Plan(
    preset="quick", board_views=14, motion_s=8.0, pivots=12, touches=30, sequence_s=14.0, synthetic=64
)


_TAKES = 3
"""How often the board is filmed in motion at most, until the recording has no doubt about its clocks."""

_WORKERS = 2
_DOMAIN = replace(SYNTHETIC, views=Views(distance_m=(0.27, 0.52), elevation_deg=(25.0, 82.0)))
"""Synthetic views are distributed as the captured ones are, as in the paper."""


class Progress:
    """Which steps are done, and how long each took: OUT/steps.json."""

    def __init__(self, folder: Path, settings: dict[str, object]) -> None:
        self._path = folder / "steps.json"
        self.seconds: dict[str, float] = {}
        if not self._path.exists():
            folder.mkdir(parents=True, exist_ok=True)
            self._settings = settings
            self._save()
            return
        state = json.loads(self._path.read_text())
        self._settings = state["settings"]
        if self._settings != settings:
            raise ToolkitError(
                f"{folder} holds a demo with other settings ({self._settings}); "
                "choose another --out, or delete the folder."
            )
        self.seconds = state["seconds"]

    def run(self, steps: list[Step], console: Console) -> None:
        for number, (name, what, action) in enumerate(steps, start=1):
            label = f"[{number}/{len(steps)}] {what}"
            if name in self.seconds:
                console.print(f"[dim]{label}: done before, {self.seconds[name]:.0f} s[/dim]")
                continue
            console.print(f"[bold]{label}[/bold]")
            started = time.perf_counter()
            action()
            self.seconds[name] = round(time.perf_counter() - started, 1)
            self._save()

    def _save(self) -> None:
        text = json.dumps({"settings": self._settings, "seconds": self.seconds}, indent=1)
        with replacing(self._path) as partial:
            partial.write_text(text)


class Demo:
    """The demo's steps, over one folder."""

    def __init__(self, out: Path, plan: Plan, object_name: str, seed: int) -> None:
        self.out, self.plan, self.seed = out, plan, seed
        self.model = objects.build(object_name)
        self.lab_folder = out / "lab"
        self.calibration = out / "calibration.json"
        self.board, self.motion = out / "board.h5", out / "board_motion.h5"
        self.tilts, self.touches = out / "tool_tip.h5", out / "touches.h5"
        self.sequence = out / "sequence.h5"
        self.synthetic = out / "synthetic.h5"
        self.detector = out / "detector" / "detector.safetensors"
        self.teacher = out / "teacher" / "teacher.safetensors"
        self.student = out / "student" / "student.safetensors"
        self.adapted = out / "adapted" / "adapted.safetensors"
        self._truth, self._rig_path = found_lab(self.lab_folder, object_name, seed)
        self.rig = Rig.load(self._rig_path)
        self.experiment = PRESETS[plan.preset]()
        # Two threads of one process fight as soon as anything else runs; one each is as fast on two cores.
        torch.set_num_threads(1)
        self._devices = ExitStack()
        self._lab: RunningLab | None = None

    def __enter__(self) -> Demo:
        return self

    def __exit__(self, *_: object) -> None:
        self._close_lab()

    def steps(self) -> list[Step]:
        """Name, what the user reads, and the function of each step."""
        return [
            ("board", "film the calibration board", self.film_board),
            ("intrinsics", "calibrate the camera", self.calibrate_camera),
            ("hand_eye", "calibrate camera to arm", self.calibrate_hand_eye),
            ("time_offset", "calibrate the clocks", self.calibrate_clocks),
            ("touch", "calibrate the tip, and touch the object with it", self.touch_object),
            ("sequence", "film the object", self.film_object),
            ("annotate", "annotate every frame", self.annotate),
            ("synthesize", "synthesize training images", self.synthesize),
            ("train", "train detector, teacher and student on synthetic images", self.train),
            ("self_supervise", "self-supervise on captured images, without their poses", self.self_supervise),
            ("evaluate", "evaluate on held-out captured images", self.evaluate),
        ]

    def film_board(self) -> None:
        self._open_lab()
        with recording("stills") as report:
            views, out = self.plan.board_views, self._fresh(self.board)
            done = capture_board(self.rig, out, views=views, seed=self.seed, on_progress=report)
        self._warn(done)
        for _ in range(_TAKES):
            with recording("in motion") as report:
                seconds, out = self.plan.motion_s, self._fresh(self.motion)
                done = capture_board_motion(self.rig, out, seconds=seconds, on_progress=report)
            self._warn(done)
            if not done.warnings:
                break

    def calibrate_camera(self) -> None:
        with counting("detect the board") as report:
            add_intrinsics(self.board, self._spec, self.calibration, report)

    def calibrate_hand_eye(self) -> None:
        with counting("detect the board") as report:
            add_hand_eye(self.board, self._spec, self.calibration, report)

    def calibrate_clocks(self) -> None:
        with counting("detect the board") as report:
            add_time_offset(self.motion, self._spec, self.calibration, report)

    def touch_object(self) -> None:
        pivots, touches, model = self.plan.pivots, self.plan.touches, self.model
        operator = Operator(self._truth, self._rig_path)
        self._open_lab()
        with operator:
            with recording("tilts about the tip") as report, operator.pivoting(pivots):
                capture_tool_tip(self.rig, self._fresh(self.tilts), count=pivots, on_progress=report)
            with recording("points") as report, operator.touching(touches):
                capture_touches(self.rig, self._fresh(self.touches), count=touches, on_progress=report)
        add_tool_tip(self.tilts, self.calibration)
        add_object(
            self.touches, model.name, model.vertices, model.faces, self.calibration, model.symmetry.axis
        )

    def film_object(self) -> None:
        self._open_lab()
        with recording("frames") as report:
            seconds, out = self.plan.sequence_s, self._fresh(self.sequence)
            done = capture_sequence(self.rig, out, seconds=seconds, on_progress=report)
        self._warn(done)
        self._close_lab()

    def annotate(self) -> None:
        with counting("masks and boxes") as report:
            annotate(self.sequence, Calibration.load(self.calibration), self.model, report)
        split_session(self.sequence, "frame", train=_TRAIN_SHARE, val=_VAL_SHARE, seed=self.seed)

    def synthesize(self) -> None:
        with counting("images") as report:
            camera = session_camera(self.calibration)
            count, workers = self.plan.synthetic, _WORKERS
            synthesize(self.model, count, camera, self.seed, self.synthetic, workers, report, _DOMAIN)

    def train(self) -> None:
        """A process and a thread each: the teacher beside the detector, then the student, which starts from
        the teacher's encoders. What is finished stays."""
        common = (str(self.synthetic), "--object", self.model.name, "--preset", self.plan.preset)

        def training(checkpoint: Path, steps: int, *more: str, after: str | None = None) -> Training:
            words = ("train", checkpoint.stem, *common, "--out", str(checkpoint.parent), *more)
            return Training(words, checkpoint.with_suffix(".log.jsonl"), steps, after)

        steps, stages = self.experiment, (self.detector, self.teacher, self.student)
        alone, beside = ("--workers", "1"), ("--workers", "0")  # the student has a core to augment on
        start = ("--teacher", str(self.teacher))
        runs = {
            "detector": training(self.detector, steps.detector.steps, *beside),
            "teacher": training(self.teacher, steps.teacher.steps, *beside),
            "student": training(self.student, steps.student.steps, *start, *alone, after="teacher"),
        }
        finished = [path.stem for path in stages if path.exists()]
        run_side_by_side({name: run for name, run in runs.items() if name not in finished})

    def self_supervise(self) -> None:
        if not self.adapted.exists():
            networks = (self.detector, self.teacher, self.student)
            with progress_bars() as report:
                out = self.adapted.parent
                adapt(self.sequence, "train", self.model, *networks, out, workers=1, report=report)

    def evaluate(self) -> None:
        networks = {"teacher": self.teacher, "before": self.student, "after": self.adapted}
        with progress_bars() as report:
            runs = evaluate_split(self.sequence, "test", self.model, networks, self.detector, report)
        for name, run in runs.items():
            run.save(self._evaluation(name))

    def report(self, seconds: dict[str, float]) -> dict[str, Any]:
        """Compares with the hidden truth, writes result.json and report.html, and returns the result."""
        runs = {name: Evaluation.load(self._evaluation(name)) for name in ("teacher", "before", "after")}
        recordings = (self.board, self.motion, self.sequence)
        calibration = Calibration.load(self.calibration)
        result = compare(calibration, LabTruth.load(self._truth), recordings, runs, seconds)
        write_report(self.out, result, self.calibration, self.sequence, self.model, runs)
        return result

    def _evaluation(self, name: str) -> Path:
        return self.out / f"evaluation-{name}.json"

    def _open_lab(self) -> None:
        """Camera and arm serve until the last recording is made."""
        if self._lab is None:
            self._lab = self._devices.enter_context(running_lab(self._truth, self.rig))

    def _close_lab(self) -> None:
        self._devices.close()
        self._lab = None

    def _warn(self, done: Recorded) -> None:
        """Says what is doubtful about a recording, and about the simulation that it was made of."""
        simulated = () if self._lab is None else self._lab.warnings()
        for warning in (*done.warnings, *simulated):
            say(f"warning: {warning}")

    @property
    def _spec(self) -> BoardSpec:
        return board_spec(self.rig.board)

    @staticmethod
    def _fresh(path: Path) -> Path:
        """A recording that an earlier, interrupted run of the demo left behind is started over."""
        path.unlink(missing_ok=True)
        return path
