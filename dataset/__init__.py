"""What a frame, a pose and a recorded session are: the ground floor, which imports no other room.

The names below load numpy only. Whatever needs HDF5, OpenCV or numba is imported from its own module:
`dataset.polarimetry`, `dataset.pixel_formats`, `dataset.session`, `dataset.validate`, `dataset.splits`.
"""

from dataset.errors import CalibrationError, DeviceError, SessionError, ToolkitError
from dataset.frames import CameraInfo, ClockFit, RawFrame, RobotSample, RobotTrace
from dataset.intrinsics import Intrinsics
from dataset.transforms import SE3, interpolate_poses, rotation_error_deg, translation_error_mm

__all__ = [
    "SE3",
    "CalibrationError",
    "CameraInfo",
    "ClockFit",
    "DeviceError",
    "Intrinsics",
    "RawFrame",
    "RobotSample",
    "RobotTrace",
    "SessionError",
    "ToolkitError",
    "interpolate_poses",
    "rotation_error_deg",
    "translation_error_mm",
]
