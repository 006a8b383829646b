"""The published rut regression (Eq 22) beside the likelihood."""

from __future__ import annotations

import numpy as np
import pytest

from calib.data import table_from_arrays
from calib.errors import CalibError
from calib.he2019.estimators import rut_regression
from calib.inference.estimators import estimate
from calib.inference.problem import build_problem


def build(kpa, slip, rut, model="modified_bekker", **kwargs):
    columns = {"average_ground_pressure_kpa": kpa, "rut_depth_mm": rut, "slip_ratio": slip}
    return build_problem(model, table_from_arrays(columns), **kwargs)


@pytest.fixture
def noisy():
    rng = np.random.default_rng(3)
    kpa = np.repeat([106.6, 178.2], 12)
    slip = np.tile(np.append(np.linspace(0.0, 0.2, 9), [0.3, 0.5, 0.7]), 2)
    rut = 1000 * (kpa / 3.3e5) ** (1 / (2.0 + 1.3 * slip))
    return kpa, slip, rut * np.exp(0.05 * rng.standard_normal(kpa.size))


def test_equals_ordinary_least_squares(noisy):
    kpa, slip, rut = noisy
    keep = slip <= 0.2
    ln_z = np.log(rut[keep] / 1000)
    X = np.column_stack([np.ones(18), ln_z, slip[keep] * ln_z])
    y = np.log(kpa[keep])
    beta, sse, *_ = np.linalg.lstsq(X, y, rcond=None)
    fit = rut_regression(build(kpa, slip, rut))
    assert fit.n == 18
    assert fit.n_excluded == 6
    assert fit.reported == pytest.approx({"n0": beta[1], "n1": beta[2], "k": np.exp(beta[0])})
    assert fit.rmse == pytest.approx(np.sqrt(sse[0] / 15))
    assert fit.r_squared == pytest.approx(1 - sse[0] / np.sum((y - y.mean()) ** 2))


def test_bekker_leaves_slip_out(noisy):
    kpa, slip, rut = noisy
    keep = slip <= 0.2
    slope, intercept = np.polyfit(np.log(rut[keep] / 1000), np.log(kpa[keep]), 1)
    fit = rut_regression(build(kpa, slip, rut, "bekker"))
    assert fit.reported == pytest.approx({"n": slope, "k": np.exp(intercept)})
    everything = rut_regression(build(kpa, slip, rut, "bekker"), max_slip=1.0)
    assert everything.n_excluded == 0


def test_estimate_is_judged_on_the_likelihood_scale(noisy):
    kpa, slip, rut = noisy
    problem = build(kpa, slip, rut)
    found = estimate(problem, "published_regression", np.random.default_rng(0))
    best = estimate(problem, "least_squares", np.random.default_rng(0))
    fit = rut_regression(problem)
    assert found.reported == pytest.approx(fit.reported)
    r = problem.response - problem.bound.location(found.theta, problem.conditions)[0]
    assert found.cost == pytest.approx(float(r @ r))
    assert found.cost >= best.cost
    assert "6 rows above 0.2 slip left out" in found.note
    assert f"RMSE = {fit.rmse:.3f}" in found.note


def test_noise_in_the_rut_attenuates_the_published_exponent():
    rng = np.random.default_rng(8)
    kpa = np.repeat([106.6, 178.2], 2000)
    slip = np.tile(np.linspace(0.0, 0.2, 10), 400)
    rut = 1000 * (kpa / 3.3e5) ** (1 / (2.0 + 1.3 * slip))
    problem = build(kpa, slip, rut * np.exp(0.1 * rng.standard_normal(kpa.size)))
    published = estimate(problem, "published_regression", rng)
    proper = estimate(problem, "least_squares", rng)
    assert proper.reported["n0"] == pytest.approx(2.0, rel=0.03)
    assert published.reported["n0"] < 0.85 * proper.reported["n0"]


def test_one_ground_pressure(noisy):
    _, slip, rut = noisy
    with pytest.raises(CalibError, match="cannot tell its 3 coefficients apart"):
        rut_regression(build(np.full(24, 120.0), slip, rut))


def test_fixed_parameters_and_falling_ruts(noisy):
    kpa, slip, rut = noisy
    with pytest.raises(CalibError, match="n1 is fixed"):
        estimate(
            build(kpa, slip, rut, fixed={"n1": 0.0}), "published_regression",
            np.random.default_rng(0),
        )  # fmt: skip
    with pytest.raises(CalibError, match="an exponent of -"):
        estimate(build(kpa[::-1], slip, rut), "published_regression", np.random.default_rng(0))
