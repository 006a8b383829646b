"""Sample a posterior with emcee: seeded by point estimates, extended until the gate passes."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from calib.batch.threads import one_thread
from calib.errors import CalibError
from calib.inference.estimators.identified import representative_rows
from calib.inference.problem import Problem
from calib.inference.sampling.adapt import Guess, adapt, refit
from calib.inference.sampling.gate import Gate, GateReport, judge
from calib.inference.sampling.mode import Mode, find_modes
from calib.inference.sampling.proposal import Proposal
from calib.inference.trial import try_simulator
from calib.models.base import Array

type Progress = Callable[[int, int], None]


@dataclass(frozen=True)
class SamplerSettings:
    """How a posterior is sampled.

    Parameters
    ----------
    ensembles : int
        Independently seeded ensembles.
    walkers : int, optional
        In each ensemble; by default 320, of long data 20, but at least twice the dimension plus
        two.
    steps : int
        Kept steps of the first attempt; doubled until the gate passes.
    max_steps : int
        Where doubling stops.
    keep : int
        About so many draws of each ensemble are stored: those of evenly picked walkers at 32 or
        more evenly picked steps.
    ahead : int
        Steps whose independent proposals are evaluated in one batch.
    gate : Gate
    """

    ensembles: int = 4
    walkers: int | None = None
    steps: int = 192
    max_steps: int = 25_600
    keep: int = 4096
    ahead: int = 16
    gate: Gate = field(default_factory=Gate)

    def n_walkers(self, n_dim: int) -> int:
        """Number of walkers for a dimension."""
        return self.walkers or max(320, 2 * (n_dim + 1))


@dataclass(frozen=True)
class Draws:
    """Draws of a posterior in internal coordinates, with what is known of their quality.

    Parameters
    ----------
    t : ndarray, shape (ensembles, walkers, draws, d)
    log_prob : ndarray, shape (ensembles, walkers, draws)
    report : GateReport
        On as many draws as are stored by default, autocorrelation times on all.
    log_evidence, efficiency : float
        By importance sampling from the proposal, and its effective fraction.
    evaluations : int
        Parameter vectors whose density was evaluated, all stages included.
    walkers : int
        That were run in each ensemble.
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
    walkers: int

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
    """Sample the posterior of a problem; read ``report.passed`` before use.

    `starts` (m, d) are point estimates in internal coordinates that seed the search for the mode.

    Raises
    ------
    CalibError
        If no parameters of positive probability can be found.
    """
    try_simulator(problem)
    chosen = _fitting(settings or SamplerSettings(), problem)
    root = np.random.SeedSequence(seed) if isinstance(seed, int) else seed
    seeds = root.spawn(1 + chosen.ensembles)
    rng = np.random.default_rng(seeds[0])
    began = time.perf_counter()
    count = _Counter(problem.log_prob)
    modes = _modes(count, problem, rng, starts)
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


def _modes(
    count: _Counter, problem: Problem, rng: np.random.Generator, starts: Array | None
) -> list[Mode]:
    rough = representative_rows(problem)
    if rough is problem:
        return find_modes(count, problem.priors, rng, starts=starts)
    # Of long data a part shows where the modes are; from there it is not far.
    count_rough = _Counter(rough.log_prob)
    near = [m.t for m in find_modes(count_rough, problem.priors, rng, starts=starts)]
    count.evaluations += count_rough.evaluations
    given = near if starts is None else [*np.atleast_2d(starts), *near]
    return find_modes(count, problem.priors, rng, starts=np.array(given), n_screen=0)


