"""What the convergence gate lets through, and what it must not."""

from __future__ import annotations

import numpy as np
import pytest

from calib.inference import sampler as sampler_module
from calib.inference.diagnostics import (
    Gate,
    GateReport,
    convergence,
    ess,
    hdi,
    judge,
    longest_autocorrelation_time,
    psis,
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


@pytest.mark.parametrize(("drift", "lowest"), [(0.0, "tail"), (0.6, "bulk")])
def test_what_is_just_reached_is_enough(drift: float, lowest: str) -> None:
    draws = good() + np.linspace(0.0, drift, 200)[:, None]
    found = convergence(draws)
    ess_min = {"bulk": float(found.ess_bulk.min()), "tail": float(found.ess_tail.min())}
    assert min(ess_min, key=lambda which: ess_min[which]) == lowest
    limits = {"rhat_max": float(found.rhat.max()), "ess_min": ess_min[lowest], "taus_min": 50.0}
    assert judged(draws, 4.0, **limits).passed
    for name, value in limits.items():
        beyond = np.nextafter(value, 0.0 if name == "rhat_max" else np.inf)
        assert not judged(draws, 4.0, **{**limits, name: float(beyond)}).passed


def broken(how: str) -> np.ndarray:
    draws = good()
    rng = np.random.default_rng(2)
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
            draws[..., 0] = rng.standard_normal((4, 20, 1)) + 0.05 * draws[..., 0]
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
    assert not report.passed
    assert [r.split(" is ")[0] for r in report.reasons] == ["steps/tau of a", "steps/tau of b"]
    assert judged(good(), tau=3.9).passed


@pytest.mark.parametrize("tau", [np.inf, np.nan])
def test_no_autocorrelation_time_is_no_pass(tau: float) -> None:
    assert not judged(good(), tau=tau).passed


def test_too_few_draws_are_refused() -> None:
    """4 x 2 x 25 independent draws are worth about 200."""
    report = judged(good(steps=25)[:, :2], tau=0.5)
    assert not report.passed
    assert any("bulk ESS" in r and "at least 400" in r for r in report.reasons)


def test_tails_that_are_seldom_visited_are_refused_though_the_middle_mixes() -> None:
    """Signs are independent, but sizes stay for fifty steps: the means know, the tails do not."""
    draws = good()
    sizes = np.random.default_rng(3).choice([0.3, 3.0], (4, 20, 4))
    draws[..., 0] *= np.repeat(sizes, 50, axis=2)
    report = judged(draws, rhat_max=1.1, ess_min=8000.0)
    assert report.ess_bulk.min() > 12_000.0
    assert [r.split(" is ")[0] for r in report.reasons] == ["tail ESS of a"]


def test_fewer_than_four_ensembles_cannot_be_compared() -> None:
    report = judged(good()[:3])
    assert not report.passed
    assert "3 ensembles, at least 4 are needed" in report.reasons


def test_its_limits_are_those_that_are_recommended() -> None:
    """Vehtari et al. (2021) for R-hat and effective sizes; fifty times of emcee's documentation."""
    gate = Gate()
    assert (gate.rhat_max, gate.ess_min, gate.taus_min) == (1.01, 400.0, 50.0)


def test_the_limits_are_those_of_the_gate() -> None:
    assert not judged(good(), ess_min=50_000.0).passed
    assert not judged(good(), rhat_max=0.9).passed
    assert judged(broken("one ensemble elsewhere"), rhat_max=2.0, ess_min=1.0).passed


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


@pytest.mark.parametrize("length", [2, 20])
def test_going_to_and_fro_between_opposite_points_is_no_mixing(length: int) -> None:
    """Walkers that flip at every step and get a new pair after some: that is how long they take."""
    size = np.random.default_rng(1).standard_normal((4000 // length, 64, 2))
    chain = np.repeat(size, length, axis=0)
    chain[1::2] *= -1.0
    # 64 x 4000 steps give an autocorrelation time to a few per cent.
    np.testing.assert_allclose(longest_autocorrelation_time(chain), length, rtol=0.15)


def test_a_run_that_cannot_move_is_refused() -> None:
    """A density known at its starting points only: every proposal is rejected."""
    seen: set[bytes] = set()
    calls = 0

    def log_prob(t):
        nonlocal calls
        calls += 1
        keys = [row.tobytes() for row in t]
        if calls <= 8:  # four rounds of adaptation, and the starts of four ensembles
            seen.update(keys)
        return np.where([key in seen for key in keys], 0.0, -np.inf)

    draws = run(log_prob, np.zeros(2), np.eye(2), settings=SamplerSettings(max_steps=200))
    assert draws.acceptance == 0.0
    assert np.ptp(draws.t, axis=2).max() == 0.0
    assert not draws.report.passed
    assert any("steps/tau of x0 is 0" in reason for reason in draws.report.reasons)


# The statistics themselves


def test_effective_sizes_of_an_autoregressive_chain() -> None:
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


def test_r_hat_of_shifted_chains() -> None:
    x = np.random.default_rng(6).standard_normal((4, 1, 4000, 1))
    assert convergence(x).rhat[0] == pytest.approx(1.0, abs=2e-3)
    x[0] += 2.0
    # The means spread by sd 1 about their mean (0, 0, 0, 2): R-hat near sqrt(1 + 1) = 1.41, less
    # what ranking takes off.
    assert 1.2 < convergence(x).rhat[0] < 1.5


def test_the_highest_density_interval_of_a_skewed_distribution() -> None:
    draws = np.random.default_rng(7).exponential(size=40_000)
    low, high = hdi(draws, 0.9)
    assert low == pytest.approx(0.0, abs=1e-3)
    # -ln 0.1, with a quantile's error of sqrt(0.1 x 0.9/40000)/0.1 = 0.015.
    assert high == pytest.approx(np.log(10.0), abs=0.075)


def test_smoothed_weights_and_their_shape() -> None:
    """Ratios r = u^-k of uniform u have a Pareto tail of shape k."""
    u = np.random.default_rng(8).uniform(size=(1, 40_000))
    for k in (0.2, 0.5, 1.0):
        log_weight, shape = psis(-k * np.log(u))
        # The tail of 3 sqrt(n) = 600 values: sd about (1 + k)/sqrt(600) = 0.04 to 0.08.
        assert shape[0] == pytest.approx(k, abs=5.0 * (1.0 + k) / np.sqrt(600))
        assert log_weight.shape == (1, 40_000)
