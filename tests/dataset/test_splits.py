"""Splits: complete, repeatable, and never with near-duplicates on both sides."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from dataset import SE3, ToolkitError
from dataset.session import Session
from dataset.splits import by_frame, by_view, split_session
from dataset.symmetry import Symmetry

FRACTIONS = {"train": 0.7, "val": 0.1, "test": 0.2}


def hemisphere(count: int, seed: int = 0) -> SE3:
    """Cameras on the upper half of a sphere that look at the object, with any roll."""
    rng = np.random.default_rng(seed)
    z = rng.uniform(0.1, 1, count)
    azimuth = rng.uniform(0, 2 * np.pi, count)
    radius = np.sqrt(1 - z**2)
    forward = -np.stack([radius * np.cos(azimuth), radius * np.sin(azimuth), z], axis=-1)
    side = np.cross(forward, [0.3, 0.1, 1.0])
    side /= np.linalg.norm(side, axis=-1, keepdims=True)
    rotation = np.stack([side, np.cross(forward, side), forward], axis=-1)
    return SE3(rotation, -0.5 * forward).inverse()


def test_frames_are_divided_completely() -> None:
    found = by_frame(100, FRACTIONS, seed=1)
    assert {name: len(indices) for name, indices in found.items()} == {"train": 70, "val": 10, "test": 20}
    assert np.sort(np.concatenate(list(found.values()))).tolist() == list(range(100))
    assert all(np.all(np.diff(indices) > 0) for indices in found.values())


@pytest.mark.parametrize(
    ("fractions", "seed"),
    [({"train": 0.9, "test": 0.9}, 0), ({"train": -1.0, "test": 2.0}, 0), ({"train": np.nan, "test": 1.0}, 0),
     ({}, 0), (FRACTIONS, -1)],
)  # fmt: skip
def test_what_is_no_division_is_refused(fractions: dict[str, float], seed: int) -> None:
    with pytest.raises(ToolkitError, match="negative"):
        by_frame(100, fractions, seed)
    with pytest.raises(ToolkitError, match="negative"):
        by_view(hemisphere(50), fractions, seed)


@pytest.mark.parametrize(("train", "val"), [(0.8, 0.2), (0.9, 0.1), (0.7, 0.3)])
def test_nothing_is_left_for_a_test_set(recorded: Path, train: float, val: float) -> None:
    found = split_session(recorded, "frame", train, val, 0)
    assert len(found["test"]) == 0
    with Session.open(recorded) as session:
        assert len(session.splits["train"]) + len(session.splits["val"]) == len(session)


def test_a_seed_names_a_split() -> None:
    poses = hemisphere(400)
    for first, again, other in (
        (by_frame(100, FRACTIONS, 1), by_frame(100, FRACTIONS, 1), by_frame(100, FRACTIONS, 2)),
        (by_view(poses, FRACTIONS, 1), by_view(poses, FRACTIONS, 1), by_view(poses, FRACTIONS, 2)),
    ):
        assert all(np.array_equal(first[name], again[name]) for name in FRACTIONS)
        assert not np.array_equal(first["test"], other["test"])


@pytest.mark.parametrize("seed", range(5))
def test_views_of_different_splits_keep_their_distance(seed: int) -> None:
    poses = hemisphere(600, seed)
    found = by_view(poses, FRACTIONS, seed, separation_deg=6.0)
    views = poses.inverse().translation
    views = views / np.linalg.norm(views, axis=-1, keepdims=True)
    for one, other in (("train", "test"), ("train", "val"), ("val", "test")):
        cosine = views[found[one]] @ views[found[other]].T
        assert np.rad2deg(np.arccos(cosine.max())) > 6.0
    assert 0.12 < len(found["test"]) / 600 < 0.28
    assert len(found["train"]) > 0.35 * 600


def test_frames_without_a_pose_join_no_split() -> None:
    matrices = hemisphere(300).as_matrix()
    matrices[::3] = np.nan
    found = by_view(SE3.from_matrix(matrices), {"train": 0.8, "test": 0.2}, seed=0)
    assert all(np.all(indices % 3 != 0) for indices in found.values())


@pytest.mark.parametrize("fractions", [{}, {"train": 0.5}, {"train": 1.2, "test": -0.2}])
def test_fractions_must_make_sense(fractions: dict[str, float]) -> None:
    with pytest.raises(ToolkitError, match="must sum to 1"):
        by_frame(10, fractions, 0)


def test_an_empty_split_is_refused() -> None:
    with pytest.raises(ToolkitError, match="'val' would be empty"):
        by_frame(3, {"train": 0.9, "val": 0.1}, 0)
    with pytest.raises(ToolkitError, match="would be empty"):
        by_view(hemisphere(1), FRACTIONS, 0)


def test_views_from_which_an_object_looks_alike_are_one_view() -> None:
    """A bottle looks the same from all around, a box the same from behind."""
    half_turn = SE3.from_rotvec([0, 0, np.pi], np.zeros(3)).as_matrix()
    box, bottle = Symmetry(transforms=half_turn[None]), Symmetry(axis=np.array([0.0, 0.0, 1.0]))
    poses = hemisphere(3000, seed=2)
    views = poses.inverse().translation
    views = views / np.linalg.norm(views, axis=-1, keepdims=True)
    found = by_view(poses, {"train": 0.5, "test": 0.5}, 0, symmetry=box)
    train, test = views[found["train"]], views[found["test"]]
    for turned in (train, train * [-1, -1, 1]):
        assert np.rad2deg(np.arccos((turned @ test.T).max())) > 5.0
    found = by_view(poses, {"train": 0.5, "test": 0.5}, 0, symmetry=bottle)
    heights = [np.rad2deg(np.arccos(views[found[name], 2])) for name in ("train", "test")]
    assert np.abs(heights[0][:, None] - heights[1]).min() > 4.85  # turns stand for all, 2 degrees apart
