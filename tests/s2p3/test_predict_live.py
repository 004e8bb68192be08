"""Shots of a live camera: triggered, undistorted, and only as many as were asked for."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from acquisition.rig import CameraTable, Rig, RobotTable
from acquisition.simulation.camera import SimulatedCamera
from calibration import Calibration, IntrinsicsRecord
from calibration.records import FixedCameraRecord
from dataset import SE3, Intrinsics
from dataset.errors import ToolkitError
from s2p3.evaluation.shots import live_shots

pytestmark = pytest.mark.devices


def calibration(height: int, width: int) -> Calibration:
    K = np.array([[300.0, 0, width / 2], [0, 300.0, height / 2], [0, 0, 1]])
    camera = Intrinsics(K, np.array([0.01, 0.0, 0.0, 0.0, 0.0]), height, width)
    return Calibration(None, IntrinsicsRecord(camera, np.eye(9), 0.04, 0.05, 20, ()))


def test_a_live_camera_gives_as_many_shots_as_asked_for(simulated_camera: SimulatedCamera) -> None:
    rig = Rig(CameraTable(address="127.0.0.1", timeout_s=5.0), RobotTable(host="127.0.0.1"))
    shots = list(live_shots(rig, calibration(192, 256), 2))
    assert len(shots) == 2
    for shot in shots:
        assert shot.stokes.shape[0] == 3
        assert shot.stokes.shape[1:] == (shot.intrinsics.height, shot.intrinsics.width)
        assert shot.stokes[0].max() > 0
        assert shot.T_base_cam is None
        assert shot.host_time_ns > 0
    still = SE3.from_rotvec([0.1, 0.2, 0.3], [0.4, 0.5, 0.6])
    stands = FixedCameraRecord(still, still, np.eye(12), 0.1, 0.1, 0.01, 1e-5, 1e-5, 20, ())
    (shot,) = live_shots(rig, replace(calibration(192, 256), fixed_camera=stands), 1)  # there is no arm
    assert shot.T_base_cam is still
    with pytest.raises(ToolkitError, match="of 256x192 pixels, the intrinsics are for 512x384"):
        next(live_shots(rig, calibration(384, 512), 1))
