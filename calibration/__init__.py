"""From recorded sessions to everything a rig must know, each part with its uncertainty."""

from calibration.apply import apply_calibration
from calibration.board import BoardSpec
from calibration.detection import Detection, detect, detect_in_mosaic
from calibration.hand_eye import HandEyeResult, calibrate_hand_eye
from calibration.intrinsics import IntrinsicsResult, calibrate_intrinsics
from calibration.next_pose import NextPose, next_pose
from calibration.object_pose import ObjectPoseResult, register_points
from calibration.polarizer import PolarizerResult, calibrate_polarizer
from calibration.records import (
    HandEyeRecord,
    IntrinsicsRecord,
    ObjectPoseRecord,
    PolarizerRecord,
    Source,
    TimeOffsetRecord,
    ToolTipRecord,
)
from calibration.result import Calibration
from calibration.robot_world import RobotWorldResult, solve_robot_world
from calibration.sessions import (
    camera_poses,
    detect_session,
    hand_eye_from_session,
    intrinsics_from_session,
    time_offset_from_session,
)
from calibration.streams import solve_streams
from calibration.time_offset import TimeOffsetResult, estimate_time_offset
from calibration.tool_tip import ToolTipResult, calibrate_tool_tip
from calibration.touches import KnownTip, tool_tip_from_session

__all__ = [
    "BoardSpec",
    "Calibration",
    "Detection",
    "HandEyeRecord",
    "HandEyeResult",
    "IntrinsicsRecord",
    "IntrinsicsResult",
    "KnownTip",
    "NextPose",
    "ObjectPoseRecord",
    "ObjectPoseResult",
    "PolarizerRecord",
    "PolarizerResult",
    "RobotWorldResult",
    "Source",
    "TimeOffsetRecord",
    "TimeOffsetResult",
    "ToolTipRecord",
    "ToolTipResult",
    "apply_calibration",
    "calibrate_hand_eye",
    "calibrate_intrinsics",
    "calibrate_polarizer",
    "calibrate_tool_tip",
    "camera_poses",
    "detect",
    "detect_in_mosaic",
    "detect_session",
    "estimate_time_offset",
    "hand_eye_from_session",
    "intrinsics_from_session",
    "next_pose",
    "register_points",
    "solve_robot_world",
    "solve_streams",
    "time_offset_from_session",
    "tool_tip_from_session",
]
