"""A lab on disk: the hidden truth, and the rig file that is all the toolkit gets."""

from __future__ import annotations

import time
from dataclasses import replace
from pathlib import Path

import numpy as np

from dataset.errors import ToolkitError
from dataset.transforms import SE3
from s2p3 import objects
from s2p3.lab.rig import BOARD, lab_rig
from s2p3.lab.scene import LabScene
from s2p3.lab.truth import LabTruth, sample_truth

_LATENCY_MARGIN = 2.5
_SHORTEST_LATENCY_S, _LONGEST_LATENCY_S = 0.2, 1.5
_DUTY = 0.9
"""Of a frame period, the share its latency takes: the camera delivers one frame before it exposes the next.
"""


def found_lab(folder: Path, object_name: str, seed: int) -> tuple[Path, Path]:
    """The lab in a folder, founded there if it is new.

    A machine that renders slowly gets a camera with a longer latency and a lower frame rate, so that the
    latency is constant, as a camera's is. Everything else that is hidden depends on the seed alone.

    Returns:
        The paths of truth.json and rig.toml.

    Raises:
        ToolkitError: the folder holds a lab of another object or seed, or there is no such object.
    """
    truth_path, rig_path = folder / "truth.json", folder / "rig.toml"
    if truth_path.exists():
        truth = LabTruth.load(truth_path)
        if (truth.object_name, truth.seed) != (object_name, seed):
            raise ToolkitError(
                f"{folder} holds a lab with {truth.object_name}, seed {truth.seed}; "
                f"give --object {truth.object_name} --seed {truth.seed}, or another folder."
            )
    else:
        model = objects.build(object_name)
        size = (BOARD.squares_x * BOARD.square_m, BOARD.squares_y * BOARD.square_m)
        truth = sample_truth(seed, object_name, model.refractive_index, size, model.resting)
        truth = replace(truth, latency_s=truth.latency_s + _rendering_allowance_s(truth))
        truth.save(truth_path)
    if not rig_path.exists():
        lab_rig(frame_rate=_DUTY / truth.latency_s).save(rig_path)
    return truth_path, rig_path


def _rendering_allowance_s(truth: LabTruth) -> float:
    """Seconds that a frame needs on this machine, with a margin for what else runs on it."""
    scene = LabScene(truth)
    above = np.array([0.0, 0.0, 0.4])
    view = SE3.from_rotvec(np.array([np.pi, 0.0, 0.0]), truth.T_base_object.translation + above)
    took = []
    for _ in range(6):
        started = time.perf_counter()
        scene.render(view)
        took.append(time.perf_counter() - started)
    # The first one compiled.
    return float(np.clip(_LATENCY_MARGIN * np.median(took[1:]), _SHORTEST_LATENCY_S, _LONGEST_LATENCY_S))
