"""Clocks, traces, and what importing the room costs."""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Callable

import numpy as np

from dataset import CameraInfo, ClockFit, RobotTrace


def test_a_clock_maps_device_time_to_host_time() -> None:
    fit = ClockFit(a_ns=5e9, b=1 + 50e-6, sigma_ns=300.0)
    device = np.array([0, 1_000_000_000, 100_000_000_000])
    np.testing.assert_array_equal(fit.to_host(device), [5_000_000_000, 6_000_050_000, 105_005_000_000])


def test_a_clock_counting_since_1970_keeps_its_nanoseconds() -> None:
    device = np.array([1_800_000_000_000_000_001, 1_800_000_000_000_000_002])
    assert np.diff(ClockFit(-1e9, 1.0, 1.0).to_host(device)).tolist() == [1]


def test_a_trace_reads_as_poses(make_trace: Callable[..., RobotTrace]) -> None:
    trace = make_trace(5)
    assert len(trace) == 5
    assert trace.poses.batch == (5,)
    np.testing.assert_allclose(trace.poses.as_pose6(), trace.pose, atol=1e-12)


def test_the_working_size_is_one_pixel_per_super_pixel(camera: CameraInfo) -> None:
    assert camera.working_size == (8, 12)


def test_importing_the_room_loads_nothing_heavy() -> None:
    heavy = ("numba", "h5py", "cv2", "torch", "scipy")
    code = f"import dataset, sys; print([name for name in {heavy} if name in sys.modules])"
    found = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert found.stdout == "[]\n"
