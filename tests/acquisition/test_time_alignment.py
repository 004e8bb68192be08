"""Poses at mid-exposure against the truth, and against the nearest sample: tools/bench/time_alignment.py."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import pytest

SCRIPT = Path(__file__).parents[2] / "tools" / "bench" / "time_alignment.py"


def figures(*arguments: str) -> dict[str, float]:
    command = [sys.executable, str(SCRIPT), "--json", *arguments]
    ended = subprocess.run(command, capture_output=True, text=True, timeout=120, check=False)
    assert ended.returncode == 0, ended.stderr
    found: dict[str, float] = json.loads(ended.stdout)
    return found


def test_virtual_devices_are_followed_to_a_tenth_of_a_millimetre() -> None:
    """30 ms of delay, 80 ppm of drift, jitter with a tail of 40 ms, 0.25 m/s."""
    found = figures("--virtual", "--seconds", "10")
    assert found["speed_m_s"] == pytest.approx(0.25, rel=0.05)
    assert found["unknown"] == 0
    assert found["ours_mm"] < 0.1
    assert found["ours_deg"] < 0.01
    assert found["offset_ms"] == pytest.approx(-30.0, abs=3 * found["offset_sigma_ms"])
    assert found["nearest_mm"] > 3.0


@pytest.mark.devices
def test_simulated_devices_are_followed_as_well_as_their_sigma_says() -> None:
    found = figures("--seconds", "5")
    assert found["frames"] > 50
    sigma_ms = (found["sigma_ms"] ** 2 + found["offset_sigma_ms"] ** 2) ** 0.5
    assert found["ours_mm"] < 0.1 + 3 * sigma_ms * found["speed_m_s"]
    assert found["ours_mm"] < found["nearest_mm"]
