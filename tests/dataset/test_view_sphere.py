"""The cells of the view sphere: a partition into patches of nearly one size."""

from __future__ import annotations

import numpy as np
import pytest

from dataset.view_sphere import OUTSIDE, ViewSphere


def directions(count: int, seed: int = 0) -> np.ndarray:
    """(count, 3) of random lengths, evenly over the sphere."""
    return np.random.default_rng(seed).normal(size=(count, 3))


@pytest.mark.parametrize(("cell_deg", "lowest_deg"), [(10.0, 0.0), (10.0, -90.0), (25.0, -30.0)])
def test_every_cell_holds_its_centre_and_what_is_near(cell_deg: float, lowest_deg: float) -> None:
    views = ViewSphere(cell_deg, lowest_deg)
    np.testing.assert_array_equal(views.cells(views.directions), np.arange(len(views)))
    vectors = directions(4000)
    cells = views.cells(vectors)
    inside = cells != OUTSIDE
    units = vectors[inside] / np.linalg.norm(vectors[inside], axis=1, keepdims=True)
    apart = np.arccos(np.clip(np.einsum("ij,ij->i", units, views.directions[cells[inside]]), -1, 1))
    # No farther from the centre than a corner of the cell; the cells at the pole are sectors.
    assert apart.max() < np.deg2rad(cell_deg)


def test_the_hemisphere_ends_at_the_horizon() -> None:
    vectors = directions(2000)
    np.testing.assert_array_equal(ViewSphere(10.0).cells(vectors) == OUTSIDE, vectors[:, 2] < 0)


@pytest.mark.parametrize("lowest_deg", [0.0, -90.0])
def test_cells_are_of_nearly_one_size_and_cover_the_sphere(lowest_deg: float) -> None:
    views = ViewSphere(10.0, lowest_deg)
    share = views.count(directions(400_000)) / 400_000
    assert share.sum() == pytest.approx((1 - np.sin(np.deg2rad(lowest_deg))) / 2, abs=0.005)
    assert share.max() < 1.5 * share.min()
    areas = views.sizes.prod(axis=1)
    np.testing.assert_allclose(areas.sum(), 2 * np.pi * (1 - np.sin(np.deg2rad(lowest_deg))), rtol=0.01)


def test_no_directions_make_no_counts() -> None:
    assert ViewSphere().count(np.zeros((0, 3))).sum() == 0
