"""Whether the numbers in a session make sense: what was computed from the recording."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterator
from itertools import combinations

import numpy as np
from numpy.typing import NDArray

from dataset.errors import CalibrationError
from dataset.intrinsics import Intrinsics
from dataset.session.files import attribute
from dataset.session.records import ObjectRecord, mask_box
from dataset.validate.images import intact_images
from dataset.validate.problems import Problem, View, first_frames

_ORTHONORMAL = 1e-4
_BOX_TOLERANCE_PX = 1.0
_EXCLUSIVE_SPLITS = ("train", "val", "test")
_ANNOTATE = "annotate the session again"


def check_calibration(view: View) -> Iterator[Problem]:
    """The intrinsics describe a camera, and the stored text is the one that was hashed."""
    matrix, distortion = view.read("calibration/K"), view.read("calibration/distortion")
    if matrix is not None and distortion is not None:
        try:
            Intrinsics(matrix, distortion, 1, 1)
        except CalibrationError as error:
            yield Problem("calibration", str(error), "apply the calibration again")
    node = view.dataset("calibration/json")
    if node is None:
        return
    text = str(node.asstr()[()])
    if hashlib.sha256(text.encode()).hexdigest() != attribute(node.parent, "sha256"):
        yield Problem("calibration/json", "does not match its sha256", "apply the calibration again")


def check_objects(view: View) -> Iterator[Problem]:
    """Meshes are finite, metric and unchanged; their faces name existing vertices."""
    for name in view.names("objects"):
        where = f"objects/{name}"
        vertices, faces = view.read(f"{where}/vertices"), view.read(f"{where}/faces")
        if vertices is None or faces is None:
            continue
        group = view.file[where]
        hint = "store the mesh again from its source"
        if len(vertices) == 0 or not np.isfinite(vertices).all():
            yield Problem(where, "its vertices are empty or not finite", hint)
            continue
        if len(faces) == 0 or faces.min() < 0 or faces.max() >= len(vertices):
            yield Problem(where, "its faces are empty or name vertices that do not exist", hint)
        record = ObjectRecord(name, vertices, faces, "", 1.0, 0.0, "{}", 0.0)
        if record.sha256 != attribute(group, "sha256"):
            yield Problem(where, "the mesh does not match its sha256", hint)
        extent = np.ptp(vertices, axis=0)
        diameter = attribute(group, "diameter")
        if isinstance(diameter, float) and not (
            extent.max() * 0.999 <= diameter <= np.linalg.norm(extent) * 1.001
        ):
            what = f"its diameter {diameter:g} m does not fit a mesh of {np.round(extent, 4).tolist()} m"
            yield Problem(where, what, "check the mesh's units: metres")
        try:
            json.loads(str(attribute(group, "symmetry")))
        except json.JSONDecodeError as error:
            yield Problem(f"{where}/@symmetry", f"is not JSON ({error})", hint)


def check_poses(view: View) -> Iterator[Problem]:
    """Poses are rigid or wholly unknown, uncertainties are not negative."""
    yield from _check_rigid(view, "poses/T_base_cam")
    for name in ("sigma_t", "sigma_r"):
        values = view.read(f"poses/{name}")
        if values is not None and (wrong := (values < 0) | np.isinf(values)).any():
            yield Problem(
                f"poses/{name}", f"is negative or infinite at frame {first_frames(wrong)}", _ANNOTATE
            )
    for name in view.names("poses/objects"):
        if f"objects/{name}" not in view.file:
            yield Problem(f"poses/objects/{name}", f"there is no mesh objects/{name}", "store the mesh")
        yield from _check_rigid(view, f"poses/objects/{name}/T_cam_obj")
        yield from _check_masks(view, f"poses/objects/{name}")


def check_splits(view: View) -> Iterator[Problem]:
    """Splits name existing frames once each, and train, val and test share none."""
    raw = view.dataset("camera/raw")
    found: dict[str, NDArray[np.int64]] = {}
    for name in view.names("splits"):
        indices = view.read(f"splits/{name}")
        if indices is None:
            continue
        found[name] = indices
        if np.any(np.diff(indices) <= 0):
            yield Problem(f"splits/{name}", "its frames are not in increasing order", "split again")
        if raw is not None and len(indices) and (indices.min() < 0 or indices.max() >= len(raw)):
            yield Problem(f"splits/{name}", f"names frames outside 0..{len(raw) - 1}", "split again")
    for one, other in combinations([name for name in _EXCLUSIVE_SPLITS if name in found], 2):
        shared = np.intersect1d(found[one], found[other])
        if len(shared):
            what = f"shares {len(shared)} frames with {other}, the first {shared[0]}"
            yield Problem(f"splits/{one}", what, "split again")


def _check_rigid(view: View, path: str) -> Iterator[Problem]:
    matrices = view.read(path)
    if matrices is None:
        return
    finite = np.isfinite(matrices).all(axis=(1, 2))
    partial = ~finite & ~np.isnan(matrices).all(axis=(1, 2))
    if partial.any():
        yield Problem(path, f"is only partly known at frame {first_frames(partial)}", _ANNOTATE)
    safe = np.where(finite[:, None, None], matrices, np.eye(4))
    rotation = safe[:, :3, :3]
    with np.errstate(over="ignore", invalid="ignore"):  # a damaged number may be of any size
        error = np.abs(rotation @ rotation.transpose(0, 2, 1) - np.eye(3)).max(axis=(1, 2), initial=0)
        wrong = ~((error <= _ORTHONORMAL) & (np.linalg.det(rotation) > 0))
    if wrong.any():
        what = f"holds no rotation at frame {first_frames(wrong)} (off by {error[wrong].max():.2g})"
        yield Problem(path, what, _ANNOTATE)
    wrong = np.abs(safe[:, 3] - [0, 0, 0, 1]).max(axis=1, initial=0) > _ORTHONORMAL
    if wrong.any():
        yield Problem(path, f"the last row is not 0 0 0 1 at frame {first_frames(wrong)}", _ANNOTATE)


def _check_masks(view: View, where: str) -> Iterator[Problem]:
    fraction, boxes = view.read(f"{where}/visible_fraction"), view.read(f"{where}/bbox_xywh")
    if fraction is not None and (wrong := ~((fraction >= 0) & (fraction <= 1))).any():
        what = f"is not within 0 and 1 at frame {first_frames(wrong)}"
        yield Problem(f"{where}/visible_fraction", what, _ANNOTATE)
    problems: list[Problem] = []
    for index, mask in intact_images(view, f"{where}/mask", _ANNOTATE, problems):
        if mask.max() > 1:
            problems.append(Problem(f"{where}/mask[{index}]", "holds values other than 0 and 1", _ANNOTATE))
        if boxes is None or index >= len(boxes):
            continue
        expected = mask_box(mask)
        if mask.any() and not np.abs(boxes[index] - expected).max() <= _BOX_TOLERANCE_PX:
            what = f"{np.round(boxes[index], 2).tolist()} is not the box {expected.tolist()} of the mask"
            problems.append(Problem(f"{where}/bbox_xywh[{index}]", what, _ANNOTATE))
    yield from problems
