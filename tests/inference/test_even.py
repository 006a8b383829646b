"""Points that fill a cube evenly leave no holes, and are the same for everyone."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.stats import kstest, qmc

from calib.inference.random import even_points, latin


@pytest.mark.parametrize("dim", [1, 2, 4, 7])
@pytest.mark.parametrize("size", [64, 400])
def test_they_fill_the_cube_more_evenly_than_random_points(size: int, dim: int) -> None:
    points = even_points(size, dim)
    assert points.shape == (size, dim)
    assert ((points >= 0.0) & (points < 1.0)).all()
    random = [
        qmc.discrepancy(np.random.default_rng(seed).uniform(size=(size, dim))) for seed in range(20)
    ]
    assert qmc.discrepancy(points) < min(random)


def test_in_each_direction_the_widest_gap_is_narrower_than_that_of_random_points() -> None:
    def widest(points: np.ndarray) -> np.ndarray:
        ends = np.vstack([np.zeros(5), np.sort(points, axis=0), np.ones(5)])
        return np.diff(ends, axis=0).max(axis=0)

    random = [widest(np.random.default_rng(seed).uniform(size=(64, 5))) for seed in range(20)]
    assert (widest(even_points(64, 5)) < np.median(random, axis=0)).all()


def test_nobody_can_change_what_others_are_given() -> None:
    with pytest.raises(ValueError, match="read-only"):
        even_points(8, 2)[0, 0] = 0.5


def test_a_latin_hypercube_has_one_point_in_each_slice_of_every_coordinate() -> None:
    points = latin(np.random.default_rng(1), 40, 3)
    assert points.shape == (40, 3)
    for column in points.T:
        assert sorted(np.floor(40 * column).astype(int).tolist()) == list(range(40))
    # Slices are paired at random, and a point may lie anywhere in its own.
    assert np.abs(np.corrcoef(latin(np.random.default_rng(2), 4000, 2).T)[0, 1]) < 0.08
    drawn = [latin(np.random.default_rng(seed), 40, 3) for seed in range(9)]
    within = np.ravel(drawn) * 40 % 1
    assert kstest(within, "uniform").pvalue > 1e-4


def test_by_a_latin_hypercube_shares_come_out_right_and_steadier() -> None:
    """As that of a coordinate beyond a bar."""
    found = [(latin(np.random.default_rng(s), 100, 2)[:, 0] > 0.7).mean() for s in range(200)]
    assert np.mean(found) == pytest.approx(0.3, abs=0.002)
    assert np.std(found) < 0.3 * np.sqrt(0.3 * 0.7 / 100)
