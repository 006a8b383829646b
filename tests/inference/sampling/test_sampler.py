"""The whole sampler against posteriors in closed form.

A random number generator and a seed fix every run; tolerances are five Monte Carlo standard errors.
"""

from __future__ import annotations

import numpy as np
import pytest
from scipy import stats

from calib.data import Table
from calib.errors import CalibError
from calib.inference.diagnostics import ess
from calib.inference.mode import find_modes
from calib.inference.problem import build_problem
from calib.inference.proposal import Guess
from calib.inference.sampler import (
    Draws,
    SamplerSettings,
    anneal,
    sample_density,
    sample_posterior,
)
from tests.custom_problems import fixed, normal, problem_of
from tests.inference.sampling.closed_form import (
    SIGMAS,
    assert_distributed,
    evidence_error,
    linear,
    run,
)
from tests.inference.sampling.test_modes import box

QUICK = SamplerSettings(walkers=32, steps=50, max_steps=50, keep=50)


def slow(*case: float):
    """One more case of the same, for `make test-slow`."""
    return pytest.param(*case, marks=pytest.mark.slow)


def test_a_normal_posterior_with_known_noise() -> None:
    model = linear()
    draws = run(model.log_prob_known, np.zeros(3), np.eye(3))
    assert draws.report.passed
    for i in range(3):
        assert_distributed(draws, lambda t, i=i: t[:, i], model.marginal_known(i))
    exact = np.linalg.inv(model.precision)
    size = draws.report.ess_bulk.min()
    scale = np.sqrt(np.outer(np.diag(exact), np.diag(exact)))
    # The sd of a sample covariance of normals is at most sqrt(2/size) of the product of sds.
    error = np.abs(np.cov(draws.flat.T) - exact) / scale
    assert error.max() < 5.0 * np.sqrt(2.0 / size)
    assert abs(draws.log_evidence - model.log_evidence_known()) < 5.0 * evidence_error(draws)


def test_an_unknown_noise_scale() -> None:
    model = linear()
    draws = run(model.log_prob_unknown, np.zeros(4), np.eye(4))
    assert draws.report.passed
    for i in range(3):
        assert_distributed(draws, lambda t, i=i: t[:, i], model.marginal_unknown(i))
    assert_distributed(draws, lambda t: np.exp(2.0 * t[:, 3]), model.sigma2())
    assert abs(draws.log_evidence - model.log_evidence_unknown()) < 5.0 * evidence_error(draws)


def test_heavy_tails() -> None:
    target = stats.multivariate_t([1.0, -1.0], [[1.0, 0.6], [0.6, 2.0]], df=3)
    draws = run(target.logpdf, np.zeros(2), np.eye(2))
    assert draws.report.passed
    assert_distributed(draws, lambda t: t[:, 0], stats.t(3, 1.0))
    assert_distributed(draws, lambda t: t[:, 1], stats.t(3, -1.0, np.sqrt(2.0)))


def two_modes(distance: float):
    def log_prob(t):
        one, other = (stats.norm.logpdf(t[:, 0] - sign * distance).clip(-1e300) for sign in (-1, 1))
        rest = stats.norm.logpdf(t[:, 1])
        return np.logaddexp(np.log(0.3) + one, np.log(0.7) + other) + rest

    return log_prob


def test_two_overlapping_modes_come_out_in_their_proportions() -> None:
    draws = run(two_modes(2.5), np.array([-2.5, 0.0]), np.eye(2))
    assert draws.report.passed
    left = (draws.t[..., 0] < 0.0).mean(axis=(1, 2))  # of each ensemble
    # Phi(-2.5) of either mode lies on the other side.
    expected = 0.3 * stats.norm.cdf(2.5) + 0.7 * stats.norm.cdf(-2.5)
    assert abs(left.mean() - expected) < 5.0 * np.sqrt(0.25 / draws.report.ess_bulk.min())


