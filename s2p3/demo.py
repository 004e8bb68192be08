"""The main job on the simulated lab, step by step: each step leaves its file and is not repeated when the demo is run again.

Two things are kept apart on purpose. The steps see what a real lab would see: devices on the wire, files, calibration
results. Only `compare` opens the simulated lab's hidden truth, to say how far off everything was.
"""

from __future__ import annotations

import json
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from rich.console import Console

from acquisition.capture import capture_board, capture_board_motion, capture_sequence, capture_touches
from acquisition.rig import Rig
from calibration import BoardSpec, Calibration
from calibration.steps import add_hand_eye, add_intrinsics, add_object, add_time_offset
from dataset.errors import ToolkitError
from dataset.splits import split_session
from s2p3 import objects
from s2p3.annotation import annotate
from s2p3.commands.capture import recording
from s2p3.commands.output import counting
from s2p3.config import PRESETS
from s2p3.lab import Operator, found_lab, running_lab
from s2p3.lab.scene import board_spec
from s2p3.learning import adapt, evaluate_split
from s2p3.side_by_side import Training, run_side_by_side
from s2p3.synthesis import session_camera, synthesize
from s2p3.training import labelled_crops, train_detector

Step = tuple[str, str, Callable[[], None]]


@dataclass(frozen=True)
class Plan:
    """How much of everything; the demo's answer to "how long have I got"."""

    preset: str
    """Training preset of s2p3.config."""
    board_views: int
    motion_s: float
    """Seconds of filming the board while the arm moves, for the clock offset."""
    touches: int
    """Points on the object touched with the tip."""
    sequence_s: float
    """Seconds of filming the object."""
    synthetic: int
    """Synthetic frames to train on."""


FULL = Plan(preset="fast", board_views=24, motion_s=14.0, touches=24, sequence_s=120.0, synthetic=1400)
QUICK = Plan(preset="quick", board_views=16, motion_s=8.0, touches=16, sequence_s=16.0, synthetic=96)


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
                f"{folder} holds a demo with other settings ({self._settings}); choose another --out, or delete the folder."
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
        temporary = self._path.with_suffix(".part")
        temporary.write_text(text)
        temporary.replace(self._path)


class Demo:
    """The demo's steps, over one folder."""

    def __init__(self, out: Path, plan: Plan, object_name: str, seed: int) -> None:
        self.out, self.plan, self.seed = out, plan, seed
        self.model = objects.build(object_name)
        self.lab_folder = out / "lab"
        self.calibration = out / "calibration.json"
        self.board, self.motion = out / "board.h5", out / "board_motion.h5"
        self.touches, self.sequence = out / "touches.h5", out / "sequence.h5"
        self.synthetic = out / "synthetic.h5"
        self.detector = out / "detector" / "detector.safetensors"
        self.teacher = out / "teacher" / "teacher.safetensors"
        self.student = out / "student" / "student.safetensors"
        self.adapted = out / "adapted" / "adapted.safetensors"
        self._truth, self._rig_path = found_lab(self.lab_folder, object_name, seed)
        self.rig = Rig.load(self._rig_path)
        self.experiment = PRESETS[plan.preset]()

    def steps(self) -> list[Step]:
        """Name, what the user reads, and the function of each step."""
        return [
            ("board", "film the calibration board", self.film_board),
            ("intrinsics", "calibrate the camera", self.calibrate_camera),
            ("hand_eye", "calibrate camera to arm", self.calibrate_hand_eye),
            ("time_offset", "calibrate the clocks", self.calibrate_clocks),
            ("touch", "touch the object with the tip", self.touch_object),
            ("sequence", "film the object", self.film_object),
            ("annotate", "annotate every frame", self.annotate),
            ("synthesize", "synthesize training images", self.synthesize),
            ("detector", "train the detector", self.train_detector),
            ("networks", "train teacher and student on synthetic images", self.train_networks),
            ("self_supervise", "self-supervise on captured images, without their poses", self.self_supervise),
            ("evaluate", "evaluate on held-out captured images", self.evaluate),
        ]

    def film_board(self) -> None:
        with running_lab(self._truth, self.rig):
            with recording("stills") as report:
                capture_board(self.rig, self._fresh(self.board), views=self.plan.board_views, seed=self.seed, on_progress=report)
            with recording("in motion") as report:
                capture_board_motion(self.rig, self._fresh(self.motion), seconds=self.plan.motion_s, on_progress=report)

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
        count = self.plan.touches
        with running_lab(self._truth, self.rig), Operator(self._truth, self._rig_path, count) as operator:
            with recording("points") as report, operator.touching():
                capture_touches(self.rig, self._fresh(self.touches), count=count, on_progress=report)
        tip = self.rig.frames.T_tcp_tip
        model = self.model
        add_object(self.touches, tip, model.name, model.vertices, model.faces, self.calibration, model.symmetry.axis)

    def film_object(self) -> None:
        with running_lab(self._truth, self.rig), recording("frames") as report:
            capture_sequence(self.rig, self._fresh(self.sequence), seconds=self.plan.sequence_s, on_progress=report)

    def annotate(self) -> None:
        with counting("masks and boxes") as report:
            annotate(self.sequence, Calibration.load(self.calibration), self.model, report)
        split_session(self.sequence, "frame", train=_TRAIN_SHARE, val=_VAL_SHARE, seed=self.seed)

    def synthesize(self) -> None:
        with counting("images") as report:
            synthesize(self.model, self.plan.synthetic, session_camera(self.calibration), self.seed, self.synthetic, 2, report)

    def train_detector(self) -> None:
        train_detector([self.synthetic], self.model, self.experiment, self.detector.parent)
        labelled_crops([self.synthetic], self.model, self.experiment.input, self.out)

    def train_networks(self) -> None:
        """Teacher and student are trained side by side, a process and a thread each."""
        common = (str(self.synthetic), "--object", self.model.name, "--preset", self.plan.preset, "--out")
        run_side_by_side(
            {
                name: Training(
                    ("train", name, *common, str(checkpoint.parent)),
                    checkpoint.with_suffix(".log.jsonl"),
                    settings.steps,
                )
                for name, checkpoint, settings in (
                    ("teacher", self.teacher, self.experiment.teacher),
                    ("student", self.student, self.experiment.student),
                )
            }
        )

    def self_supervise(self) -> None:
        adapt(self.sequence, "train", self.model, self.detector, self.teacher, self.student, self.adapted.parent)

    def evaluate(self) -> None:
        for name, network in (("teacher", self.teacher), ("before", self.student), ("after", self.adapted)):
            result = evaluate_split(self.sequence, "test", self.model, network, self.detector)
            result.save(self.out / f"evaluation-{name}.json")

    @property
    def _spec(self) -> BoardSpec:
        return board_spec(self.rig.board)

    @staticmethod
    def _fresh(path: Path) -> Path:
        """A recording that an earlier, interrupted run of the demo left behind is started over."""
        path.unlink(missing_ok=True)
        return path
