"""From sessions to canonical crops: read once, kept in memory and resampled thousands of times. (Where the
memory does not hold them, `loader` makes the same crops anew for every epoch.)

Two kinds, kept apart by type. `Crops` holds what can be had of a captured frame without its pose: Stokes
values in a predicted box, and the predicted mask. `LabelledCrops` adds the truth of a synthetic (or
annotated) session.
"""

from __future__ import annotations

import hashlib
from collections.abc import Container, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import torch
from numpy.typing import NDArray
from safetensors import SafetensorError
from safetensors.torch import load_file
from torch import Tensor

from dataset import SE3, Intrinsics
from dataset.errors import ToolkitError
from dataset.session import ObjectPoses, Session, mask_box
from dataset.stokes_cache import images_hash
from s2p3.config import InputConfig
from s2p3.inputs import crop_intrinsics, extract_crop, extract_depth, square_box
from s2p3.networks.detector import Detection
from s2p3.objects import ObjectModel, Symmetry, poses_of
from s2p3.progress import Report, quiet
from s2p3.rendering import rasterize
from s2p3.training.checkpoint import save_tensors

if TYPE_CHECKING:
    from typing_extensions import Self

_ASKEW = np.array([0.36, 0.48, 0.8])  # a direction that is no axis of any usual symmetry
_KEPT = 3  # which tensors a file of crops holds: one that holds others is not read, but made anew
_MINIMUM_VISIBLE = 0.3  # our choice: frames that show less of the object than this are not trained on


@dataclass(frozen=True, kw_only=True)
class Crops:
    """N upright canonical crops of side P.

    Attributes:
        stokes: (N, 3, P, P) float16.
        mask: (N, 1, P, P) float16, 0 to 1: predicted, or the visible mask where the truth is known.
        K: (N, 3, 3) float32, intrinsics of the crops.
        depth: (N, 1, P, P) float16 metres, 0 unknown; None where the sessions have none.
        valid: (N, 1, P, P) bool, where `stokes` is a measurement: neither saturated nor too dark; None where
            nobody asks.
    """

    stokes: Tensor
    mask: Tensor
    K: Tensor
    depth: Tensor | None = None
    valid: Tensor | None = None

    def __len__(self) -> int:
        return len(self.stokes)

    def take(self, rows: Tensor) -> Self:
        """Some of the crops."""
        return type(self)(**{name: tensor[rows] for name, tensor in self.tensors().items()})

    def tensors(self) -> dict[str, Tensor]:
        """All there are, by name."""
        return {name: value for name, value in vars(self).items() if value is not None}


@dataclass(frozen=True, kw_only=True)
class LabelledCrops(Crops):
    """Crops with their truth.

    Attributes:
        rotation, translation: (N, 3, 3) and (N, 3) of T_cam_obj; for a symmetric object, of the equivalent
            pose that `canonical_pose` chooses by the viewing direction.
        normals: (N, 3, P, P) float16, camera frame, zero outside the object.
        coordinates: (N, 3, P, P) float16, -1 to 1 across the object's bounding box, zero outside.
    """

    rotation: Tensor
    translation: Tensor
    normals: Tensor
    coordinates: Tensor


def content_hashes(paths: Sequence[Path], model: ObjectModel) -> dict[str, str]:
    """What trainings on sessions depend on, by session id: short hashes of the images and their calibration,
    of depth, and of the object's poses and how it is seen.

    Raises ToolkitError: a session is given twice; see also `poses_of`.
    """
    hashes: dict[str, str] = {}
    for path in paths:
        with Session.open(path) as session:
            digest = hashlib.sha256(images_hash(session).encode())
            if session.has_depth:
                digest.update(session.contents.read("depth_crc32", slice(len(session))).tobytes())
            poses = poses_of(session, model)
            for part in (poses.T_cam_obj.as_matrix(), poses.bbox_xywh, poses.visible_fraction):
                digest.update(np.ascontiguousarray(part).tobytes())
            hashes[once(session, hashes)] = digest.hexdigest()[:16]
    return hashes


def once(session: Session, before: Container[str]) -> str:
    """The session's id. Raises ToolkitError: it is among those that were given before."""
    if session.session_id in before:
        raise ToolkitError(f"{session.path}: this session was given before; name each one once")
    return session.session_id


def crops_hash(crops: Crops) -> str:
    """A short hash of what captured crops show."""
    digest = hashlib.sha256()
    for tensor in crops.tensors().values():
        digest.update(tensor.numpy().tobytes())
    return digest.hexdigest()[:16]


