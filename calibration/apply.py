"""Writing a calibration into a session, which from then on is self-contained."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from calibration.result import Calibration
from calibration.sessions import camera_poses
from dataset.errors import CalibrationError
from dataset.session import Session, write_calibration, write_poses


@dataclass(frozen=True)
class Applied:
    """What a session got: intrinsics, the polarizers' response, a pose for so many of its frames."""

    intrinsics: bool
    polarizer: bool
    poses: int
    frames: int


def apply_calibration(session: Path, calibration: Calibration) -> Applied:
    """Writes /calibration (the text with its sha256, K and distortion, the polarizers' response) and, where
    they are known, the camera's pose in every frame. What an earlier calibration left is replaced, poses
    included; objects annotated with it lose theirs: annotate again.

    Raises:
        CalibrationError: nothing in the calibration concerns a camera; it is of another camera; or the
            session holds poses that no arm gave, as an import or a synthetic set does.
        SessionError: the session cannot be edited.
    """
    if calibration.intrinsics is None and calibration.polarizer is None:
        raise CalibrationError(
            "calibration: neither intrinsics nor polarizers are calibrated; there is nothing to apply to"
            f" {session} yet"
        )
    intrinsics = None if calibration.intrinsics is None else calibration.intrinsics.intrinsics
    response = calibration.polarizer_response
    with Session.open(session) as opened:
        frames, has_arm = len(opened), opened.robot is not None and len(opened.robot) > 1
        carried = calibration.hand_eye is not None and has_arm
        cameras = None
        if frames and (carried or calibration.fixed_camera is not None):
            cameras = camera_poses(opened, calibration)
        elif opened.poses is not None and not has_arm:
            raise CalibrationError(
                f"{session}: holds poses that no arm's trace gave (imported or synthetic), and they would not"
                " fit another calibration; apply it to a recording"
            )
        calibration.require_camera(opened.camera, str(session))
    write_calibration(session, calibration.to_json(), intrinsics, response)
    known = 0
    if cameras is not None:
        write_poses(session, cameras.T_base_cam, cameras.sigma_m, cameras.sigma_rad, {})
        known = int(cameras.T_base_cam.finite.sum())
    return Applied(intrinsics is not None, response is not None, known, frames)
