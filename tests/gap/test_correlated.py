"""Rows that are correlated along a run."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from scipy.stats import multivariate_normal

from calib.data import table_from_arrays
from calib.data.quantities import OUTPUTS
from calib.errors import CalibError
from calib.gap.campaigns import campaigns
from calib.gap.case import Case
from calib.gap.constants import CORRELATIONS
from calib.gap.diagnose import Diagnosis, diagnose_once
from calib.gap.effects import EFFECTS
from calib.gap.fit import Residuals
from calib.gap.forward import Forward
from calib.gap.hypotheses import Hypothesis
from calib.gap.noise import Noise, NoiseConditions, ln_averaged, ln_prior, most_probable
from calib.inference.prior_files import DeclaredPriors, default_priors
from tests.gap.cases import LARGE, simulate

RUNS, ROWS = 4, 12
ASKED = (
    default_priors("magic_formula").read_text() + '\n[likelihood]\ncorrelated_along = "run_order"\n'
)
RHO = """
[parameters.rho]
dist = "fixed"
value = 0.6
unit = "1"
reason = "Measured before"
source = "A test"
"""
FEW = {
    name: EFFECTS[name] for name in ("force_offset", "lug_thrust", "rate_effect", "load_transfer")
}


def conditions(speeds: list[float]) -> dict[str, np.ndarray]:
    """Runs in which slip grows, each at a pressure and a speed of its own."""
    psi = np.repeat(np.resize([18.0, 30.0, 42.0], RUNS), ROWS)
    return {
        "run": np.repeat(np.arange(RUNS, dtype=float), ROWS),
        "run_order": np.tile(np.arange(ROWS, dtype=float), RUNS),
        "slip_ratio": np.tile(np.linspace(0.02, 0.6, ROWS), RUNS),
        "inflation_pressure_psi": psi,
        "average_ground_pressure_kpa": 30.0 * psi**0.5,
        "normal_load_kn": np.full(psi.size, 5.0),
        "speed_m_s": np.repeat(np.resize(speeds, RUNS), ROWS),
    }


def correlated_case(effect: str | None, seed: int, rho: float = 0.8, *, asked: bool = True) -> Case:
    """Simulate pulls with an autoregressive noise of 0.05 kN."""
    rng = np.random.default_rng([seed, 77])
    both = [conditions([0.3]), conditions([0.1, 0.3, 1.0, 2.0])]
    column, models = OUTPUTS["drawbar_pull"], {"drawbar_pull": "magic_formula"}
    placed = [table_from_arrays({**c, column: np.linspace(1.0, 2.0, RUNS * ROWS)}) for c in both]
    tables = []
    for c, location in zip(both, simulate(Case("", *placed, models), effect), strict=True):
        noise = rng.standard_normal((RUNS, ROWS))
        for i in range(1, ROWS):
            noise[:, i] = rho * noise[:, i - 1] + np.sqrt(1.0 - rho**2) * noise[:, i]
        pull = location["drawbar_pull"] + 0.05 * noise.ravel()
        tables.append(table_from_arrays({**c, column: pull}))
    priors = {"drawbar_pull": DeclaredPriors("own.toml", ASKED)} if asked else {}
    return Case(effect or "null", tables[0], tables[1], models, priors=priors)


@cache
def diagnosed(effect: str | None, seed: int, *, asked: bool) -> Diagnosis:
    """Diagnose a case, judged on its own rows."""
    return diagnose_once(correlated_case(effect, seed, asked=asked), 1, FEW)


def dense(noise: Noise, at: NoiseConditions) -> np.ndarray:
    """Covariance of the rows of one run after the other, written out."""
    place = np.tile(np.arange(ROWS), at.slip.size // ROWS)
    run = np.arange(at.slip.size) // ROWS
    apart = np.abs(place[:, None] - place)
    correlation = np.where(run[:, None] == run, noise.correlation**apart, 0.0)
    return noise.sd(at)[:, None] * correlation * noise.sd(at)


def at_rows() -> NoiseConditions:
    """Return what the noise of the case's rows depends on."""
    return campaigns(correlated_case(None, 1)).at_rows["drawbar_pull"]


