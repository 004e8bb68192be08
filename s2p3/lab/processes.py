"""Starts the simulated lab: arm and camera, processes that the toolkit knows by their addresses alone."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from acquisition.rig import Rig
from acquisition.simulation.camera import SimulatedCamera
from acquisition.simulation.robot import SimulatedRobot
from s2p3.lab.truth import LabTruth


@contextmanager
def running_lab(truth_path: Path, rig: Rig) -> Iterator[None]:
    """The simulated arm and camera of one lab, at the rig's addresses, for the length of a `with` block.

    Raises:
        DeviceError: one of them does not start, for example because another process holds its port.
    """
    truth = LabTruth.load(truth_path)
    camera = SimulatedCamera(
        rig.camera.address,
        source="s2p3.lab.scene:camera_source",
        source_args={"truth": str(truth_path), "arm_host": rig.robot.host, "arm_hz": rig.robot.frequency_hz},
        latency_s=truth.latency_s,
        drift_ppm=truth.camera_drift_ppm,
    )
    arm = SimulatedRobot(rig.robot.host, rig.robot.frequency_hz, drift_ppm=truth.arm_drift_ppm)
    with arm, camera:
        yield
