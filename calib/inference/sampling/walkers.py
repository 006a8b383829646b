"""Walkers of emcee, moved by differential evolution and by draws from a fitted proposal."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from calib.inference.diagnostics import autocorrelation_time
from calib.inference.sampling.proposal import Proposal
from calib.models.base import Array

# Walkers whose autocorrelations are averaged, evenly picked.
_WALKERS_OF_TAU = 64

type Moves = Sequence[tuple[Any, float]]


def local_moves() -> Moves:
    """Differential evolution (ter Braak 2006, doi:10.1007/s11222-006-8769-1); a tenth are jumps.

    Steps of many lengths: short ones are accepted in corners. Whole differences carry walkers from
    mode to mode.
    """
    import emcee  # late: half a second, which predicting from a posterior does without

    return [(emcee.moves.DEMove(sigma=1.0), 0.9), (emcee.moves.DEMove(gamma0=1.0), 0.1)]


def fitted_moves(proposal: Proposal, rng: np.random.Generator) -> Moves:
    """Independent draws from a proposal in seven of ten steps, local moves in the others."""
    import emcee

    def draw(coords: Array, _: Any) -> tuple[Array, Array]:
        new, log_q = proposal.draw(rng, len(coords))
        return new, proposal.log_prob(coords) - log_q

    return [
        (emcee.moves.MHMove(draw), 0.7),
        *((move, 0.3 * share) for move, share in local_moves()),
    ]


def run_walkers(
    log_prob: Callable[[Array], Array],
    start: Array,
    moves: Moves,
    steps: int,
    rng: np.random.Generator,
) -> tuple[Array, Array, float]:
    """Run walkers from where they start, shape (walkers, d), every one of positive density.

    Returns
    -------
    chain : ndarray, shape (steps, walkers, d)
    log_prob : ndarray, shape (steps, walkers)
    accepted : float
        Fraction of the moves.

    Raises
    ------
    ValueError
        If the density is not a number somewhere.
    """
    import emcee

    sampler = emcee.EnsembleSampler(*start.shape, log_prob, vectorize=True, moves=moves)
    # emcee's wrapper prints the arguments of whatever ends a call, an interruption as well.
    sampler.log_prob_fn = log_prob
    # emcee ignores a state that it cannot take without a word.
    state: Any = np.random.RandomState(np.random.MT19937(rng.integers(2**63))).get_state()
    sampler.random_state = state
    if not np.array_equal(sampler.random_state[1], state[1]):
        raise RuntimeError("emcee did not take the random state")
    with warnings.catch_warnings():
        # numpy 2 deprecates what emcee does inside its moves.
        warnings.simplefilter("ignore", DeprecationWarning)
        sampler.run_mcmc(start, steps, skip_initial_state_check=True)
    accepted = float(np.mean(sampler.acceptance_fraction))
    return sampler.get_chain(), sampler.get_log_prob(), accepted


def longest_tau(chain: Array) -> Array:
    """Autocorrelation times of a chain (steps, walkers, d), shape (d,).

    The larger of a coordinate's own and that of its distance from its median: a walker that goes to
    and fro between two modes has little autocorrelation of its own to show.
    """
    some = chain[:, :: max(1, chain.shape[1] // _WALKERS_OF_TAU)].transpose(1, 0, 2)
    folded = abs(some - np.median(some, axis=(0, 1)))
    tau = np.maximum(autocorrelation_time(some), autocorrelation_time(folded))
    # A constant chain has no autocorrelation time; it must fail the gate.
    return np.where(np.isfinite(tau), np.maximum(tau, 1.0), np.inf)
