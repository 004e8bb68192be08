"""Whole silhouettes of annotated objects: for export, and to hold a session's masks against its poses."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from dataset import SE3, Intrinsics
from dataset.errors import ToolkitError
from dataset.session import ObjectRecord, Session
from dataset.validate import Problem
from s2p3.rendering import Mesh, rasterize
from s2p3.rendering.rasterizer import projected_region

_AGREEMENT = 0.8
"""Smallest IoU of a mask with its silhouette, allowing for what is hidden (our choice: small objects lose a
tenth of their pixels to the boundary)."""

_SMALLEST = 64
"""Silhouettes of fewer pixels are all boundary and are not judged (our choice)."""


class Silhouettes:
    """Draws objects that nothing hides; prepares each mesh once."""

    def __init__(self) -> None:
        self._meshes: dict[str, Mesh] = {}

    def __call__(self, record: ObjectRecord, T_cam_obj: SE3, camera: Intrinsics) -> NDArray[np.bool_]:
        """(H, W) bool: where a camera sees an object at a pose."""
        key = record.sha256
        if key not in self._meshes:
            self._meshes[key] = Mesh.from_arrays(record.vertices, record.faces)
        mesh = self._meshes[key]
        raster = rasterize(mesh, T_cam_obj, camera, projected_region(mesh, T_cam_obj, camera))
        drawn = np.zeros((camera.height, camera.width), dtype=bool)
        drawn[raster.window] = raster.mask
        return drawn


def check_masks(path: str | Path) -> Iterator[Problem]:
    """Holds every mask of a session against the silhouette of its mesh at its pose, for `dataset validate`.

    With m the mask, s the silhouette inside the image and e the pixels that the stored visible fraction leads
    one to expect, the agreement |m and s| / (|m| + e - |m and s|) is the IoU where nothing is hidden, and 1
    for a right pose under any occlusion.

    Raises:
        SessionError: the session cannot be read.
    """
    with Session.open(path) as session:
        for name in session.annotated:
            if name in session.objects and session.intrinsics is not None:
                yield from _check_object(session, name)


def _check_object(session: Session, name: str) -> Iterator[Problem]:
    record, poses, camera = session.object(name), session.object_poses(name), session.working_intrinsics
    canvas = camera.surrounded
    draw, hint = Silhouettes(), "annotate the session again"
    for index in range(len(session)):
        where = f"poses/objects/{name}/mask[{index}]"
        try:
            mask = poses.mask(index)
        except ToolkitError:
            continue  # reported by the check of the checksums
        if not poses.T_cam_obj[index].finite:
            if mask.any():
                yield Problem(where, "shows the object where its pose is unknown", hint)
            continue
        whole = draw(record, poses.T_cam_obj[index], canvas)
        inside = whole[camera.middle]
        if whole.sum() < _SMALLEST:
            continue
        common, expected = int((mask & inside).sum()), float(poses.visible_fraction[index] * whole.sum())
        union = max(int(mask.sum()) + expected - common, common)
        if union >= _SMALLEST and common / union < _AGREEMENT:
            what = f"agrees with the mesh at the stored pose to {common / union:.2f} only"
            yield Problem(where, what, hint)
