"""One session as one scene folder of a BOP data set."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from dataset.bop.layout import MM, encode_stokes, write_image, write_json
from dataset.frames import SUPERPIXEL
from dataset.intrinsics import Intrinsics
from dataset.polarimetry import split_colours, white_level
from dataset.session import ObjectRecord, Session
from dataset.transforms import SE3

Drawn = Callable[[ObjectRecord, SE3, Intrinsics], NDArray[np.bool_]]
"""Draws the silhouette of an object at a pose T_cam_obj: (H, W) bool of the camera's size."""

_TARGET_VISIBLE = 0.1
"""The benchmark's: an instance of which less is visible is no test target."""


class Scene:
    """Writes the folder frame by frame.

    Args:
        session: open, calibrated and annotated.
        folder: to be.
        records: the annotated objects by name.
        ids: BOP's ids of objects by name.
        draw: draws the whole silhouettes.
    """

    def __init__(
        self,
        session: Session,
        folder: Path,
        records: dict[str, ObjectRecord],
        ids: dict[str, int],
        draw: Drawn,
    ) -> None:
        self.session, self.folder, self.records, self.ids, self.draw = session, folder, records, ids, draw
        self.camera = session.working_intrinsics
        self.canvas = self.camera.surrounded  # what lies outside the image belongs to the silhouette, too
        assert session.intrinsics is not None
        self.maps = session.intrinsics.at(SUPERPIXEL[session.camera.mosaic]).undistort_map()
        self.cameras: dict[int, dict[str, Any]] = {}
        self.truth: dict[int, list[dict[str, Any]]] = {}
        self.infos: dict[int, list[dict[str, Any]]] = {}

    def add(self, index: int) -> None:
        """Writes the images of a frame and notes its annotation."""
        session, name = self.session, f"{index:06d}"
        write_image(self.folder / "stokes" / f"{name}.png", encode_stokes(session.stokes(index).stack()))
        kind = "rgb" if session.camera.mosaic == "colour" else "gray"
        write_image(self.folder / kind / f"{name}.png", self._intensity(index))
        depth = None
        if session.has_depth:
            depth = np.rint(session.depth(index) * MM).astype(np.uint16)
            write_image(self.folder / "depth" / f"{name}.png", depth)
        self.cameras[index] = {
            "cam_K": self.camera.K.ravel().tolist(),
            "depth_scale": 1.0,
            **self._world(index),
        }
        self.truth[index], self.infos[index] = [], []
        for object_name, record in self.records.items():
            poses = session.object_poses(object_name)
            pose = poses.T_cam_obj[index]
            if not pose.finite:
                continue
            whole = self.draw(record, pose, self.canvas)
            visible = poses.mask(index)
            label = f"{name}_{len(self.truth[index]):06d}.png"
            inside = whole[self.camera.middle]
            write_image(self.folder / "mask" / label, 255 * inside.astype(np.uint8))
            write_image(self.folder / "mask_visib" / label, 255 * visible.astype(np.uint8))
            rotation, translation = pose.rotation.ravel().tolist(), (pose.translation * MM).tolist()
            self.truth[index].append(
                {"cam_R_m2c": rotation, "cam_t_m2c": translation, "obj_id": self.ids[object_name]}
            )
            self.infos[index].append(_info(whole, visible, inside, depth))

    def finish(self) -> None:
        """Writes the scene's tables."""
        write_json(self.folder / "scene_camera.json", self.cameras)
        write_json(self.folder / "scene_gt.json", self.truth)
        write_json(self.folder / "scene_gt_info.json", self.infos)

    def targets(self, scene: int) -> list[dict[str, int]]:
        """Rows of test_targets_bop19.json."""
        return [
            {"im_id": index, "inst_count": 1, "obj_id": truth["obj_id"], "scene_id": scene}
            for index in self.truth
            for truth, info in zip(self.truth[index], self.infos[index], strict=True)
            if info["visib_fract"] >= _TARGET_VISIBLE
        ]

    def _intensity(self, index: int) -> NDArray[np.uint8]:
        """(h, w, 3) or (h, w): mean over the four angles, undistorted, white = 255."""
        camera = self.session.camera
        if camera.mosaic == "colour":
            mean = split_colours(self.session.mosaic(index)).mean(axis=0) / white_level(camera.bits)
        else:
            mean = self.session.stokes(index, undistort=False).s0 / 2
        flat = cv2.remap(mean.astype(np.float32), *self.maps, cv2.INTER_LINEAR)
        counts: NDArray[np.uint8] = np.clip(np.rint(255 * flat), 0, 255).astype(np.uint8)
        return counts

    def _world(self, index: int) -> dict[str, list[float]]:
        """The optional pose of the world, here the arm's base, in the camera."""
        poses = self.session.poses
        if poses is None or not poses[index].finite:
            return {}
        T_cam_base = poses[index].inverse()
        return {
            "cam_R_w2c": T_cam_base.rotation.ravel().tolist(),
            "cam_t_w2c": (T_cam_base.translation * MM).tolist(),
        }


def _info(
    whole: NDArray[np.bool_],
    visible: NDArray[np.bool_],
    inside: NDArray[np.bool_],
    depth: NDArray[np.uint16] | None,
) -> dict[str, Any]:
    height, width = visible.shape
    count, seen = int(whole.sum()), int(visible.sum())
    return {
        "bbox_obj": _box(whole if seen else visible, (width, height)),  # as there, none where nothing is seen
        "bbox_visib": _box(visible, (0, 0)),
        "px_count_all": count,
        "px_count_valid": 0 if depth is None else int((depth[inside] > 0).sum()),
        "px_count_visib": seen,
        "visib_fract": min(seen / count, 1.0) if count else 0.0,
    }


def _box(mask: NDArray[np.bool_], origin: tuple[int, int]) -> list[int]:
    rows, columns = np.nonzero(mask)
    if len(rows) == 0:
        return [-1, -1, -1, -1]
    left, top = int(columns.min()), int(rows.min())
    return [left - origin[0], top - origin[1], int(columns.max()) - left, int(rows.max()) - top]
