"""Residuals over the noise, and what is tested of them."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import stats

from calib.inference.calibration import Calibration
from calib.validation.residuals import normal_order, normality_p, spreads, standardise


def test_sorted_normals_lie_where_they_are_expected() -> None:
    middle, low, high = normal_order(15)
    drawn = np.sort(np.random.default_rng(1).standard_normal((20_000, 15)), axis=1)
    assert middle == pytest.approx(drawn.mean(axis=0), abs=0.03)
    assert low == pytest.approx(np.quantile(drawn, 0.025, axis=0), abs=0.08)
    assert high == pytest.approx(np.quantile(drawn, 0.975, axis=0), abs=0.08)


def test_normality_is_doubted_of_what_is_not_normal() -> None:
    u = (np.arange(60) + 0.5) / 60.0
    assert normality_p(stats.norm.ppf(u)) > 0.9
    assert normality_p(stats.expon.ppf(u)) < 1e-3
    assert np.isnan(normality_p(np.array([0.1, -0.2])))


def test_the_spread_is_compared_between_groups(rut_calibration: Calibration) -> None:
    problem = rut_calibration.problem
    predicted = standardise(rut_calibration, problem).predicted
    raw = np.log(problem.observed / predicted)
    first, n = np.arange(len(raw)) < 9, len(raw)
    sd, p = spreads(problem, predicted, (first, ~first))
    assert sd == pytest.approx([raw[first].std(ddof=1), raw[~first].std(ddof=1)])
    assert p == pytest.approx(stats.levene(raw[first], raw[~first]).pvalue)
    few = np.arange(n) < 4
    sd, p = spreads(problem, predicted, (few, ~few))
    assert np.isnan(sd).tolist() == [True, False]
    assert np.isnan(p)
