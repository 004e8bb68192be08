"""What a running lab says about itself."""

from __future__ import annotations

import pytest

from acquisition.camera import CameraConfig
from acquisition.cameras.aravis import AravisCamera
from acquisition.simulation.camera import SimulatedCamera
from s2p3.lab import RunningLab

pytestmark = pytest.mark.devices


def test_frames_that_left_late_are_told_once() -> None:
    with SimulatedCamera(width=256, height=192, frame_rate=50, latency_s=0.0) as simulated:
        lab = RunningLab(simulated)
        assert lab.warnings() == ()
        with AravisCamera(CameraConfig("127.0.0.1")) as camera:
            camera.start("free")
            for _ in range(5):
                camera.read()
            camera.stop()
        (warning,) = lab.warnings()
        late, sent = (int(word) for word in warning.split() if word.isdigit())
        assert late == sent >= 5
        assert lab.warnings() == ()
