"""Posteriors, evidence and noise against closed forms, quadrature and a long chain."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import emcee
import numpy as np
import pytest
from scipy.special import logsumexp
from scipy.stats import multivariate_normal, norm

from calib.data import table_from_arrays
from calib.gap.campaigns import Campaigns, campaigns
from calib.gap.case import Case
from calib.gap.constants import KAPPA, RHO
from calib.gap.effects import EFFECTS
from calib.gap.fit import Fit, Residuals
from calib.gap.hypotheses import Hypothesis, effect_priors, unknowns
from calib.gap.noise import Noise, NoiseConditions, ln_averaged, ln_prior, most_probable
from calib.gap.posterior import Density, searched
from calib.he2019.gaps import paper_gaps
from calib.inference.priors import Prior
from tests.gap.cases import PULL_ONLY, campaigns_of, make_case
from tests.gap.fits import averaged_log_joint, fitted, straight_line

SIZE = 0.12
NONE = Hypothesis("none")


def single(data: Campaigns, name: str) -> Hypothesis:
    return Hypothesis(name, (EFFECTS[name],), (effect_priors(data, EFFECTS[name]),))


def test_size_and_noise_are_recovered():
    data = campaigns(make_case("force_offset", size={"offset": SIZE}, models=PULL_ONLY))
    found = fitted(data, single(data, "force_offset"))
    i = found.forward.phi_slices[0].start
    sd = np.sqrt(found.covariance[i, i])
    assert abs(found.psi[i] - SIZE) < 3.0 * sd
    assert 0.002 < sd < 0.05
    # 57 rows: the sd of ln sigma is 1/sqrt(2 x 57) = 0.09.
    assert np.log(found.noise["drawbar_pull"].sigma / 0.03) == pytest.approx(0.0, abs=0.3)


def noisy_again(case: Case, sds: Sequence[np.ndarray], seed: int) -> Campaigns:
    """The case's two tables without noise, and noise of these sds."""
    rng = np.random.default_rng(seed)
    tables = [
        table_from_arrays(
            dict(table.columns)
            | {"drawbar_pull_kn": table["drawbar_pull_kn"] + sd * rng.standard_normal(sd.size)}
        )
        for table, sd in zip((case.lab, case.field), sds, strict=True)
    ]
    return campaigns(replace(case, lab=tables[0], field=tables[1]))


def fitted_noise(data: Campaigns) -> Noise:
    return fitted(data, NONE).noise["drawbar_pull"]


def test_noise_that_grows_with_slip_is_seen():
    case = make_case(models=PULL_ONLY, n_lab=120, n_field=60, noise=0.0)
    sds = [0.01 * (1.0 + 5.0 * table["slip_ratio"]) for table in (case.lab, case.field)]
    found = fitted_noise(noisy_again(case, sds, 8))
    assert found.rho >= 2.5
    assert found.kappa == 0.0


@pytest.mark.parametrize("kappa", [0.0, 0.8, -0.8])
def test_noise_of_a_soft_tyre_is_seen(kappa: float):
    case = make_case(models=PULL_ONLY, n_lab=120, n_field=60, noise=0.0)
    pressures = [table["inflation_pressure_psi"] for table in (case.lab, case.field)]
    middle = np.median(pressures[0])
    found = fitted_noise(noisy_again(case, [0.02 * (middle / p) ** kappa for p in pressures], 8))
    assert found.kappa == kappa
    assert found.rho == 0.0
    # 180 readings less a dozen parameters: 5.5 %.
    assert found.sigma == pytest.approx(0.02, rel=0.17)


def design_of(data: Campaigns) -> np.ndarray:
    return np.stack([np.ones(17), data.at_rows["drawbar_pull"].slip], axis=1)


PRIOR_MEAN, PRIOR_COVARIANCE = np.array([0.0, 0.5]), np.diag([1.0, 4.0])


def closed_form(data: Campaigns, noise: Noise) -> float:
    """Both parameters integrated out, the readings are normal; with the noise's own prior."""
    at, design = data.at_rows["drawbar_pull"], design_of(data)
    covariance = design @ PRIOR_COVARIANCE @ design.T + np.diag(noise.sd(at) ** 2)
    exact = multivariate_normal.logpdf(data.observed, design @ PRIOR_MEAN, covariance)
    return float(exact) + ln_prior(noise)