def test_it_is_averaged_over_as_by_quadrature_of_dense_covariances():
    at = at_rows()
    raw = 0.05 * np.random.default_rng(5).standard_normal(at.slip.size)
    # Equally probable correlations of an even prior up to 0.99.
    correlations = 0.99 * (np.arange(CORRELATIONS) + 0.5) / CORRELATIONS
    np.testing.assert_allclose(at.along.correlations, correlations)
    ln_sigma = np.linspace(np.log(0.05) - 2.0, np.log(0.05) + 3.0, 801)
    expected = 0.0
    for noise in at.grid:
        covariance = dense(noise, at)
        squares = raw @ np.linalg.solve(covariance, raw)
        unit = multivariate_normal.logpdf(raw, cov=covariance) + 0.5 * squares
        ln_density = unit - raw.size * ln_sigma - 0.5 * squares * np.exp(-2.0 * ln_sigma)
        share = np.sqrt(raw.size / np.pi) * np.exp(ln_prior(noise)) / CORRELATIONS
        expected += share * np.trapezoid(np.exp(ln_density), ln_sigma)
    found = ln_averaged(at.products(raw, raw)[None], at)
    np.testing.assert_allclose(found, np.log(expected), rtol=1e-6)


@pytest.mark.parametrize("rho", [0.0, 0.5, 0.9])
def test_the_most_probable_correlation_is_near_the_true_one(rho: float):
    data = campaigns(correlated_case(None, 3, rho))
    at = data.at_rows["drawbar_pull"]
    noise = np.linalg.cholesky(dense(Noise(0.05, correlation=rho), at))
    raw = noise @ np.random.default_rng(8).standard_normal((at.slip.size, 200))
    found = [n.correlation for n in most_probable(at.products(raw.T, raw.T), at)]
    assert np.mean(found) == pytest.approx(rho, abs=0.1)


def test_residuals_are_made_independent():
    data = campaigns(correlated_case(None, 1))
    noise = {"drawbar_pull": Noise(0.05, 1.0, 0.0, 0.7)}
    at = data.at_rows["drawbar_pull"]
    root = np.linalg.cholesky(dense(noise["drawbar_pull"], at))
    forward = Forward(data, Hypothesis("none"), {"drawbar_pull": 0.05})
    white = Residuals(data, forward).whitening(noise)
    np.testing.assert_allclose(white(root.T) @ white(root.T).T, np.eye(at.slip.size), atol=1e-9)
    assert white.ln_scale == pytest.approx(np.log(np.diag(root)).sum())


def test_correlated_rows_are_no_gap_once_it_is_said():
    quiet = [diagnosed(None, seed, asked=True).ranking.probability["none"] for seed in range(4)]
    taken_as_independent = diagnosed(None, 2, asked=False).ranking.probability["none"]
    assert min(quiet) > 0.9
    assert taken_as_independent < 0.1


def test_a_cause_is_found_among_correlated_rows():
    assert "lug_thrust" in LARGE
    found = diagnosed("lug_thrust", 1, asked=True)
    assert found.ranking.order[0] == "lug_thrust"
    assert found.ranking.best("lug_thrust").noise["drawbar_pull"].correlation > 0.5


def test_it_is_said_that_rows_depend_on_each_other_unless_the_noise_says_so():
    assert [d.title for d in diagnosed(None, 2, asked=False).doubts] == [
        "Rows depend on each other"
    ]
    assert not any(diagnosed(None, seed, asked=True).doubts for seed in range(4))
    # Places in the order are of each run by itself.
    assert not [w for w in diagnosed(None, 0, asked=True).warnings if "same run_order" in w]


def test_an_order_is_needed_in_the_field_too():
    case = correlated_case(None, 1)
    columns = {k: v for k, v in case.field.columns.items() if k != "run_order"}
    with pytest.raises(CalibError, match="run_order"):
        campaigns(replace(case, field=table_from_arrays(columns)))


def test_a_known_correlation_is_taken_as_it_is():
    text = ASKED + RHO
    case = replace(correlated_case(None, 1), priors={"drawbar_pull": DeclaredPriors("", text)})
    at = campaigns(case).at_rows["drawbar_pull"]
    assert {noise.correlation for noise in at.grid} == {0.6}
