"""Prior sensitivity against closed forms and against ArviZ's own function."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import stats

from calib.inference.calibration import Calibration, calibrate
from calib.inference.io import to_datatree
from calib.validation.scores import CONTRACTION_MIN, SENSITIVITY_MIN, Sensitivity, prior_sensitivity
from tests.custom_problems import fixed, normal, problem_of

SLIP = np.linspace(0.0, 0.3, 10)
SIGMA = 0.5


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


@pytest.mark.parametrize("prior", [(1.0, 10.0), (0.0, 0.3), (3.0, 0.2), (1.0, 0.05)])
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
    found = prior_sensitivity(calibrate(problem, 1))
    assert found["a"].identified
    assert found["a"].reading == "data"
    assert not found["idle"].identified
    assert abs(found["idle"].contraction) < 0.1
    assert found["idle"].prior > SENSITIVITY_MIN > found["idle"].likelihood


def test_two_parameters_of_which_only_the_sum_is_seen() -> None:
    """Each contracts to half its prior variance, yet only the prior tells them apart."""
    priors = (normal("a", 0.0, 1.0), normal("b", 0.0, 1.0), fixed("sigma", SIGMA))
    problem = problem_of(lambda a, b, x: a + b + 0.0 * x, priors, SLIP, pulls())
    found = prior_sensitivity(calibrate(problem, 1))
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