def fingerprint(paths: Sequence[Path], model: ObjectModel, config: InputConfig) -> str:
    """A short hash of which sessions, which object and which crops."""
    hashes = content_hashes(paths, model)
    return hashlib.sha256(f"{_KEPT} {model.fingerprint} {config} {hashes}".encode()).hexdigest()[:16]


def labelled_crops(
    paths: Sequence[Path],
    model: ObjectModel,
    config: InputConfig,
    cache: Path | None = None,
    report: Report = quiet,
) -> LabelledCrops:
    """The crops of every frame of `paths` that shows the object, with dense targets drawn by the rasterizer.

    Args:
        paths: sessions with poses of the object.
        cache: folder in which the crops are kept for the next call with the same data and settings.

    Raises ToolkitError: a session lacks the object, or no frame shows it.
    """
    stored = None if cache is None else cache / f"crops-{fingerprint(paths, model, config)}.safetensors"
    if stored is not None and stored.exists():
        with suppress(OSError, SafetensorError):  # damaged, or another's: made anew
            return LabelledCrops(**load_file(stored))
    shown = shown_rows(paths, model)
    rows: list[dict[str, NDArray[np.generic]]] = []
    for number, path in enumerate(paths):
        with Session.open(path) as session:
            poses = poses_of(session, model)
            for index in (index for which, index in shown if which == number):
                stokes = np.moveaxis(session.stokes(index).stack(), 0, -1)
                rows.append(labelled_crop(session, poses, index, stokes, model, config))
                report(f"crops of {model.name}", len(rows), len(shown), {})
    crops = collate(rows)
    if stored is not None:
        stored.parent.mkdir(parents=True, exist_ok=True)
        save_tensors(stored, crops.tensors())
    return crops


def shown_rows(paths: Sequence[Path], model: ObjectModel) -> list[tuple[int, int]]:
    """Session and frame, as positions in `paths` and in it, of every frame that shows enough of the object to
    be trained on.

    Raises ToolkitError: a session lacks the object, or no frame shows it.
    """
    rows = []
    for number, path in enumerate(paths):
        with Session.open(path) as session:
            poses = poses_of(session, model)
            seen = (poses.visible_fraction >= _MINIMUM_VISIBLE) & (poses.bbox_xywh[:, 2:].min(axis=1) > 0)
            rows += [(number, int(index)) for index in np.flatnonzero(seen)]
    if not rows:
        raise ToolkitError(
            f"{', '.join(map(str, paths))}: no frame shows {model.name!r}; annotate or synthesize first"
        )
    return rows


def labelled_crop(
    session: Session,
    poses: ObjectPoses,
    index: int,
    stokes: NDArray[np.floating],
    model: ObjectModel,
    config: InputConfig,
) -> dict[str, NDArray[np.generic]]:
    """A frame that shows the object as a row of `LabelledCrops`.

    Args:
        poses: the session's, of the object.
        stokes: (H, W, 3) undistorted, or a memory map of it: only the part under the crop is read.
    """
    mask, depth, camera = poses.mask(index), depth_of(session, index, config), session.working_intrinsics
    crop = _crop(stokes, mask, mask_box(mask), camera, config, depth)
    return crop | _truth(mask, poses.T_cam_obj[index], camera, model, config)


def collate(rows: Sequence[dict[str, NDArray[np.generic]]]) -> LabelledCrops:
    """Rows of `labelled_crop` as one batch."""
    return LabelledCrops(**_stacked(rows))


def _stacked(rows: Sequence[dict[str, NDArray[np.generic]]]) -> dict[str, Tensor]:
    """What all rows have (some sessions may lack depth), by name."""
    names = [name for name in rows[0] if all(name in row for row in rows)]
    return {name: torch.from_numpy(np.stack([row[name] for row in rows])) for name in names}


def captured_crops(
    session: Session, indices: Sequence[int], detections: Sequence[Detection | None], config: InputConfig
) -> Crops:
    """The crops of captured frames at their predicted boxes; frames without a detection are left out.

    Reads the Stokes and depth images and the intrinsics of `session`, nothing else.

    Raises ToolkitError: the object was detected in no frame; networks that see depth, and there is none.
    """
    rows = []
    for index, found in zip(indices, detections, strict=True):
        if found is None:
            continue
        stokes, depth = session.stokes(index), depth_of(session, index, config)
        image, camera = np.moveaxis(stokes.stack(), 0, -1), session.working_intrinsics
        row = _crop(image, found.mask, found.box_xywh, camera, config, depth)
        region = square_box(found.box_xywh, config.canonical_zoom)
        valid = stokes.valid[None].astype(np.float32)
        whole = extract_crop(valid, region, config.canonical_size, outside="zeros")
        rows.append({**row, "valid": whole > 0.999})
    if not rows:
        raise ToolkitError(
            "the detector found the object in none of the frames given; "
            "train it longer, or on scenes closer to these"
        )
    return Crops(**_stacked(rows))


