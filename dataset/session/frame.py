"""One frame of a session."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from dataset.polarimetry import Raw, Stokes
from dataset.transforms import SE3

if TYPE_CHECKING:
    from dataset.session.reader import Session


@dataclass(frozen=True)
class Frame:
    """One frame of a session; everything is read when asked.

    Attributes:
        session: where it comes from; must stay open.
        index: within the session.
    """

    session: Session
    index: int

    @property
    def raw(self) -> Raw:
        """(H, W) uint8 or uint16 mosaic."""
        return self.session.raw(self.index)

    @property
    def stokes(self) -> Stokes:
        """Undistorted Stokes image, one pixel per super-pixel."""
        return self.session.stokes(self.index)

    @property
    def T_base_cam(self) -> SE3 | None:
        """Camera pose at mid-exposure; None before annotation."""
        return None if self.session.poses is None else self.session.poses[self.index]

    def T_cam_obj(self, name: str) -> SE3:
        """An object's pose; NaN where unknown."""
        return self.session.object_poses(name).T_cam_obj[self.index]

    def mask(self, name: str) -> NDArray[np.bool_]:
        """(h, w) bool visible mask of an object."""
        return self.session.object_poses(name).mask(self.index)
