"""Where the images to predict on come from: a session, a folder of raw frames, the live camera of a rig.

No pose, mask or box of a session is read, only images, intrinsics and the camera's place.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from acquisition.camera import Camera, CameraLost
from acquisition.rig import Rig, open_camera, open_pose_source
from calibration import Calibration
from dataset import SE3, CameraInfo, Intrinsics
from dataset.errors import DeviceError
from dataset.frames import SUPERPIXEL, Mosaic, RawFrame
from dataset.importers.raw_folder import RawMosaics
from dataset.on_camera import decode_frame
from dataset.polarimetry import Raw, remap
from dataset.session import Session


@dataclass(frozen=True, eq=False)
class Shot:
    """One undistorted polarization image.

    Attributes:
        name: frame index, file name, or the camera's frame id.
        stokes: (3, H, W).
        intrinsics: of that image, a pinhole.
        T_base_cam: the camera in the robot's base frame; None where unknown.
        host_time_ns: when it arrived; 0 where unknown.
        depth: (H, W) metres, 0 unknown; None where there is none.
    """

    name: str
    stokes: NDArray[np.float32]
    intrinsics: Intrinsics
    T_base_cam: SE3 | None
    host_time_ns: int
    depth: NDArray[np.float32] | None = None


def session_shots(session: Session, indices: Sequence[int]) -> Iterator[Shot]:
    """Frames of an open, calibrated session."""
    poses, times = session.poses, session.host_time_ns
    for index in indices:
        known = poses is not None and bool(poses.finite[index])
        place = poses[index] if poses is not None and known else None
        stokes = session.stokes(index).stack()
        depth = session.depth(index) if session.has_depth else None
        yield Shot(str(index), stokes, session.working_intrinsics, place, int(times[index]), depth)


def folder_shots(
    folder: Path, mosaic: Mosaic | None, bits: int | None, calibration: Calibration
) -> Iterator[Shot]:
    """The raw mosaics of a folder, by name.

    Args:
        mosaic: where a calibration of before it was kept does not say which it is of.
        bits: significant bits of a value; must be given for 16-bit files.

    Raises ToolkitError: as `RawMosaics`, or another size or mosaic than the calibrated one.
    """
    known = None if calibration.intrinsics is None else calibration.intrinsics.mosaic
    mosaics = RawMosaics.of(folder, mosaic or known or "colour", bits)
    decoder = _Decoder(mosaics.camera, calibration, str(mosaics.files[0]))
    for path, raw in zip(mosaics.files, mosaics, strict=True):
        yield decoder.shot(path.name, raw, None, 0)


def live_shots(rig: Rig, calibration: Calibration, count: int | None) -> Iterator[Shot]:
    """The rig's camera, triggered frame by frame, until `count` or for ever; the arm is only read.

    The camera's place is the arm's after the exposure, so it holds while the arm stands; a fixed camera's is
    known without the arm.

    Raises ToolkitError: a device does not answer; the arm's tool setting is changed meanwhile; the
        calibration is of another camera.
    """
    with ExitStack() as stack:
        camera = stack.enter_context(open_camera(rig))
        place_now = _live_place(rig, calibration, stack)
        decoder = _Decoder(camera.info, calibration, "the camera")
        camera.start("software")
        taken = 0
        while count is None or taken < count:
            frame = _triggered(camera)
            yield decoder.shot(str(frame.frame_id), frame.pixels, place_now(), frame.host_time_ns)
            taken += 1


def _triggered(camera: Camera) -> RawFrame:
    """A frame whose exposure begins now; asked for once more where it was lost on its way."""
    camera.trigger()
    try:
        return camera.read()
    except CameraLost:
        raise
    except DeviceError:
        camera.trigger()
        return camera.read()


def _live_place(rig: Rig, calibration: Calibration, stack: ExitStack) -> Callable[[], SE3 | None]:
    """Tells T_base_cam of now; opens the arm on `stack` where it is needed for that."""
    fixed, hand_eye = calibration.fixed_camera, calibration.hand_eye
    if fixed is not None:
        return lambda: fixed.T_base_cam
    if hand_eye is None:
        return lambda: None
    arm = stack.enter_context(open_pose_source(rig))
    T_tcp_cam = hand_eye.camera_on(arm.tcp_offset)
    return lambda: arm.sample().T_base_tcp @ T_tcp_cam


class _Decoder:
    """Raw mosaics of one camera to shots."""

    def __init__(self, camera: CameraInfo, calibration: Calibration, where: str) -> None:
        calibration.require("intrinsics")
        calibration.require_camera(camera, where)
        assert calibration.intrinsics is not None
        working = calibration.intrinsics.intrinsics.at(SUPERPIXEL[camera.mosaic])
        self._camera = camera
        self._response = calibration.polarizer_response
        self._maps, self._pinhole = working.undistort_map(), working.pinhole

    def shot(self, name: str, raw: Raw, place: SE3 | None, host_time_ns: int) -> Shot:
        stokes = remap(decode_frame(raw, self._camera, self._response), *self._maps)
        return Shot(name, stokes.stack(), self._pinhole, place, host_time_ns)
