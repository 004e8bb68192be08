"""The rig file of the simulated lab: what its owner knows, with a tape measure's accuracy."""

from __future__ import annotations

import numpy as np

from acquisition.rig import BoardTable, CameraTable, FramesTable, Rig, RobotTable
from dataset.transforms import SE3
from s2p3.lab.truth import NOMINAL_BOARD_CENTRE, NOMINAL_OBJECT_CENTRE, NOMINAL_TCP_CAM, TCP_TIP

BOARD = BoardTable()
_FREQUENCY_HZ = 125.0
"""Of the simulated arm: an e-Series' 500 Hz costs a third of a core that the simulated camera needs."""


def lab_rig(frame_rate: float, camera_address: str = "127.0.0.1", arm_host: str = "127.0.0.1") -> Rig:
    """The rig of a simulated lab at these addresses."""
    half_size = np.array([BOARD.squares_x, BOARD.squares_y, 0.0]) * BOARD.square_m / 2
    face_up = SE3.from_rotvec(np.array([np.pi, 0.0, 0.0]), np.array(NOMINAL_BOARD_CENTRE))
    board = face_up @ SE3.from_rotvec(np.zeros(3), -half_size)
    return Rig(
        camera=CameraTable(address=camera_address, exposure_us=8000.0, frame_rate=frame_rate, timeout_s=5.0),
        robot=RobotTable(
            host=arm_host,
            frequency_hz=_FREQUENCY_HZ,
            silence_s=1.0,  # simulators share a busy host with what they serve
            speed=0.35,
            joint_speed=0.9,
            joint_acceleration=1.2,
            tcp_offset=(0.0,) * 6,
            workspace=((-0.6, -0.9, 0.02), (0.95, 0.9, 1.1)),
        ),
        board=BOARD,
        frames=FramesTable(
            T_tcp_cam_guess=NOMINAL_TCP_CAM,
            T_base_board_guess=tuple(board.as_pose6().tolist()),
            object_centre_guess=(*NOMINAL_OBJECT_CENTRE[:2], 0.05),
            T_tcp_tip=TCP_TIP,
        ),
    )
