"""Scores against their definitions and against closed forms."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import stats

from calib.inference.calibration import Calibration, calibrate
from calib.inference.io import to_datatree
from calib.inference.sampler import SamplerSettings
from calib.validation.constants import CONTRACTION_MIN, LEVELS, SENSITIVITY_MIN
from calib.validation.scores import (
    Sensitivity,
    coverage,
    crps,
    normal_order,
    pit,
    prior_sensitivity,
    score,
)
from tests.custom_problems import fixed, normal, problem_of


def test_crps_is_its_definition() -> None:
    rng = np.random.default_rng(1)
    draws, observed = rng.gamma(2.0, size=(60, 7)), rng.gamma(2.0, size=7)
    for j in range(7):
        x = draws[:, j]
        expected = np.abs(x - observed[j]).mean() - 0.5 * np.abs(x[:, None] - x).mean()
        assert crps(draws, observed)[j] == pytest.approx(expected, rel=1e-12)


@pytest.mark.parametrize("y", [-2.0, 0.0, 0.3, 4.0])
def test_crps_of_a_normal(y: float) -> None:
    """Gneiting & Raftery (2007), Eq 21: sigma [z (2 Phi(z) - 1) + 2 phi(z) - 1/sqrt(pi)]."""
    mu, sigma = 0.5, 1.5
    z = (y - mu) / sigma
    expected = sigma * (z * (2.0 * stats.norm.cdf(z) - 1.0) + 2.0 * stats.norm.pdf(z) - np.pi**-0.5)
    # Quantiles in place of draws: the error falls as 1/m instead of 1/sqrt(m).
    m = 20_000
    draws = stats.norm.ppf((np.arange(m) + 0.5) / m, mu, sigma)[:, None]
    assert crps(draws, np.array([y]))[0] == pytest.approx(expected, abs=1e-3)


@pytest.mark.parametrize(("hits", "n"), [(9, 14), (1, 30), (50, 100), (0, 5), (5, 5)])
def test_coverage_has_the_jeffreys_interval_closed_at_none_and_all(hits: int, n: int) -> None:
    draws = np.tile(np.linspace(-1.0, 1.0, 201)[:, None], n)
    observed = np.where(np.arange(n) < hits, 0.0, 5.0)
    found = coverage(draws, observed, 0.9)
    assert (found.hits, found.n, found.proportion) == (hits, n, hits / n)
    low, high = stats.beta.interval(0.95, hits + 0.5, n - hits + 0.5)
    expected = [low if hits else 0.0, high if hits < n else 1.0]
    np.testing.assert_allclose([found.lower, found.upper], expected, rtol=1e-10)


@pytest.mark.parametrize("level", LEVELS)
def test_bands_are_central(level: float) -> None:
    draws = np.arange(10_001.0)[:, None]
    low, high = 10_000 * (0.5 - level / 2), 10_000 * (0.5 + level / 2)
    for y, inside in ((low - 1, 0), (low + 1, 1), (high - 1, 1), (high + 1, 0)):
        assert coverage(draws, np.array([y]), level).hits == inside


def test_pit_is_the_part_below() -> None:
    draws = np.arange(10.0)[:, None] * np.ones(3)
    np.testing.assert_allclose(pit(draws, np.array([-1.0, 3.5, 20.0])), [0.0, 0.4, 1.0])


def simulated(spread: float) -> tuple[np.ndarray, np.ndarray]:
    """Draws of 400 normals of various widths, and observations `spread` times as wide."""
    rng = np.random.default_rng(7)
    mean, sd = rng.normal(size=400), rng.uniform(0.5, 2.0, 400)
    return mean + sd * rng.standard_normal((2000, 400)), mean + spread * sd * rng.normal(size=400)


@pytest.mark.parametrize("spread", [0.5, 1.0, 2.0])
def test_miscalibrated_predictions_are_noticed_and_others_are_not(spread: float) -> None:
    """A calibrated method fails either line with probability 1e-3 or less, at one fixed seed."""
    found = score(*simulated(spread))
    p = stats.kstest(found.pit, "uniform").pvalue
    covered = {v: stats.binomtest(c.hits, c.n, v).pvalue for v, c in found.coverage.items()}
    if spread == 1.0:
        assert min(p, *covered.values()) > 1e-3
    else:
        assert max(p, covered[0.5]) < 1e-3


def test_relative_errors_leave_out_what_is_near_zero() -> None:
    observed = np.array([2.0, -1.0, 0.1, 0.11, 0.0])
    draws = np.tile([2.2, -0.9, 5.0, 0.088, 1.0], (5, 1))
    found = score(draws, observed)
    # A twentieth of the largest is 0.1, which is not above itself.
    np.testing.assert_allclose(found.relative_error, [0.1, -0.1, np.nan, -0.2, np.nan], rtol=1e-9)
    assert found.max_relative_error == pytest.approx(0.2)
    rmse = np.sqrt((0.2**2 + 0.1**2 + 4.9**2 + 0.022**2 + 1.0**2) / 5)
    assert found.rmse == pytest.approx(rmse)
    assert found.n == 5
    np.testing.assert_allclose(found.median, draws[0])
    # Of zeros alone they are undefined.
    assert np.isnan(score(np.ones((5, 2)), np.zeros(2)).max_relative_error)


def test_sorted_normals_lie_where_they_are_expected() -> None:
    middle, low, high = normal_order(15)
    drawn = np.sort(np.random.default_rng(1).standard_normal((20_000, 15)), axis=1)
    assert middle == pytest.approx(drawn.mean(axis=0), abs=0.03)
    assert low == pytest.approx(np.quantile(drawn, 0.025, axis=0), abs=0.08)
    assert high == pytest.approx(np.quantile(drawn, 0.975, axis=0), abs=0.08)


# Prior sensitivity, against closed forms and ArviZ's own function

SLIP = np.linspace(0.0, 0.3, 10)
SIGMA = 0.5
FEW = SamplerSettings(steps=200, max_steps=200)


def pulls(mean: float = 1.0) -> np.ndarray:
    return mean + SIGMA * np.random.default_rng(5).standard_normal(SLIP.size)


def level(prior_mean: float, prior_sd: float) -> Calibration:
    """A constant with a normal prior and known noise: everything is normal."""
    priors = (normal("a", prior_mean, prior_sd), fixed("sigma", SIGMA))
    return calibrate(problem_of(lambda a, x: a + 0.0 * x, priors, SLIP, pulls()), 1)


def distance(p: stats.rv_frozen, q: stats.rv_frozen, ends: tuple[float, float]) -> float:
    """Cumulative Jensen-Shannon distance, by quadrature, the larger of the two directions.

    It is relative to the areas below the distribution functions, so it depends on the ends; those
    of an estimate are its least and greatest draw.
    """
    x = np.linspace(*ends, 200_001)

    def one_way(P: np.ndarray, Q: np.ndarray) -> float:
        def half(A: np.ndarray, B: np.ndarray) -> float:
            safe = np.where(A > 0.0, A, 1.0)
            term = np.where(A > 0.0, A * np.log2(safe / np.where(A > 0.0, 0.5 * (A + B), 1.0)), 0.0)
            return np.trapezoid(term + (B - A) / (2.0 * np.log(2.0)), x)

        return np.sqrt((half(P, Q) + half(Q, P)) / np.trapezoid(P + Q, x))

    return max(one_way(p.cdf(x), q.cdf(x)), one_way(p.sf(x), q.sf(x)))


def exact(prior_mean: float, prior_sd: float, part: str, ends: tuple[float, float]) -> float:
    def posterior(alpha: float) -> stats.rv_frozen:
        a, b = (alpha, 1.0) if part == "prior" else (1.0, alpha)
        of_prior, of_data = a / prior_sd**2, b * SLIP.size / SIGMA**2
        precision = of_prior + of_data
        mean = (of_prior * prior_mean + of_data * pulls().mean()) / precision
        return stats.norm(mean, precision**-0.5)

    reactions = [
        distance(posterior(1.0), posterior(alpha), ends) / abs(np.log2(alpha))
        for alpha in (0.99, 1.01)
    ]
    return float(np.mean(reactions))


@pytest.mark.parametrize("prior", [(1.0, 10.0), (3.0, 0.2)])
def test_a_normal_posterior_reacts_as_in_closed_form(prior: tuple[float, float]) -> None:
    calibration = level(*prior)
    found, draws = prior_sensitivity(calibration)["a"], calibration.draws.flat
    ends = float(draws.min()), float(draws.max())
    for part, value in (("prior", found.prior), ("likelihood", found.likelihood)):
        # Both are estimated from one set of draws; a tenth is ten standard errors of 20,000.
        assert value == pytest.approx(exact(*prior, part, ends), rel=0.1, abs=2e-3), part
    expected = 1.0 - 1.0 / (1.0 + SLIP.size * prior[1] ** 2 / SIGMA**2)
    # Five standard errors of a normal's variance.
    error = (1.0 - expected) * np.sqrt(2.0 / calibration.draws.report.ess_bulk.min())
    assert found.contraction == pytest.approx(expected, abs=5.0 * error)


def test_a_parameter_without_effect_is_not_identified() -> None:
    priors = (normal("a", 0.0, 3.0), normal("idle", 2.0, 1.0), fixed("sigma", SIGMA))
    problem = problem_of(lambda a, idle, x: a + 0.0 * idle * x, priors, SLIP, pulls())
    found = prior_sensitivity(calibrate(problem, 1, settings=FEW))
    assert found["a"].identified
    assert found["a"].reading == "data"
    assert not found["idle"].identified
    assert abs(found["idle"].contraction) < 0.1
    assert found["idle"].prior > SENSITIVITY_MIN > found["idle"].likelihood


def test_two_parameters_of_which_only_the_sum_is_seen() -> None:
    """Each contracts to half its prior variance, yet only the prior tells them apart."""
    priors = (normal("a", 0.0, 1.0), normal("b", 0.0, 1.0), fixed("sigma", SIGMA))
    problem = problem_of(lambda a, b, x: a + b + 0.0 * x, priors, SLIP, pulls())
    found = prior_sensitivity(calibrate(problem, 1, settings=FEW))
    for name in "ab":
        assert found[name].contraction == pytest.approx(0.5, abs=0.05)
        assert found[name].contraction > CONTRACTION_MIN
        assert found[name].prior_dominated
        assert found[name].reading == "not identified"


def test_it_is_what_arviz_works_out_of_the_saved_tree(rut_calibration: Calibration) -> None:
    # Not at the top: to import them takes every process of the tests a second.
    import arviz as az
    import xarray as xr

    ours = prior_sensitivity(rut_calibration)
    tree = to_datatree(rut_calibration)
    logged = tree["posterior"].to_dataset()
    # All but n1 are sampled on the logarithm, or derived and positive.
    for name in ("k", "z_ref", "n0", "sigma"):
        logged[name] = np.log(logged[name])
    tree["posterior"] = xr.DataTree(logged)
    for part in ("prior", "likelihood"):
        theirs = az.psense(tree, group=part)
        for name, s in ours.items():
            assert getattr(s, part) == pytest.approx(float(theirs[name]), rel=1e-6), name


def test_what_is_derived_contracts_as_what_it_follows_from(rut_calibration: Calibration) -> None:
    """Of k, n0 and z_ref: whatever the scale, a contraction lies below one, and k's is not NaN."""
    found = prior_sensitivity(rut_calibration)
    assert set(found) == set(rut_calibration.parameters)
    assert 0.5 < found["k"].contraction < 1.0
    for name in rut_calibration.problem.names:
        ratio = rut_calibration.summary[name].sd_ratio
        assert found[name].contraction == 1.0 - ratio**2


def test_half_of_a_quadratic_comes_from_the_prior(pull_calibration: Calibration) -> None:
    """Two pressures do not determine quadratics in pressure, however much their ends contract."""
    found = prior_sensitivity(pull_calibration)
    for name in ("K_bend", "D_bend", "G_bend", *(f"c{i}" for i in range(1, 10))):
        assert found[name].reading == "not identified", name
    for name in ("K_lo", "D_lo", "D_hi", "C", "b0", "sigma"):
        assert found[name].reading == "data", name


@pytest.mark.parametrize(
    ("prior", "likelihood", "contraction", "reading"),
    [
        (0.01, 0.2, 0.9, "data"),
        (0.05, 0.2, 0.9, "data and prior"),
        (0.05, 0.049, 0.9, "not identified"),
        (0.01, 0.2, 0.18, "not identified"),
        (0.01, 0.2, 0.19, "data"),
        (0.01, 0.01, 0.9, "data"),
    ],
)
def test_readings(prior: float, likelihood: float, contraction: float, reading: str) -> None:
    assert Sensitivity("x", prior, likelihood, contraction).reading == reading