def noises(data: Campaigns) -> tuple[list[Noise], float]:
    """A grid of them, and the log of what each stands for in ln sigma."""
    ln_sigma = np.log(0.04) + np.linspace(-2.0, 3.0, 201)
    kappas = KAPPA if np.ptp(data.at_rows["drawbar_pull"].softness) else KAPPA[:1]
    grid = [Noise(float(np.exp(s)), r, k) for s in ln_sigma for r in RHO for k in kappas]
    return grid, float(np.log(ln_sigma[1] - ln_sigma[0]) + 0.5 * np.log(17.0 / np.pi))


@pytest.mark.parametrize("seed", [1, 2])
def test_the_evidence_is_that_of_the_closed_form(seed: int):
    data = straight_line(seed)
    grid, each = noises(data)
    averaged = logsumexp([closed_form(data, noise) for noise in grid]) + each
    # Of thousands of weighted draws the error is about 0.02.
    assert fitted(data, NONE).log_evidence == pytest.approx(averaged, abs=0.05)


def test_what_nothing_depends_on_changes_no_evidence():
    # As the change point of a step that falls between two runs.
    idle = Prior("c", "1", "a test", "nobody", "uniform", False, 0.5, np.inf, 0.1, 0.9)
    without = fitted(straight_line(1), NONE)
    found = fitted(straight_line(1, idle), NONE)
    assert found.log_evidence == pytest.approx(without.log_evidence, abs=0.08)


@pytest.mark.parametrize("lower", [-np.inf, 0.2, 0.3, 0.4])
def test_of_a_bounded_parameter_the_evidence_is_the_mass_inside(lower: float):
    """The mode is inside the bound, beside it, or held at it by readings that ask for less."""
    data = straight_line(1, lower=lower)
    grid, each = noises(data)
    design = design_of(data)
    inside = []
    for noise in grid:
        sd = noise.sd(data.at_rows["drawbar_pull"])
        precision = design.T @ (design / sd[:, None] ** 2) + np.linalg.inv(PRIOR_COVARIANCE)
        information = design.T @ (data.observed / sd**2)
        information += np.linalg.solve(PRIOR_COVARIANCE, PRIOR_MEAN)
        mean, covariance = np.linalg.solve(precision, information), np.linalg.inv(precision)
        # Of the normals without the bound, the shares beyond it after and before the readings.
        after = norm.logsf(lower, mean[0], np.sqrt(covariance[0, 0]))
        inside.append(closed_form(data, noise) + after - norm.logsf(lower))
    assert fitted(data, NONE).log_evidence == pytest.approx(logsumexp(inside) + each, abs=0.05)


@pytest.fixture(scope="module")
def free() -> Fit:
    """A discrepancy of both outputs that varies with every condition."""
    data = campaigns_of("force_offset")
    everything = [h for h in unknowns(data) if h.smooth_over == "all" and h.onset_over is None]
    return fitted(data, max(everything, key=lambda h: len(h.smooth_outputs)))


@pytest.fixture(scope="module")
def lugs() -> Fit:
    data = campaigns_of("force_offset")
    return fitted(data, single(data, "lug_thrust"), 300.0)


