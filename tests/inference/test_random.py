"""Random streams depend on the seed and the purpose, and on nothing else."""

from __future__ import annotations

import itertools

import numpy as np
import pytest
from scipy.stats import kstest, qmc

from calib.inference.random import even_points, generator, latin, stream

PURPOSES = [(), ("a",), ("b",), ("a", "b"), ("b", "a"), ("ab",), ("a", "refit", 0),
            ("a", "refit", 1)]  # fmt: skip


def test_same_seed_and_purpose_same_numbers() -> None:
    for labels in PURPOSES:
        first = generator(3, *labels).standard_normal(5)
        generator(3, "something else").standard_normal(1000)
        np.testing.assert_array_equal(generator(3, *labels).standard_normal(5), first)


def test_every_seed_and_purpose_has_its_own_stream() -> None:
    states = [
        tuple(stream(seed, *labels).generate_state(4))
        for seed, labels in itertools.product((0, 1, 2019), PURPOSES)
    ]
    assert len(set(states)) == len(states)


@pytest.mark.parametrize(("size", "dim"), [(64, 1), (64, 4), (400, 7)])
def test_they_fill_the_cube_more_evenly_than_random_points(size: int, dim: int) -> None:
    points = even_points(size, dim)
    assert points.shape == (size, dim)
    assert ((points >= 0.0) & (points < 1.0)).all()
    random = [
        qmc.discrepancy(np.random.default_rng(seed).uniform(size=(size, dim))) for seed in range(20)
    ]
    assert qmc.discrepancy(points) < min(random)


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
