"""Statistics of chains against libraries and closed forms, and what the gate refuses."""

from __future__ import annotations

import numpy as np
import pytest

from calib.inference import sampler as sampler_module
from calib.inference.diagnostics import (
    Gate,
    GateReport,
    convergence,
    distances,
    ess,
    hdi,
    hdi_error,
    judge,
    longest_autocorrelation_time,
    mcse,
    median_error,
    power_scaled_weights,
    power_sensitivity,
    psis,
    rank_histograms,
    rank_scatter,
    tail_shape,
)
from calib.inference.sampler import SamplerSettings
from tests.inference.sampling.closed_form import linear, run

NAMES = ("a", "b")


def good(seed: int = 1, steps: int = 200) -> np.ndarray:
    return np.random.default_rng(seed).standard_normal((4, 20, steps, 2))


def judged(draws: np.ndarray, tau: float = 1.0, **gate: float) -> GateReport:
    return judge(draws, NAMES, Gate(**gate), tau=np.full(2, tau))


def test_independent_draws_pass() -> None:
    report = judged(good())
    assert report.passed
    assert report.reasons == ()
    # 16,000 independent draws: R-hat is 1 within a few times 1/sqrt(16000), ESS within 10 %.
    assert np.all(np.abs(report.rhat - 1.0) < 1e-3)
    assert np.all(np.abs(report.ess_bulk / 16_000 - 1.0) < 0.1)


def test_the_limits_are_the_recommended_ones_and_what_just_reaches_them_is_enough() -> None:
    """Vehtari et al. (2021) for R-hat and effective sizes; fifty times of emcee's documentation."""
    assert Gate() == Gate(rhat_max=1.01, ess_min=400.0, taus_min=50.0)
    rhat, bulk, tail = convergence(good())
    ess_min = float(min(bulk.min(), tail.min()))
    limits = {"rhat_max": float(rhat.max()), "ess_min": ess_min, "taus_min": 50.0}
    assert judged(good(), 4.0, **limits).passed
    for name, value in limits.items():
        beyond = np.nextafter(value, 0.0 if name == "rhat_max" else np.inf)
        assert not judged(good(), 4.0, **{**limits, name: float(beyond)}).passed


def broken(how: str) -> np.ndarray:
    draws = good()
    match how:
        case "everything constant":
            draws[..., 0] = 3.0
        case "one parameter NaN":
            draws[0, 0, 5, 0] = np.nan
        case "one ensemble elsewhere":
            draws[2, :, :, 0] += 1.0
        case "one ensemble stuck":
            draws[2, :, :, 0] = 1.0
        case "one ensemble too narrow":
            draws[2, :, :, 0] *= 0.2
        case "a drift":
            draws[..., 0] += np.linspace(0.0, 1.0, 200)
        case "walkers that hardly move":
            fixed = np.random.default_rng(2).standard_normal((4, 20, 1))
            draws[..., 0] = fixed + 0.05 * draws[..., 0]
    return draws


@pytest.mark.parametrize(
    ("how", "reason"),
    [
        ("everything constant", "of a is"),
        ("one parameter NaN", "R-hat of a is nan"),
        ("one ensemble elsewhere", "R-hat of a is"),
        ("one ensemble stuck", "R-hat of a is"),
        ("one ensemble too narrow", "R-hat of a is"),
        ("a drift", "R-hat of a is"),
        ("walkers that hardly move", "bulk ESS of a is"),
    ],
)
def test_bad_chains_are_refused_and_the_parameter_is_named(how: str, reason: str) -> None:
    report = judged(broken(how))
    assert not report.passed
    assert any(reason in r for r in report.reasons), report.reasons
    assert not any(" of b is" in r for r in report.reasons)


def test_too_short_chains_are_refused() -> None:
    report = judged(good(), tau=4.1)
    assert [r.split(" is ")[0] for r in report.reasons] == ["steps/tau of a", "steps/tau of b"]
    assert judged(good(), tau=3.9).passed
    assert not any(judged(good(), tau=tau).passed for tau in (np.inf, np.nan))
    few = judged(good(steps=25)[:, :2], tau=0.5)  # worth about 200 independent draws
    assert any("bulk ESS" in r and "at least 400" in r for r in few.reasons)
    assert "3 ensembles, at least 4 are needed" in judged(good()[:3]).reasons


