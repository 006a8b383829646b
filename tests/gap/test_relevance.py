"""Relevance: hypotheses are about effects large enough to matter."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from scipy.stats import norm

import calib.gap.odds as module
from calib.gap.forward import Forward
from calib.gap.hypotheses import joined, singles, unknowns
from calib.gap.noise import Noise, noise_conditions
from calib.gap.odds import _log_share, sizes, sizes_of_all
from tests.gap.cases import CHOICE, campaigns_of, ranking_of
from tests.gap.fits import SIGMA, fit_at


def fit_of(case: str | None, name: str):
    return ranking_of(case).fits[name][0]


def relevance(fit, seed: int, draws: int) -> float:
    (found,) = module.relevance([(fit, draws)], seed)
    return found


def test_none_has_no_size_to_restrict():
    assert relevance(fit_of(None, "none"), 1, 200) == 0.0


def test_size_is_in_noise_sds_of_the_output_where_it_is_largest():
    fit = fit_of("force_offset", "force_offset")
    psi = np.tile(fit.psi, (2, 1))
    part = fit.forward.phi_slices[0]
    psi[0, part], psi[1, part] = 0.0, 0.1
    size = sizes(fit.forward, fit.noise, psi)
    assert size.shape == (2, 1)
    assert size[0, 0] == pytest.approx(0.0, abs=1e-12)
    # Ruts, which an offset of the pull does not touch, make it no smaller.
    at = noise_conditions(fit.forward.data.view)
    in_noise = 0.1 / fit.noise["drawbar_pull"].sd(at)
    assert size[1, 0] == pytest.approx(np.sqrt(np.mean(np.square(in_noise))))


def test_each_of_a_pair_has_its_own_size():
    fit = fit_of("force_offset", "force_offset+sensor_drift")
    psi = fit.psi[None].copy()
    offset, drift = fit.forward.phi_slices
    psi[:, drift.start] = 0.0
    psi[:, offset] = 0.2
    size = sizes(fit.forward, fit.noise, psi)
    assert size.shape == (1, 2)
    # One column for each effect left out: without the drift nothing changes.
    assert sorted(size[0] > 1e-9) == [False, True]


def test_a_large_effect_gains_and_an_invisible_one_loses():
    # A large one is relevant for certain, so that its evidence is divided by the prior share.
    assert relevance(fit_of("lug_thrust", "lug_thrust"), 1, 200) >= 0.0
    # On a null campaign, the posterior of an offset is far below one noise sd.
    assert relevance(fit_of(None, "force_offset"), 1, 200) < -1.0


def test_it_is_the_same_for_the_same_seed():
    fit = fit_of(None, "rate_effect")
    assert relevance(fit, 5, 200) == relevance(fit, 5, 200)


def test_a_discrepancy_of_both_outputs_is_as_large_as_where_it_is_smallest():
    h = next(
        h
        for h in unknowns(campaigns_of(None))
        if h.onset_over == "slip" and len(h.smooth_outputs) == 2
    )
    noise = {"drawbar_pull": Noise(0.03, 0.0), "rut_depth": Noise(0.05, 0.0)}
    forward = Forward(campaigns_of(None), h, {o: n.sigma for o, n in noise.items()})
    psi = np.array([[p.loc for p in forward.priors.free]] * 2)
    psi[:, forward.threshold] = -3.0  # everywhere beyond it: a constant
    psi[:, forward.smooth_slices["drawbar_pull"].start] = 0.3
    psi[1, forward.smooth_slices["rut_depth"].start] = 0.1
    # Ten noise sds of the pull, of the rut none and two.
    np.testing.assert_allclose(sizes(forward, noise, psi)[:, 0], [0.0, 2.0], rtol=1e-6)


@pytest.mark.parametrize("case", ["force_offset", None])
def test_it_is_the_posterior_share_of_relevant_sizes_over_the_prior_share(case):
    """Of an offset both are shares of a normal beyond 1.5 noise sds on either side."""
    fit = fit_of(case, "force_offset")
    (part,) = fit.forward.phi_slices
    (prior,) = fit.forward.hypothesis.effect_priors[0].free
    at = noise_conditions(fit.forward.data.view)
    rows = fit.forward.data.outputs[0].rows
    bar = 1.5 / np.sqrt(np.mean(np.square(1.0 / fit.noise["drawbar_pull"].sd(at.rows(rows)))))

    def beyond(mean, sd):
        return norm.sf(bar, mean, sd) + norm.cdf(-bar, mean, sd)

    # A form error of the size would make it another's.
    assert not any(s.stop > s.start for each in fit.forward.form_slices.values() for s in each)
    n = 20_000
    draws = fit.draws(np.random.default_rng(2), n)[:, part.start]
    after = beyond(draws.mean(), draws.std())
    found = relevance(fit, 1, n)
    shares = (after * n + 0.2) / (n + 0.4), beyond(prior.loc, prior.scale)
    # Sds of a logarithm of a share: of the posterior, where it is small, some draws.
    sd = np.sqrt((1.0 - shares[0]) / (n * shares[0]) + (1.0 - shares[1]) / (n * shares[1]))
    assert found == pytest.approx(np.log(shares[0] / shares[1]), abs=5.0 * sd + 0.02)


def test_alone_a_cause_counts_from_one_and_a_half_noise_sds_on_and_of_several_from_one():
    """As shares of the draws that say something, by a fifth of a draw off none and all."""
    alone = np.array([[1.5], [1.49], [2.0], [np.nan], [0.0]])
    assert _log_share(alone) == pytest.approx(np.log((2 + 0.2) / (4 + 0.4)))
    several = np.array([[1.0, 1.0], [1.0, 0.99], [0.0, 5.0], [np.inf, 5.0], [1.5, 1.6]])
    assert _log_share(several) == pytest.approx(np.log((2 + 0.2) / (4 + 0.4)))
    assert _log_share(np.zeros((3, 2))) == pytest.approx(np.log(0.2 / 3.4))


def test_no_gap_is_as_relevant_as_it_ever_was():
    forward = SimpleNamespace(hypothesis=SimpleNamespace(name="none"))
    assert relevance(SimpleNamespace(forward=forward), 1, 10) == 0.0


def test_prior_and_posterior_draws_are_told_by_their_effect_alone(monkeypatch):
    """The simulator stays as it was fitted; one is the share of what draws of the fit have."""
    data = campaigns_of(None)
    (single,) = singles(data, {"force_offset": CHOICE["force_offset"]})
    found = fit_at(data, single)
    part = found.forward.phi_slices[0]
    psi = found.psi.copy()
    psi[part] = 0.1  # over three noise sds
    large = replace(found, psi=psi)
    asked = []

    def noted(parts):
        asked.extend(psi for _, _, psi in parts)
        return sizes_of_all(parts)

    monkeypatch.setattr(module, "sizes_of_all", noted)
    gained = relevance(large, 3, 500)
    posterior, prior = asked
    np.testing.assert_allclose(posterior, np.tile(psi, (500, 1)), atol=1e-6)
    np.testing.assert_array_equal(prior[:, : part.start], np.tile(psi[: part.start], (500, 1)))
    assert np.unique(prior[:, part]).size == 500
    (offset,) = single.effect_priors[0].free
    share = 2.0 * norm.sf(1.5 * SIGMA["drawbar_pull"] / offset.scale)
    assert gained == pytest.approx(-np.log(share), abs=5.0 * np.sqrt((1 - share) / share / 500))


def test_of_several_causes_each_is_as_large_as_what_goes_with_it():
    data = campaigns_of(None)
    few = singles(data, {n: CHOICE[n] for n in ("force_offset", "rut_rebound")})
    both = fit_at(data, joined(*few))
    psi = both.psi.copy()
    psi[both.forward.phi_slices[0]] = 0.06
    found = sizes(both.forward, both.noise, psi[None])
    without = both.forward.without(psi[None], data.view, "rut_rebound")["rut_depth"]
    full = both.forward.field(psi[None], data.view)["rut_depth"]
    gone = np.sqrt(np.square((full - without) / SIGMA["rut_depth"]).mean())
    np.testing.assert_allclose(found, [[2.0, gone]])
    # One output that a shift leaves alone makes it no smaller, nor one that both outputs have.
    unknown = next(h for h in unknowns(data) if h.smooth_over == "level" and h.smooth == 1.5)
    alone = fit_at(data, unknown)
    psi = alone.psi.copy()
    psi[alone.forward.smooth_slices["drawbar_pull"].start] = 0.3
    assert sizes(alone.forward, alone.noise, psi[None])[0, 0] > 1.0


def test_what_no_draw_of_the_prior_makes_relevant_gains_nothing_by_it(monkeypatch):
    """Its share before the data is as good as none, and so is the ratio to that."""
    fit = fit_of("lug_thrust", "lug_thrust")

    def of_sizes(posterior: float, prior: float) -> float:
        monkeypatch.setattr(
            module, "sizes_of_all", lambda _: [np.full((n, 1), s) for n, s in (
                (1500, posterior), (400, prior))]
        )  # fmt: skip
        return relevance(fit, 1, 400)

    assert of_sizes(0.2, 0.3) == pytest.approx(np.log(0.2 / 1500.4))
    assert of_sizes(9.0, 0.3) == pytest.approx(np.log(1500.2 / 1500.4))
    assert of_sizes(9.0, 9.0) == pytest.approx(np.log(1500.2 / 1500.4 / (400.2 / 400.4)))


def test_sizes_of_many_hypotheses_are_those_of_each():
    """Whatever is asked for at once: of sets, shifts and discrepancies, few draws and many."""
    ranking = ranking_of("lug_thrust")
    rng = np.random.default_rng(4)
    asked = []
    for name, n in (("lug_thrust", 700), ("parameter_shift", 3), ("unknown", 90), ("none", 2),
                    ("lug_thrust+slip_sinkage", 900), ("parameter_shift+unknown", 5)):  # fmt: skip
        if name in ranking.fits:
            fit = ranking.fits[name][0]
            asked.append((fit.forward, fit.noise, fit.draws(rng, n)))
    assert len(asked) >= 5
    every = sizes_of_all(asked)
    for (forward, noise, psi), found in zip(asked, every, strict=True):
        assert found.shape == (len(psi), max(1, len(forward.causes)))
        some = slice(None, None, max(1, len(psi) // 3))
        np.testing.assert_allclose(found[some], sizes(forward, noise, psi[some]), rtol=1e-9)
        full = forward.field(psi[some], forward.data.view)
        for j, cause in enumerate(forward.causes if len(forward.causes) > 1 else ()):
            rest = forward.without(psi[some], forward.data.view, cause)
            at = noise_conditions(forward.data.view)
            written = np.max([
                np.sqrt(np.mean(np.square(
                    (full[o.name] - rest[o.name])[:, o.rows] / noise[o.name].sd(at.rows(o.rows))
                ), axis=1)) for o in forward.data.outputs
            ], axis=0)  # fmt: skip
            np.testing.assert_allclose(found[some, j], written, rtol=1e-9)
