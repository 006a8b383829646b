"""One emcee ensemble: our pair move beside local ones."""

from __future__ import annotations

import warnings
from collections.abc import Callable

import emcee
import numpy as np
from numpy.typing import NDArray

from calib.chains import autocorrelation_time
from calib.errors import CalibError
from calib.models.base import Array
from calib.sampling.moves import PairMove, WalkMove
from calib.sampling.proposal import Proposal

__all__ = ["POOR", "Ensemble"]

# Efficiency below which the local moves do most of the work.
POOR = 0.1
# Efficiency above which they are there for safety only.
GOOD = 0.5
# Walkers whose autocorrelations are averaged, evenly picked.
_WALKERS_OF_TAU = 64


class Ensemble:
    """One independently seeded emcee ensemble that is run in stretches of a fixed kernel each."""

    def __init__(
        self,
        log_prob: Callable[[Array], Array],
        proposal: Proposal,
        seed: np.random.SeedSequence,
        *,
        walkers: int,
        ahead: int,
    ) -> None:
        self.log_prob_fn = log_prob
        self.ahead = ahead
        start, self.rng = (np.random.default_rng(child) for child in seed.spawn(2))
        self.random_state = np.random.RandomState(np.random.MT19937(seed)).get_state()
        self.state = _start(log_prob, proposal, walkers, start)

    def run(self, proposal: Proposal, efficiency: float, steps: int) -> None:
        """Run on with a proposal, forgetting the steps before."""
        # A good proposal does most of the work; a poor one leaves it to the local moves.
        independent = 0.95 if efficiency > GOOD else 0.9 if efficiency > POOR else 0.3
        if efficiency > POOR:
            local = [(WalkMove(proposal, self.rng), 1.0)]
        else:
            # Not emcee's snooker move: with half the exponent of ter Braak & Vrugt (2008) in its
            # acceptance it does not keep a normal. Whole differences jump between modes.
            local = [(emcee.moves.DEMove(), 0.7), (emcee.moves.DEMove(gamma0=1.0), 0.3)]
        self.sampler = emcee.EnsembleSampler(
            *self.state.coords.shape,
            self.log_prob_fn,
            vectorize=True,
            moves=[
                (PairMove(proposal, self.rng, self.ahead), independent),
                *((move, (1.0 - independent) * share) for move, share in local),
            ],
        )
        self.sampler.random_state = self.random_state
        if not np.array_equal(self.sampler.random_state[1], self.random_state[1]):
            # emcee ignores a state it does not like; the run would not be reproducible.
            raise RuntimeError("emcee did not take the random state")
        with warnings.catch_warnings():
            # numpy 2 deprecates what emcee does inside its moves.
            warnings.simplefilter("ignore", DeprecationWarning)
            end = self.sampler.run_mcmc(self.state, steps, skip_initial_state_check=True)
        # The random state travels apart, as a start may be without one.
        self.state = emcee.State(end.coords, log_prob=end.log_prob, copy=True)
        self.random_state = self.sampler.random_state

    @property
    def walkers(self) -> int:
        """Number of walkers."""
        return int(self.state.coords.shape[0])

    def drawn(self, steps: NDArray[np.intp], who: NDArray[np.intp]) -> tuple[Array, Array]:
        """Draws of some walkers at some steps of the stretch, (m, n, d), log densities (m, n)."""
        which = np.ix_(steps, who)
        t, log_prob = self.sampler.get_chain()[which], self.sampler.get_log_prob()[which]
        return t.transpose(1, 0, 2), log_prob.T

    def tau(self, target: int) -> Array:
        """Autocorrelation times over the last `target` steps, shape (d,).

        The larger of a coordinate's own and that of its distance from its median: a walker that
        goes to and fro between two opposite points has no autocorrelation of its own to show.
        """
        # A constant chain has no autocorrelation time; it must fail the gate.
        chain = self.sampler.get_chain()[-target:, :: max(1, self.walkers // _WALKERS_OF_TAU)]
        chain = chain.transpose(1, 0, 2)
        folded = abs(chain - np.median(chain, axis=(0, 1)))
        tau = np.maximum(autocorrelation_time(chain), autocorrelation_time(folded))
        return np.where(np.isfinite(tau), np.maximum(tau, 1.0), np.inf)

    @property
    def acceptance(self) -> float:
        """Fraction of proposals accepted."""
        return float(np.mean(self.sampler.acceptance_fraction))


def _start(
    log_prob: Callable[[Array], Array],
    proposal: Proposal,
    walkers: int,
    rng: np.random.Generator,
) -> emcee.State:
    """Overdispersed starting points, every one of positive probability.

    emcee accepts walkers that start where the density is zero without a word.
    """
    coords, values = np.empty((0, proposal.n_dim)), np.empty(0)
    for _ in range(500):
        drawn, _ = proposal.draw(rng, walkers)
        value = log_prob(drawn)
        good = np.isfinite(value)
        coords, values = np.concatenate([coords, drawn[good]]), np.append(values, value[good])
        if values.size >= walkers:
            return emcee.State(coords[:walkers], log_prob=values[:walkers])
    raise CalibError(
        "the sampler could not be started: almost no parameters near the mode are allowed",
        mend="widen the priors' bounds, or check the data's units",
    )
