"""What reaches a recording of the arm's samples: our RTDE reader beside ur_rtde's receive interface.

    python tools/bench/trace.py --seconds 20 --json

Both read the simulated controller (a process of its own, 500 Hz) at 125 and 500 Hz, in turns, in rounds of
two seconds, so that what else the machine does slows both. The vendor's interface keeps the newest package
only: it is asked every 0.1 ms, as no recorder would.

    kept        samples with a timestamp of their own, as a share of those that the controller sent meanwhile
    p50_ms      from the moment of the state to the moment at which Python holds it; of a sample that was
                overwritten before anybody looked there is none, which flatters the vendor's p99
    p99_ms
    samples     kept, in all rounds

The moment of a state on the host's clock is its timestamp and a constant, which a register that only the
simulated controller has tells.
"""

from __future__ import annotations

import argparse
import json
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import rtde_receive

from acquisition.robots.rtde import RtdeReader
from acquisition.simulation.controller import TRUE_TIME_VARIABLE
from acquisition.simulation.robot import SimulatedRobot

HOST = "127.0.0.41"
RATES_HZ = (125.0, 500.0)
_ROUND_S = 2.0
_VARIABLES = ["timestamp", "actual_q", "actual_TCP_pose", "safety_status_bits"]
_ASKED_EVERY_S = 1e-4


Stamps = list[tuple[float, float]]
"""The controller's clock in each sample, and the host's when Python held it, seconds."""


@dataclass
class Tally:
    """What one client got at one rate."""

    kept: int = 0
    sent: int = 0
    late_s: list[float] = field(default_factory=list)

    def add(self, stamps: Stamps, rate_hz: float, offset_s: float) -> None:
        """One round; the controller's clock and `offset_s` are the host's."""
        robot_s, seen_s = np.array(stamps).T
        unique, first = np.unique(robot_s, return_index=True)
        self.kept += len(unique)
        self.sent += 1 + round((unique[-1] - unique[0]) * rate_hz)
        self.late_s += (seen_s - robot_s - offset_s)[first].tolist()

    def figures(self) -> dict[str, float]:
        p50, p99 = 1e3 * np.percentile(self.late_s, [50, 99])
        return {
            "kept": round(self.kept / self.sent, 5),
            "p50_ms": round(float(p50), 3),
            "p99_ms": round(float(p99), 3),
            "samples": self.kept,
        }


def clock_offset_s() -> float:
    """From the controller's clock to the host's."""
    with RtdeReader(HOST, ["timestamp", TRUE_TIME_VARIABLE], RATES_HZ[0]) as reader:
        while not (packages := reader.packages()):
            continue
    (record, *_) = np.frombuffer(packages[0], reader.dtype)
    return float(record[TRUE_TIME_VARIABLE] - record["timestamp"])


def read_ours(rate_hz: float, seconds: float) -> Stamps:
    """With the reader that our traces come from."""
    stamps: Stamps = []
    with RtdeReader(HOST, _VARIABLES, rate_hz) as reader:
        end = time.monotonic() + seconds
        while time.monotonic() < end:
            packages = reader.packages()
            now = time.monotonic()
            records = np.frombuffer(b"".join(packages), reader.dtype)
            stamps += [(float(robot_s), now) for robot_s in records["timestamp"]]
    return stamps


def read_vendors(rate_hz: float, seconds: float) -> Stamps:
    """With ur_rtde's receive interface, asked again and again."""
    receive = rtde_receive.RTDEReceiveInterface(HOST, rate_hz, _VARIABLES)
    stamps: Stamps = []
    last = 0.0
    try:
        end = time.monotonic() + seconds
        while time.monotonic() < end:
            robot_s = receive.getTimestamp()
            if robot_s != last:
                stamps.append((robot_s, time.monotonic()))
                last = robot_s
            time.sleep(_ASKED_EVERY_S)
    finally:
        receive.disconnect()
    return stamps


CLIENTS: dict[str, Callable[[float, float], Stamps]] = {"ours": read_ours, "ur_rtde": read_vendors}


def measure(seconds: float) -> dict[str, Any]:
    """The figures of every client at every rate, after that many seconds each."""
    tallies = {(rate, name): Tally() for rate in RATES_HZ for name in CLIENTS}
    with SimulatedRobot(HOST):
        offset_s = clock_offset_s()
        for _ in range(max(1, round(seconds / _ROUND_S))):
            for (rate, name), tally in tallies.items():
                tally.add(CLIENTS[name](rate, _ROUND_S), rate, offset_s)
    return {f"{rate:g}_hz": {name: tallies[rate, name].figures() for name in CLIENTS} for rate in RATES_HZ}


def main() -> None:
    parser = argparse.ArgumentParser(description="Our RTDE reader beside ur_rtde's receive interface.")
    parser.add_argument("--seconds", type=float, default=20.0, help="of each client at each rate (20)")
    parser.add_argument("--json", action="store_true", help="print one JSON object")
    options = parser.parse_args()
    figures = measure(options.seconds)
    if options.json:
        print(json.dumps({"seconds": options.seconds, **figures}))
        return
    for rate, clients in figures.items():
        for name, values in clients.items():
            print(f"{rate:>7} {name:>8}", *(f"{key}={value}" for key, value in values.items()))


if __name__ == "__main__":
    main()