def depth_of(session: Session, index: int, config: InputConfig) -> NDArray[np.float32] | None:
    """The depth image of a frame, None where the session has none.

    Raises ToolkitError: networks that see depth, and there is none.
    """
    if session.has_depth:
        return session.depth(index)
    if config.modality == "rgbd":
        raise ToolkitError(
            f"{session.path} has no depth, and these networks see it; record it, synthesize with --depth, or "
            "take networks without"
        )
    return None


def single_crop(
    stokes: NDArray[np.float32],
    found: Detection,
    intrinsics: Intrinsics,
    config: InputConfig,
    depth: NDArray[np.float32] | None = None,
) -> Crops:
    """The crop (N = 1) of one undistorted Stokes image (3, H, W) at a predicted box."""
    row = _crop(np.moveaxis(stokes, 0, -1), found.mask, found.box_xywh, intrinsics, config, depth)
    return Crops(**_stacked([row]))


def canonical_pose(pose: SE3, symmetry: Symmetry) -> SE3:
    """The pose that, among its equivalents under a symmetry, shows the camera on a fixed side: maps of
    coordinates would contradict each other otherwise (our choice). Without a symmetry the pose itself."""
    axis = symmetry.axis
    if len(symmetry.transforms):
        equivalent = SE3.stack([pose, *(pose @ SE3.from_matrix(motion) for motion in symmetry.transforms)])
        side = _ASKEW if axis is None else axis
        pose = equivalent[int(np.argmax(equivalent.inverse().translation @ side))]
    if axis is None:
        return pose
    towards = pose.inverse().translation
    towards = towards - axis * (axis @ towards)
    side = np.linalg.svd(axis[None])[2][1]  # any fixed direction across the axis
    turn = np.arctan2(axis @ np.cross(side, towards), side @ towards)
    return pose @ SE3.from_rotvec(axis * turn, np.zeros(3))


def _crop(
    stokes: NDArray[np.floating],
    mask: NDArray[np.bool_],
    box: NDArray[np.float64],
    intrinsics: Intrinsics,
    config: InputConfig,
    depth: NDArray[np.float32] | None,
) -> dict[str, NDArray[np.generic]]:
    region = square_box(box, config.canonical_zoom)
    rows, columns = _under(region, mask.shape)
    local = region - [columns.start, rows.start, 0, 0]
    light = np.moveaxis(stokes[rows, columns], -1, 0).astype(np.float32)
    silhouette = mask[None, rows, columns].astype(np.float32)
    measured = {}
    if depth is not None:
        near = extract_depth(depth[rows, columns], local, config.canonical_size)
        measured["depth"] = near[None].astype(np.float16)
    return {
        **measured,
        "stokes": extract_crop(light, local, config.canonical_size).astype(np.float16),
        "mask": extract_crop(silhouette, local, config.canonical_size, outside="zeros").astype(np.float16),
        "K": crop_intrinsics(intrinsics, region, config.canonical_size),
    }


def _under(region: NDArray[np.float64], shape: tuple[int, ...]) -> tuple[slice, slice]:
    """Rows and columns of an image that interpolation inside a region reads; at least one pixel."""
    x, y, w, h = region
    spans = []
    for low, high, size in ((y, y + h, shape[0]), (x, x + w, shape[1])):
        start = min(max(int(np.floor(low)) - 2, 0), size - 1)
        spans.append(slice(start, max(min(int(np.ceil(high)) + 2, size), start + 1)))
    return spans[0], spans[1]


def _truth(
    mask: NDArray[np.bool_],
    T_cam_obj: SE3,
    intrinsics: Intrinsics,
    model: ObjectModel,
    config: InputConfig,
) -> dict[str, NDArray[np.generic]]:
    pose = canonical_pose(T_cam_obj, model.symmetry)
    region = square_box(mask_box(mask), config.canonical_zoom)
    raster = rasterize(model.mesh, pose, intrinsics.crop(region, config.canonical_size))
    inside = raster.mask[None]
    return {
        "rotation": pose.rotation.astype(np.float32),
        "translation": pose.translation.astype(np.float32),
        "normals": np.moveaxis(raster.normals, -1, 0).astype(np.float16) * inside,
        "coordinates": np.moveaxis(2 * raster.nocs - 1, -1, 0).astype(np.float16) * inside,
    }
