"""When a camera's clock was set or restarted, told from the two times of its frames."""

from __future__ import annotations

import numpy as np
import pytest

from acquisition.cameras.clock_epochs import ClockEpochs

SECOND = 10**9


def epochs_of(camera_ns: np.ndarray, host_ns: np.ndarray) -> list[int]:
    epochs = ClockEpochs()
    return [epochs.of(int(c), int(h)) for c, h in zip(camera_ns, host_ns, strict=True)]


def arrivals(drift_ppm: float, seed: int = 0, count: int = 400) -> tuple[np.ndarray, np.ndarray]:
    """Ten seconds of frames: camera's times, host's times with jitter and a stall of two seconds."""
    rng = np.random.default_rng(seed)
    true_ns = np.arange(count) * SECOND // 40
    lateness = rng.exponential(2e6, count)
    lateness[150:190] += np.linspace(2e9, 1e8, 40)
    camera = np.rint(true_ns * (1 + drift_ppm * 1e-6)).astype(np.int64) + 123
    host = np.maximum.accumulate((true_ns + 20_000_000 + lateness).astype(np.int64)) + 7 * SECOND
    return camera, host


@pytest.mark.parametrize("drift_ppm", [-5000.0, -100.0, 0.0, 100.0, 5000.0])
def test_drift_jitter_and_a_busy_host_are_no_jumps(drift_ppm: float) -> None:
    assert set(epochs_of(*arrivals(drift_ppm))) == {0}


@pytest.mark.parametrize("jump_s", [0.3, 5.0, 3600.0, -0.3, -5.0, -3600.0])
def test_a_jump_begins_an_epoch_at_its_frame(jump_s: float) -> None:
    camera, host = arrivals(50.0)
    camera[300:] += int(jump_s * SECOND)
    assert epochs_of(camera, host) == [0] * 300 + [1] * 100


def test_two_jumps_are_two_epochs() -> None:
    camera, host = arrivals(50.0)
    camera[100:] += 20 * SECOND
    camera[300:] -= 20 * SECOND
    assert epochs_of(camera, host)[-1] == 2


def test_a_camera_opened_anew_begins_an_epoch() -> None:
    epochs = ClockEpochs()
    assert epochs.of(5, 100) == 0
    epochs.restart()
    assert epochs.of(6, 200) == 1
    assert epochs.of(7 + SECOND, 201 + SECOND) == 1
