"""Relevance: hypotheses are about effects large enough to matter."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.stats import norm

import calib.gap.odds as module
from calib.gap.forward import Forward
from calib.gap.hypotheses import joined, singles, unknowns
from calib.gap.noise import Noise, noise_conditions
from calib.gap.odds import sizes, sizes_of_all
from tests.gap.cases import CHOICE, campaigns_of, ranking_of
from tests.gap.fits import SIGMA, fit_at


def fit_of(case: str | None, name: str):
    return ranking_of(case).fits[name][0]


def ln_size_restriction(fit, seed: int, draws: int) -> float:
    (found,) = module.ln_size_restriction([(fit, draws)], seed)
    return found


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
    found = ln_size_restriction(fit, 1, n)
    shares = (after * n + 0.2) / (n + 0.4), beyond(prior.loc, prior.scale)
    # Sds of a logarithm of a share: of the posterior, where it is small, some draws.
    sd = np.sqrt((1.0 - shares[0]) / (n * shares[0]) + (1.0 - shares[1]) / (n * shares[1]))
    assert found == pytest.approx(np.log(shares[0] / shares[1]), abs=5.0 * sd + 0.02)


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
