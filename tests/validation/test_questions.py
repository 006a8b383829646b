"""Probabilities, quantiles and peaks of predictions, against closed forms and drawn readings."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy import stats

import calib
from calib.data import table_from_arrays
from calib.errors import CalibError
from calib.inference.calibration import Calibration, calibrate
from calib.inference.likelihood import Noise
from calib.inference.prior_files import DeclaredPriors, default_priors
from calib.inference.priors import Priors
from calib.inference.problem import build_problem
from calib.inference.sampler import SamplerSettings
from calib.validation.prediction import combine, predict, predict_prior, predict_stacked
from calib.validation.questions import Drawn, Sample, Weights
from tests.conftest import he2019_table
from tests.custom_problems import fixed, normal, problem_of

SIGMA = 0.3
MEAN, SD = np.array([1.0, -1.0]), np.array([2.0, 5.0])
SLIP = np.linspace(-0.1, 0.7, 15)
AT = np.array([0.0, 0.3, 0.6])
VALUES = (-0.2, 0.5, 0.75, 1.6)


def design(slip: np.ndarray) -> np.ndarray:
    return np.column_stack([np.ones_like(slip), slip])


@pytest.fixture(scope="module")
def line() -> Calibration:
    pull = design(SLIP) @ [0.5, 0.6] + SIGMA * np.random.default_rng(8).standard_normal(SLIP.size)
    priors = [normal(n, m, s) for n, m, s in zip("ab", MEAN, SD, strict=True)]
    found = calibrate(
        problem_of(lambda a, b, x: a + b * x, [*priors, fixed("sigma", SIGMA)], SLIP, pull), 1
    )
    assert found.converged
    return found


@pytest.fixture(scope="module")
def exact(line: Calibration) -> tuple[np.ndarray, np.ndarray]:
    """Mean (n,) and covariance (n, n) of the line at `AT`."""
    X = design(SLIP)
    covariance = np.linalg.inv(X.T @ X / SIGMA**2 + np.diag(SD**-2.0))
    mean = covariance @ (X.T @ line.problem.observed / SIGMA**2 + MEAN / SD**2)
    return design(AT) @ mean, design(AT) @ covariance @ design(AT).T


def at(slip: np.ndarray, **more: np.ndarray) -> calib.Table:
    return table_from_arrays({"slip_ratio": slip, **more}, source="at.csv")


def off(chance, value) -> np.ndarray:
    return np.abs((chance.value - value) / chance.error)


@pytest.mark.parametrize("value", VALUES)
def test_probabilities_are_those_of_the_normal_posterior(line, exact, value) -> None:
    mean, covariance = exact
    found = predict(line, at(AT)).probability(">", value)
    below = predict(line, at(AT)).probability("<", value)
    for kind, noise in (("mean", 0.0), ("reading", SIGMA**2)):
        chance, sd = getattr(found, kind), np.sqrt(np.diag(covariance) + noise)
        assert (off(chance, stats.norm.sf(value, mean, sd)) < 5.0).all()
        np.testing.assert_allclose(getattr(below, kind).value, 1.0 - chance.value, atol=1e-12)
        # Of rows together, which the line has in common; a matrix of rank two, so nudged.
        whole = covariance + (noise + 1e-9) * np.eye(AT.size)
        together = stats.multivariate_normal(-mean, whole, allow_singular=True, seed=1)
        assert off(getattr(found, f"{kind}_everywhere"), together.cdf(-np.full(3, value))) < 5.0
    # The reading's is exact to the error of its mean over draws, not of drawn readings.
    assert (found.reading.error < 0.6 * 0.5 / np.sqrt(4000)).all()


def test_each_row_may_have_a_value_of_its_own(line, exact) -> None:
    found = predict(line, at(AT)).probability(">", exact[0])
    assert (off(found.mean, 0.5) < 5.0).all()
    assert (off(found.reading, 0.5) < 5.0).all()


@pytest.mark.parametrize("kept", [0.0, 0.9])
def test_errors_are_as_large_as_what_they_are_errors_of(kept: float) -> None:
    """Of draws in chains that remember, too: 300 times four chains of 1000."""
    rng, errors, naive = np.random.default_rng(1), [], []
    block = np.arange(4000) // 250
    for _ in range(300):
        z = rng.standard_normal((1000, 4))
        for i in range(1, 1000):
            z[i] = kept * z[i - 1] + np.sqrt(1.0 - kept**2) * z[i]
        values = z.T.reshape(-1, 1)
        sample = Sample(values, Weights(np.full(4000, 1.0 / 4000), block, 4000.0))
        chance = sample.probability(">", 1.0)
        errors.append((chance.value - stats.norm.sf(1.0))[0] / chance.error[0])
        p = chance.value[0]
        naive.append((p - stats.norm.sf(1.0)) / np.sqrt(p * (1 - p) / 4000))
    # Those of Student's t with 15 degrees of freedom have the variance 15/13.
    spread = np.mean(np.square(errors)) / (15.0 / 13.0)
    assert 0.75 < spread < 1.35, spread
    if kept:
        assert np.mean(np.square(naive)) > 5.0


def test_none_of_the_draws_is_no_certainty(line) -> None:
    found = predict(line, at(AT)).probability(">", 50.0)
    assert found.mean.value.tolist() == [0.0] * 3
    # A probability of 1e-4 leaves 4000 draws without one in two cases of three.
    assert (found.mean.error > 1e-4).all()
    assert (found.reading.error > 1e-4).all()
    certain = predict(line, at(AT)).probability("<", 50.0)
    assert certain.mean.value.tolist() == [1.0] * 3
    assert (certain.mean.error > 1e-4).all()


@pytest.fixture(scope="module")
def heavy() -> Calibration:
    """Ruts with Student-t noise on their logarithms, few draws."""
    text = default_priors("bekker").read_text(encoding="utf-8")
    priors = DeclaredPriors("t.toml", f'{text}\n[likelihood]\nfamily = "student_t"\n')
    few = SamplerSettings(steps=100, max_steps=100)
    return calibrate(build_problem("bekker", he2019_table("rut_depth"), priors), 1, settings=few)


@pytest.mark.parametrize("name", ["rut_calibration", "pull_calibration", "heavy"])
def test_probabilities_are_those_of_drawn_readings(name, request) -> None:
    calibration = request.getfixturevalue(name)
    problem = calibration.problem
    rows = np.linspace(0, len(problem.table) - 1, 6).astype(int)
    prediction = predict(calibration, problem.table.take(rows))
    value = float(np.median(problem.observed[rows]))
    found, drawn = prediction.probability(">", value), prediction.draws(4000)
    theirs = drawn.probability(">", value)
    np.testing.assert_allclose(found.mean.value, theirs.mean.value)
    for kind in ("reading", "reading_everywhere"):
        one, other = getattr(found, kind), getattr(theirs, kind)
        error = np.hypot(one.error, other.error)
        assert (np.abs(one.value - other.value) < 5.0 * error).all(), kind
    assert np.ptp(found.reading.value) > 0.1
    if problem.bound.model.response == "log":
        assert (prediction.probability(">", 0.0).reading.value == 1.0).all()


def test_quantiles_are_those_of_the_bands(pull_calibration: Calibration) -> None:
    prediction = predict(pull_calibration, pull_calibration.problem.table)
    low, high = prediction.quantile([0.05, 0.95]).reading
    np.testing.assert_allclose(low, prediction.predictive.lower[0.9], rtol=1e-12)
    np.testing.assert_allclose(high, prediction.predictive.upper[0.9], rtol=1e-12)
    middle = prediction.quantile(0.5).mean
    np.testing.assert_allclose(middle, prediction.parameter.median, rtol=1e-12)
    few = prediction.draws(1000)
    assert few.mean.values.shape == (1000, len(middle))
    # Fewer draws, evenly picked: to six standard errors of the median of 1000.
    error = 6.0 * 1.2533 * few.mean.values.std(axis=0) / np.sqrt(1000)
    assert (np.abs(few.quantile(0.5).mean - middle) < error).all()


def test_where_the_model_has_no_value_nothing_is_said(pull_calibration: Calibration) -> None:
    far = at(np.array([0.2, 0.2]), inflation_pressure_psi=np.array([30.0, 120.0]))
    prediction = predict(pull_calibration, far)
    for found in (prediction.probability(">", 1.0), prediction.draws(500).probability(">", 1.0)):
        for chance in (found.mean, found.reading):
            assert np.isfinite(chance.value).tolist() == [True, False]
            assert np.isfinite(chance.error).tolist() == [True, False]
        assert np.isnan(found.mean_everywhere.value)
    assert np.isnan(prediction.draws(500).quantile([0.1, 0.9]).mean[:, 1]).all()


def test_noise_that_is_correlated_needs_the_order_of_rows(line) -> None:
    """Readings of neighbours are alike, so both lie above more often than apart."""
    p = line.problem
    entries = (*p.priors.entries[:-1], fixed("rho", 0.9), p.priors.entries[-1])
    noise = Noise(correlated_along="run_order")
    problem = replace(p, priors=Priors(entries, noise=noise), noise=noise)
    correlated = replace(line, problem=problem)
    prediction = predict(correlated, at(AT))
    found = prediction.probability(">", 0.75)
    assert np.isnan(found.reading_everywhere.value)
    np.testing.assert_allclose(
        found.reading.value, predict(line, at(AT)).probability(">", 0.75).reading.value
    )
    with pytest.raises(CalibError, match="correlated along run_order, and the data have no"):
        prediction.draws()
    # The mean has no noise, and so a peak whatever the order.
    assert prediction.peak("slip_ratio").output.quantile([0.5]).size == 1
    near = at(np.full(2, 0.3), run_order=np.array([1.0, 2.0]))
    drawn = predict(correlated, near).draws(4000)
    left = drawn.reading.values - drawn.mean.values
    assert np.corrcoef(left.T)[0, 1] == pytest.approx(0.9, abs=0.02)
    apart = predict(line, near).draws(4000)
    assert drawn.reading.everywhere(">", 0.75).value > apart.reading.everywhere(">", 0.75).value


def test_a_stack_is_certain_of_its_weights(line) -> None:
    """One part lies above, one below: the share above is the weight, which has no error."""
    shift = replace(
        line.problem.bound.model, mean_response=lambda x, a, b: a + b * x["slip_ratio"] - 9
    )
    bound = replace(line.problem.bound, model=shift)
    low = replace(line, problem=replace(line.problem, bound=bound))
    found = predict_stacked([(0.7, line), (0.3, low)], at(AT)).probability(">", -4.0)
    np.testing.assert_allclose(found.mean.value, 0.7)
    # Blocks differ by a draw or two; a part drawn anew each time would give 0.007.
    assert (found.mean.error < 0.002).all()


def drawn_curves(place: np.ndarray, x: np.ndarray) -> Drawn:
    """Parabolas about places (size,), at slips x (n,), for two pressures the second first."""
    slip = np.concatenate([x, x[::-1]])
    psi = np.repeat([30.0, 20.0], x.size)
    values = 3.0 - 2.0 * (slip - place[:, None]) ** 2 + psi / 10.0
    w = Weights(np.full(place.size, 1.0 / place.size), np.arange(place.size) % 16, place.size)
    conditions = {"slip_ratio": slip, "inflation_pressure_psi": psi}
    return Drawn(conditions, Sample(values, w), Sample(values, w))


def test_the_peak_of_a_parabola_is_its_vertex() -> None:
    place = np.linspace(0.11, 0.59, 400)
    x = np.array([0.0, 0.1, 0.2, 0.35, 0.5, 0.7])
    found = drawn_curves(place, x).peak("slip_percent")
    assert found.conditions["inflation_pressure_psi"].tolist() == [30.0, 20.0]
    np.testing.assert_allclose(found.at.values, 100.0 * np.tile(place[:, None], 2))
    np.testing.assert_allclose(found.output.values, np.tile([6.0, 5.0], (400, 1)))
    assert found.inside.value.tolist() == [1.0, 1.0]
    half = np.linspace(0.11, 1.29, 400)
    beyond = drawn_curves(half, x).peak("slip_percent")
    assert (off(beyond.inside, 0.5) < 3.0).all()
    assert (beyond.at.values.max(axis=0) == 70.0).all()


def test_peaks_are_those_of_a_fine_grid(pull_calibration: Calibration) -> None:
    slip = np.linspace(0.0, 0.6, 61)
    coarse, fine = (
        predict(pull_calibration, at(x, inflation_pressure_psi=np.full(x.size, 20.0))).draws(500)
        for x in (slip, np.linspace(0.0, 0.6, 601))
    )
    best = coarse.peak("slip_ratio").at.values[:, 0]
    theirs = fine.conditions["slip_ratio"][fine.mean.values.argmax(axis=1)]
    np.testing.assert_allclose(best, theirs, atol=0.002)


def test_functions_of_outputs_are_formed_draw_by_draw(line) -> None:
    """Of one posterior the difference has no doubt left; of two posteriors it has both."""
    mine = predict(line, at(AT))
    same = combine({"a": mine, "b": mine}, lambda a, b: a - b, size=4000)
    assert not same.mean.values.any()
    other = predict(calibrate(line.problem, 1), at(AT))  # of the same seed
    apart = combine({"a": mine, "b": other}, lambda a, b: a - b, size=4000)
    sd = mine.draws(4000).mean.values.std(axis=0)
    np.testing.assert_allclose(apart.mean.values.std(axis=0), np.sqrt(2.0) * sd, rtol=0.08)
    with pytest.raises(CalibError, match=r"returned the shape \(3,\)"):
        combine({"a": mine}, lambda a: a[0])
    with pytest.raises(CalibError, match="differ in their rows"):
        combine({"a": mine, "b": predict(line, at(AT[:2]))}, lambda a, b: a - b[:, :1])
    with pytest.raises(CalibError, match="differ in their rows"):
        combine({"a": mine, "b": predict(line, at(AT[::-1]))}, lambda a, b: a - b)


def test_what_priors_expect_is_said_without_data() -> None:
    conditions = {"average_ground_pressure_kpa": [100.0, 150.0], "slip_ratio": [0.1, 0.2]}
    found = calib.predict("modified_bekker", conditions)
    problem = found._parts[0].problem
    natural = problem.theta(problem.priors.sample(np.random.default_rng(1), 20_000))
    curve = problem.bound.predict(natural[:, :-1], problem.conditions)
    reading = curve * np.exp(
        natural[:, -1:] * np.random.default_rng(2).standard_normal(curve.shape)
    )
    for banded, drawn in ((found.parameter, curve), (found.predictive, reading)):
        level = (drawn < banded.upper[0.9]).mean(axis=0)
        np.testing.assert_allclose(level, 0.95, atol=5.0 * np.sqrt(0.95 * 0.05 / 4000))
    assert found.outside == ((), ())
    p, many = found.probability(">", 30.0).mean, (curve > 30.0).mean(axis=0)
    assert (np.abs(p.value - many) < 5.0 * np.hypot(p.error, 0.5 / np.sqrt(20_000))).all()
    # Where a quadratic would turn negative there is no fit either.
    ends = {"slip_ratio": [0.1, 0.2, 0.4], "inflation_pressure_psi": [30.0, 30.0, 25.0]}
    assert (calib.predict("magic_formula_pressure", ends).defined == 1.0).all()


def test_what_is_no_question_is_refused(line) -> None:
    prediction = predict(line, at(AT))
    for sign, value in (("above", 1.0), (">", "much"), (">", np.nan), (">", [1.0, 2.0])):
        with pytest.raises(CalibError, match="is no comparison"):
            prediction.probability(sign, value)
    for level in (0.0, 1.0, [0.5, np.nan], 90):
        with pytest.raises(CalibError, match="there is no quantile"):
            prediction.quantile(level)
    for over in ("inflation_pressure_psi", "operator"):
        with pytest.raises(CalibError, match="no condition"):
            prediction.peak(over)
    with pytest.raises(CalibError, match="2 values of slip_ratio cannot show a peak"):
        predict(line, at(AT[:2])).peak("slip_ratio")
    with pytest.raises(CalibError, match="priors are for a model"):
        calib.predict(line, at(AT), priors="my.toml")
    with pytest.raises(CalibError, match="no column for"):
        calib.predict("bekker", at(AT))
    assert predict_prior(line.problem, at(AT)).outside == ((), (), ())
