"""The state of a Universal Robots arm, package by package, read by a thread of its own.

A plain reader of the RTDE port loses nothing at 500 Hz, whereas a client that keeps only the newest package
misses some; a trace therefore comes from here.
"""

from __future__ import annotations

import struct
import threading
import time
from array import array
from collections import deque

import numpy as np
from numpy.typing import NDArray

from acquisition.robot import EmergencyStop, ProtectiveStop
from acquisition.robots.rtde import RtdeReader
from dataset.errors import DeviceError
from dataset.frames import RobotSample, RobotTrace
from dataset.transforms import SE3

Floats = NDArray[np.float64]

_VARIABLES = ("timestamp", "actual_q", "actual_TCP_pose", "safety_status_bits")
_OPTIONAL = ("tcp_offset", "payload", "payload_cog")  # software before PolyScope 3.12 / 5.5 lacks some
_TIMESTAMP = struct.Struct(">xd")  # after the recipe's number
_LOST_AFTER_S = 1.5
_STILL_WINDOW_S = 0.15
_STILL_RAD = 2e-4  # a joint's noise at rest is a few 1e-5 rad

# Bits of RTDE's safety_status_bits.
_PROTECTIVE = 1 << 2
_SAFEGUARD = 1 << 4
_EMERGENCY = 1 << 5 | 1 << 6 | 1 << 7
_FAULT = 1 << 8 | 1 << 9
_STOPPED = 1 << 10


def safety_error(bits: int, where: str) -> DeviceError | None:
    """The error that a safety status word stands for; None where the arm may move.

    Args:
        bits: RTDE's safety_status_bits.
        where: the arm, for the message.
    """
    if bits & _EMERGENCY:
        return EmergencyStop(
            f"emergency stop at {where}; release the button, power the arm on at the pendant and start again"
        )
    if bits & (_PROTECTIVE | _SAFEGUARD):
        kind = "protective" if bits & _PROTECTIVE else "safeguard"
        return ProtectiveStop(
            f"{kind} stop at {where}; clear what the arm touched or the safety device that tripped, unlock "
            "the arm at the pendant and start again"
        )
    if bits & (_FAULT | _STOPPED):
        return DeviceError(
            f"the safety system of {where} stopped the arm (status {bits:#x}); restart safety at the pendant"
        )
    return None


