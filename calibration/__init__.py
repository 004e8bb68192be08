"""From recorded sessions to intrinsics, hand-eye, time offset and object poses, each with its uncertainty."""

from calibration.board import BoardSpec
from calibration.detection import Detection, detect, detect_in_mosaic
from calibration.hand_eye import HandEyeResult, calibrate_hand_eye
from calibration.intrinsics import IntrinsicsResult, calibrate_intrinsics
from calibration.object_pose import ObjectPoseResult, register_points
from calibration.records import (
    HandEyeRecord,
    IntrinsicsRecord,
    ObjectPoseRecord,
    Source,
    TimeOffsetRecord,
    ToolTipRecord,
)
from calibration.result import Calibration
from calibration.sessions import (
    camera_poses,
    detect_session,
    hand_eye_from_session,
    intrinsics_from_session,
    time_offset_from_session,
)
from calibration.time_offset import TimeOffsetResult, estimate_time_offset
from calibration.touches import object_from_touches

__all__ = [
    "BoardSpec",
    "Calibration",
    "Detection",
    "HandEyeRecord",
    "HandEyeResult",
    "IntrinsicsRecord",
    "IntrinsicsResult",
    "ObjectPoseRecord",
    "ObjectPoseResult",
    "Source",
    "TimeOffsetRecord",
    "TimeOffsetResult",
    "ToolTipRecord",
    "calibrate_hand_eye",
    "calibrate_intrinsics",
    "camera_poses",
    "detect",
    "detect_in_mosaic",
    "detect_session",
    "estimate_time_offset",
    "hand_eye_from_session",
    "intrinsics_from_session",
    "object_from_touches",
    "register_points",
    "time_offset_from_session",
]
