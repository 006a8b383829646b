"""Sample a posterior with emcee: seeded by point estimates, extended until the gate passes."""

from __future__ import annotations

import time
import warnings
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace

import emcee
import numpy as np

from calib.chains import autocorrelation_time
from calib.errors import CalibError
from calib.models.base import Array
from calib.problem import Problem
from calib.sampling.gate import Gate, GateReport, judge
from calib.sampling.mode import find_modes
from calib.sampling.moves import IndependenceMove
from calib.sampling.proposal import AnyProposal, Guess, adapt, refit
from calib.threads import one_thread

__all__ = ["Draws", "SamplerSettings", "sample_density", "sample_posterior"]

type Progress = Callable[[int, int], None]


@dataclass(frozen=True)
class SamplerSettings:
    """How a posterior is sampled.

    Parameters
    ----------
    ensembles : int
        Independently seeded ensembles.
    walkers : int, optional
        In each ensemble; by default 64, of long data 20, but at least twice the dimension plus
        two.
    steps : int
        Kept steps of the first attempt; doubled until the gate passes.
    max_steps : int
        Where doubling stops.
    keep : int
        Draws of each ensemble that are stored, thinned evenly from the kept steps.
    ahead : int
        Steps whose independent proposals are evaluated in one batch.
    gate : Gate
    """

    ensembles: int = 4
    walkers: int | None = None
    steps: int = 200
    max_steps: int = 25_600
    keep: int = 4096
    ahead: int = 16
    gate: Gate = field(default_factory=Gate)

    def n_walkers(self, n_dim: int) -> int:
        """Number of walkers for a dimension."""
        return self.walkers or max(64, 2 * (n_dim + 1))


@dataclass(frozen=True)
class Draws:
    """Draws of a posterior in internal coordinates, with what is known of their quality.

    Parameters
    ----------
    t : ndarray, shape (ensembles, walkers, draws, d)
    log_prob : ndarray, shape (ensembles, walkers, draws)
    report : GateReport
        On the whole chain, before thinning.
    mode : ndarray, shape (d,)
    log_evidence, efficiency : float
        By importance sampling from the proposal, and its effective fraction.
    acceptance : float
    evaluations : int
        Parameter vectors whose density was evaluated, all stages included.
    seconds : float
    """

    t: Array
    log_prob: Array
    report: GateReport
    mode: Array
    log_evidence: float
    efficiency: float
    acceptance: float
    evaluations: int
    seconds: float

    @property
    def flat(self) -> Array:
        """All draws, shape (ensembles * walkers * draws, d)."""
        return self.t.reshape(-1, self.t.shape[-1])


@one_thread()
def sample_posterior(
    problem: Problem,
    seed: int | np.random.SeedSequence,
    *,
    starts: Array | None = None,
    settings: SamplerSettings | None = None,
    progress: Progress | None = None,
) -> Draws:
    """Sample the posterior of a problem.

    Parameters
    ----------
    problem : Problem
    seed : int or SeedSequence
        Same seed, same numbers.
    starts : ndarray, shape (m, d), optional
        Point estimates in internal coordinates that seed the search for the mode.
    settings : SamplerSettings, optional
    progress : callable, optional
        Called with steps done and steps planned.

    Returns
    -------
    Draws
        Read ``report.passed`` before use.

    Raises
    ------
    CalibError
        If no parameters of positive probability can be found.
    """
    chosen = _fitting(settings or SamplerSettings(), problem)
    root = np.random.SeedSequence(seed) if isinstance(seed, int) else seed
    seeds = root.spawn(1 + chosen.ensembles)
    rng = np.random.default_rng(seeds[0])
    began = time.perf_counter()
    count = _Counter(problem.log_prob)
    modes = find_modes(count, problem.priors, rng, starts=starts)
    if not np.isfinite(count(modes[0].t[None])[0]):
        raise CalibError(
            "no parameter values of positive probability were found",
            where=problem.table.source,
            mend="check that the data's units and the priors' scales fit each other",
        )
    first = [Guess(m.t, np.linalg.cholesky(m.covariance)) for m in modes]
    return sample_density(
        count, first, seeds, problem.names, chosen, rng=rng, progress=progress, began=began
    )


