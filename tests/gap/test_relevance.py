"""Relevance: hypotheses are about effects large enough to matter."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.stats import norm

from calib.gap.forward import Forward
from calib.gap.hypotheses import unknowns
from calib.gap.noise import Noise, noise_conditions
from calib.gap.relevance import relevance, sizes
from tests.gap.cases import campaigns_of, ranking_of


def fit_of(case: str | None, name: str):
    return ranking_of(case).fits[name][0]


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
