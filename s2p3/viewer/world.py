"""Where the camera went during a session, and around what."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from dataset.session import Session
from dataset.transforms import SE3
from dataset.view_sphere import ViewSphere

Floats = NDArray[np.float64]

_CELL_DEG = 10.0


@dataclass(frozen=True, eq=False)
class World:
    """The poses of a session in one frame: the arm's base where there was an arm, else the object's.

    Attributes:
        frame: "base" or "object".
        T_world_cam: a batch of N, NaN where unknown.
        T_world_obj: the first object's poses, a batch of N, NaN where unknown; None without an object.
        q: (N, 6) the arm's joint angles at each frame, radians; None without an arm.
        centre: (3,) what was looked at; None where that is not known.
        views: the cells of the directions it was looked at from; None with `centre`.
        counts: (C,) frames from each of them.
    """

    frame: str
    T_world_cam: SE3
    T_world_obj: SE3 | None
    q: Floats | None
    centre: Floats | None
    views: ViewSphere | None
    counts: NDArray[np.int64]

    @property
    def path(self) -> Floats:
        """(K, 3) the camera's centre in the frames where it is known."""
        return self.T_world_cam.translation[self.T_world_cam.finite]


def world_of(session: Session, objects: tuple[str, ...]) -> World | None:
    """The poses of an annotated session; None where the camera's are not known."""
    T_cam_obj = session.object_poses(objects[0]).T_cam_obj if objects else None
    if session.poses is not None and (session.robot is not None or T_cam_obj is None):
        T_base_obj = None if T_cam_obj is None else session.poses @ T_cam_obj
        return _world("base", session.poses, T_base_obj, _joints(session))
    if T_cam_obj is None:
        return None
    return _world("object", T_cam_obj.inverse(), SE3.identity((len(session),)), None)


def _world(frame: str, T_world_cam: SE3, T_world_obj: SE3 | None, q: Floats | None) -> World:
    if T_world_obj is None or not T_world_obj.finite.any():
        return World(frame, T_world_cam, T_world_obj, q, None, None, np.zeros(0, np.int64))
    centre = np.median(T_world_obj.translation[T_world_obj.finite], axis=0)
    known = T_world_cam.finite
    directions = T_world_cam.translation[known] - centre
    below = len(directions) > 0 and bool((directions[:, 2] < 0).any())
    views = ViewSphere(_CELL_DEG, -90.0 if below else 0.0)
    return World(frame, T_world_cam, T_world_obj, q, centre, views, views.count(directions))


def _joints(session: Session) -> Floats | None:
    """(N, 6) joint angles when each frame arrived: for a drawing, near enough."""
    trace = session.robot
    if trace is None:
        return None
    columns = [np.interp(session.host_time_ns, trace.host_time_ns, angle) for angle in trace.q.T]
    return np.stack(columns, axis=1)
