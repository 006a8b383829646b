"""A slow reference for the diagnosis: `python -m tests.gap.reference CASE [--particles N]`.

Each explanation in play is drawn again, over all its coordinates, by likelihood-tempered sequential
Monte Carlo (Del Moral, Doucet & Jasra 2006, doi:10.1111/j.1467-9868.2006.00553.x). Particles of the
prior are reweighted with the likelihood to a small power more, resampled, and moved by random
walks, each half by the covariance of the other. Nothing is linearised or integrated out. An
evidence has an error of some 0.15 nats with 1000 particles.
"""

from __future__ import annotations

import argparse
from collections.abc import Mapping
from pathlib import Path

import numpy as np
from scipy.optimize import brentq
from scipy.special import logsumexp

from calib.batch.environment import one_thread
from calib.gap.case import read_case
from calib.gap.diagnose import screened_ranking
from calib.gap.effects import EFFECTS
from calib.gap.fit import Residuals
from calib.gap.forward import Forward
from calib.gap.mixture import inclusion_probability
from calib.gap.odds import likelihood_tempering, ln_relevant, probabilities, sizes
from calib.gap.ranking import Ranking, calibrate_lab
from calib.inference.proposal import systematic

type Array = np.ndarray
EVEN, ODD = slice(0, None, 2), slice(1, None, 2)


def ln_evidence(forward: Forward, particles: int, rng: np.random.Generator) -> tuple[float, Array]:
    """Draw the posterior of a hypothesis.

    Returns
    -------
    float
        Log evidence of the prior with causes of any size.
    ndarray, shape (particles, d)
        Draws of psi, all of the same weight.
    """
    problem = Residuals(forward.data, forward)

    def ln_likelihood(psi: Array) -> Array:
        with np.errstate(all="ignore"):
            value = problem.ln_averaged(problem.raw(psi))
        return np.where(np.isfinite(value), value, -1e300)

    psi = forward.prior_draws(rng, particles)
    prior, likelihood = forward.log_prior(psi), ln_likelihood(psi)
    power, ln_z, scale = 0.0, 0.0, 1.0
    while power < 1.0:
        following = _following(power, likelihood)
        ln_weight = (following - power) * likelihood
        ln_z += float(logsumexp(ln_weight) - np.log(particles))
        picked = systematic(np.exp(ln_weight - logsumexp(ln_weight)), particles, rng)
        psi, prior, likelihood = psi[picked], prior[picked], likelihood[picked]
        power = following
        # More steps than coordinates take to mix. Each half of the particles is moved by the
        # covariance of the other: by their own they would draw together.
        for _ in range(20 + 2 * psi.shape[1]):
            for half, other in (EVEN, ODD), (ODD, EVEN):
                spread = np.cov(psi[other], rowvar=False).reshape(psi.shape[1], -1)
                root = np.linalg.cholesky(spread + 1e-9 * np.diag(np.diag(spread) + 1e-12))
                length = scale * 2.38 / np.sqrt(psi.shape[1])
                moved = psi[half] + length * rng.standard_normal(psi[half].shape) @ root.T
                prior_there = forward.log_prior(moved)
                there = np.full(len(moved), -1e300)
                inside = np.isfinite(prior_there)
                if inside.any():
                    there[inside] = ln_likelihood(moved[inside])
                gain = np.where(inside, prior_there, -np.inf) - prior[half]
                gain = gain + power * (there - likelihood[half])
                taken = np.log(rng.random(len(moved))) < gain
                psi[half] = np.where(taken[:, None], moved, psi[half])
                prior[half] = np.where(taken, prior_there, prior[half])
                likelihood[half] = np.where(taken, there, likelihood[half])
                scale *= float(np.exp(0.5 * (taken.mean() - 0.234)))
    return ln_z, psi


def _following(power: float, likelihood: Array) -> float:
    """Return the power at which nine tenths of the particles still count."""

    def left(following: float) -> float:
        ln = (following - power) * likelihood
        most = 0.9 * likelihood.size
        return float(np.exp(2.0 * logsumexp(ln) - logsumexp(2.0 * ln))) - most

    return 1.0 if left(1.0) >= 0.0 else float(brentq(left, power, 1.0))


def reference(
    ranking: Ranking, particles: int, runs: int, seed: int, least: float = 0.005
) -> tuple[dict[str, float], dict[str, float]]:
    """Compute the probabilities of the explanations in play again.

    Returns
    -------
    dict of str to float
        By hypothesis, all of at least `least`.
    dict of str to float
        Standard errors of their log evidence, from run to run.
    """
    found: dict[str, float] = {}
    errors: dict[str, float] = {}
    for name in ranking.order:
        if ranking.probability[name] < least:
            continue
        scores = np.array(ranking.scores[name])
        each = np.full((runs, scores.size), -np.inf)
        for i, (fit, score) in enumerate(zip(ranking.fits[name], scores, strict=True)):
            if score < scores.max() - 5.0:
                each[:, i] = score
                continue
            # What the relevant prior and the share of a variant add is by the same draws.
            noise = calibrate_lab(fit.forward.data, seed)[1]
            for run in range(runs):
                rng = np.random.default_rng([seed, run, i, len(name)])
                value, psi = ln_evidence(fit.forward, particles, rng)
                own = score - fit.log_evidence
                if fit.forward.causes:
                    own -= ln_relevant(sizes(fit.forward, noise, fit.sample))
                    own += ln_relevant(sizes(fit.forward, noise, psi))
                each[run, i] = value + own
        by_run = logsumexp(each, axis=1)
        found[name] = float(logsumexp(by_run) - np.log(runs))
        errors[name] = float(by_run.std(ddof=1) / np.sqrt(runs)) if runs > 1 else np.nan
    coarse = likelihood_tempering(ranking.gap)
    return probabilities(found, ranking.odds, coarse), errors


def main() -> None:
    """Print both, by hypothesis and by cause."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("case", type=Path)
    parser.add_argument("--particles", type=int, default=1000)
    parser.add_argument("--runs", type=int, default=2)
    parser.add_argument("--seed", type=int, default=1)
    asked = parser.parse_args()
    with one_thread():
        _, ranking, _ = screened_ranking(read_case(asked.case), asked.seed, EFFECTS)
        there, errors = reference(ranking, asked.particles, asked.runs, asked.seed)
    whole = sum(ranking.probability[name] for name in there)
    here: Mapping[str, float] = {name: ranking.probability[name] / whole for name in there}
    for name in there:
        print(f"{name}: {here[name]:.3f}, reference {there[name]:.3f} (± {errors[name]:.2f} nats)")
    one, other = inclusion_probability(here), inclusion_probability(there)
    for cause in one:
        print(f"  {cause} acts: {one[cause]:.3f}, reference {other[cause]:.3f}")


if __name__ == "__main__":
    main()
