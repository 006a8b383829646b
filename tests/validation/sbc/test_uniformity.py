"""Ranks to transforms, transforms to p values and bands."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy import stats

from calib.validation.sbc import ecdf_band, holm, p_value, pit


def statistic(values: np.ndarray) -> float:
    """The smallest pointwise tail, written out."""
    n = values.size
    tails = []
    for i in range(1, n):
        k = int((values <= i / n).sum())
        law = stats.binom(n, i / n)
        tails += [law.cdf(k), law.sf(k - 1)]
    return min(tails)


def p_by_transitions(n: int, tail: float) -> float:
    """An independent way: counts are a Markov chain with binomial steps."""
    mass = {0: 1.0}
    for i in range(1, n):
        z, before = i / n, (i - 1) / n
        law, new = stats.binom(n, z), {}
        for k, m in mass.items():
            step = stats.binom(n - k, (z - before) / (1.0 - before))
            for j in range(n - k + 1):
                if min(law.cdf(k + j), law.sf(k + j - 1)) > tail * (1.0 + 1e-9):
                    new[k + j] = new.get(k + j, 0.0) + m * step.pmf(j)
        mass = new
    return 1.0 - sum(mass.values())


@pytest.mark.parametrize("seed", range(6))
def test_the_p_value_is_that_of_a_slow_and_plain_recursion(seed: int) -> None:
    values = np.random.default_rng(seed).uniform(size=12) ** (1.0 + 0.5 * seed)
    expected = p_by_transitions(12, statistic(values))
    assert p_value(values) == pytest.approx(expected, rel=1e-8, abs=1e-12)


def test_p_values_of_uniform_samples_are_uniform() -> None:
    rng = np.random.default_rng(2)
    found = np.array([p_value(rng.uniform(size=60)) for _ in range(2000)])
    for level in (0.01, 0.05, 0.2, 0.5):
        # They are discrete: P(p <= level) may fall short of the level a little, never exceed it.
        hits = int((found <= level).sum())
        assert stats.binomtest(hits, 2000, level, alternative="greater").pvalue > 1e-3
        assert hits > 0.7 * 2000 * level


@settings(max_examples=50, deadline=None)
@given(seed=st.integers(0, 2**32 - 1), n=st.integers(2, 80), power=st.floats(0.2, 5.0))
def test_a_p_value_is_a_probability_whatever_the_side(seed: int, n: int, power: float) -> None:
    values = np.random.default_rng(seed).uniform(size=n) ** power
    assert 0.0 <= p_value(values) <= 1.0
    assert p_value(1.0 - values) == pytest.approx(p_value(values), rel=1e-6, abs=1e-9)


@pytest.mark.parametrize("shape", [(0.5, 0.5), (2.0, 2.0), (1.5, 1.0), (1.0, 1.5)])
def test_what_is_not_uniform_is_found(shape: tuple[float, float]) -> None:
    """Too narrow, too wide, biased up, biased down."""
    assert p_value(stats.beta(*shape).rvs(300, random_state=1)) < 1e-4


@pytest.mark.parametrize("n", [40, pytest.param(300, marks=pytest.mark.slow)])
@pytest.mark.parametrize("level", [0.9, 0.95])
def test_arviz_bands_hold_the_whole_curve_as_often_as_they_say(n: int, level: float) -> None:
    rng = np.random.default_rng(3)
    band = ecdf_band(rng.uniform(size=n), level)
    assert band.x[0] == band.ecdf[0] == 0.0
    assert band.x[-1] == band.ecdf[-1] == 1.0
    x = band.x[1:-1]
    samples = np.sort(rng.uniform(size=(2000, n)), axis=1)
    inside = 0
    for sample in samples:
        ecdf = np.searchsorted(sample, x, side="right") / n
        inside += bool(((ecdf >= band.lower[1:-1]) & (ecdf <= band.upper[1:-1])).all())
    # The band is simulated itself, from 4000 samples: a standard error of its own.
    error = np.sqrt(level * (1.0 - level) * (1.0 / 2000 + 1.0 / 4000))
    assert abs(inside / 2000 - level) < 5.0 * error


def test_ranks_are_spread_over_their_share() -> None:
    ranks = [[0, 3], [3, 3], [1, 3]]
    drawn = np.array([pit(ranks, np.random.default_rng(s)) for s in range(400)])
    low, high = drawn.min(axis=0), drawn.max(axis=0)
    np.testing.assert_allclose(low, [0.0, 0.75, 0.25], atol=0.01)
    np.testing.assert_allclose(high, [0.25, 1.0, 0.5], atol=0.01)


def test_holm() -> None:
    # The smallest is multiplied by all, the next by all but one, and order is kept.
    assert holm([0.01, 0.04, 0.03]) == pytest.approx([0.03, 0.06, 0.06])
    assert holm([0.5, 0.9]) == pytest.approx([1.0, 1.0])
