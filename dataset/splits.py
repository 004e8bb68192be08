"""Dividing the frames of a session into train, validation and test."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Literal

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from dataset.errors import SessionError, ToolkitError
from dataset.session import Session, write_split
from dataset.symmetry import Symmetry
from dataset.transforms import SE3

Indices = NDArray[np.int64]

_ASKEW = np.array([0.36, 0.48, 0.8])  # a direction that is no axis of any usual symmetry
_TURNS = 180
"""About an axis of symmetry that stand for all, 2 degrees apart (our choice)."""
_CELLS = 64
"""Patches the view sphere is cut into, about 25 degrees wide (our choice)."""


def by_frame(count: int, fractions: Mapping[str, float], seed: int) -> dict[str, Indices]:
    """Divides frames at random. Neighbouring frames of a moving camera look alike: prefer `by_view`.

    Args:
        count: number of frames.
        fractions: share of each split by name, such as {"train": 0.8, "test": 0.2}; they sum to 1.
        seed: same seed, same split.

    Returns:
        Increasing frame indices by name; every frame is in exactly one split.

    Raises:
        ToolkitError: fractions or seed are negative, fractions do not sum to 1, or a split would be empty.
    """
    _check(fractions, seed)
    order = np.random.default_rng(seed).permutation(count)
    ends = np.rint(np.cumsum(list(fractions.values())) * count).astype(int)
    parts = np.split(order, ends[:-1])
    found = {name: np.sort(part).astype(np.int64) for name, part in zip(fractions, parts, strict=True)}
    return _not_empty(found, fractions, f"{count} frames are too few")


def by_view(
    T_cam_obj: SE3,
    fractions: Mapping[str, float],
    seed: int,
    separation_deg: float = 5.0,
    symmetry: Symmetry | None = None,
) -> dict[str, Indices]:
    """Divides frames by where they look from, so that no near-duplicate straddles two splits.

    The sphere of viewing directions around the object is cut into patches, whole patches are dealt out, and
    a frame of a larger split that lies within `separation_deg` of a smaller one joins no split at all (our
    choice: the guard band costs frames, straddling would cost the meaning of the result).

    Args:
        T_cam_obj: N poses of one object; frames where it is unknown (NaN) join no split.
        fractions: share of each split by name, before guard bands; they sum to 1.
        seed: same seed, same split.
        separation_deg: smallest angle between views of different splits, degrees.
        symmetry: of the object: views from which it looks alike are one view.

    Returns:
        Increasing frame indices by name.

    Raises:
        ToolkitError: fractions are negative or do not sum to 1, or a split would be empty.
    """
    _check(fractions, seed)
    known = np.flatnonzero(T_cam_obj.finite)
    alike = _alike(T_cam_obj[known], symmetry or Symmetry())
    first = np.argmax(alike @ _ASKEW, axis=1)  # one view stands for all that are alike
    views = alike[np.arange(len(alike)), first]
    rng = np.random.default_rng(seed)
    cells = cKDTree(_fibonacci_sphere(_CELLS)).query(views)[1] if len(views) else np.zeros(0, dtype=int)
    owner = _deal_cells(cells, fractions, rng)
    smallest_first = sorted(fractions, key=lambda name: fractions[name])
    chord = 2 * np.sin(np.deg2rad(separation_deg) / 2)
    found: dict[str, Indices] = {}
    taken = np.zeros((0, 3))
    for name in smallest_first:
        mine = np.flatnonzero(owner == name)
        if len(taken) and len(mine):
            mine = mine[cKDTree(taken).query(views[mine])[0] > chord]
        found[name] = known[mine].astype(np.int64)
        taken = np.concatenate([taken, alike[mine].reshape(-1, 3)])
    hint = f"{len(known)} posed frames cover too few directions from which the object looks different"
    return _not_empty({name: found[name] for name in fractions}, fractions, hint)


def split_session(
    path: str | Path, by: Literal["frame", "view"], train: float, val: float, seed: int
) -> dict[str, Indices]:
    """Divides a session into train, val and test (the rest), and stores the split in the file.

    Args:
        path: of a complete session; annotated with one object at least where `by` is "view".
        by: see `by_frame` and `by_view`.
        train, val: shares of the frames.
        seed: same seed, same split.

    Raises:
        ToolkitError: as `by_frame` and `by_view`.
        SessionError: the session cannot be read or edited, or lacks the poses that views need.
    """
    test = round(1.0 - train - val, 9)  # 1 - 0.8 - 0.2 is not zero in floating point
    fractions = {"train": train, "val": val, "test": test}
    with Session.open(path) as session:
        if by == "frame":
            found = by_frame(len(session), fractions, seed)
        elif not session.annotated:
            raise SessionError(f"{path} has no annotated object, so no views; run: s2p3 annotate {path}")
        else:
            name = session.annotated[0]
            symmetry = Symmetry.from_json(session.object(name).symmetry)
            found = by_view(session.object_poses(name).T_cam_obj, fractions, seed, symmetry=symmetry)
    for name, indices in found.items():
        write_split(path, name, indices)
    return found


def _alike(T_cam_obj: SE3, symmetry: Symmetry) -> NDArray[np.float64]:
    """(N, M, 3) unit directions from which the object looks as it does in each of N poses."""
    eyes = T_cam_obj.inverse().translation
    found = np.stack([motion.apply(eyes) for motion in SE3.from_matrix(symmetry.sampled(_TURNS))], axis=1)
    return found / np.linalg.norm(found, axis=-1, keepdims=True)


def _deal_cells(cells: Indices, fractions: Mapping[str, float], rng: np.random.Generator) -> NDArray[np.str_]:
    """The split of each frame: cells in random order, each to the split that lacks most of its share."""
    owner = np.full(len(cells), "", dtype=f"<U{max(len(name) for name in fractions)}")
    lacking = {name: share * len(cells) for name, share in fractions.items()}
    for cell in rng.permutation(np.unique(cells)):
        name = max(lacking, key=lambda candidate: lacking[candidate] / max(fractions[candidate], 1e-12))
        owner[cells == cell] = name
        lacking[name] -= np.count_nonzero(cells == cell)
    return owner


def _fibonacci_sphere(count: int) -> NDArray[np.float64]:
    index = np.arange(count) + 0.5
    z = 1 - 2 * index / count
    azimuth = np.pi * (1 + np.sqrt(5)) * index
    radius = np.sqrt(1 - z**2)
    return np.stack([radius * np.cos(azimuth), radius * np.sin(azimuth), z], axis=-1)


def _check(fractions: Mapping[str, float], seed: int) -> None:
    if seed < 0:
        raise ToolkitError(f"--seed {seed} is negative; give 0 or more")
    shares = list(fractions.values())
    if not (shares and all(share >= 0 for share in shares) and abs(sum(shares) - 1) <= 1e-6):
        raise ToolkitError(
            f"split fractions {dict(fractions)} must not be negative and must sum to 1; adjust one of them"
        )


def _not_empty(found: dict[str, Indices], fractions: Mapping[str, float], why: str) -> dict[str, Indices]:
    empty = [name for name, indices in found.items() if fractions[name] > 0 and len(indices) == 0]
    if empty:
        raise ToolkitError(
            f"the split {empty[0]!r} would be empty: {why}; record more, or change the fractions"
        )
    return found
