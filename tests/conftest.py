"""Simulated devices that whole test modules share. They own fixed ports: one of a kind at a time."""

from collections.abc import Iterator

import pytest

from acquisition.simulation.camera import SimulatedCamera


@pytest.fixture(scope="module")
def simulated_camera() -> Iterator[SimulatedCamera]:
    """A small and fast camera on 127.0.0.1, which shows `MovingPattern`."""
    with SimulatedCamera(width=256, height=192, frame_rate=100, latency_s=0.002) as camera:
        yield camera
