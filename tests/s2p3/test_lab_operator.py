"""What the lab's operator does with his hands, recorded over the wire and calibrated from the recordings."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from acquisition.capture import capture_polarizer, capture_tool_tip
from acquisition.rig import Rig
from calibration import Calibration
from calibration.touch_steps import add_tool_tip
from dataset.session import Session
from s2p3.cli import main
from s2p3.lab import LabTruth, Operator, found_lab, running_lab

pytestmark = pytest.mark.devices


def test_tip_and_polarizers_are_recovered_from_what_the_operator_does(tmp_path: Path) -> None:
    truth_path, rig_path = found_lab(tmp_path / "lab", "cup", 3)
    truth, rig = LabTruth.load(truth_path), Rig.load(rig_path)
    tilts, turned, calibration = tmp_path / "tilts.h5", tmp_path / "turned.h5", tmp_path / "calibration.json"
    angles = np.radians(np.arange(0, 180, 22.5))
    with running_lab(truth_path, rig), Operator(truth_path, rig_path) as operator:
        with operator.pivoting(9):
            capture_tool_tip(rig, tilts, count=9)
        capture_polarizer(rig, turned, operator.turning(angles))

    add_tool_tip(tilts, calibration)
    words = ["calibrate", "polarizer", str(turned), "--calibration", str(calibration), "--apply", str(turned)]
    assert main(words) == 0

    found = Calibration.load(calibration)
    assert found.tool_tip is not None
    assert found.polarizer is not None
    assert 1e3 * np.linalg.norm(np.array(truth.tcp_tip) - rig.frames.T_tcp_tip) > 0.1
    assert 1e3 * np.linalg.norm(found.tool_tip.tip_in_tcp - truth.tcp_tip) < 0.2
    assert found.polarizer.warnings == ()
    with Session.open(turned) as session:
        assert session.kind == "polarizer"
        np.testing.assert_allclose(session.polarizer_angles, angles)
        response = session.polarizer_response
        assert response is not None
        off = response.analysis - truth.sensor.response.analysis
        # Eight frames of 8 bits and 10 000 electrons: noise, but no bias.
        assert off.std(axis=(0, 1)).max() < 1.3 * found.polarizer.sigma < 0.01
        assert np.abs(off.mean(axis=(0, 1))).max() < 1e-3
        stokes = session.stokes(2, undistort=False)
        assert np.median(stokes.dolp) == pytest.approx(1.0, abs=5e-3)
        assert np.degrees(np.median(stokes.aolp)) == pytest.approx(45.0, abs=0.1)