def _fitting(settings: SamplerSettings, problem: Problem) -> SamplerSettings:
    """Of long data fewer draws are taken: each is dear, and the posterior all but normal."""
    if settings.walkers is not None or problem.squares.n_distinct <= _LONG:
        return settings
    return replace(settings, walkers=max(20, 2 * (problem.n_dim + 1)), ahead=1)


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
    """Sample any unnormalised density ``(k, d) -> (k,)`` from first guesses, the best first.

    Parameters
    ----------
    seeds : list of SeedSequence
        One for the adaptation (already used by `rng`) and one for each ensemble.
    began : float, optional
        ``time.perf_counter()`` at which the work began.
    """
    # emcee takes half a second to import, which predicting from a posterior does without.
    from calib.inference.sampling.ensemble import GOOD, POOR, Ensemble

    began = time.perf_counter() if began is None else began
    count = log_prob if isinstance(log_prob, _Counter) else _Counter(log_prob)
    walkers = settings.n_walkers(first[0].mean.size)
    planned = (len(seeds) - 1) * walkers * min(settings.steps, settings.max_steps)
    proposal, found = adapt(count, first, rng, planned)
    ensembles = [
        Ensemble(count, proposal, seed, walkers=walkers, ahead=settings.ahead) for seed in seeds[1:]
    ]
    target = min(settings.steps, settings.max_steps)
    done = 0
    while True:
        length = target + target // _DISCARDED
        if not done and found.efficiency > GOOD:
            length = min(length, target + _ENOUGH)
        chain = np.empty((len(ensembles), length, walkers, proposal.n_dim))
        chain_log_prob = np.empty(chain.shape[:-1])
        for i, ensemble in enumerate(ensembles):
            ensemble.run(proposal, found.efficiency, chain[i], chain_log_prob[i])
            if progress is not None:
                progress(done + (i + 1) * length, done + len(ensembles) * length)
        done += len(ensembles) * length
        tau = np.stack([e.tau(target) for e in ensembles]).max(axis=0)
        # Fewer draws, evenly thinned, are worth less: what passes is not in doubt.
        last = chain[:, -target:], chain_log_prob[:, -target:]
        t, log_probs = _drawn(*last, _JUDGED)
        report = judge(t, names, settings.gate, tau=tau, steps=target)
        if report.passed and found.efficiency > POOR:
            report = _refuse_neglect(report, proposal, t, log_probs, steps=target)
        if report.passed or target * 2 > settings.max_steps:
            break
        target *= 2
        proposal, found = refit(count, proposal, *_pooled(t, report), rng)
    if settings.keep != _JUDGED:
        t, log_probs = _drawn(*last, settings.keep)
    return Draws(
        t=t,
        log_prob=log_probs,
        report=report,
        mode=first[0].mean,
        log_evidence=found.log_evidence,
        efficiency=found.efficiency,
        acceptance=float(np.mean([e.acceptance for e in ensembles])),
        evaluations=count.evaluations,
        seconds=time.perf_counter() - began,
        walkers=walkers,
    )


def _drawn(t: Array, log_prob: Array, draws: int) -> tuple[Array, Array]:
    """About so many draws of each ensemble, of evenly picked walkers and among its steps.

    Shape (ensembles, steps, walkers, d) to (ensembles, walkers, kept, d), and their log densities.
    """
    _, steps, walkers, _ = t.shape
    kept = min(steps, max(_LEAST_STEPS, draws // walkers))
    few = min(walkers, max(1, draws // kept))
    if (kept, few) != (steps, walkers):
        picked = np.linspace(0, steps - 1, kept).round().astype(np.intp)[:, None]
        who = np.linspace(0, walkers - 1, few).round().astype(np.intp)
        t, log_prob = t[:, picked, who], log_prob[:, picked, who]
    return t.swapaxes(1, 2), log_prob.swapaxes(1, 2)


# Draws of each ensemble that the gate looks at, and of how many steps at least: of few, effective
# sizes come out too large (by a tenth of 32).
_JUDGED, _LEAST_STEPS = 4096, 32
# One step in so many is run before those that are kept; no more than so many where walkers start
# at draws from a good proposal.
_DISCARDED, _ENOUGH = 12, 16
# A region of at least this part of the draws must have been proposed at least so often.
_LEAST_REGION, _LEAST_PROPOSED = 0.003, 5.0


def _refuse_neglect(
    report: GateReport, proposal: Proposal, t: Array, log_prob: Array, *, steps: int
) -> GateReport:
    """Refuse draws some of which lie where the proposal would not have gone.

    A walker that a local move, or luck, has carried to a tail or a mode of which the proposal
    knows nothing stays there, and the others never follow: R-hat sees little of it, and what the
    walkers say of the region is luck. Of draws from pi, those in a region stand for a part of the
    proposal q that is proportional to the mean of q/pi over them. `steps` is the length of the
    chain that the draws were taken from.
    """
    log_ratio = proposal.log_prob(t.reshape(-1, t.shape[-1])) - log_prob.ravel()
    ratio = np.sort(np.exp(log_ratio - log_ratio.max()))
    n_proposed = log_prob.shape[0] * log_prob.shape[1] * steps
    proposed = n_proposed * np.cumsum(ratio) / ratio.sum()
    region = np.arange(1, ratio.size + 1) / ratio.size
    neglected = region[(region >= _LEAST_REGION) & (proposed < _LEAST_PROPOSED)]
    if not neglected.size:
        return report
    reason = f"{neglected.max():.1%} of the draws lie where hardly any was proposed"
    return replace(report, passed=False, reasons=(reason,))


def _pooled(t: Array, report: GateReport) -> tuple[Array, float]:
    """Draws of all ensembles, and what they are worth."""
    flat = t.reshape(-1, t.shape[-1])
    worth = report.ess_bulk[np.isfinite(report.ess_bulk)].min(initial=np.inf)
    return flat, float(min(worth, flat.shape[0]))
