"""Walkers of emcee, and sequential Monte Carlo from the prior to the posterior.

Sequential Monte Carlo (Del Moral, Doucet & Jasra 2006, doi:10.1111/j.1467-9868.2006.00553.x). The
target moves from the first density to the second in steps that leave half of the draws effective;
after each, draws are resampled and moved by differential evolution, which emcee provides. It knows
of no optimum, so that what it ends in is a check on a search for modes.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from scipy.special import logsumexp

from calib.inference.diagnostics import autocorrelation_time
from calib.inference.sampling.proposal import Proposal, systematic
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


type LogProb = Callable[[Array], Array]

# Moves after each step of the target.
_MOVES = 8


def anneal(first: LogProb, second: LogProb, draws: Array, rng: np.random.Generator) -> Array | None:
    """Move draws (k, d) of one unnormalised density to another; None if it is zero at all of them.

    The second density must be zero wherever the first is.
    """
    done = 0.0
    while True:
        gain = second(draws) - first(draws)
        if not np.isfinite(gain).any():
            return None
        step = _step(gain, 1.0 - done)
        done += step
        log_weight = step * gain
        weight = np.exp(log_weight - logsumexp(log_weight))
        draws = draws[systematic(weight, weight.size, rng)]

        def tempered(t: Array, share: float = done) -> Array:
            low, high = first(t), second(t)
            with np.errstate(invalid="ignore"):  # where both are zero
                value = low + share * (high - low)
            return np.where(np.isfinite(high), value, -np.inf)

        draws = run_walkers(tempered, draws, local_moves(), _MOVES, rng)[0][-1]
        if done >= 1.0:
            return draws


def _step(gain: Array, most: float) -> float:
    """The largest step that leaves half of the possible draws effective, by bisection."""
    gain = gain[np.isfinite(gain)]

    def effective(step: float) -> float:
        return float(np.exp(2.0 * logsumexp(step * gain) - logsumexp(2.0 * step * gain)))

    if effective(most) >= 0.5 * gain.size:
        return most
    low, high = 0.0, most
    while high - low > 1e-3 * high:
        middle = 0.5 * (low + high) if low > 0.0 else 0.1 * high
        low, high = (middle, high) if effective(middle) >= 0.5 * gain.size else (low, middle)
    return low or high
