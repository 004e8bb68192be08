"""A Universal Robots UR5e that is only read: somebody else moves it, a hand or the pendant.

Reading needs no remote control and takes nothing away from other programs: it opens the RTDE port alone.
"""

from __future__ import annotations

import time

import numpy as np
from numpy.typing import NDArray

from acquisition.kinematics import forward
from acquisition.robot import PoseSource, RobotConfig
from acquisition.robots.stream import RtdeStream
from dataset.errors import DeviceError, ToolkitError
from dataset.frames import RobotSample, RobotTrace
from dataset.transforms import SE3, rotation_error_deg

Floats = NDArray[np.float64]

_POLL_S = 0.02
_PLAUSIBLE_M, _PLAUSIBLE_DEG = 0.02, 3.0  # factory calibration differs from the nominal arm by millimetres
_SAME_TOOL = 1e-4  # m and rad; what is copied from the pendant's display is rounded


class UrReceiver(PoseSource):
    """A UR5e that is only read; it may be in local mode.

    Args:
        config: its `tcp_offset` is required where the controller's software, older than PolyScope 3.12 / 5.5,
            does not tell the active one.

    Raises:
        DeviceError: the arm does not answer, another tool than the configured one is active, or its pose
            contradicts the tool.
        ToolkitError: the tool offset is not known.
    """

    def __init__(self, config: RobotConfig) -> None:
        self.config = config
        self._stream = RtdeStream(config.host, config.frequency_hz, config.silence_s)
        try:
            self._tcp_offset = self._known_tool()
        except BaseException:
            self._stream.close()
            raise

    @property
    def tcp_offset(self) -> Floats:
        return self._tcp_offset.copy()

    @property
    def payload(self) -> Floats:
        return self._stream.payload

    def sample(self) -> RobotSample:
        sample, told = self._stream.sample(), self._stream.tcp_offset
        if told is None:  # then the pose must tell whether the tool is still the same
            check_tool(sample, self._tcp_offset, self.config.host)
        else:
            check_unchanged(told, self._tcp_offset, self.config.host)
        return sample

    def start_trace(self) -> None:
        self._stream.start_trace()

    def take_trace(self) -> RobotTrace:
        return self._stream.take_trace()

    def stop_trace(self) -> RobotTrace:
        return self._stream.stop_trace()

    def wait_until_still(self, timeout_s: float = 10.0) -> None:
        deadline = time.monotonic() + timeout_s
        while not self._stream.still():
            self._stream.sample()
            if time.monotonic() > deadline:
                raise DeviceError(
                    f"the arm {self.config.host} still moves after {timeout_s:g} s; stop what moves it, or "
                    "wait longer"
                )
            time.sleep(_POLL_S)

    def close(self) -> None:
        self._stream.close()

    def _known_tool(self) -> Floats:
        """The tool offset that the controller tells, or the configured one where it does not."""
        told, wanted = self._stream.tcp_offset, self.config.tcp_offset
        if told is None and wanted is None:
            raise ToolkitError(
                "[robot] tcp_offset is missing, and this controller's software does not tell it; copy "
                "it from the pendant (Installation > TCP) into the rig file"
            )
        tool = told if told is not None else np.array(wanted, dtype=np.float64)
        if wanted is not None and not same_tool(tool, wanted):
            raise DeviceError(
                f"the active tool of the arm {self.config.host} is {np.round(tool, 4).tolist()}, the rig "
                f"file says {list(wanted)}; check tcp_offset in the rig file against the TCP at the pendant"
            )
        check_tool(self._stream.sample(), tool, self.config.host)
        return tool


def same_tool(one: Floats, other: Floats | tuple[float, ...]) -> bool:
    """Whether two tool offsets (6,) are one; as poses, because rotation vectors are ambiguous."""
    a, b = SE3.from_pose6(one), SE3.from_pose6(np.array(other, dtype=np.float64))
    return bool(np.allclose(a.as_matrix(), b.as_matrix(), rtol=0, atol=_SAME_TOOL))


def check_unchanged(active: Floats, tcp_offset: Floats, host: str) -> None:
    """Raises DeviceError where the active tool is no longer the one that the arm was opened with."""
    if not same_tool(active, tcp_offset):
        was, is_now = (np.round(tool, 4).tolist() for tool in (tcp_offset, active))
        raise DeviceError(
            f"the tool offset of the arm {host} was changed from {was} to {is_now}; connect again, and "
            "calibrate with this tool"
        )


def check_tool(sample: RobotSample, tcp_offset: Floats, host: str) -> None:
    """Raises DeviceError where the reported pose is not that of the tool offset on a UR5e."""
    nominal = forward(sample.q) @ SE3.from_pose6(tcp_offset)
    away = float(np.linalg.norm(nominal.translation - sample.T_base_tcp.translation))
    turned = float(rotation_error_deg(nominal, sample.T_base_tcp))
    if away > _PLAUSIBLE_M or turned > _PLAUSIBLE_DEG:
        raise DeviceError(
            f"the pose of the arm {host} is {1000 * away:.0f} mm and {turned:.1f} deg from that of a UR5e "
            f"with the tool offset {np.round(tcp_offset, 4).tolist()}; check tcp_offset in the rig file "
            "against the active tool at the pendant, and that the arm is a UR5e"
        )
