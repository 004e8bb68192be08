"""Where the simulated arm really is: the light path from arm to camera, which in a real lab is physics."""

from __future__ import annotations

import threading
from collections import deque
from time import monotonic, sleep

import numpy as np

from acquisition import kinematics
from acquisition.robots.rtde import RtdeReader
from acquisition.simulation.controller import TRUE_TIME_VARIABLE
from dataset.errors import DeviceError
from dataset.transforms import SE3

_KEPT_S = 2.0
_PATIENCE_S = 1.0


class ArmPose:
    """Follows the simulated controller and answers with the flange's exact pose at a past moment.

    The simulated controller stamps each state with the true host time; that register exists for this reader
    only, a real controller has none and the toolkit's driver does not read it. The flange follows from the
    joints, whatever tool the client has set.
    """

    def __init__(self, host: str, frequency_hz: float) -> None:
        self._host, self._frequency_hz = host, frequency_hz
        self._times: deque[float] = deque(maxlen=int(_KEPT_S * frequency_hz))
        self._joints: deque[np.ndarray] = deque(maxlen=int(_KEPT_S * frequency_hz))
        self._lock = threading.Lock()
        threading.Thread(target=self._follow, daemon=True).start()

    def at(self, time_s: float) -> SE3:
        """T_base_flange at a time of the host's monotonic clock, seconds.

        Raises:
            DeviceError: the arm's simulator has not covered that moment.
        """
        deadline = monotonic() + _PATIENCE_S
        while monotonic() < deadline:
            with self._lock:
                if self._times and self._times[-1] >= time_s:
                    return self._interpolate(time_s)
            sleep(0.002)
        raise DeviceError(
            f"the simulated arm at {self._host} reported no pose for this exposure; is its process running?"
        )

    def _interpolate(self, time_s: float) -> SE3:
        times, joints = np.array(self._times), np.array(self._joints)
        q = [np.interp(time_s, times, angle) for angle in joints.T]
        return kinematics.forward(np.array(q))

    def _follow(self) -> None:
        variables = (TRUE_TIME_VARIABLE, "actual_q")
        while True:
            try:
                with RtdeReader(self._host, variables, self._frequency_hz) as reader:
                    while True:
                        for package in np.frombuffer(b"".join(reader.packages()), reader.dtype):
                            with self._lock:
                                self._times.append(float(package[TRUE_TIME_VARIABLE]))
                                self._joints.append(np.array(package["actual_q"], dtype=np.float64))
            except DeviceError:
                sleep(0.2)  # the arm is being restarted
