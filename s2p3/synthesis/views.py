"""Where synthetic cameras stand: anywhere on the upper hemisphere, or as those of a session did."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from dataset import SE3, Intrinsics, ToolkitError
from dataset.session import Session
from s2p3.objects import ObjectModel

Range = tuple[float, float]

_LOWEST_EYE = 0.05
"""Sine of the smallest elevation of a camera above the table: from below, the table hides the object."""
_TRIES = 100


@dataclass(frozen=True)
class Views:
    """Cameras on the upper hemisphere about the object, all around it."""

    distance_m: Range = (0.28, 0.6)
    elevation_deg: Range = (20.0, 80.0)
    roll_deg: Range = (-25.0, 25.0)
    offset: float = 0.45
    """Largest distance of the object from the image's centre, in half image sides."""

    def draw(self, model: ObjectModel, intrinsics: Intrinsics, rng: np.random.Generator) -> SE3:
        """T_cam_obj of the object resting on the table."""
        azimuth = rng.uniform(0, 2 * np.pi)
        low, high = np.sin(np.radians(self.elevation_deg))
        elevation = np.arcsin(rng.uniform(low, high))
        roll = np.radians(rng.uniform(*self.roll_deg))
        outward = np.array(
            [np.cos(elevation) * np.cos(azimuth), np.cos(elevation) * np.sin(azimuth), np.sin(elevation)]
        )
        right = np.array([-np.sin(azimuth), np.cos(azimuth), 0.0])
        level = np.stack(
            [right, np.cross(-outward, right), -outward]
        )  # rows: the camera's axes in the table's frame
        upright = SE3.from_rotvec([0.0, 0.0, roll], np.zeros(3)).rotation @ level
        half = 0.5 * np.array([intrinsics.width, intrinsics.height])
        ray = intrinsics.rays(half - 0.5 + self.offset * half * rng.uniform(-1, 1, 2))
        return SE3(_turn_to(ray) @ upright, rng.uniform(*self.distance_m) * ray)

    @property
    def reach(self) -> str:
        """Where they stand, for messages."""
        return f"{self.distance_m[0]:g} to {self.distance_m[1]:g} m"


@dataclass(frozen=True)
class ViewsLike:
    """Views distributed as a session's: one of its poses, drawn at random and disturbed.

    Each view keeps the camera's elevation, roll, distance and place in the image up to the disturbance; a
    smoothed bootstrap of the poses (our choice).
    """

    poses: tuple[tuple[float, ...], ...]
    """T_cam_obj of the session's frames, 12 numbers each: the upper three rows."""
    angle_deg: float = 4.0
    """Standard deviation of the disturbing rotation, per axis."""
    distance: float = 0.05
    """Standard deviation of the distance's factor."""

    @staticmethod
    def of(path: str | Path, name: str) -> ViewsLike:
        """The views of a recorded session: those of its split train where it has one, so that the views it is
        tested on stay unknown.

        Raises:
            ToolkitError: no such session, or it knows no pose of the object.
        """
        with Session.open(path) as session:
            poses = session.object_poses(name).T_cam_obj.as_matrix()[:, :3].reshape(-1, 12)
            if "train" in session.splits:
                poses = poses[session.frames_in("train")]
        known = poses[np.isfinite(poses).all(axis=1)]
        if len(known) == 0:
            raise ToolkitError(f"{path}: no frame knows the pose of {name}; run: s2p3 annotate {path}")
        return ViewsLike(tuple(tuple(row) for row in known.tolist()))

    def draw(self, model: ObjectModel, intrinsics: Intrinsics, rng: np.random.Generator) -> SE3:
        """T_cam_obj, the camera above the table and the object's centre in the picture.

        Raises:
            ToolkitError: from these poses the object is not seen on a table from above.
        """
        for _ in range(_TRIES):
            rows = np.reshape(self.poses[int(rng.integers(len(self.poses)))], (3, 4))
            turn = SE3.from_rotvec(np.radians(rng.normal(0, self.angle_deg, 3)), np.zeros(3)).rotation
            place = rows[:, 3] * max(1 + rng.normal(0, self.distance), 0.1)
            spin = SE3.from_rotvec(
                np.radians([0, 0, rng.normal(0, 3 * self.angle_deg)]), np.zeros(3)
            ).rotation
            pose = SE3(turn @ rows[:, :3] @ spin, place)
            if pose.inverse().translation[2] > _LOWEST_EYE * np.linalg.norm(place) and _inside(
                pose, intrinsics
            ):
                return pose
        raise ToolkitError(
            f"{model.name}: the session's {len(self.poses)} poses do not look down on it; "
            "its mesh must stand upright, z up, as it rests on the table"
        )

    @property
    def reach(self) -> str:
        """Where they stand, for messages."""
        distances = np.linalg.norm(np.array(self.poses)[:, 3::4], axis=1)
        return f"{distances.min():.2f} to {distances.max():.2f} m"


def _inside(pose: SE3, intrinsics: Intrinsics) -> bool:
    if pose.translation[2] <= 0:
        return False
    x, y = intrinsics.project(pose.translation)
    return bool(0 <= x < intrinsics.width and 0 <= y < intrinsics.height)


def _turn_to(ray: NDArray[np.float64]) -> NDArray[np.float64]:
    """The shortest rotation (3, 3) that takes the optical axis onto a unit ray (3,)."""
    axis = np.cross([0.0, 0.0, 1.0], ray)
    sine = float(np.linalg.norm(axis))
    return SE3.from_rotvec(axis / max(sine, 1e-12) * np.arcsin(sine), np.zeros(3)).rotation
