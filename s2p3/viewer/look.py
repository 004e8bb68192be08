"""The pictures of a session's frames: polarization, the priors' normals, the object where it is annotated."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from dataset.errors import SessionError
from dataset.frames import SUPERPIXEL
from dataset.intrinsics import Intrinsics
from dataset.pictures import (
    SATURATED_BGR,
    Picture,
    angle,
    degree,
    in_colour,
    intensity,
    nominal_camera_matrix,
    saturated,
)
from dataset.polarimetry import Stokes
from dataset.session import Session
from s2p3.pictures import draw_object, normals, prior_normals
from s2p3.rendering.mesh import Mesh
from s2p3.rendering.rasterizer import projected_region, rasterize

S0, DOLP, AOLP, OBJECT = "S0", "DoLP", "AoLP", "object"
PRIORS = ("normals, diffuse", "normals, specular 1", "normals, specular 2")

_NOMINAL_INDEX = 1.5
"""Refractive index for the priors of a session without an object (our choice: plastic, glaze)."""


class SessionLook:
    """One session's frames as pictures.

    With a calibration they are undistorted, as everything derived is; without one they are as the camera saw
    them, and the priors assume a plausible lens.

    Args:
        session: open.

    Attributes:
        camera: the pinhole camera of the pictures.
        objects: names of those that are annotated.
        refractive_index: that the priors assume: the first object's.

    Raises:
        SessionError: there are no frames.
    """

    def __init__(self, session: Session) -> None:
        if len(session) == 0:
            raise SessionError(
                f"{session.path} ({session.kind}) holds no frames, so there is nothing to look at; see what "
                f"it holds with: s2p3 dataset info {session.path}"
            )
        self.session = session
        self.calibrated = session.intrinsics is not None
        self.camera = session.working_intrinsics if self.calibrated else _nominal(session)
        self.objects = tuple(
            name for name in session.objects if name in session.annotated and self.calibrated
        )
        records = {name: session.object(name) for name in self.objects}
        self._meshes = {name: Mesh.from_arrays(r.vertices, r.faces) for name, r in records.items()}
        self.refractive_index = records[self.objects[0]].refractive_index if self.objects else _NOMINAL_INDEX
        self._decoded: tuple[int, Stokes] | None = None
        self._priors: tuple[int, NDArray[np.float32]] | None = None

    @property
    def names(self) -> tuple[str, ...]:
        """The pictures that there are."""
        return (S0, DOLP, AOLP, *PRIORS, *((OBJECT,) if self.objects else ()))

    def picture(self, name: str, index: int) -> Picture:
        """(h, w, 3) BGR of a frame.

        Raises:
            SessionError: the frame is damaged.
            ToolkitError: the camera sent no intensities.
        """
        stokes = self.stokes(index)
        if name == DOLP:
            return degree(stokes)
        if name == AOLP:
            return angle(stokes)
        if name in PRIORS:
            return normals(self._prior_normals(index)[PRIORS.index(name)])
        picture = in_colour(intensity(stokes))
        if name == OBJECT:
            self._draw_objects(picture, index)
        else:
            picture[saturated(stokes)] = SATURATED_BGR
        return picture

    def stokes(self, index: int) -> Stokes:
        """The frame's Stokes image, kept until another frame is asked for."""
        if self._decoded is None or self._decoded[0] != index:
            self._decoded = (index, self.session.stokes(index, undistort=self.calibrated))
        return self._decoded[1]

    def sheet(self, index: int, tile_width: int) -> Picture:
        """A frame's pictures with their names, three a row: polarization above, the priors below."""
        names = (OBJECT if self.objects else S0, DOLP, AOLP, *PRIORS)
        tiles = [titled(shrunk(self.picture(name, index), tile_width), name) for name in names]
        return np.vstack([np.hstack(tiles[:3]), np.hstack(tiles[3:])])

    def _prior_normals(self, index: int) -> NDArray[np.float32]:
        if self._priors is None or self._priors[0] != index:
            maps = prior_normals(self.stokes(index), self.camera.K.copy(), self.refractive_index)
            self._priors = (index, maps)
        return self._priors[1]

    def _draw_objects(self, picture: Picture, index: int) -> None:
        for name, mesh in self._meshes.items():
            pose = self.session.object_poses(name).T_cam_obj[index]
            if pose.finite:
                region = projected_region(mesh, pose, self.camera)
                if region[2] and region[3]:
                    draw_object(picture, rasterize(mesh, pose, self.camera, region))


def shrunk(picture: Picture, width: int) -> Picture:
    """A picture no wider than `width` pixels; both its sides are even, as video codecs want them."""
    scale = min(1.0, width / picture.shape[1])
    size = [max(2, 2 * round(side * scale / 2)) for side in (picture.shape[1], picture.shape[0])]
    return np.asarray(cv2.resize(picture, size, interpolation=cv2.INTER_AREA), np.uint8)


def titled(picture: Picture, title: str) -> Picture:
    """The picture with a line of text in its upper left corner."""
    out = picture.copy()
    size = min(0.5, picture.shape[1] / 600)
    for colour, thickness in (((0, 0, 0), 3), ((255, 255, 255), 1)):
        cv2.putText(out, title, (8, 18), cv2.FONT_HERSHEY_SIMPLEX, size, colour, thickness, cv2.LINE_AA)
    return out


def _nominal(session: Session) -> Intrinsics:
    size = SUPERPIXEL[session.camera.mosaic]
    height, width = session.camera.height // size, session.camera.width // size
    return Intrinsics(nominal_camera_matrix(height, width), np.zeros(0), height, width)