@pytest.mark.parametrize("distance", [4.0, slow(6.0)])
@pytest.mark.parametrize("seed", [0, slow(1)])
def test_a_mode_that_is_hard_to_reach_comes_out_right_or_is_refused(
    distance: float, seed: int
) -> None:
    """Started in the lesser of two modes up to 12 sd apart, told nothing of the other.

    Farther off (16 sd) nothing that the sampler sees tells of the other mode, and the gate passes:
    there it is the search for modes that finds both.
    """
    short = SamplerSettings(max_steps=800)
    guess = np.array([-distance, 0.0])
    draws = run(two_modes(distance), guess, np.eye(2), seed=seed, settings=short)
    left = (draws.t[..., 0] < 0.0).mean()
    right = abs(left - 0.3) < 5.0 * np.sqrt(0.25 / draws.report.ess_bulk.min())
    assert right or not draws.report.passed


def test_a_mode_that_only_walkers_know_is_sampled_in_its_proportion() -> None:
    """The guess is of one mode; the walkers of the last ensemble start in both.

    Three hundredths lie 40 sd away, where neither the first proposal nor a local move ever goes.
    """

    def log_prob(t):
        modes = [stats.norm.logpdf(t[:, 0], m).clip(-1e300) for m in (0.0, 40.0)]
        return np.logaddexp(np.log(0.97) + modes[0], np.log(0.03) + modes[1]) + rest(t)

    def rest(t):
        return stats.norm.logpdf(t[:, 1])

    rng = np.random.default_rng(1)
    born = rng.standard_normal((320, 2))
    born[:16, 0] += 40.0
    shares = []
    for settings in (SamplerSettings(max_steps=192), SamplerSettings()):
        draws = run(log_prob, np.zeros(2), np.eye(2), settings=settings, last_starts=born)
        shares.append((draws.t[..., 0] > 20.0).mean())
        if settings.max_steps == 192:
            assert not draws.report.passed
            assert "of the draws lie where hardly any was proposed" in draws.report.reasons[-1]
        else:
            assert draws.report.passed
    assert abs(shares[1] - 0.03) < 5.0 * np.sqrt(0.03 * 0.97 / draws.report.ess_bulk.min())


def test_modes_far_apart_are_found_by_the_search() -> None:
    """Two modes 60 sd apart, both seen from the prior: the ensembles visit them in proportion."""
    priors = box((-60.0, 60.0), (-60.0, 60.0))

    def log_prob(t):
        return np.where(np.isfinite(priors.log_prob(t)), two_modes(30.0)(t), -np.inf)

    rng = np.random.default_rng(5)
    modes = find_modes(log_prob, priors, rng)
    assert sorted(round(float(m.t[0])) for m in modes) == [-30, 30]
    draws = sample_density(
        log_prob, [Guess(m.t, np.linalg.cholesky(m.covariance)) for m in modes],
        np.random.SeedSequence(5).spawn(5), ("x0", "x1"), SamplerSettings(), rng=rng,
    )  # fmt: skip
    assert draws.report.passed
    left = (draws.t[..., 0] < 0.0).mean()
    assert abs(left - 0.3) < 5.0 * np.sqrt(0.25 / draws.report.ess_bulk.min())


def ridge(thinness: float):
    """The first coordinate standard normal, each of the others near half its square."""

    def log_prob(t):
        bent = (t[:, 1:] - 0.5 * t[:, :1] ** 2) / thinness
        return -0.5 * (t[:, 0] ** 2 + np.square(bent).sum(axis=1))

    return log_prob


def on_ridge(d: int, thinness: float, max_steps: int) -> Draws:
    covariance = np.diag([1.0, *np.full(d - 1, thinness**2)])
    settings = SamplerSettings(max_steps=max_steps)
    return run(ridge(thinness), np.zeros(d), covariance, settings=settings)


