"""Captures from a rig file: what cannot be done leaves no file behind that stands in the way of the next."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import pytest

from acquisition.capture import capture_board, capture_board_motion, capture_sequence
from acquisition.rig import CameraTable, Rig, RobotTable
from acquisition.simulation.camera import SimulatedCamera
from acquisition.simulation.robot import SimulatedRobot
from dataset.errors import SessionError, ToolkitError

Capture = Callable[[Rig, Path], object]

HOST = "127.0.0.37"
RIG = Rig(CameraTable("127.0.0.1"), RobotTable(HOST, silence_s=1.0))
CAPTURES: list[Capture] = [
    lambda rig, out: capture_board(rig, out, views=2),
    lambda rig, out: capture_board_motion(rig, out, seconds=1.0),
    lambda rig, out: capture_sequence(rig, out, seconds=1.0),
]


@pytest.mark.parametrize("capture", CAPTURES)
def test_a_file_that_exists_is_refused_before_any_device_is_opened(tmp_path: Path, capture: Capture) -> None:
    mine = tmp_path / "mine.h5"
    mine.write_text("mine")
    nowhere = Rig(CameraTable("nowhere.invalid"), RobotTable("nowhere.invalid"))
    with pytest.raises(SessionError, match=r"mine\.h5 already exists; choose another name"):
        capture(nowhere, mine)
    assert mine.read_text() == "mine"


@pytest.mark.devices
def test_a_route_that_cannot_be_planned_leaves_no_file(
    tmp_path: Path, simulated_camera: SimulatedCamera
) -> None:
    del simulated_camera
    walled_in = replace(RIG, robot=replace(RIG.robot, workspace=((0.5, 0.5, 0.5), (0.6, 0.6, 0.6))))
    with SimulatedRobot(HOST):
        for capture in CAPTURES:
            with pytest.raises(ToolkitError, match=r"where the arm stands, .* outside the workspace"):
                capture(walled_in, tmp_path / "s.h5")
            assert list(tmp_path.iterdir()) == []
