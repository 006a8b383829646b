"""Points that fill a cube evenly leave no holes, and are the same for everyone."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.stats import qmc

from calib.inference.even import even_points


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