def _fitting(settings: SamplerSettings, problem: Problem) -> SamplerSettings:
    """Of long data fewer draws are taken: each is dear, and the posterior all but normal."""
    if settings.walkers is not None or problem.squares.n_distinct <= _LONG:
        return settings
    walkers = max(20, 2 * (problem.n_dim + 1))
    return replace(settings, walkers=walkers, steps=min(settings.steps, 100), ahead=1)


_LONG = 5000


class _Counter:
    """Count the vectors a density is evaluated at."""

    def __init__(self, log_prob: Callable[[Array], Array]) -> None:
        self.log_prob = log_prob
        self.evaluations = 0

    def __call__(self, t: Array) -> Array:
        self.evaluations += t.shape[0]
        return self.log_prob(t)


def sample_density(
    log_prob: Callable[[Array], Array],
    first: Sequence[Guess],
    seeds: list[np.random.SeedSequence],
    names: tuple[str, ...],
    settings: SamplerSettings,
    *,
    rng: np.random.Generator,
    progress: Progress | None = None,
    began: float | None = None,
) -> Draws:
    """Sample any density from a first guess of its location and scale.

    Parameters
    ----------
    log_prob : callable
        ``(k, d) -> (k,)``, unnormalised.
    first : sequence of Guess
        First guesses, the best first, for instance from the curvature at each mode.
    seeds : list of SeedSequence
        One for the adaptation (already used by `rng`) and one for each ensemble.
    names : tuple of str
        Of the coordinates.
    settings : SamplerSettings
    rng : Generator
    progress : callable, optional
    began : float, optional
        ``time.perf_counter()`` at which the work began.
    """
    began = time.perf_counter() if began is None else began
    count = log_prob if isinstance(log_prob, _Counter) else _Counter(log_prob)
    proposal, found = adapt(count, first, rng)
    ensembles = [_Ensemble(count, proposal, seed, settings) for seed in seeds[1:]]
    target = min(settings.steps, settings.max_steps)
    done = 0
    while True:
        length = target + target // _DISCARDED
        for i, ensemble in enumerate(ensembles):
            ensemble.run(proposal, found.efficiency, length)
            if progress is not None:
                progress(done + (i + 1) * length, done + len(ensembles) * length)
        done += len(ensembles) * length
        t = np.stack([e.chain(target) for e in ensembles])
        tau = np.stack([e.tau(target) for e in ensembles]).max(axis=0)
        report = judge(t, names, settings.gate, tau=tau)
        log_probs = np.stack([e.log_prob(target) for e in ensembles])
        if report.passed and found.efficiency > _POOR:
            report = _refuse_neglect(report, proposal, t, log_probs)
        if report.passed or target * 2 > settings.max_steps:
            break
        target *= 2
        proposal, found = refit(count, proposal, *_pooled(t, report), rng)
    kept = min(target, max(1, settings.keep // t.shape[1]))
    picked = np.linspace(0, target - 1, kept).round().astype(int)
    return Draws(
        t=t[:, :, picked],
        log_prob=log_probs[:, :, picked],
        report=report,
        mode=first[0].mean,
        log_evidence=found.log_evidence,
        efficiency=found.efficiency,
        acceptance=float(np.mean([e.acceptance for e in ensembles])),
        evaluations=count.evaluations,
        seconds=time.perf_counter() - began,
    )


# One step in so many is run before those that are kept.
_DISCARDED = 6
# Efficiency below which the local moves do most of the work, and the share of a good proposal.
_POOR, _INDEPENDENT = 0.1, 0.9
_POOLED = 20_000
# A region of at least this part of the draws must have been proposed at least so often.
_LEAST_REGION, _LEAST_PROPOSED = 0.003, 5.0


def _refuse_neglect(
    report: GateReport, proposal: AnyProposal, t: Array, log_prob: Array
) -> GateReport:
    """Refuse draws some of which lie where the proposal would not have gone.

    A walker that a local move, or luck, has carried to a tail or a mode of which the proposal
    knows nothing stays there, and the others never follow: R-hat sees little of it, and what the
    walkers say of the region is luck. Of draws from pi, those in a region stand for a part of the
    proposal q that is proportional to the mean of q/pi over them.
    """
    every = max(1, log_prob.size // _POOLED)
    flat, value = t.reshape(-1, t.shape[-1])[::every], log_prob.ravel()[::every]
    log_ratio = proposal.log_prob(flat) - value
    ratio = np.sort(np.exp(log_ratio - log_ratio.max()))
    proposed = log_prob.size * np.cumsum(ratio) / ratio.sum()
    region = np.arange(1, ratio.size + 1) / ratio.size
    neglected = region[(region >= _LEAST_REGION) & (proposed < _LEAST_PROPOSED)]
    if not neglected.size:
        return report
    reason = f"{neglected.max():.1%} of the draws lie where hardly any was proposed"
    return replace(report, passed=False, reasons=(reason,))


def _pooled(t: Array, report: GateReport) -> tuple[Array, float]:
    """Draws of all ensembles, thinned, and what they are worth."""
    flat = t.reshape(-1, t.shape[-1])
    worth = report.ess_bulk[np.isfinite(report.ess_bulk)].min(initial=np.inf)
    return flat[:: max(1, flat.shape[0] // _POOLED)], float(min(worth, flat.shape[0]))


class _Ensemble:
    """One independently seeded emcee ensemble that is run in stretches of a fixed kernel each."""

    def __init__(
        self,
        log_prob: Callable[[Array], Array],
        proposal: AnyProposal,
        seed: np.random.SeedSequence,
        settings: SamplerSettings,
    ) -> None:
        self.log_prob_fn = log_prob
        self.walkers = settings.n_walkers(proposal.n_dim)
        self.ahead = settings.ahead
        start, self.rng = (np.random.default_rng(child) for child in seed.spawn(2))
        self.random_state = np.random.RandomState(np.random.MT19937(seed)).get_state()
        self.state = _start(log_prob, proposal, self.walkers, start)

    def run(self, proposal: AnyProposal, efficiency: float, steps: int) -> None:
        """Run on with a proposal, forgetting the steps before."""
        # A good proposal does most of the work; a poor one leaves it to the local moves.
        independent = _INDEPENDENT if efficiency > _POOR else 0.3
        local = 1.0 - independent
        self.sampler = emcee.EnsembleSampler(
            self.walkers,
            proposal.n_dim,
            self.log_prob_fn,
            vectorize=True,
            moves=[
                (IndependenceMove(proposal, self.rng, self.ahead), independent),
                # Not emcee's snooker move: with half the exponent of ter Braak & Vrugt (2008) in
                # its acceptance it does not keep a normal. Whole differences jump between modes.
                (emcee.moves.DEMove(), 0.7 * local),
                (emcee.moves.DEMove(gamma0=1.0), 0.3 * local),
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

    def chain(self, target: int) -> Array:
        """The last `target` steps, shape (walkers, target, d)."""
        kept: Array = self.sampler.get_chain()[-target:]
        return kept.transpose(1, 0, 2)

    def log_prob(self, target: int) -> Array:
        """Log densities of the last `target` steps, shape (walkers, target)."""
        kept: Array = self.sampler.get_log_prob()[-target:]
        return kept.T

    def tau(self, target: int) -> Array:
        """Autocorrelation times over the last `target` steps, shape (d,)."""
        # A constant chain has no autocorrelation time; it must fail the gate.
        tau = autocorrelation_time(self.chain(target))
        return np.where(np.isfinite(tau), np.maximum(tau, 1.0), np.inf)

    @property
    def acceptance(self) -> float:
        """Fraction of proposals accepted."""
        return float(np.mean(self.sampler.acceptance_fraction))


def _start(
    log_prob: Callable[[Array], Array],
    proposal: AnyProposal,
    walkers: int,
    rng: np.random.Generator,
) -> emcee.State:
    """Overdispersed starting points, every one of positive probability.

    emcee accepts walkers that start where the density is zero without a word.
    """
    coords, values = np.empty((0, proposal.n_dim)), np.empty(0)
    for _ in range(500):
        drawn = proposal.sample(rng, walkers)
        value = log_prob(drawn)
        good = np.isfinite(value)
        coords, values = np.concatenate([coords, drawn[good]]), np.append(values, value[good])
        if values.size >= walkers:
            return emcee.State(coords[:walkers], log_prob=values[:walkers])
    raise CalibError(
        "the sampler could not be started: almost no parameters near the mode are allowed",
        mend="widen the priors' bounds, or check the data's units",
    )
