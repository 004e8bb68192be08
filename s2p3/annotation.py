"""Annotates a recorded session: where the camera was and where the object is, in every frame, without a
human's click.

T_cam_obj = T_base_cam^-1 T_base_obj: the arm's forward kinematics at the exposure, the hand-eye transform,
and the pose at which the object was touched. Masks and boxes are rendered from it, in the undistorted image.
"""

from __future__ import annotations

import warnings
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from calibration import Calibration, camera_poses
from dataset import SE3, CalibrationError
from dataset.errors import ToolkitWarning
from dataset.progress import Progress, silent
from dataset.session import (
    ObjectPoses,
    PackedMasks,
    Session,
    mask_box,
    write_calibration,
    write_object,
    write_poses,
)
from s2p3.objects import ObjectModel
from s2p3.rendering.mesh import Mesh
from s2p3.rendering.rasterizer import projected_region, rasterize

"""Called with (frames done, frames in all)."""


@dataclass(frozen=True)
class Annotation:
    """What was written: frames in all, and those in which the object is in view."""

    frames: int
    visible: int


def annotate(
    path: Path, calibration: Calibration, model: ObjectModel, on_progress: Progress = silent
) -> Annotation:
    """Writes camera poses, object poses, boxes and masks into a session, replacing earlier ones. Objects that
    were annotated before are annotated again, with this calibration.

    Args:
        path: of a complete session, with a robot trace unless the camera is fixed.
        calibration: with intrinsics, hand-eye or a fixed camera, and the object's pose; the time offset where
            the arm was moving.
        model: the object.

    Raises:
        CalibrationError: a part is missing, the object's pose was not calibrated, or the camera is another.
        SessionError: the session cannot be read or edited.

    Warns (ToolkitWarning) of an object annotated before whose pose this calibration does not hold: it loses
    its annotation.
    """
    calibration.require("intrinsics")
    assert calibration.intrinsics is not None
    if model.name not in calibration.objects:
        known = ", ".join(calibration.objects) or "none"
        raise CalibrationError(
            f"calibration: no pose of {model.name!r} (objects: {known}); "
            "touch it and run `s2p3 calibrate object` first"
        )
    with Session.open(path) as session:
        calibration.require_camera(session.camera, str(path))
        cameras = camera_poses(session, calibration)
        names = dict.fromkeys((model.name, *session.annotated))
    write_calibration(
        path, calibration.to_json(), calibration.intrinsics.intrinsics, calibration.polarizer_response
    )
    write_object(path, model.to_record())
    T_cam_base = cameras.T_base_cam.inverse()
    poses = {}
    with Session.open(path) as session:
        for name in names:
            if name in calibration.objects:
                record = session.object(name)
                mesh = Mesh.from_arrays(record.vertices, record.faces)
                T_cam_obj = T_cam_base @ calibration.objects[name].T_base_obj
                poses[name] = render_poses(session, T_cam_obj, mesh, on_progress)
            else:
                warnings.warn(
                    f"{path}: {name!r} is no longer annotated, because this calibration does not hold its "
                    "pose; touch it and run `s2p3 calibrate object`, then annotate it again",
                    ToolkitWarning,
                    stacklevel=2,
                )
    write_poses(path, cameras.T_base_cam, cameras.sigma_m, cameras.sigma_rad, poses)
    visible = poses[model.name].visible_fraction
    return Annotation(len(visible), int((visible > 0).sum()))


def render_poses(session: Session, T_cam_obj: SE3, mesh: Mesh, on_progress: Progress = silent) -> ObjectPoses:
    """Masks, boxes and visibility of an object at known poses (N) in a session's undistorted image.

    The visible fraction is the share of the silhouette inside the image; what occludes the object is not
    known.
    """
    camera = session.working_intrinsics
    size, canvas = (camera.height, camera.width), camera.surrounded
    count = len(session)
    masks = [np.packbits(np.zeros(size, dtype=bool))] * count
    boxes = np.zeros((count, 4))
    visible = np.zeros(count)
    for index in range(count):
        if np.isfinite(T_cam_obj.translation[index]).all():
            pose = T_cam_obj[index]
            raster = rasterize(mesh, pose, canvas, projected_region(mesh, pose, canvas))
            drawn = np.zeros((canvas.height, canvas.width), dtype=bool)
            drawn[raster.window] = raster.mask
            mask = drawn[camera.middle]
            masks[index] = np.packbits(mask)
            boxes[index] = mask_box(mask)
            visible[index] = mask.sum() / max(raster.mask.sum(), 1)
        on_progress(index + 1, count)
    return ObjectPoses(T_cam_obj, visible, boxes, PackedMasks(masks, size))
