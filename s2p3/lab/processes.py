"""Starts the simulated lab: arm and camera, processes that the toolkit knows by their addresses alone."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from acquisition.rig import Rig
from acquisition.simulation.camera import SimulatedCamera
from acquisition.simulation.robot import SimulatedRobot
from s2p3.lab.truth import LabTruth


class RunningLab:
    """The processes of a lab that is being simulated."""

    def __init__(self, camera: SimulatedCamera) -> None:
        self._camera = camera
        self._told = (0, 0)

    def warnings(self) -> tuple[str, ...]:
        """What went wrong with the simulation since this was last asked, a line each."""
        _, frames, _, late = self._camera.command("statistics").split()
        before, self._told = self._told, (int(frames), int(late))
        sent, delayed = self._told[0] - before[0], self._told[1] - before[1]
        if delayed == 0:
            return ()
        return (
            f"{delayed} of {sent} simulated frames left late: this computer was too busy to render them in "
            "time, so their delay was not the camera's; close other programs",
        )


@contextmanager
def running_lab(truth_path: Path, rig: Rig) -> Iterator[RunningLab]:
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
        yield RunningLab(camera)
