"""Sample a posterior with emcee: seeded by point estimates, extended until the gate passes."""

from __future__ import annotations

import time
import warnings
from collections.abc import Callable
from dataclasses import dataclass, field

import emcee
import numpy as np

from calib.errors import CalibError
from calib.models.base import Array
from calib.problem import Problem
from calib.sampling.gate import Gate, GateReport, judge
from calib.sampling.mode import find_modes
from calib.sampling.moves import IndependenceMove
from calib.sampling.proposal import Mixture, StudentT, adapt

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
        In each ensemble; by default the smallest even number of at least twice the dimension
        plus two, and 20.
    steps : int
        Kept steps of the first attempt; doubled until the gate passes.
    max_steps : int
        Where doubling stops.
    keep : int
        Steps of each walker that are stored, thinned evenly from the kept ones.
    dof : float
        Degrees of freedom of the proposal.
    gate : Gate
    """

    ensembles: int = 4
    walkers: int | None = None
    steps: int = 200
    max_steps: int = 25_600
    keep: int = 200
    dof: float = 6.0
    gate: Gate = field(default_factory=Gate)

    def n_walkers(self, n_dim: int) -> int:
        """Number of walkers for a dimension."""
        return self.walkers or max(20, 2 * (n_dim + 1))


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
    chosen = settings or SamplerSettings()
    root = np.random.SeedSequence(seed) if isinstance(seed, int) else seed
    seeds = root.spawn(1 + chosen.ensembles)
    rng = np.random.default_rng(seeds[0])
    began = time.perf_counter()
    count = _Counter(problem.log_prob)
    modes = find_modes(count, problem.priors, rng, starts=starts)
    if not np.isfinite(modes[0].height):
        raise CalibError(
            "no parameter values of positive probability were found",
            where=problem.table.source,
            mend="check that the data's units and the priors' scales fit each other",
        )
    parts = [StudentT(m.at, np.linalg.cholesky(m.covariance), chosen.dof) for m in modes]
    # Laplace's evidence of each mode; none so small that its draws could not correct it.
    mass = np.array([m.height + 0.5 * np.linalg.slogdet(m.covariance)[1] for m in modes])
    share = np.maximum(np.exp(mass - mass.max()), 0.05)
    first = Mixture(share / share.sum(), tuple(parts))
    return sample_density(
        count, first, seeds, problem.names, chosen, rng=rng, progress=progress, began=began
    )


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
    first: StudentT | Mixture,
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
    first : StudentT or Mixture
        The first guess, for instance from the curvature at each mode, the highest first.
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
    proposal, log_evidence, efficiency = adapt(count, first, rng)
    samplers = [_Ensemble(count, proposal, efficiency, seed, settings) for seed in seeds[1:]]
    target = min(settings.steps, settings.max_steps)
    while True:
        planned = target + target // 4
        for i, sampler in enumerate(samplers):
            sampler.run_to(planned)
            if progress is not None:
                progress((i + 1) * planned, len(samplers) * planned)
        t = np.stack([s.chain(target) for s in samplers])
        tau = np.stack([s.tau(target) for s in samplers]).max(axis=0)
        report = judge(t, names, settings.gate, tau=tau)
        if report.passed or target * 2 > settings.max_steps:
            break
        target *= 2
    picked = np.linspace(0, target - 1, min(settings.keep, target)).round().astype(int)
    log_probs = np.stack([s.log_prob(target) for s in samplers])
    return Draws(
        t=t[:, :, picked],
        log_prob=log_probs[:, :, picked],
        report=report,
        mode=(first.components[0] if isinstance(first, Mixture) else first).mean,
        log_evidence=log_evidence,
        efficiency=efficiency,
        acceptance=float(np.mean([s.acceptance for s in samplers])),
        evaluations=count.evaluations,
        seconds=time.perf_counter() - began,
    )


class _Ensemble:
    """One independently seeded emcee ensemble that can be run further."""

    def __init__(
        self,
        log_prob: Callable[[Array], Array],
        proposal: Mixture,
        efficiency: float,
        seed: np.random.SeedSequence,
        settings: SamplerSettings,
    ) -> None:
        d = proposal.n_dim
        walkers = settings.n_walkers(d)
        # A good proposal does most of the work; a poor one leaves it to the local moves.
        independent = 0.8 if efficiency > 0.1 else 0.3
        local = 1.0 - independent
        self.sampler = emcee.EnsembleSampler(
            walkers,
            d,
            log_prob,
            vectorize=True,
            moves=[
                (IndependenceMove(proposal), independent),
                (emcee.moves.DEMove(), 0.7 * local),
                (emcee.moves.DESnookerMove(), 0.3 * local),
            ],
        )
        state = np.random.RandomState(np.random.MT19937(seed)).get_state()
        self.sampler.random_state = state
        if not np.array_equal(self.sampler.random_state[1], state[1]):
            # emcee ignores a state it does not like; the run would not be reproducible.
            raise RuntimeError("emcee did not take the random state")
        self.start = _start(log_prob, proposal, walkers, np.random.default_rng(seed.spawn(1)[0]))
        self.steps = 0

    def run_to(self, steps: int) -> None:
        if steps > self.steps:
            initial = self.start if self.steps == 0 else None
            with warnings.catch_warnings():
                # numpy 2 deprecates what emcee does inside its moves.
                warnings.simplefilter("ignore", DeprecationWarning)
                self.sampler.run_mcmc(initial, steps - self.steps, skip_initial_state_check=True)
            self.steps = steps

    def chain(self, target: int) -> Array:
        """The last `target` steps, shape (walkers, target, d)."""
        kept: Array = self.sampler.get_chain()[-target:]
        return kept.transpose(1, 0, 2)

    def log_prob(self, target: int) -> Array:
        kept: Array = self.sampler.get_log_prob()[-target:]
        return kept.T

    def tau(self, target: int) -> Array:
        chain = self.sampler.get_chain()[-target:]
        # A constant chain has no autocorrelation time; it must fail the gate.
        with np.errstate(invalid="ignore"):
            tau = emcee.autocorr.integrated_time(chain, quiet=True, tol=0)
        return np.where(np.isfinite(tau), np.maximum(tau, 1.0), np.inf)

    @property
    def acceptance(self) -> float:
        return float(np.mean(self.sampler.acceptance_fraction))


def _start(
    log_prob: Callable[[Array], Array],
    proposal: Mixture,
    walkers: int,
    rng: np.random.Generator,
) -> Array:
    """Overdispersed starting points, every one of positive probability.

    emcee accepts walkers that start where the density is zero without a word.
    """
    found: list[Array] = []
    n = 0
    for _ in range(200):
        drawn = proposal.sample(rng, 4 * walkers)
        good = drawn[np.isfinite(log_prob(drawn))]
        found.append(good)
        n += good.shape[0]
        if n >= walkers:
            return np.concatenate(found)[:walkers]
    raise CalibError(
        "the sampler could not be started: almost no parameters near the mode are allowed",
        mend="widen the priors' bounds, or check the data's units",
    )