def test_tails_that_are_seldom_visited_are_refused_though_the_middle_mixes() -> None:
    """Signs are independent, but sizes stay for fifty steps: the means know, the tails do not."""
    draws = good()
    sizes = np.random.default_rng(3).choice([0.3, 3.0], (4, 20, 4))
    draws[..., 0] *= np.repeat(sizes, 50, axis=2)
    report = judged(draws, rhat_max=1.1, ess_min=8000.0)
    assert report.ess_bulk.min() > 12_000.0
    assert [r.split(" is ")[0] for r in report.reasons] == ["tail ESS of a"]


def test_one_stuck_ensemble_is_refused_in_a_whole_run(monkeypatch: pytest.MonkeyPatch) -> None:
    run_of = sampler_module.run_walkers
    made: list[int] = []

    def stuck(*args):
        chain, log_prob, accepted = run_of(*args)
        made.append(len(made))
        if made[-1] == 1:
            chain[1:], log_prob[1:] = chain[:1], log_prob[:1]
        return chain, log_prob, accepted

    monkeypatch.setattr(sampler_module, "run_walkers", stuck)
    settings = SamplerSettings(max_steps=200)
    draws = run(linear().log_prob_known, np.zeros(3), np.eye(3), settings=settings)
    assert len(made) == 4
    assert not draws.report.passed


def test_a_run_that_cannot_move_is_refused() -> None:
    """A density known at its starting points only: every proposal is rejected."""
    seen: set[bytes] = set()
    calls = 0

    def log_prob(t):
        nonlocal calls
        calls += 1
        keys = [row.tobytes() for row in t]
        if calls <= 10:  # six rounds of adaptation, and the starts of four ensembles
            seen.update(keys)
        return np.where([key in seen for key in keys], 0.0, -np.inf)

    settings = SamplerSettings(max_steps=100)
    draws = run(log_prob, np.zeros(2), np.eye(2), settings=settings)
    assert draws.acceptance == 0.0
    assert not draws.report.passed
    assert any("steps/tau of x0 is 0" in reason for reason in draws.report.reasons)