def linear_model(found: Fit, which: np.ndarray, at: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Residuals at zero of some coordinates, and what one unit of each takes from them."""
    problem = Residuals(found.forward.data, found.forward)
    zero = at.copy()
    zero[which] = 0.0
    at_zero = problem.raw(zero[None])[0]
    units = np.tile(zero, (which.size, 1))
    units[np.arange(which.size), which] = 1e-3
    return at_zero, ((at_zero - problem.raw(units)) / 1e-3).T


def closed_density(found: Fit, which: np.ndarray, at: np.ndarray) -> float:
    """Log density of the rest and the readings, residuals linear in `which` of normal prior."""
    at_zero, basis = linear_model(found, which, at)
    priors = found.forward.priors.free
    prior_sd = np.array([priors[i].scale for i in which])
    noise = Residuals(found.forward.data, found.forward).sds(found.noise)
    covariance = np.diag(noise**2) + (basis * prior_sd**2) @ basis.T
    zero = at.copy()
    zero[which] = 0.0
    rest = found.forward.log_prior(zero[None])[0] - norm.logpdf(0.0, scale=prior_sd).sum()
    return float(rest + multivariate_normal.logpdf(at_zero, cov=covariance))


def averaged_closed_form(found: Fit, which: np.ndarray, at: np.ndarray) -> float:
    """As `closed_density`, averaged over how large the noise of each output is and how it grows."""
    at_zero, basis = linear_model(found, which, at)
    priors = found.forward.priors.free
    prior_sd = np.array([priors[i].scale for i in which])
    zero = at.copy()
    zero[which] = 0.0
    total = found.forward.log_prior(zero[None])[0] - norm.logpdf(0.0, scale=prior_sd).sum()
    problem, ln_sigma = Residuals(found.forward.data, found.forward), np.linspace(-0.7, 0.7, 36)
    for o, part in problem.parts.items():
        rows, most = found.forward.data.at_rows[o], found.noise[o].sigma
        shared = (basis[part] * prior_sd**2) @ basis[part].T
        values = [
            multivariate_normal.logpdf(at_zero[part], cov=shared + np.diag(noise.sd(rows) ** 2))
            + ln_prior(noise)
            for noise in (
                Noise(most * np.exp(s), r, k) for s in ln_sigma for r in RHO for k in KAPPA
            )
        ]
        step = ln_sigma[1] - ln_sigma[0]
        total += logsumexp(values) + np.log(step) + 0.5 * np.log(at_zero[part].size / np.pi)
    return float(total)


def near(found: Fit, count: int) -> np.ndarray:
    """Draws beside the posterior mean, of what is searched."""
    u, rng = searched(found.forward), np.random.default_rng(3)
    root = np.linalg.cholesky(found.covariance[np.ix_(u, u)])
    return found.psi[u] + 0.5 * rng.standard_normal((count, u.size)) @ root.T


def test_a_free_discrepancy_is_integrated_out(free):
    density, rng = Density(free.forward, free.noise), np.random.default_rng(1)
    which = np.delete(np.arange(free.psi.size), searched(free.forward))
    assert which.size > 40
    found, psi = density.evaluate(near(free, 5), rng)
    for value, at in zip(found, psi, strict=True):
        np.testing.assert_array_equal(at[which], 0.0)
        assert value == pytest.approx(closed_density(free, which, at), abs=1e-4)


def test_form_errors_of_an_effect_that_is_added_are_weighted_as_if_integrated_out(lugs):
    """Whatever is drawn of them, as long as the factor stays positive."""
    density, u = Density(lugs.forward, lugs.noise), searched(lugs.forward)
    forms = np.delete(np.arange(lugs.psi.size), u)
    assert {lugs.forward.priors.free[i].name for i in forms} == {
        "drawbar_pull.lug_thrust.form", "rut_depth.lug_thrust.form",
    }  # fmt: skip
    # What is drawn is wider than the normal: the estimates scatter, and their mean is right.
    drawn = near(lugs, 3)
    repeated, psi = density.evaluate(np.repeat(drawn, 4000, axis=0), np.random.default_rng(4))
    assert psi[:, forms].std() > 0.0
    for value, at in zip(repeated.reshape(3, -1), drawn, strict=True):
        whole = lugs.psi.copy()
        whole[u] = at
        assert value.std() < 0.7  # of their mean, 0.01
        expected = averaged_closed_form(lugs, forms, whole)
        assert logsumexp(value) - np.log(value.size) == pytest.approx(expected, abs=0.01)


def test_without_anything_linear_it_is_the_joint_density():
    data = campaigns_of("force_offset")
    found = fitted(data, NONE, 300.0)
    assert searched(found.forward).tolist() == list(range(found.psi.size))
    drawn = near(found, 1200)  # more than are evaluated at once
    density = Density(found.forward, found.noise)
    value, psi = density.evaluate(drawn, np.random.default_rng(7))
    np.testing.assert_allclose(psi, drawn, atol=1e-6)
    np.testing.assert_allclose(value, averaged_log_joint(found, drawn), rtol=1e-9)


def test_the_evidence_of_a_free_discrepancy_is_the_same_whatever_the_seed(free):
    """Drawn in all its dimensions it came out 1 to 5 nats too low."""
    data, h = free.forward.data, free.forward.hypothesis
    evidence = [fitted(data, h, seed=seed).log_evidence for seed in (1, 2, 3)]
    assert np.ptp(evidence) < 0.2


def long_chain(found: Fit, seed: int) -> np.ndarray:
    """Draw by emcee alone, an independent check, shape (draws, d)."""
    d = found.psi.size
    rng = np.random.default_rng(seed)
    scale = np.sqrt(np.diag(found.covariance))
    start = found.psi + 0.2 * scale * rng.standard_normal((64 * d, d))
    *_, lower, upper, _ = found.forward.priors._arrays
    start = np.clip(start, lower + 1e-6, upper - 1e-6)
    sampler = emcee.EnsembleSampler(
        64 * d, d, lambda psi: averaged_log_joint(found, psi), vectorize=True,
        moves=emcee.moves.DEMove(),
    )  # fmt: skip
    sampler.random_state = np.random.RandomState(seed).get_state()
    # Autocorrelation times are up to 47 steps: thousands of effective draws.
    sampler.run_mcmc(start, 600)
    return np.asarray(sampler.get_chain(discard=300, thin=20, flat=True))


@pytest.mark.parametrize(
    "name", ["slip_zero_shift", pytest.param("slip_sinkage", marks=pytest.mark.slow)]
)
def test_draws_are_those_of_the_posterior(name):
    models = {"rut_depth": "modified_bekker"}
    case = make_case(name, models=models, size={"growth": 0.8, "radius_error": 0.05})
    data = campaigns(case)
    found = fitted(data, single(data, name))
    exact = long_chain(found, 2)
    sd = exact.std(axis=0)
    # Sds within 20 % and means within 0.3 sd in 3 standard errors of a hundred draws; the rest is
    # the chain's own error.
    assert np.abs((found.psi - exact.mean(axis=0)) / sd).max() < 0.4
    ratio = found.sample.std(axis=0) / sd
    assert ratio.min() > 0.7
    assert ratio.max() < 1.4


def test_draws_of_a_bent_posterior_are_there_whatever_the_seed():
    """From 20 rows, size, exponent and form of slip sinkage are told apart by priors alone."""
    data = campaigns(next(gap.case for gap in paper_gaps() if gap.name == "plain_bekker"))
    h = single(data, "slip_sinkage")
    # Sds would be those of the heavy tails.
    exact = np.ptp(np.quantile(long_chain(fitted(data, h), 2), (0.16, 0.84), axis=0), axis=0)
    for seed in range(1, 6):
        found = np.ptp(np.quantile(fitted(data, h, seed=seed).sample, (0.16, 0.84), axis=0), axis=0)
        np.testing.assert_allclose(found / exact, 1.0, atol=0.25)


def at_noise(n: int, *, pressures: bool = True) -> NoiseConditions:
    rng = np.random.default_rng(5)
    pressure = rng.choice([18.0, 30.0, 42.0], n)
    return NoiseConditions(
        rng.uniform(0.0, 0.6, n), np.log(30.0 / pressure) if pressures else np.zeros(n)
    )


@pytest.mark.parametrize("rho", RHO.tolist())
@pytest.mark.parametrize("kappa", KAPPA.tolist())
def test_it_is_found_again(rho: float, kappa: float):
    rows, truth = at_noise(4000), Noise(0.3, rho, kappa)
    squared = np.square(truth.sd(rows) * np.random.default_rng(2).standard_normal(4000))
    (found,) = most_probable(squared[None], rows)
    assert (found.rho, found.kappa) == (rho, kappa)
    # sigma of 4000 residuals, 1.1 %.
    assert found.sigma == pytest.approx(0.3, rel=0.045)


def test_it_is_the_most_probable_of_all_it_could_be():
    rows = at_noise(40)
    squared = np.random.default_rng(9).standard_normal(40) ** 2

    def log_posterior(noise: Noise) -> float:
        sd = noise.sd(rows)
        return float(-np.log(sd).sum() - 0.5 * (squared / sd**2).sum()) + ln_prior(noise)

    best = log_posterior(most_probable(squared[None], rows)[0])
    others = [Noise(s, r, k) for s in np.linspace(0.3, 3.0, 400) for r in RHO for k in KAPPA]
    assert best >= max(map(log_posterior, others)) - 1e-9


def test_it_is_averaged_over_as_by_quadrature():
    """Over ln sigma with a density of the root of n / pi, over its growth by its prior."""
    rows = at_noise(12)
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


def test_how_a_noise_grows_has_a_probability_beforehand_and_all_have_one():
    grown = [Noise(0.1, rho, kappa) for rho in RHO for kappa in KAPPA]
    assert np.exp([ln_prior(n) for n in grown]).sum() == pytest.approx(1.0)
    # No growth at_noise all is believed before any other.
    assert ln_prior(Noise(0.1)) == max(map(ln_prior, grown))
    assert np.exp(ln_prior(Noise(0.1))) == pytest.approx(0.35)
