"""Carry draws of one density over to another: the sampler's way from the prior to the posterior.

Sequential Monte Carlo (Del Moral, Doucet & Jasra 2006, doi:10.1111/j.1467-9868.2006.00553.x). The
target moves from the first density to the second in steps that leave half of the draws effective;
after each, draws are resampled and moved by differential evolution, which emcee provides. It knows
of no optimum, so that what it ends in is a check on a search for modes.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from scipy.special import logsumexp

from calib.inference.sampling.proposal import systematic
from calib.inference.sampling.walkers import local_moves, run_walkers
from calib.models.base import Array

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