@pytest.mark.slow
def test_an_attempt_that_fails_teaches_the_next() -> None:
    first, whole = (on_ridge(4, 0.3, steps) for steps in (200, 1600))
    assert not first.report.passed
    assert whole.report.passed
    assert whole.efficiency > first.efficiency
    assert_distributed(whole, lambda t: t[:, 0], stats.norm())
    assert_distributed(whole, lambda t: t[:, 3] - 0.5 * t[:, 0] ** 2, stats.norm(0.0, 0.3))


@pytest.mark.parametrize(("d", "thinness"), [(2, 0.05), slow(4, 0.1), slow(7, 0.3)])
def test_thin_bent_ridges_come_out_right_or_are_refused(d: int, thinness: float) -> None:
    draws = on_ridge(d, thinness, 400)
    if draws.report.passed:
        assert_distributed(draws, lambda t: t[:, 0], stats.norm())


def test_distant_modes_come_out_in_their_proportions() -> None:
    """A square tells no sign: modes 80 sd apart, which no local move ever crosses."""
    slip = np.linspace(0.0, 0.2, 12)
    pull = 4.0 + 0.05 * np.random.default_rng(3).standard_normal(12)
    priors = (normal("a", 0.4, 2.0), fixed("sigma", 0.05))
    problem = problem_of(lambda a, x: a * a + 0.0 * x, priors, slip, pull)
    draws = sample_posterior(problem, 0)
    assert draws.report.passed
    grid = np.concatenate([np.linspace(-2.1, -1.9, 4001), np.linspace(1.9, 2.1, 4001)])[:, None]
    density = np.exp(problem.log_prob(grid) - problem.log_prob(grid).max())
    exact = density[4001:].sum() / density.sum()
    right = (draws.flat[:, 0] > 0.0).astype(float)
    ensembles, walkers, steps, _ = draws.t.shape
    size = float(ess(right.reshape(ensembles * walkers, steps, 1), "mean")[0])
    assert abs(right.mean() - exact) < SIGMAS * np.sqrt(exact * (1.0 - exact) / size)
    ln_evidence = np.log(density.sum() * 5e-5) + problem.log_prob(grid).max()
    assert abs(draws.log_evidence - ln_evidence) < SIGMAS * evidence_error(draws)


def test_a_run_extends_itself_until_the_gate_passes() -> None:
    model = linear()
    short = SamplerSettings(steps=10, max_steps=10_000)
    draws = run(model.log_prob_known, np.zeros(3), np.eye(3), settings=short)
    assert draws.report.passed
    assert draws.report.steps > 10
    assert draws.t.shape == (4, 128, min(32, draws.report.steps), 3)
    assert draws.walkers == 320


@pytest.mark.parametrize(("steps", "most", "done"), [(10, 39, 39), (200, 30, 30)])
def test_extension_stops_where_it_is_told_to(steps: int, most: int, done: int) -> None:
    settings = SamplerSettings(steps=steps, max_steps=most)
    draws = run(linear().log_prob_known, np.zeros(3), np.eye(3), settings=settings)
    assert draws.report.steps == done
    assert not draws.report.passed
    assert any("steps/tau" in reason for reason in draws.report.reasons)


def test_progress_counts_up_to_what_is_planned(rut_tables: tuple[Table, Table]) -> None:
    seen: list[tuple[int, int]] = []
    problem = build_problem("modified_bekker", rut_tables[0])
    sample_posterior(
        problem, 3, settings=QUICK, progress=lambda done, planned: seen.append((done, planned))
    )
    assert [done for done, _ in seen] == sorted(done for done, _ in seen)
    assert seen[-1][0] == seen[-1][1]


def test_no_parameters_of_positive_probability(rut_tables: tuple[Table, Table]) -> None:
    problem = build_problem("modified_bekker", rut_tables[0], fixed={"sigma": -1.0})
    with pytest.raises(CalibError, match="no parameter values of positive probability") as caught:
        sample_posterior(problem, 1)
    assert "he2019 rut_depth" in str(caught.value)
    assert "hint:" in str(caught.value)


