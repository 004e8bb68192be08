"""Accidents: whatever byte of a session is damaged, no wrong value is handed out as a good one.

`S2P3_DAMAGES=500 pytest tests/dataset/test_corruption.py` does five hundred of them. The damaged copies are
read in processes of their own, because HDF5 is a C library: were one to crash or hang, the test would say on
which damage.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from dataset import SE3, CameraInfo, ClockFit, Intrinsics, RawFrame, RobotTrace
from dataset.polarizer_response import PolarizerResponse
from dataset.session import (
    ObjectPoses,
    ObjectRecord,
    SessionWriter,
    mask_box,
    write_calibration,
    write_object,
    write_poses,
    write_split,
)
from dataset.session.edit import write_depth

SEED, DAMAGES, BATCH = 20, int(os.environ.get("S2P3_DAMAGES", "100")), 100
WORKER = Path(__file__).with_name("corruption_worker.py")


@pytest.fixture
def small(
    tmp_path: Path,
    camera: CameraInfo,
    intrinsics: Intrinsics,
    tetrahedron: ObjectRecord,
    make_frame: Callable[..., RawFrame],
    make_trace: Callable[..., RobotTrace],
    make_depth: Callable[[int], NDArray[np.uint16]],
) -> Path:
    """Everything a session can hold, of a few frames."""
    count = 3
    path = tmp_path / "small.h5"
    with SessionWriter(path, "polarizer", camera, rig_toml="[camera]\n") as writer:
        for index in range(count):
            writer.add_frame(make_frame(index, 3 * index))
            writer.add_polarizer_angle(0.1 * index)
            writer.add_drop(3 * index + 1, "queue full", 10**9)
            writer.add_pause(3 * index + 2, 3 * index + 2, "asked for", 10**9, 2 * 10**9)
        writer.add_robot_trace(make_trace(40), [0, 0, 0.1, 0, 0, 0], [1.2, 0, 0, 0.05])
        writer.set_clocks(camera=ClockFit(-6e9, 1.0, 300.0), robot=ClockFit(-99e9, 1.0, 400.0))
    response = PolarizerResponse.of(1.0, 300.0, np.full((camera.height, camera.width), 0.3))
    write_calibration(path, '{"fx": 40}', intrinsics, response)
    write_depth(path, make_depth(count))
    write_object(path, tetrahedron)
    masks = np.random.default_rng(0).random((count, *camera.working_size)) > 0.5
    boxes = np.stack([mask_box(mask) for mask in masks])
    poses = SE3.exp(np.random.default_rng(3).normal(size=(count, 6)))
    write_poses(
        path, poses, 1e-4, 2e-4, {"tetra": ObjectPoses(poses.inverse(), np.full(count, 0.9), boxes, masks)}
    )
    write_split(path, "train", [0, 1])
    return path


def outcomes(session: Path, folder: Path, first: int) -> list[dict[str, Any]]:
    count = min(BATCH, DAMAGES - first)
    command = [sys.executable, str(WORKER), *map(str, (session, folder, SEED, first, count))]
    try:
        done = subprocess.run(command, capture_output=True, text=True, timeout=600, check=False)
    except subprocess.TimeoutExpired as error:
        last = (error.stdout or b"").decode().splitlines()[-1:]
        pytest.fail(f"reading hung at {last}")
    lines = [json.loads(line) for line in done.stdout.splitlines()]
    assert done.returncode == 0, f"exit {done.returncode} at {lines[-1:]}: {done.stderr[-2000:]}"
    return [line for line in lines if "wrong" in line]


def test_no_damage_goes_unseen_or_crashes(small: Path, tmp_path: Path) -> None:
    found = [line for first in range(0, DAMAGES, BATCH) for line in outcomes(small, tmp_path, first)]
    assert len(found) == DAMAGES
    for line in found:
        assert line["wrong"] == [], line
        messages = line["errors"] + line["problems"]
        assert all("\n" not in message for message in messages), line
        assert line["complete"] or line["errors"], line
        assert line["problems"] or not line["errors"], line  # what a reader refuses, validate names
    hurt = sum(bool(line["problems"]) for line in found)
    assert hurt > DAMAGES / 5  # the rest hit bytes that mean nothing
