"""How the posterior of a parameter is written."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from calib.inference.calibration import Calibration, ParameterSummary
from calib.inference.diagnostics import hdi, hdi_error, median_error
from calib.report.numbers import centre_text, interval_text, skewed


def summary(mean, sd, low, high, median=2.0) -> ParameterSummary:
    return ParameterSummary(
        "C1", "kPa", mean, sd, median, low, high, 900.0, 900.0, 1.0, 0.1, float("nan")
    )


@pytest.mark.parametrize(
    ("s", "expected"),
    [
        (summary(2.1, 0.5, 1.2, 3.1), False),
        (summary(2.4, 0.9, 1.2, 3.7), True),
        (summary(-2.4, 0.9, -3.7, -1.2, -2.0), True),
        (summary(1.6, 0.9, 0.3, 2.8), True),
        (summary(0.05, 0.29, -0.5, 0.6, 0.05), False),
        (summary(2.0, 1.0, 0.1, 3.5), True),
        (summary(-2.0, 1.0, -3.5, -0.1, -2.0), True),
        (summary(2.0, 1.0, 0.13, 3.5), False),
        (summary(2.0, 1.0, -0.01, 3.5), False),
    ],
)
def test_where_a_mean_would_mislead(s, expected):
    assert skewed(s) is expected


def test_a_well_behaved_parameter():
    s = replace(summary(1.64812, 0.0251, 1.6012, 1.6949, 1.648), mcse_mean=0.0004,
                mcse_hdi_lower=0.0006, mcse_hdi_upper=0.0009)  # fmt: skip
    assert centre_text(s) == "1.648 ± 0.025"
    assert interval_text(s) == "1.601 to 1.695"


def test_ends_are_shown_no_finer_than_their_monte_carlo_error():
    s = replace(summary(1.64812, 0.0251, 1.6012, 1.6949, 1.648), mcse_mean=0.0004,
                mcse_hdi_lower=0.0006, mcse_hdi_upper=0.0015)  # fmt: skip
    assert interval_text(s) == "1.60 to 1.69"


def test_a_skewed_parameter_has_its_median_and_a_lower_end_that_is_nothing():
    s = replace(summary(5e-9, 9.5e-8, 2.6e-21, 1.09e-8, 8.13e-11), mcse_median=9e-13,
                mcse_hdi_lower=1e-13, mcse_hdi_upper=4e-10)  # fmt: skip
    assert centre_text(s) == "median 8.1\N{MULTIPLICATION SIGN}10⁻¹¹"
    assert interval_text(s) == "0 to 1.1\N{MULTIPLICATION SIGN}10⁻⁸"


def test_a_tail_of_many_decades_does_not_round_the_median_away():
    s = replace(summary(1.2e12, 1.0e14, 3.52e3, 1.2e8, 6.598e5), mcse_median=5e3,
                mcse_hdi_lower=300.0, mcse_hdi_upper=5e6)  # fmt: skip
    times = "\N{MULTIPLICATION SIGN}"
    assert centre_text(s) == f"median 6.6{times}10⁵"
    assert interval_text(s).endswith(f"1.2{times}10⁸")


@pytest.mark.parametrize("kind", ["normal", "lognormal"])
def test_monte_carlo_errors_are_those_of_repeated_sampling(kind):
    rng = np.random.default_rng(3)
    draws = rng.standard_normal((300, 16, 250))
    draws = np.exp(draws) if kind == "lognormal" else draws
    ends = np.array([hdi(d.ravel(), 0.95) for d in draws])
    stated = np.array([hdi_error(d, 0.95) for d in draws]).mean(axis=0)
    actual = ends.std(axis=0)
    assert (stated > 0.8 * actual).all()
    assert (stated < 2.0 * actual).all()
    medians = np.median(draws.reshape(300, -1), axis=1).std()
    assert np.mean([median_error(d) for d in draws]) == pytest.approx(medians, rel=0.15)


def test_every_parameter_of_a_calibration_has_its_errors(rut_calibration: Calibration):
    ensembles = rut_calibration.draws.t.shape[0]
    for name, s in rut_calibration.summary.items():
        assert 0.0 < s.mcse_median < 0.2 * s.sd
        values = rut_calibration.parameters[name].reshape(ensembles, -1)
        between = np.array([hdi(v, 0.95) for v in values]).std(axis=0, ddof=1)
        for error, scatter in zip((s.mcse_hdi_lower, s.mcse_hdi_upper), between, strict=True):
            # The ensembles' own scatter, from four of them, allows no closer comparison.
            assert error > 0.1 * scatter
            assert error < 0.5 * s.sd
