"""How the noise of readings grows with slip and as the tyre goes soft."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest
from scipy.stats import norm

from calib.data import table_from_arrays
from calib.gap.campaigns import campaigns
from calib.gap.constants import KAPPA, RHO
from calib.gap.noise import (
    Noise,
    NoiseConditions,
    ln_averaged,
    ln_averaging,
    ln_prior,
    most_probable,
    noise_conditions,
    noise_conditions_of_lab,
)
from tests.gap.cases import PULL_ONLY, make_case


def at(n: int, *, pressures: bool = True) -> NoiseConditions:
    rng = np.random.default_rng(5)
    pressure = rng.choice([18.0, 30.0, 42.0], n)
    return NoiseConditions(
        rng.uniform(0.0, 0.6, n), np.log(30.0 / pressure) if pressures else np.zeros(n)
    )


def test_it_grows_as_stated():
    rows = NoiseConditions(np.array([0.0, 0.5, -0.1]), np.log(30.0 / np.array([30.0, 15.0, 60.0])))
    found = Noise(0.1, 2.0, 1.0).sd(rows)
    np.testing.assert_allclose(found, [0.1, 0.1 * 2.0 * 2.0, 0.1 * 0.5])


def test_the_reference_is_the_calibrations_median_pressure():
    data = campaigns(make_case(models=PULL_ONLY))
    psi = data.view.conditions["inflation_pressure_psi"]
    median = np.median(data.case.lab["inflation_pressure_psi"])
    np.testing.assert_allclose(noise_conditions(data.view).softness, np.log(median / psi))
    lab = data.lab_at["drawbar_pull"]
    assert np.median(lab.softness) == pytest.approx(0.0, abs=1e-12)
    np.testing.assert_array_equal(lab.slip, data.case.lab["slip_ratio"])


def test_without_pressures_there_is_nothing_to_be_soft():
    view = campaigns(make_case(models=PULL_ONLY)).view
    conditions = {k: v for k, v in view.conditions.items() if k != "inflation_pressure_psi"}
    bare = type(view)(conditions, view.lab, 5.0, 0.5, (0.0, 1.0))
    assert not noise_conditions(bare).softness.any()
    squared = np.random.default_rng(0).standard_normal(200) ** 2
    assert most_probable(squared[None], at(200, pressures=False))[0].kappa == 0.0


@pytest.mark.parametrize("rho", RHO.tolist())
@pytest.mark.parametrize("kappa", KAPPA.tolist())
def test_it_is_found_again(rho: float, kappa: float):
    rows, truth = at(4000), Noise(0.3, rho, kappa)
    squared = np.square(truth.sd(rows) * np.random.default_rng(2).standard_normal(4000))
    (found,) = most_probable(squared[None], rows)
    assert (found.rho, found.kappa) == (rho, kappa)
    # sigma of 4000 residuals, 1.1 %.
    assert found.sigma == pytest.approx(0.3, rel=0.045)


def test_it_is_the_most_probable_of_all_it_could_be():
    rows = at(40)
    squared = np.random.default_rng(9).standard_normal(40) ** 2

    def log_posterior(noise: Noise) -> float:
        sd = noise.sd(rows)
        return float(-np.log(sd).sum() - 0.5 * (squared / sd**2).sum()) + ln_prior(noise)

    best = log_posterior(most_probable(squared[None], rows)[0])
    others = [Noise(s, r, k) for s in np.linspace(0.3, 3.0, 400) for r in RHO for k in KAPPA]
    assert best >= max(map(log_posterior, others)) - 1e-9


def test_it_is_averaged_over_as_by_quadrature():
    """Over ln sigma with a density of the root of n / pi, over its growth by its prior."""
    rows = at(12)
    squared = 0.04 * np.random.default_rng(5).standard_normal((2, 12)) ** 2
    ln_sigma = np.linspace(np.log(0.2) - 3.0, np.log(0.2) + 6.0, 20_001)
    expected = np.zeros(2)
    for rho in RHO:
        for kappa in KAPPA:
            sd = np.exp(ln_sigma)[:, None] * rows.growth(rho, kappa)
            share = np.sqrt(12.0 / np.pi) * np.exp(ln_prior(Noise(1.0, rho, kappa)))
            for i in range(2):
                density = norm.pdf(np.sqrt(squared[i]), scale=sd).prod(axis=1)
                expected[i] += share * np.trapezoid(density, ln_sigma)
    np.testing.assert_allclose(ln_averaged(squared, rows), np.log(expected), rtol=1e-6)


def test_averaging_leaves_the_density_at_the_most_probable_size_as_it_is():
    """So that a hypothesis of which only that is known can be compared.

    Where parameters took up a half of the variance sigma is known worse by the root of two.
    """
    rows = at(60, pressures=False)
    squared = np.random.default_rng(6).standard_normal(60) ** 2
    (best,) = most_probable(squared[None], rows)
    sd = best.sd(rows)
    at_best = norm.logpdf(np.sqrt(squared), scale=sd).sum() + ln_prior(best)
    raw, whole = np.sqrt(squared)[None], np.ones((1, 60))
    (lifted,) = ln_averaging(raw, whole, rows)
    assert 0.0 < lifted < np.log(RHO.size)
    # Stirling's formula is off by 1/(6 n).
    found = ln_averaged(squared[None], rows)[0]
    assert found - lifted == pytest.approx(at_best, abs=0.005)
    (more,) = ln_averaging(raw, 0.5 * whole, rows)
    assert more == pytest.approx(lifted + 0.5 * np.log(2.0))
    raw[0, 3] = np.nan
    assert ln_averaging(raw, whole, rows).tolist() == [0.0]


def test_how_a_noise_grows_has_a_probability_beforehand_and_all_have_one():
    grown = [Noise(0.1, rho, kappa) for rho in RHO for kappa in KAPPA]
    assert np.exp([ln_prior(n) for n in grown]).sum() == pytest.approx(1.0)
    # No growth at all is believed before any other.
    assert ln_prior(Noise(0.1)) == max(map(ln_prior, grown))
    assert np.exp(ln_prior(Noise(0.1))) == pytest.approx(0.35)


@pytest.mark.parametrize(("rho", "beforehand"), [(0.0, 0.5), (1.0, 0.2), (2.5, 0.15), (5.0, 0.15)])
@pytest.mark.parametrize(("kappa", "too"), [(0.0, 0.7), (0.8, 0.2), (-0.8, 0.1)])
def test_the_probability_of_a_growth_is_that_with_slip_times_that_with_softness(
    rho, beforehand, kappa, too
):
    assert ln_prior(Noise(0.1, rho, kappa)) == pytest.approx(np.log(beforehand * too))


def test_rows_may_be_picked_and_put_one_after_the_other():
    one, other = at(5), at(3, pressures=False)
    some = one.rows(np.array([3, 0]))
    assert some.slip.tolist() == one.slip[[3, 0]].tolist()
    assert some.softness.tolist() == one.softness[[3, 0]].tolist()
    both = one + other
    assert both.slip.tolist() == [*one.slip, *other.slip]
    assert both.softness.tolist() == [*one.softness, *other.softness]


def test_softness_is_of_pressures_of_any_size_where_both_campaigns_have_one():
    pressure = np.array([0.5, 0.8, 2.0])
    view = SimpleNamespace(
        conditions={"inflation_pressure_psi": pressure}, lab={"inflation_pressure_psi": 0.8},
        slip=lambda: np.zeros(3),
    )  # fmt: skip
    np.testing.assert_allclose(noise_conditions(view).softness, np.log(0.8 / pressure))
    view.lab = {}
    assert not noise_conditions(view).softness.any()
    assert not noise_conditions(view).slip.any()
    # The laboratory's rows are beside the same reference.
    view.lab = {"inflation_pressure_psi": 4.0}

    lab = table_from_arrays({"inflation_pressure_psi": pressure, "slip_ratio": 0.1 * pressure})
    rows = noise_conditions_of_lab(lab, view)
    np.testing.assert_allclose(rows.softness, np.log(4.0 / pressure))
    np.testing.assert_allclose(rows.slip, 0.1 * pressure)


def test_a_guess_without_a_value_somewhere_says_nothing_of_the_noise():
    rows = at(30)
    squared = np.random.default_rng(3).standard_normal((3, 30)) ** 2
    alone = most_probable(squared[[0, 2]], rows)
    squared[1, 4] = np.nan
    assert most_probable(squared, rows) == [alone[0], Noise(1.0), alone[1]]
    squared[1, 4] = np.inf
    assert most_probable(squared, rows)[1] == Noise(1.0)
