"""What a session holds besides frames: objects, their poses, and clock fits."""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol, TypeVar

import numpy as np
from numpy.typing import NDArray

from dataset.clocks import DeviceClock
from dataset.transforms import SE3

Image = TypeVar("Image", bound=NDArray[np.generic], covariant=True)


class Images(Protocol[Image]):
    """N images, read one at a time: a (N, h, w) array, a list of images, or images in a file."""

    def __len__(self) -> int: ...

    def __getitem__(self, index: int, /) -> Image: ...


Masks = Images[NDArray[np.bool_]]
"""N visible masks, each (h, w) bool."""


@dataclass(frozen=True, eq=False)
class PackedMasks:
    """Masks kept a bit a pixel, so that those of a long session fit into memory.

    Attributes:
        packed: N times `np.packbits` of a mask.
        shape: (h, w) of each.
    """

    packed: Sequence[NDArray[np.uint8]]
    shape: tuple[int, int]

    def __len__(self) -> int:
        return len(self.packed)

    def __getitem__(self, index: int, /) -> NDArray[np.bool_]:
        bits = np.unpackbits(self.packed[index], count=self.shape[0] * self.shape[1])
        return bits.reshape(self.shape).astype(bool)


@dataclass(frozen=True, eq=False)
class ObjectRecord:
    """An object as a session stores it.

    Attributes:
        name: a file-system-safe word.
        vertices: (V, 3) float64 in the object frame, metres.
        faces: (F, 3) int32, counter-clockwise seen from outside.
        material: its name.
        refractive_index, extinction: real and imaginary part of the refractive index.
        symmetry: JSON text.
        diameter: largest distance between two vertices, metres.
    """

    name: str
    vertices: NDArray[np.float64]
    faces: NDArray[np.int32]
    material: str
    refractive_index: float
    extinction: float
    symmetry: str
    diameter: float

    @property
    def sha256(self) -> str:
        """Of the vertices' bytes (float64) followed by the faces' (int32)."""
        vertices = np.ascontiguousarray(self.vertices, dtype="<f8").tobytes()
        return hashlib.sha256(vertices + np.ascontiguousarray(self.faces, dtype="<i4").tobytes()).hexdigest()


@dataclass(frozen=True, eq=False)
class ObjectPoses:
    """One object in every frame of a session, in the undistorted polarization image.

    Attributes:
        T_cam_obj: a batch of N; NaN where unknown.
        visible_fraction: (N,) float64 in [0, 1], share of the silhouette that is visible.
        bbox_xywh: (N, 4) float64, box of the visible mask in pixel-edge coordinates; zeros where empty.
        masks: N visible masks, each (h, w) bool.
    """

    T_cam_obj: SE3
    visible_fraction: NDArray[np.float64]
    bbox_xywh: NDArray[np.float64]
    masks: Masks

    def mask(self, index: int) -> NDArray[np.bool_]:
        """(h, w) bool: where frame `index` shows the object."""
        return np.asarray(self.masks[index], dtype=bool)


@dataclass(frozen=True)
class Clocks:
    """The devices' clocks on the host's, None where not fitted; of a recording just made, why times are not
    known, a line each."""

    camera: DeviceClock | None
    robot: DeviceClock | None
    problems: tuple[str, ...] = ()


def mask_box(mask: NDArray[np.generic]) -> NDArray[np.float64]:
    """(4,) left, top, width, height of a mask (h, w) in pixel-edge coordinates; zeros where it is empty."""
    rows, columns = np.flatnonzero(mask.any(axis=1)), np.flatnonzero(mask.any(axis=0))
    if len(rows) == 0:
        return np.zeros(4)
    left, top = columns[0], rows[0]
    return np.array([left, top, columns[-1] + 1 - left, rows[-1] + 1 - top], dtype=np.float64)