def test_data_that_the_model_meets_exactly_are_refused() -> None:
    """Whatever sigma is, a smaller one fits better: nothing is sampled."""
    slip = np.linspace(0.1, 0.5, 9)
    priors = (normal("a", 0.0, 3.0), normal("b", 0.0, 3.0), normal("sigma", -2.0, 2.0, log=True))
    for noise, refused in ((0.0, True), (1e-3, False)):
        pull = 1.0 + 2.0 * slip + noise * np.sin(50.0 * slip)
        problem = problem_of(lambda a, b, x: a + b * x, priors, slip, pull)
        if refused:
            with pytest.raises(CalibError, match="the model meets the data exactly"):
                sample_posterior(problem, 1)
        else:
            sample_posterior(problem, 1, settings=QUICK)


def test_a_density_that_is_almost_nowhere_positive_cannot_be_started() -> None:
    def log_prob(t):
        return np.where((t == 0.0).all(axis=1), 0.0, -np.inf)

    with pytest.raises(CalibError, match="could not be started"):
        run(log_prob, np.zeros(2), np.eye(2), settings=QUICK)


def test_draws_of_a_calibration_belong_together(rut_calibration) -> None:
    draws: Draws = rut_calibration.draws
    picked = draws.t[:, ::10, ::20]
    expected = rut_calibration.problem.log_prob(picked.reshape(-1, picked.shape[-1]))
    np.testing.assert_allclose(draws.log_prob[:, ::10, ::20].ravel(), expected, rtol=1e-10)
    assert not any((draws.t[i] == draws.t[j]).any() for i in range(4) for j in range(i))
    np.testing.assert_array_equal(draws.flat[0], draws.t[0, 0, 0])
    np.testing.assert_array_equal(draws.flat[-1], draws.t[-1, -1, -1])
    assert 0.0 < draws.acceptance < 1.0
    assert draws.evaluations > draws.t[..., 0].size


def wide(t):
    return stats.norm.logpdf(t, 0.0, 10.0).sum(axis=1)


def test_draws_that_are_annealed_keep_the_proportions_of_modes() -> None:
    def two(t):
        one, other = (stats.norm.logpdf(t[:, 0], m, 0.1) for m in (-5.0, 5.0))
        return np.logaddexp(np.log(0.2) + one, np.log(0.8) + other) + stats.norm.logpdf(t[:, 1])

    shares = []
    for seed in range(6):
        rng = np.random.default_rng(seed)
        found = anneal(wide, two, 10.0 * rng.standard_normal((1000, 2)), rng)
        assert found is not None
        shares.append((found[:, 0] < 0.0).mean())
        # Resampled draws are worth fewer than as many independent ones: a fifth at the least.
        assert abs(found[:, 1].mean()) < 5.0 / np.sqrt(200)
        assert found[:, 1].std() == pytest.approx(1.0, abs=5.0 / np.sqrt(2.0 * 200))
    assert abs(np.mean(shares) - 0.2) < 5.0 * np.std(shares) / np.sqrt(len(shares))
    assert min(shares) > 0.05


def test_draws_are_annealed_to_where_the_density_is_positive() -> None:
    edge = 10.0 * stats.norm.ppf(0.01)
    rng = np.random.default_rng(1)
    draws = 10.0 * rng.standard_normal((1000, 2))
    found = anneal(wide, lambda t: np.where(t[:, 0] < edge, wide(t), -np.inf), draws, rng)
    assert found is not None
    assert (found[:, 0] < edge).all()
    assert len(np.unique(found[:, 0])) > 500
    assert anneal(wide, lambda t: np.full(len(t), -np.inf), draws, rng) is None


@pytest.mark.parametrize("walkers", [0, 7])
def test_too_few_walkers_are_refused(walkers: int) -> None:
    with pytest.raises(CalibError, match=f"{walkers} walkers are too few for 4 parameters"):
        SamplerSettings(walkers=walkers).n_walkers(4)
