"""Draws of a hypothesis: of the posterior itself, also where the normal about its mode is wrong."""

from __future__ import annotations

from dataclasses import replace

import emcee
import numpy as np
import pytest

from calib.gap.campaigns import campaigns
from calib.gap.effects import EFFECTS
from calib.gap.fit import fit
from calib.gap.forward import Forward
from calib.gap.hypotheses import Hypothesis, effect_priors
from calib.gap.importance import refine
from calib.gap.noise import Noise
from calib.gap.ranking import rank
from calib.he2019.gaps import paper_gaps
from tests.gap.cases import make_case
from tests.gap.fits import averaged_log_joint


def fitted(name: str, models: dict[str, str], **case):
    data = campaigns(make_case(name, models=models, **case))
    effect = EFFECTS[name]
    h = Hypothesis(name, (effect,), (effect_priors(data, effect),))
    noise = dict.fromkeys(models, 0.05)
    forward = Forward(data, h, noise)
    start = np.array([p.loc for p in forward.priors.free])
    return fit(forward, start, {o: Noise(s, 0.0) for o, s in noise.items()})


def long_chain(found, seed: int) -> np.ndarray:
    """Draw by emcee alone, an independent check, shape (draws, d)."""
    d = found.psi.size
    rng = np.random.default_rng(seed)
    scale = np.sqrt(np.diag(found.covariance))
    start = found.psi + 0.2 * scale * rng.standard_normal((64 * d, d))
    *_, lower, upper, _ = found.forward.priors._arrays
    start = np.clip(start, lower + 1e-6, upper - 1e-6)
    moves = emcee.moves.DEMove()
    sampler = emcee.EnsembleSampler(
        64 * d, d, lambda psi: averaged_log_joint(found, psi), vectorize=True, moves=moves
    )
    sampler.random_state = np.random.RandomState(seed).get_state()
    # Autocorrelation times are up to 47 steps: thousands of effective draws.
    sampler.run_mcmc(start, 1000)
    return np.asarray(sampler.get_chain(discard=400, thin=20, flat=True))


@pytest.mark.parametrize(
    "name", ["slip_zero_shift", pytest.param("slip_sinkage", marks=pytest.mark.slow)]
)
def test_draws_are_those_of_the_posterior(name):
    found = fitted(
        name, {"rut_depth": "modified_bekker"}, size={"growth": 0.8, "radius_error": 0.05}
    )
    better = refine(found, 1)
    assert better.sample is not None
    exact = long_chain(found, 2)
    sd = exact.std(axis=0)
    # At least 120 effective draws: sds within 20 % and means within 0.3 sd in 3 standard errors;
    # the rest is the chain's own error.
    assert np.abs(better.sample.mean(axis=0) - exact.mean(axis=0)).max() < 0.4 * sd.max()
    ratio = better.sample.std(axis=0) / sd
    assert ratio.min() > 0.7
    assert ratio.max() < 1.4


def test_draws_of_a_bent_posterior_are_there_whatever_the_seed():
    """From 20 rows, size, exponent and form of slip sinkage are told apart by their priors alone.

    With the weights of the last round alone, one seed in seven kept the normal.
    """
    case = next(gap.case for gap in paper_gaps() if gap.name == "plain_bekker")
    few = {"slip_sinkage": EFFECTS["slip_sinkage"]}
    found = rank(campaigns(case), 1, effects=few).best("slip_sinkage")
    exact = long_chain(found, 2).std(axis=0)
    for seed in range(1, 21):
        sample = refine(found, seed).sample
        assert sample is not None
        # Sds of 500 draws have a standard error of 3 %, 5 % with heavy tails.
        np.testing.assert_allclose(sample.std(axis=0) / exact, 1.0, atol=0.25)


def test_a_hopeless_normal_is_left_as_it_is():
    found = fitted("slip_zero_shift", {"rut_depth": "modified_bekker"})
    hopeless = replace(found, psi=found.psi + 40.0 * np.sqrt(np.diag(found.covariance)))
    tight = replace(hopeless, covariance=found.covariance * 1e-6)
    assert refine(tight, 1).sample is None
