"""Random streams depend on the seed and the purpose, and on nothing else."""

from __future__ import annotations

import itertools

import numpy as np
from scipy import stats

from calib.inference.random import generator, stream

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


def test_streams_are_uncorrelated() -> None:
    draws = np.stack([generator(1, *labels).standard_normal(2000) for labels in PURPOSES])
    off = np.corrcoef(draws)[np.triu_indices(len(PURPOSES), 1)]
    # 28 correlations of sd 1/sqrt(2000); a two-sided level of 1e-4 over all of them.
    assert np.abs(off).max() < stats.norm.ppf(1 - 0.5e-4 / off.size) / np.sqrt(2000)


def test_children_do_not_disturb_the_stream() -> None:
    parent = stream(5, "x")
    before = parent.generate_state(4)
    children = parent.spawn(2)
    np.testing.assert_array_equal(parent.generate_state(4), before)
    assert tuple(children[0].generate_state(4)) != tuple(children[1].generate_state(4))
