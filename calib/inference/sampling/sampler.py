"""Sample a posterior with emcee: seeded by point estimates, extended until the gate passes."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from calib.batch.threads import one_thread
from calib.errors import CalibError
from calib.inference.diagnostics import LEAST_ENSEMBLES, Gate, GateReport, judge
from calib.inference.estimators.search import representative_rows
from calib.inference.joined import Joined, joined
from calib.inference.problem import Problem
from calib.inference.sampling.mixture import moments
from calib.inference.sampling.mode import Mode, find_modes
from calib.inference.sampling.proposal import Guess, Proposal, adapt, refit
from calib.inference.sampling.walkers import anneal, fitted_moves, longest_tau, run_walkers
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
        In each ensemble; by default 320, 64 of a slow model and 20 of long data, but at least
        twice the dimension plus two.
    steps : int
        Kept steps of the first attempt; later ones are as long as the gate requires.
    max_steps : int
        Upper limit of the kept steps.
    keep : int
        About so many draws of each ensemble are stored: those of evenly picked walkers at 32 or
        more evenly picked steps.
    """

    ensembles: int = 4
    walkers: int | None = None
    steps: int = 192
    max_steps: int = 25_600
    keep: int = 4096
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
    Of four ensembles or more, as many as can be judged, the last comes from the prior.

    Raises
    ------
    CalibError
        If no parameters of positive probability can be found.
    """
    try_simulator(problem)
    problem = joined(problem)
    priors = problem.priors
    if isinstance(priors, Joined) and starts is not None:
        starts = priors.joined(np.atleast_2d(starts))
    chosen = _fitting(settings or SamplerSettings(), problem)
    root = np.random.SeedSequence(seed) if isinstance(seed, int) else seed
    seeds = root.spawn(1 + chosen.ensembles)
    rng = np.random.default_rng(seeds[0])
    began = time.perf_counter()
    count = _Counter(problem.log_prob)
    walkers = chosen.n_walkers(problem.n_dim)
    born = None
    if chosen.ensembles >= LEAST_ENSEMBLES:
        born = _born(count, problem, walkers, rng)
        few = born[:_CLIMBED]
        starts = few if starts is None else np.concatenate([np.atleast_2d(starts), few])
    modes = _modes(count, problem, rng, starts)
    if not np.isfinite(modes[0].log_prob):
        raise _nowhere(problem)
    _refuse_exact(problem, modes[0])
    draws = sample_density(
        count, _guesses(modes, born), seeds, problem.names, chosen, rng=rng,
        born=None if born is None else born[:walkers], progress=progress, began=began,
    )  # fmt: skip
    draws = replace(draws, mode=modes[0].t)
    return _by_parameter(draws, priors, chosen.gate) if isinstance(priors, Joined) else draws


def _by_parameter(draws: Draws, priors: Joined, gate: Gate) -> Draws:
    """Return draws in internal coordinates, and judge them there as well."""
    t, joint = priors.by_parameter(draws.t), draws.report
    report = judge(t, priors.names, gate, tau=joint.tau, steps=joint.steps)
    if not joint.passed:
        reasons = dict.fromkeys((*joint.reasons, *report.reasons))
        report = replace(report, passed=False, reasons=tuple(reasons))
    return replace(draws, t=t, report=report, mode=priors.by_parameter(draws.mode))


def _born(log_prob: _Counter, problem: Problem, walkers: int, rng: np.random.Generator) -> Array:
    """Draws that come from the prior and have not heard of any optimum, (walkers or more, d)."""
    rough, prior = representative_rows(problem), problem.priors.log_prob
    count = _Counter(rough.log_prob)
    drawn = problem.priors.sample(rng, max(_DRAWN, walkers))
    found = anneal(prior, count, drawn, rng)
    log_prob.evaluations += count.evaluations
    if found is not None and rough is not problem:
        found = anneal(rough.log_prob, log_prob, found[:walkers], rng)
    if found is None:
        raise _nowhere(problem)
    # Resampled draws stand beside their copies.
    return found[rng.permutation(len(found))]


def _nowhere(problem: Problem) -> CalibError:
    return CalibError(
        "no parameter values of positive probability were found",
        where=problem.table.source,
        hint="check that the data's units and the priors' scales fit each other",
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
    return find_modes(count, problem.priors, rng, starts=np.array(near), spread=0)


def _guesses(modes: Sequence[Mode], born: Array | None) -> list[Guess]:
    """Guess what lies about each mode: from the draws (k, d) nearest to it, or its curvature."""
    choleskys = [np.linalg.cholesky(m.covariance) for m in modes]
    if born is None:
        return [Guess(m.t, c) for m, c in zip(modes, choleskys, strict=True)]
    # Log densities by the curvature at each mode.
    by_mode = [
        m.log_prob - 0.5 * np.square(np.linalg.solve(c, (born - m.t).T)).sum(axis=0)
        for m, c in zip(modes, choleskys, strict=True)
    ]
    nearest = np.argmax(by_mode, axis=0)
    guesses = []
    for j, (mode, cholesky) in enumerate(zip(modes, choleskys, strict=True)):
        own = born[nearest == j]
        found = None
        if len(own) >= _DRAWS_PER_DIMENSION * born.shape[1]:
            found = moments(own, np.full(len(own), 1.0 / len(own)))
        guesses.append(Guess(*found) if found else Guess(mode.t, cholesky))
    return guesses


def _refuse_exact(problem: Problem, mode: Mode) -> None:
    """Refuse data that the model meets but for rounding: the noise has no scale to be found."""
    if "sigma" not in problem.names:
        return
    left = problem.residuals(problem.theta(mode.t[None]))[0]
    spread = float(np.std(problem.response))
    if float(np.sqrt(np.mean(left**2))) < _EXACT * spread:
        raise CalibError(
            f"the model meets the data exactly: residuals are {np.sqrt(np.mean(left**2)):.1g} rms, "
            f"the data spread by {spread:.3g}, so the noise sigma cannot be estimated",
            where=problem.table.source,
            expected="measurements with scatter, and more rows than parameters",
            hint='fix sigma at the accuracy of the instrument (dist = "fixed" in the prior file), '
            "or give more rows; data computed from the model itself need noise added",
        )


def _fitting(settings: SamplerSettings, problem: Problem) -> SamplerSettings:
    """Where an evaluation is dear, fewer walkers are run."""
    if settings.walkers is not None:
        return settings
    d, model = problem.n_dim, problem.bound.model
    if problem.squares.n_distinct > _LONG:
        return replace(settings, walkers=max(20, 2 * (d + 1)))
    if model.slow or model.uncertain is not None:
        return replace(settings, walkers=max(64, 2 * (d + 1)))
    return settings


# Distinct rows from which data are long.
_LONG = 5000
# Draws from the prior that are carried to the posterior; of them, starts of the search for modes.
_DRAWN, _CLIMBED = 512, 24
# Draws from which a covariance is taken, for each dimension.
_DRAWS_PER_DIMENSION = 10
# Residuals of this part of the data's spread are rounding.
_EXACT = 1e-6


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
    born: Array | None = None,
    progress: Progress | None = None,
    began: float | None = None,
) -> Draws:
    """Sample any unnormalised density ``(k, d) -> (k,)`` from first guesses, the best first.

    Parameters
    ----------
    seeds : list of SeedSequence
        One for the adaptation (already used by `rng`) and one for each ensemble.
    born : ndarray, shape (walkers, d), optional
        Where the last ensemble starts; like the others, at draws from the proposal by default.
    began : float, optional
        ``time.perf_counter()`` at which the work began.
    """
    began = time.perf_counter() if began is None else began
    count = log_prob if isinstance(log_prob, _Counter) else _Counter(log_prob)
    walkers = settings.n_walkers(first[0].mean.size)
    proposal, found = adapt(count, first, rng)
    streams = [np.random.default_rng(seed) for seed in seeds[1:]]
    starts = [_start(count, proposal, walkers, stream) for stream in streams]
    if born is not None:
        starts[-1] = born
    target = min(settings.steps, settings.max_steps)
    done = 0
    while True:
        length = target + max(_LEAST_DISCARDED, target // _DISCARDED)
        chains, values, accepted = [], [], []
        for i, stream in enumerate(streams):
            moves = fitted_moves(proposal, stream)
            chain, value, fraction = run_walkers(count, starts[i], moves, length, stream)
            starts[i] = chain[-1]
            chains.append(chain[-target:])
            values.append(value[-target:])
            accepted.append(fraction)
            if progress is not None:
                progress(done + (i + 1) * length, done + len(streams) * length)
        done += len(streams) * length
        tau = np.stack([longest_tau(chain) for chain in chains]).max(axis=0)
        # Fewer draws, evenly thinned, are worth less: what passes is not in doubt.
        last = np.stack(chains), np.stack(values)
        t, log_probs = _drawn(*last, _JUDGED)
        report = judge(t, names, settings.gate, tau=tau, steps=target)
        neglected = _neglected(proposal, t, log_probs, target, settings.gate.ess_min)
        if neglected.any():
            what = f"{neglected.mean():.1%} of the draws lie where hardly any was proposed"
            report = replace(report, passed=False, reasons=(*report.reasons, what))
        if report.passed or _LEAST_LONGER * target > settings.max_steps:
            break
        target = min(_longer(target, tau, report, settings.gate), settings.max_steps)
        if neglected.any():
            proposal = proposal.extended(t[neglected])
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
        acceptance=float(np.mean(accepted)),
        evaluations=count.evaluations,
        seconds=time.perf_counter() - began,
        walkers=walkers,
    )


# The next attempt is at least so many times as long.
_LEAST_LONGER = 1.25


def _longer(steps: int, tau: Array, report: GateReport, gate: Gate) -> int:
    """Return the length of the next attempt: what the slowest parameter needs, plus a fifth."""
    ess = np.concatenate([report.ess_bulk, report.ess_tail])
    short = np.concatenate([gate.taus_min * tau / steps, gate.ess_min / ess])
    known = short[np.isfinite(short)]
    needed = 1.2 * float(known.max(initial=0.0))
    return int(steps * (np.clip(needed, _LEAST_LONGER, 4.0) if needed > 1.2 else 2.0))


def _start(
    log_prob: Callable[[Array], Array], proposal: Proposal, walkers: int, rng: np.random.Generator
) -> Array:
    """Overdispersed starting points, every one of positive probability.

    emcee accepts walkers that start where the density is zero without a word.
    """
    coords = np.empty((0, proposal.n_dim))
    for _ in range(500):
        drawn, _ = proposal.draw(rng, walkers)
        coords = np.concatenate([coords, drawn[np.isfinite(log_prob(drawn))]])
        if len(coords) >= walkers:
            return coords[:walkers]
    raise CalibError(
        "the sampler could not be started: almost no parameters near the mode are allowed",
        hint="widen the priors' bounds, or check the data's units",
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
# One step in so many is run before those that are kept, and so many at least.
_DISCARDED, _LEAST_DISCARDED = 12, 16
# A region of at least this part of the draws must have been proposed so often, or entered.
_LEAST_REGION, _LEAST_PROPOSED = 0.003, 5.0


def _neglected(
    proposal: Proposal, t: Array, log_prob: Array, steps: int, least_ess: float
) -> NDArray[np.bool_]:
    """Which draws lie where walkers neither were sent nor came by local moves, as `log_prob`.

    A walker that started in a mode of which the proposal knows nothing stays there, and the others
    never follow: R-hat sees little of it, and what the walkers say of the region is luck. Of draws
    from pi, those in a region stand for a part of the proposal q that is proportional to the mean
    of q/pi over them. `steps` is the length of the chain that the draws were taken from. Walkers
    must have entered the region so often that its mass is known as well as by `least_ess` draws.
    """
    log_ratio = proposal.log_prob(t.reshape(-1, t.shape[-1])).reshape(log_prob.shape) - log_prob
    ratio = np.exp(log_ratio - log_ratio.max())
    ordered = np.sort(ratio, axis=None)
    n_proposed = log_prob.shape[0] * log_prob.shape[1] * steps
    proposed = n_proposed * np.cumsum(ordered) / ordered.sum()
    size = int(np.searchsorted(proposed, _LEAST_PROPOSED))
    inside = ratio < ordered[size]
    entered = (inside[:, :, 1:] & ~inside[:, :, :-1]).sum()
    share = size / ratio.size
    if share < _LEAST_REGION or entered >= max(1.0, least_ess * share / (1.0 - share)):
        return np.zeros_like(inside)
    return np.asarray(inside)


def _pooled(t: Array, report: GateReport) -> tuple[Array, float]:
    """Draws of all ensembles, and what they are worth."""
    flat = t.reshape(-1, t.shape[-1])
    worth = report.ess_bulk[np.isfinite(report.ess_bulk)].min(initial=np.inf)
    return flat, float(min(worth, flat.shape[0]))