class RtdeStream:
    """Receives every package of an arm, from construction to `close`.

    Args:
        host: address of the controller.
        frequency_hz: rate of the packages.
        silence_s: the longest silence after which the newest state still counts as current.

    Raises:
        DeviceError: the arm does not answer.
    """

    def __init__(self, host: str, frequency_hz: float, silence_s: float = 0.1) -> None:
        self.host = host
        self._silence_s = silence_s
        self._reader = RtdeReader(host, _VARIABLES, frequency_hz, max(silence_s, _LOST_AFTER_S), _OPTIONAL)
        self.dtype = self._reader.dtype
        self._tool = _Field(self.dtype, "tcp_offset")
        self._lock = threading.Lock()
        self._failure: DeviceError | None = None
        self._closing = False
        self._frozen_s = 0.0
        self._recent: deque[tuple[int, bytes]] = deque(maxlen=max(2, round(_STILL_WINDOW_S * frequency_hz)))
        self._trace: bytearray | None = None
        self._trace_times = array("q")
        self._trace_tool: bytes | None = None
        try:
            self._take(self._reader.packages())
            while not self._recent:
                self._take(self._reader.packages())
        except BaseException:
            self._reader.close()
            raise
        self._thread = threading.Thread(target=self._run, name=f"rtde {host}", daemon=True)
        self._thread.start()

    def check(self) -> None:
        """Raises DeviceError where the stream has ended, is stale, or the arm is stopped for safety."""
        error = safety_error(self.sample().safety_bits, f"the arm {self.host}")
        if error is not None:
            raise error

    def sample(self) -> RobotSample:
        """The newest state. Raises DeviceError where the stream has ended or fell silent."""
        if self._failure is not None:
            raise self._failure
        silent_s = max(self._reader.silent_s, self._frozen_s)
        if silent_s > self._silence_s:
            raise DeviceError(
                f"the arm {self.host} has sent nothing new for {silent_s:.2f} s although its connection is "
                "open; check the network and whether the controller hangs"
            )
        host_time_ns, package = self._recent[-1]
        record = np.frombuffer(package, self.dtype)[0]
        return RobotSample(
            host_time_ns=host_time_ns,
            robot_time_s=float(record["timestamp"]),
            q=record["actual_q"].astype(np.float64),
            T_base_tcp=SE3.from_pose6(record["actual_TCP_pose"]),
            safety_bits=int(record["safety_status_bits"]),
        )

    @property
    def tcp_offset(self) -> Floats | None:
        """(6,) the active tool centre point in the flange frame; None where the controller does not tell."""
        return self._newest("tcp_offset")

    @property
    def payload(self) -> Floats:
        """(4,) mass, kg, and centre of gravity in the flange frame, metres, that the controller reckons with;
        NaN where it does not tell."""
        mass, centre = self._newest("payload"), self._newest("payload_cog")
        if mass is None or centre is None:
            return np.full(4, np.nan)
        return np.append(mass, centre)

    def _newest(self, name: str) -> Floats | None:
        assert self.dtype.names is not None
        if name not in self.dtype.names:
            return None
        return np.array(np.frombuffer(self._recent[-1][1], self.dtype)[0][name], dtype=np.float64)

    def still(self) -> bool:
        """Whether no joint has moved over the last moment."""
        with self._lock:
            recent = b"".join(package for _, package in self._recent)
            full = len(self._recent) == self._recent.maxlen
        return full and bool(np.ptp(np.frombuffer(recent, self.dtype)["actual_q"], axis=0).max() < _STILL_RAD)

    def start_trace(self) -> None:
        """Begins to keep every package; from here on, another tool offset ends the stream.

        Raises DeviceError where a trace is running or the stream ended.
        """
        self.sample()
        with self._lock:
            if self._trace is not None:
                raise DeviceError(f"a trace of the arm {self.host} is already running; stop it first")
            self._trace, self._trace_times = bytearray(), array("q")
            self._trace_tool = self._tool.of(self._recent[-1][1])

    def take_trace(self) -> RobotTrace:
        """Every package since `start_trace` or since they were last taken, also where the stream ended since.

        Raises DeviceError where no trace is running.
        """
        return self._taken(bytearray())

    def stop_trace(self) -> RobotTrace:
        """Every package not taken yet. Raises DeviceError where none was started or the stream ended."""
        trace = self._taken(None)
        if self._failure is not None:
            raise DeviceError(f"the trace is incomplete after {len(trace)} samples: {self._failure}")
        return trace

    def _taken(self, successor: bytearray | None) -> RobotTrace:
        with self._lock:
            trace, times = self._trace, self._trace_times
            if trace is None:
                raise DeviceError(f"no trace of the arm {self.host} is running; start one first")
            self._trace, self._trace_times = successor, array("q")
        records = np.frombuffer(bytes(trace), self.dtype)
        return RobotTrace(
            host_time_ns=np.array(times, dtype=np.int64),
            robot_time_s=_native(records["timestamp"]),
            q=_native(records["actual_q"]).reshape(-1, 6),
            pose=_native(records["actual_TCP_pose"]).reshape(-1, 6),
            safety_bits=records["safety_status_bits"].astype(np.uint32),
        )

    def close(self) -> None:
        """Ends the thread and the connection. Idempotent."""
        self._closing = True
        self._reader.close()
        self._thread.join()

    def _run(self) -> None:
        try:
            while not self._closing:
                self._take(self._reader.packages())
        except DeviceError as error:
            self._failure = error

    def _take(self, packages: list[bytes]) -> None:
        host_time_ns = time.monotonic_ns()
        with self._lock:
            for package in packages:
                if not self._is_newer(package):
                    continue
                if self._trace is not None:
                    self._check_tool(package)
                self._recent.append((host_time_ns, package))
                if self._trace is not None:
                    self._trace += package
                    self._trace_times.append(host_time_ns)
            if packages and self._recent:  # a controller that hangs may repeat its last state for ever
                self._frozen_s = 1e-9 * (host_time_ns - self._recent[-1][0])

    def _is_newer(self, package: bytes) -> bool:
        if not self._recent:
            return True
        (time_s,), (last_s,) = _TIMESTAMP.unpack_from(package), _TIMESTAMP.unpack_from(self._recent[-1][1])
        if time_s < last_s:
            raise DeviceError(
                f"the clock of the arm {self.host} went back by {last_s - time_s:.3f} s: its controller "
                "restarted; connect again, and discard what was recorded across the restart"
            )
        return bool(time_s > last_s)

    def _check_tool(self, package: bytes) -> None:
        if self._tool.of(package) != self._trace_tool:
            was, is_now = (
                np.round(np.frombuffer(record, self.dtype)[0]["tcp_offset"].astype(np.float64), 4).tolist()
                for record in (self._recent[-1][1], package)
            )
            raise DeviceError(
                f"the tool offset of the arm {self.host} changed from {was} to {is_now} during the "
                "recording; leave the TCP at the pendant as it is, and record again"
            )


class _Field:
    """The bytes of one variable in a package; empty where the package does not hold it."""

    def __init__(self, dtype: np.dtype[np.void], name: str) -> None:
        self._slice = slice(0)
        if dtype.fields is not None and name in dtype.fields:
            kind, start = dtype.fields[name][:2]
            self._slice = slice(start, start + kind.itemsize)

    def of(self, package: bytes) -> bytes:
        return package[self._slice]


def _native(values: NDArray[np.generic]) -> NDArray[np.float64]:
    return values.astype(np.float64)
