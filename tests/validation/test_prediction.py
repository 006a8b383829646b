"""Bands against quantiles formed anew from the draws."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy import stats

from calib.data import Table, table_from_arrays
from calib.errors import CalibError
from calib.inference.calibration import Calibration
from calib.validation.constants import LEVELS
from calib.validation.prediction import (
    bands,
    binomial_p,
    coverage_probability,
    effective_rows,
    ks_distance,
    median_change,
    pit_half_width,
    predict,
    prediction_columns,
    predictive_draws,
    smooth_bands,
)
from calib.validation.validate import leave_one_out


def conditions(slip, psi=30.0, **more) -> Table:
    slip = np.atleast_1d(np.asarray(slip, dtype=float))
    columns = {"slip_ratio": slip, "inflation_pressure_psi": np.full(slip.size, psi)}
    return table_from_arrays(columns | more, source="at.csv")


def test_bands_are_quantiles() -> None:
    draws = np.random.default_rng(1).standard_normal((501, 4))
    found = bands(draws)
    np.testing.assert_allclose(found.median, np.median(draws, axis=0))
    for level in LEVELS:
        np.testing.assert_allclose(found.lower[level], np.quantile(draws, 0.5 - level / 2, axis=0))
        np.testing.assert_allclose(found.upper[level], np.quantile(draws, 0.5 + level / 2, axis=0))
    # Vectors without a value are left out; where none has one, neither have the bands.
    holed = np.vstack([draws, np.full((100, 4), np.nan)])
    np.testing.assert_allclose(bands(holed).upper[0.9], found.upper[0.9])
    assert np.isnan(bands(np.full((10, 2), np.nan)).median).all()


def emulated(calibration: Calibration, sd: float) -> Calibration:
    """The calibration with a prediction that has an error of its own: sd (1 + slip)."""
    bound = calibration.problem.bound

    def uncertain(theta, at):
        curve = 1.0 + at["slip_ratio"]
        return bound.mean_response(theta, at), np.full(len(theta), sd**2), curve[:, None]

    model = replace(bound.model, uncertain=uncertain)
    return replace(
        calibration, problem=replace(calibration.problem, bound=replace(bound, model=model))
    )


def test_bands_contain_an_emulators_error(pull_calibration: Calibration) -> None:
    slip, sd = np.linspace(0.0, 0.6, 7), 0.2
    table, calibration = conditions(slip), emulated(pull_calibration, sd)
    found = predict(calibration, table)
    natural = pull_calibration.problem.theta(pull_calibration.subset(4000))
    curve = pull_calibration.problem.bound.predict(natural[:, :-1], table.columns)
    error = sd * (1.0 + slip)
    whole = np.sqrt(natural[:, -1:] ** 2 + error**2)
    for banded, scale in ((found.parameter, error), (found.predictive, whole)):
        for level in LEVELS:
            below = stats.norm.cdf(banded.upper[level], curve, scale).mean(axis=0)
            # Five standard errors of the level of a quantile of 4000 draws.
            np.testing.assert_allclose(below, 0.5 + level / 2, atol=2.5 / np.sqrt(4000))
    mean, reading = predictive_draws(calibration, table.columns, np.random.default_rng(1))
    spread = curve.var(axis=0) + error**2
    np.testing.assert_allclose(mean.var(axis=0), spread, rtol=0.12)
    more = np.mean(natural[:, -1] ** 2)
    np.testing.assert_allclose(reading.var(axis=0), spread + more, rtol=0.12)
    # A row's band does not depend on the others.
    alone = predict(calibration, conditions(slip[3]))
    assert alone.predictive.upper[0.9][0] == pytest.approx(found.predictive.upper[0.9][3])


@pytest.mark.slow
def test_rows_left_out_are_predicted_with_an_emulators_error(
    pull_calibration: Calibration,
) -> None:
    sd = 0.5
    plain = leave_one_out(pull_calibration)
    found = leave_one_out(emulated(pull_calibration, sd))
    added = (sd * (1.0 + pull_calibration.problem.conditions["slip_ratio"])) ** 2
    # Importance weights differ as well, in the parameters alone.
    more = found.draws.var(axis=0) - plain.draws.var(axis=0)
    np.testing.assert_allclose(more, added, rtol=0.25)


def test_predictive_bands_add_the_noise(pull_calibration: Calibration) -> None:
    """Where a measurement lies is a normal of each draw's sigma about each draw's curve."""
    table = conditions(np.linspace(0.0, 0.6, 12))
    found = predict(pull_calibration, table)
    natural = pull_calibration.problem.theta(pull_calibration.subset(4000))
    curve = pull_calibration.problem.bound.predict(natural[:, :-1], table.columns)
    sigma = natural[:, -1:]
    np.testing.assert_allclose(found.parameter.median, np.median(curve, axis=0))
    np.testing.assert_allclose(found.parameter.upper[0.95], np.quantile(curve, 0.975, axis=0))
    assert found.output == "drawbar_pull_kn"
    again = predict(pull_calibration, table)
    np.testing.assert_array_equal(again.predictive.upper[0.9], found.predictive.upper[0.9])
    for level in LEVELS:
        # The part of each draw's normal below the band's edge, averaged, is the band's level.
        below = stats.norm.cdf(found.predictive.upper[level], curve, sigma).mean(axis=0)
        # 4000 draws: the level of an empirical quantile varies by sqrt(p(1-p)/4000).
        p = 0.5 + level / 2
        assert np.all(np.abs(below - p) < 5.0 * np.sqrt(p * (1 - p) / 4000))
        assert np.all(found.predictive.upper[level] > found.parameter.upper[level])
        assert np.all(found.predictive.lower[level] < found.parameter.lower[level])


def test_draws_come_in_the_order_of_mean_and_measurement(rut_calibration: Calibration) -> None:
    at = rut_calibration.problem.conditions
    mean, measured = predictive_draws(rut_calibration, at, np.random.default_rng(1), size=1000)
    assert mean.shape == measured.shape == (1000, 18)
    sigma = rut_calibration.problem.theta(rut_calibration.subset(1000))[:, -1:]
    z = (np.log(measured) - np.log(mean)) / sigma
    # 18,000 standard normals, on the logarithm's scale.
    assert stats.kstest(z.ravel(), "norm").pvalue > 1e-4


def test_leaving_the_calibrated_range_is_flagged(pull_calibration: Calibration) -> None:
    calibrated = pull_calibration.problem.conditions["slip_ratio"]
    top = float(calibrated.max())
    inside = conditions([calibrated.min(), 0.1, top, top * (1 + 1e-12)])
    assert predict(pull_calibration, inside).outside == ((), (), (), ())
    slips = conditions([-0.3, top + 0.01])
    assert predict(pull_calibration, slips).outside == (("slip_ratio",),) * 2
    assert predict(pull_calibration, conditions([0.1], psi=45.0)).outside == (
        ("inflation_pressure_psi",),
    )
    both = predict(pull_calibration, conditions([0.95], psi=10.0))
    assert both.outside == (("slip_ratio", "inflation_pressure_psi"),)


def test_a_missing_condition_is_told(pull_calibration: Calibration) -> None:
    table = table_from_arrays({"slip_ratio": np.array([0.1])})
    with pytest.raises(CalibError, match="needs inflation_pressure_psi"):
        predict(pull_calibration, table)


def test_a_prediction_as_columns(pull_calibration: Calibration) -> None:
    table = conditions([0.1, 0.95], drawbar_pull_kn=np.array([1.0, 2.0]), run=np.array([1, 2]))
    found = predict(pull_calibration, table)
    columns = prediction_columns(found, table)
    assert list(columns)[:4] == [
        "slip_ratio", "inflation_pressure_psi", "run", "drawbar_pull_kn_median",
    ]  # fmt: skip
    assert len(columns) == 3 + 1 + 2 * 2 * len(LEVELS) + 1
    np.testing.assert_array_equal(
        columns["drawbar_pull_kn_predictive_95_upper"], found.predictive.upper[0.95]
    )
    np.testing.assert_array_equal(
        columns["drawbar_pull_kn_parameter_50_lower"], found.parameter.lower[0.5]
    )
    assert columns["outside_calibrated_range"] == ["", "slip_ratio"]


def test_no_band_where_the_model_has_no_value_for_much_of_the_posterior(
    pull_calibration: Calibration,
) -> None:
    far = table_from_arrays(
        {"slip_ratio": np.array([0.2, 0.2]), "inflation_pressure_psi": np.array([30.0, 120.0])}
    )
    found = predict(pull_calibration, far)
    assert found.defined[0] == 1.0
    assert np.isfinite(found.predictive.median[0])
    assert found.defined[1] < 0.95
    assert np.isnan(found.predictive.median[1])
    assert np.isnan(found.parameter.upper[0.9][1])
    assert "no value" in prediction_columns(found, far)["outside_calibrated_range"][1]


def test_smooth_bands_nest_and_match_the_draws(rut_calibration: Calibration) -> None:
    conditions = {"average_ground_pressure_kpa": np.full(5, 140.0),
                  "slip_ratio": np.linspace(0, 0.2, 5)}  # fmt: skip
    mean, measured = smooth_bands(rut_calibration, conditions)
    for outer, inner in ((0.95, 0.9), (0.9, 0.5)):
        assert (measured.lower[outer] < measured.lower[inner]).all()
        assert (measured.upper[outer] > measured.upper[inner]).all()
    assert (mean.upper[0.9] < measured.upper[0.9]).all()
    assert (np.diff(mean.median) > 0).all()
    natural = rut_calibration.problem.theta(rut_calibration.draws.flat)
    exact = rut_calibration.problem.bound.predict(natural[:, :-1], conditions)
    assert mean.median == pytest.approx(np.median(exact, axis=0), rel=0.01)


def test_the_median_changes_as_the_equation_does(rut_calibration: Calibration) -> None:
    problem = rut_calibration.problem
    ends = np.quantile(problem.table["slip_ratio"], [0.1, 0.9])
    pressure = np.median(problem.table["average_ground_pressure_kpa"])
    at = {"average_ground_pressure_kpa": np.full(2, pressure), "slip_ratio": ends}
    natural = problem.theta(rut_calibration.draws.flat)
    low, high = np.median(problem.bound.predict(natural[:, :-1], at), axis=0)
    assert median_change(rut_calibration, "slip_ratio") == pytest.approx(high - low, rel=0.02)
    assert median_change(rut_calibration, "average_ground_pressure_kpa") > 0.0


# References for rows that are not independent


@pytest.fixture
def independent() -> np.ndarray:
    return np.random.default_rng(1).standard_normal((4000, 12))


@pytest.fixture
def shared() -> np.ndarray:
    """Rows that move as one."""
    rng = np.random.default_rng(2)
    return rng.standard_normal((4000, 1)) + 0.01 * rng.standard_normal((4000, 12))


def test_independent_rows_give_the_kolmogorov_law(independent):
    assert pit_half_width(independent) == pytest.approx(stats.kstwo.ppf(0.95, 12), rel=0.04)


def test_independent_rows_give_the_binomial_law(independent):
    found = coverage_probability(independent, 9, 0.9)
    assert found == pytest.approx(stats.binom.cdf(9, 12, 0.9), abs=0.02)


def test_rows_that_move_as_one_miss_as_one(shared):
    # All twelve outside happens one time in ten, where the binomial law says 1e-12.
    assert coverage_probability(shared, 0, 0.9) == pytest.approx(0.1, abs=0.02)
    assert pit_half_width(shared) > 0.9


def test_effective_rows(independent, shared):
    assert effective_rows(independent) == pytest.approx(12, abs=0.6)
    assert effective_rows(shared) == pytest.approx(1, abs=0.01)
    assert effective_rows(shared[:, :1]) == 1


def test_draws_without_a_value_are_left_out(independent):
    holed = independent.copy()
    holed[::50, 3] = np.nan
    assert coverage_probability(holed, 12, 0.9) == pytest.approx(1.0)
    assert np.isfinite(effective_rows(holed))


def test_ks_distance_of_known_values():
    assert ks_distance(np.array([0.5])) == pytest.approx(0.5)
    assert ks_distance(np.array([0.25, 0.75])) == pytest.approx(0.25)
    assert ks_distance(np.array([[0.9, 0.95], [0.25, 0.75]])) == pytest.approx([0.9, 0.25])


def test_binomial_p():
    assert binomial_p(14, 14) == pytest.approx(1.0)
    assert binomial_p(9, 14) == pytest.approx(0.0092, abs=0.0005)
    assert binomial_p(9, 14, 0.5) == pytest.approx(stats.binom.cdf(9, 14, 0.5), rel=1e-12)
    assert np.isnan(binomial_p(0, 0))
