"""One emcee ensemble: our pair move with local ones between."""

from __future__ import annotations

import warnings
from collections.abc import Callable
from typing import Any

import emcee
import numpy as np

from calib.errors import CalibError
from calib.inference.diagnostics import autocorrelation_time
from calib.inference.sampling.moves import PairMove, WalkMove
from calib.inference.sampling.proposal import Proposal
from calib.models.base import Array

# Efficiency of the proposal below which local moves do most of the work, and above which few do.
POOR, GOOD = 0.1, 0.5
# Steps with pairs between two of the walk's: a good proposal has the walk for safety only.
_EVERY, _OFTEN = 32, 8
# Walkers whose autocorrelations are averaged, evenly picked.
_WALKERS_OF_TAU = 64


class _Sampler(emcee.EnsembleSampler):  # type: ignore[misc]
    """emcee's sampler, which would copy the state of its random numbers at every step."""

    random_state = None

    def begin(self, state: Any) -> None:
        """Take up a state of the random numbers."""
        self._random.set_state(state)

    def end(self) -> Any:
        """Return the state of the random numbers."""
        return self._random.get_state()

    def compute_log_prob(self, coords: Array) -> tuple[Array, None]:
        """Evaluate walkers at once; emcee takes the values apart one by one."""
        log_prob: Array = self.log_prob_fn(coords)
        if np.isnan(log_prob).any():
            raise ValueError("a log density is not a number")
        return log_prob, None


class _Backend(emcee.backends.Backend):  # type: ignore[misc]
    """emcee's, in arrays that are given: memory new from the system is as dear as arithmetic."""

    def __init__(self, chain: Array, log_prob: Array) -> None:
        super().__init__()
        self._given = chain, log_prob

    def grow(self, ngrow: int, blobs: None) -> None:
        """Take the arrays that were given as room for the steps."""
        self.chain, self.log_prob = self._given


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
        self.random_state: Any = np.random.RandomState(np.random.MT19937(seed)).get_state()
        self.state = _start(log_prob, proposal, walkers, start)

    def run(self, proposal: Proposal, efficiency: float, t: Array, log_prob: Array) -> None:
        """Run on with a proposal; write steps, (steps, walkers, d), and log densities."""
        if efficiency > POOR:
            walk, every = WalkMove(proposal, self.rng), _EVERY if efficiency > GOOD else _OFTEN
            moves = [(PairMove(proposal, self.rng, self.ahead, walk=walk, every=every), 1.0)]
        else:
            # Not emcee's snooker move: with half the exponent of ter Braak & Vrugt (2008) in its
            # acceptance it does not keep a normal. Whole differences jump between modes.
            pairs, jump = PairMove(proposal, self.rng, self.ahead), emcee.moves.DEMove(gamma0=1.0)
            moves = [(pairs, 0.3), (emcee.moves.DEMove(), 0.49), (jump, 0.21)]
        self.sampler = _Sampler(
            *self.state.coords.shape, self.log_prob_fn, vectorize=True, moves=moves,
            backend=_Backend(t, log_prob),
        )  # fmt: skip
        # emcee's wrapper prints the arguments of whatever ends a call, an interruption as well.
        self.sampler.log_prob_fn = self.log_prob_fn
        self.sampler.begin(self.random_state)
        with warnings.catch_warnings():
            # numpy 2 deprecates what emcee does inside its moves.
            warnings.simplefilter("ignore", DeprecationWarning)
            end = self.sampler.run_mcmc(self.state, len(t), skip_initial_state_check=True)
        # The random state travels apart, as a start may be without one.
        self.state = emcee.State(end.coords, log_prob=end.log_prob, copy=True)
        taken, self.random_state = self.random_state, self.sampler.end()
        if taken[2] == self.random_state[2] and np.array_equal(taken[1], self.random_state[1]):
            # Another emcee may keep them elsewhere; the run would not be reproducible.
            raise RuntimeError("emcee did not take the random state")

    @property
    def walkers(self) -> int:
        """Number of walkers."""
        return int(self.state.coords.shape[0])

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