@pytest.mark.parametrize("length", [2, 20])
def test_going_to_and_fro_between_opposite_points_is_no_mixing(length: int) -> None:
    """Walkers that flip at every step and get a new pair after some: that is how long they take."""
    size = np.random.default_rng(1).standard_normal((4000 // length, 64, 2))
    chain = np.repeat(size, length, axis=0)
    chain[1::2] *= -1.0
    # 64 x 4000 steps give an autocorrelation time to a few per cent.
    np.testing.assert_allclose(longest_autocorrelation_time(chain), length, rtol=0.15)
    chain[:, 3, 1] = 0.7  # a walker that never moved has none
    assert np.isinf(longest_autocorrelation_time(chain)).tolist() == [False, True]


def test_three_steps_say_nothing() -> None:
    assert np.isfinite(convergence(good(steps=4))[0]).all()
    assert np.isnan(convergence(good(steps=3))).all()


def test_effective_sizes_and_r_hat_in_closed_form() -> None:
    rng = np.random.default_rng(5)
    rho, n = 0.8, 5000
    noise = rng.standard_normal((8, n))
    x = np.zeros((8, n))
    x[:, 0] = noise[:, 0] / np.sqrt(1 - rho**2)
    for i in range(1, n):
        x[:, i] = rho * x[:, i - 1] + noise[:, i]
    size = float(ess(x[..., None], "mean")[0])
    # n (1 - rho)/(1 + rho) = 4444; the estimate varies by several percent.
    assert size == pytest.approx(8 * n * (1 - rho) / (1 + rho), rel=0.25)
    y = rng.standard_normal((4, 1, 4000, 1))
    y[0] += 2.0
    # The means spread by sd 1 about their mean (0, 0, 0, 2): R-hat near sqrt(1 + 1) = 1.41, less
    # what ranking takes off.
    assert 1.2 < convergence(y)[0][0] < 1.5


def test_errors_of_independent_draws_are_the_textbooks() -> None:
    """Of n normal draws the mean errs by s / sqrt n, the sd by s / sqrt 2n, the median more."""
    chains = np.random.default_rng(7).normal(0.0, [2.0, 5.0], (4, 5000, 2))
    mean, sd, median = (mcse(chains, method) for method in ("mean", "sd", "median"))
    root = np.array([2.0, 5.0]) / np.sqrt(20_000)
    # Of the effective size, estimated over some dozen lags, and of a density: some percent.
    np.testing.assert_allclose(mean, root, rtol=0.1)
    np.testing.assert_allclose(sd, root / np.sqrt(2.0), rtol=0.1)
    np.testing.assert_allclose(median, root * np.sqrt(np.pi / 2.0), rtol=0.2)


def test_errors_are_the_scatter_of_parts_over_a_root_of_their_number() -> None:
    """Parts that differ by a shift alone; the ends of an interval go with the cube root."""
    shifts = np.array([0.0, 1.0, 3.0, 4.0, 4.5, 6.0, 6.5, 7.0])
    parts = np.random.default_rng(5).gamma(2.0, 1.0, 400) + shifts[:, None]
    scatter = float(shifts.std(ddof=1))
    np.testing.assert_allclose(hdi_error(parts, 0.9), [scatter / 2.0, scatter / 2.0])
    assert median_error(parts) == pytest.approx(scatter / np.sqrt(8.0))


def test_the_highest_density_interval_of_a_skewed_distribution() -> None:
    low, high = hdi(np.random.default_rng(7).exponential(size=40_000), 0.9)
    assert low == pytest.approx(0.0, abs=1e-3)
    # -ln 0.1, with a quantile's error of sqrt(0.1 x 0.9/40000)/0.1 = 0.015.
    assert high == pytest.approx(np.log(10.0), abs=0.075)


@pytest.mark.parametrize("k", [0.2, 0.5, 1.0])
def test_tails_have_the_shape_of_their_pareto_distribution(k: float) -> None:
    """Ratios r = u^-k of uniform u have a Pareto tail of shape k."""
    u = np.random.default_rng(8).uniform(size=(1, 40_000))
    log_weight, shape = psis(-k * np.log(u))
    # The tail of 3 sqrt(n) = 600 values: sd about (1 + k)/sqrt(600) = 0.04 to 0.08.
    assert shape[0] == pytest.approx(k, abs=5.0 * (1.0 + k) / np.sqrt(600))
    assert log_weight.shape == (1, 40_000)
    heavy = (u.reshape(4, -1) ** -k - 1.0) / k
    found = tail_shape(np.stack([heavy, -heavy, u.reshape(4, -1)], axis=-1))
    np.testing.assert_allclose(found[:2], k, atol=0.3)
    assert found[2] < 0.0


def test_a_rank_histogram_counts_twentieths_of_all_draws() -> None:
    """One ensemble below the other: twice its even share in the lower ten, nothing above."""
    found = rank_histograms(np.arange(80.0).reshape(2, 40))
    np.testing.assert_array_equal(found, np.repeat([[2.0, 0.0], [0.0, 2.0]], 10, axis=1))
    for effective in (0.3, 400.0):  # binomial, never of less than one draw
        n = max(effective, 1.0)
        sd = np.sqrt(n * 0.05 * 0.95) / (n * 0.05)
        assert rank_scatter(effective) == pytest.approx(1.96 * sd)


@pytest.mark.parametrize(
    ("interval", "log"),
    [((1.0, 4.0), False), ((1.0, 4.01), True), ((0.0, 9.0), False), ((-1.0, 9.0), False)],
)
def test_distances_in_sds_of_logarithms_where_an_interval_spans_a_factor_of_four(
    interval, log
) -> None:
    """Of the draws those that have one; others are seldom so far outside the interval."""
    draws = np.array([-3.0, 0.0, 1.0, 2.0, 5.0])
    distance, ends, taken = distances(draws, np.array([3.0, np.nan]), interval)
    to, used = (np.log, draws[2:]) if log else (np.asarray, draws)
    middle, sd = to(used).mean(), to(used).std()
    assert taken is log
    np.testing.assert_allclose(distance, [(to(3.0) - middle) / sd, np.nan])
    np.testing.assert_allclose(ends, (to(np.array(interval)) - middle) / sd)


def test_raised_to_a_power_a_normal_has_another_variance() -> None:
    """Draws of variance one, whose density is raised by a quarter: variance 1/1.25."""
    draws = np.random.default_rng(9).standard_normal((4, 5000))
    lower, upper = (power_scaled_weights(-0.5 * draws**2, a) for a in (0.8, 1.25))
    assert upper.sum() == pytest.approx(1.0)
    # The sd of a variance of 20,000 draws is 1 %.
    assert (upper * draws**2).sum() == pytest.approx(0.8, abs=0.04)
    near = power_sensitivity(draws, (lower, upper), (0.8, 1.25))
    # The same marginals, had they needed powers that are three times as far apart.
    far = power_sensitivity(draws, (lower, upper), (0.8**3, 1.25**3))
    assert near == pytest.approx(3.0 * far)
    assert near > 0.0
