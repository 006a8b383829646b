"""Sample a posterior with emcee: seeded by point estimates, extended until the gate passes.

Walkers mix independent draws from a proposal fitted to the posterior with differential evolution
(ter Braak 2006, doi:10.1007/s11222-006-8769-1); the proposal is fitted again between attempts. The
last ensemble starts from draws that sequential Monte Carlo carried from the prior to the posterior
and independently of any optimum, so it checks the search for modes.
"""

from __future__ import annotations

import time
import warnings
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from numbers import Integral
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import block_diag
from scipy.special import logsumexp

from calib.batch.environment import one_thread
from calib.errors import CalibError
from calib.inference.constants import JUDGED, PROPOSED
from calib.inference.design import try_simulator
from calib.inference.diagnostics import (
    LEAST_ENSEMBLES,
    Gate,
    GateReport,
    judge,
    longest_autocorrelation_time,
)
from calib.inference.mode import LogProb, Mode, find_modes
from calib.inference.priors import Priors, SumAndRatio, sum_and_ratio
from calib.inference.problem import Problem
from calib.inference.proposal import Guess, Proposal, adapt, moments, refit, systematic
from calib.inference.search import representative_rows
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
    keep: int = JUDGED
    gate: Gate = field(default_factory=Gate)

    def __post_init__(self) -> None:
        for name in ("ensembles", "steps", "max_steps", "keep"):
            value = getattr(self, name)
            if isinstance(value, bool) or not isinstance(value, Integral) or int(value) < 1:
                raise CalibError(
                    f"{name} = {value!r}",
                    where="calib.SamplerSettings",
                    expected="a whole number from 1 on",
                    hint=f"correct {name}, or leave it out",
                )

    def n_walkers(self, n_dim: int) -> int:
        """Number of walkers for a dimension; a CalibError if emcee cannot move so few."""
        if self.walkers is not None and self.walkers < 2 * n_dim:
            raise CalibError(
                f"{self.walkers} walkers are too few for {n_dim} parameters",
                expected=f"at least {2 * n_dim}, twice the parameters that are sampled",
                hint="give more walkers, or leave the setting out",
            )
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


class _Counter:
    """Count the vectors a density is evaluated at."""

    def __init__(self, log_prob: LogProb) -> None:
        self.log_prob = log_prob
        self.evaluations = 0

    def __call__(self, t: Array) -> Array:
        self.evaluations += t.shape[0]
        return self.log_prob(t)


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
    began = time.perf_counter()
    try_simulator(problem)
    problem = replace(
        problem,
        priors=sum_and_ratio(problem.priors, problem.bound.model.joined, problem.conditions),
    )
    priors, model, d = problem.priors, problem.bound.model, problem.n_dim
    if isinstance(priors, SumAndRatio) and starts is not None:
        starts = priors.joined(np.atleast_2d(starts))
    chosen = settings or SamplerSettings()
    if chosen.walkers is None:
        # Where an evaluation is dear, fewer walkers are run.
        long, dear = problem.squares.mean.size > 5000, model.slow or model.uncertain
        few = 20 if long else 64 if dear else 320
        chosen = replace(chosen, walkers=max(few, 2 * (d + 1)))
    walkers = chosen.n_walkers(d)
    root = np.random.SeedSequence(seed) if isinstance(seed, int) else seed
    seeds = root.spawn(1 + chosen.ensembles)
    rng = np.random.default_rng(seeds[0])

    count, rough = _Counter(problem.log_prob), representative_rows(problem)
    # Of long data a part shows where the modes are; from there it is not far.
    count_rough = count if rough is problem else _Counter(rough.log_prob)
    annealed = None
    if chosen.ensembles >= LEAST_ENSEMBLES:
        annealed = _from_prior(count_rough, priors, rng, walkers)
        if annealed is not None and rough is not problem:
            some = annealed[rng.permutation(len(annealed))[:walkers]]
            annealed = anneal(count_rough, count, some, rng)
        if annealed is None:
            raise _nowhere(problem.table.source)
        annealed = annealed[rng.permutation(len(annealed))]  # copies stand side by side
        some = annealed[:24]
        starts = some if starts is None else np.concatenate([np.atleast_2d(starts), some])
    modes = find_modes(count_rough, priors, rng, starts=starts)
    if rough is not problem:
        near = np.array([m.t for m in modes])
        modes = find_modes(count, priors, rng, starts=near, spread=0)
        count.evaluations += count_rough.evaluations
    if not np.isfinite(modes[0].log_prob):
        raise _nowhere(problem.table.source)
    _refuse_exact(problem, modes[0])
    draws = sample_density(
        count, _guesses(modes, annealed), seeds, problem.names, chosen, rng=rng,
        last_starts=None if annealed is None else annealed[:walkers], progress=progress,
    )  # fmt: skip
    draws = replace(draws, mode=modes[0].t, seconds=time.perf_counter() - began)
    if not isinstance(priors, SumAndRatio):
        return draws
    return in_coordinates(draws, priors.by_parameter, priors.names, chosen.gate)


def in_coordinates(
    draws: Draws, to: Callable[[Array], Array], names: tuple[str, ...], gate: Gate
) -> Draws:
    """Return draws in other coordinates, (..., d) to (..., d), where they are judged as well."""
    t, sampled = to(draws.t), draws.report
    report = judge(t, names, gate, tau=sampled.tau, steps=sampled.steps)
    if not sampled.passed:
        reasons = dict.fromkeys((*sampled.reasons, *report.reasons))
        report = replace(report, passed=False, reasons=tuple(reasons))
    return replace(draws, t=t, report=report, mode=to(draws.mode))


def sample_joint(
    log_prob: LogProb,
    priors: Priors,
    seed: np.random.SeedSequence,
    names: tuple[str, ...],
    settings: SamplerSettings,
    *,
    where: str,
    dear: bool = False,
    progress: Progress | None = None,
) -> Draws:
    """Sample a density of coordinates (k, d), the first of which have priors.

    The others, if there are any, are nearly independent of them and standard normal. Modes are
    sought, and the prior is carried to the posterior, where these are zero. `dear` is whether an
    evaluation is, `where` names the data. With priors in other coordinates (`SumAndRatio`) these
    are sampled; density and draws are in those by parameter.
    """
    rest = len(names) - len(priors.free)
    few = 64 if dear else 320
    chosen = replace(settings, walkers=settings.walkers or max(few, 2 * (len(names) + 1)))
    walkers, seeds = chosen.n_walkers(len(names)), seed.spawn(1 + chosen.ensembles)
    rng = np.random.default_rng(seeds[0])
    back = priors.by_parameter if isinstance(priors, SumAndRatio) else None
    count = _Counter(log_prob if back is None else lambda t: log_prob(back(t)))

    def of_first(h: Array) -> Array:
        return count(np.column_stack([h, np.zeros((len(h), rest))]))

    annealed = _from_prior(of_first, priors, rng, walkers)
    if annealed is None:
        raise _nowhere(where)
    annealed = annealed[rng.permutation(len(annealed))]
    modes = find_modes(of_first, priors, rng, starts=annealed[:24], spread=16 if dear else 64)
    guesses = [
        Guess(np.append(g.mean, np.zeros(rest)), block_diag(g.cholesky, np.eye(rest)))
        for g in _guesses(modes, annealed)
    ]
    starts = np.column_stack([annealed[:walkers], rng.standard_normal((walkers, rest))])
    draws = sample_density(
        count, guesses, seeds, names, chosen, rng=rng,
        last_starts=starts if chosen.ensembles >= LEAST_ENSEMBLES else None, progress=progress,
    )  # fmt: skip
    return draws if back is None else in_coordinates(draws, back, names, chosen.gate)


def _from_prior(
    log_prob: LogProb, priors: Priors, rng: np.random.Generator, walkers: int
) -> Array | None:
    """Carry draws of the prior to a density by sequential Monte Carlo; None where it is zero."""
    return anneal(priors.log_prob, log_prob, priors.sample(rng, max(512, walkers)), rng)


def _nowhere(where: str) -> CalibError:
    return CalibError(
        "no parameter values of positive probability were found",
        where=where,
        hint="check that the data's units and the priors' scales fit each other",
    )


def _guesses(modes: Sequence[Mode], annealed: Array | None) -> list[Guess]:
    """Guess what lies about each mode: from the draws (k, d) nearest to it, or its curvature."""
    guesses = [Guess(m.t, np.linalg.cholesky(m.covariance)) for m in modes]
    if annealed is None:
        return guesses
    # Log densities by the curvature at each mode.
    by_mode = [
        m.log_prob - 0.5 * np.square(np.linalg.solve(g.cholesky, (annealed - m.t).T)).sum(axis=0)
        for m, g in zip(modes, guesses, strict=True)
    ]
    nearest = np.argmax(by_mode, axis=0)
    for j in range(len(modes)):
        own = annealed[nearest == j]
        # Ten draws for each dimension tell a covariance.
        found = (
            moments(own, np.full(len(own), 1.0 / len(own)))
            if len(own) >= 10 * own.shape[1]
            else None
        )
        guesses[j] = Guess(*found) if found else guesses[j]
    return guesses


def _refuse_exact(problem: Problem, mode: Mode) -> None:
    """Refuse data that the model meets but for rounding: the noise has no scale to be found."""
    if "sigma" not in problem.names:
        return
    left = float(np.sqrt(np.mean(problem.residuals(problem.theta(mode.t[None]))[0] ** 2)))
    spread = float(np.std(problem.response))
    if left < 1e-6 * spread:
        raise CalibError(
            f"the model meets the data exactly: residuals are {left:.1g} rms, the data spread by "
            f"{spread:.3g}, so the noise sigma cannot be estimated",
            where=problem.table.source,
            expected="measurements with scatter, and more rows than parameters",
            hint='fix sigma at the accuracy of the instrument (dist = "fixed" in the prior file), '
            "or give more rows; data computed from the model itself need noise added",
        )


def sample_density(
    log_prob: LogProb,
    first: Sequence[Guess],
    seeds: list[np.random.SeedSequence],
    names: tuple[str, ...],
    settings: SamplerSettings,
    *,
    rng: np.random.Generator,
    last_starts: Array | None = None,
    progress: Progress | None = None,
) -> Draws:
    """Sample any unnormalised density ``(k, d) -> (k,)`` from first guesses, the best first.

    Parameters
    ----------
    seeds : list of SeedSequence
        One for the adaptation (already used by `rng`) and one for each ensemble.
    last_starts : ndarray, shape (walkers, d), optional
        Where the last ensemble starts; like the others, at draws from the proposal by default.
    """
    began = time.perf_counter()
    count = log_prob if isinstance(log_prob, _Counter) else _Counter(log_prob)
    walkers = settings.n_walkers(first[0].mean.size)
    proposal, found = adapt(count, first, rng)
    streams = [np.random.default_rng(seed) for seed in seeds[1:]]
    starts = [_start(count, proposal, walkers, stream) for stream in streams]
    if last_starts is not None:
        starts[-1] = last_starts
    target = min(settings.steps, settings.max_steps)
    done = 0
    segments: list[list[tuple[Array, Array]]] = [[] for _ in streams]
    while True:
        made = sum(len(value) for _, value in segments[0])
        burn_in = 0 if made else max(16, target // 12)
        length, accepted = target - made + burn_in, []
        for i, stream in enumerate(streams):
            moves = fitted_moves(proposal, stream)
            chain, value, fraction = run_walkers(count, starts[i], moves, length, stream)
            starts[i] = chain[-1]
            segments[i].append((chain[burn_in:], value[burn_in:]))
            accepted.append(fraction)
            if progress is not None:
                progress(done + (i + 1) * length, done + len(streams) * length)
        done += len(streams) * length
        chains, values = (
            [np.concatenate([segment[part] for segment in one]) for one in segments]
            for part in (0, 1)
        )
        tau = np.stack([longest_autocorrelation_time(chain) for chain in chains]).max(axis=0)
        # Fewer draws, evenly thinned, are worth less: what passes is not in doubt.
        last = np.stack(chains), np.stack(values)
        t, log_probs = _thinned(*last, JUDGED)
        report = judge(t, names, settings.gate, tau=tau, steps=target)
        neglected = _neglected(proposal, t, log_probs, target, settings.gate.ess_min)
        if neglected.any():
            what = f"{neglected.mean():.1%} of the draws lie where hardly any was proposed"
            report = replace(report, passed=False, reasons=(*report.reasons, what))
        if report.passed or 1.25 * target > settings.max_steps:
            break
        had, target = target, min(_longer(target, tau, report, settings.gate), settings.max_steps)
        if target <= 2 * had and not neglected.any():
            continue  # the chains go on
        segments = [[] for _ in streams]
        if neglected.any():
            proposal = proposal.extended(t[neglected])
        flat = t.reshape(-1, t.shape[-1])
        worth = report.ess_bulk[np.isfinite(report.ess_bulk)].min(initial=len(flat))
        proposal, found = refit(count, proposal, flat, float(worth), rng)
    if settings.keep != JUDGED:
        t, log_probs = _thinned(*last, settings.keep)
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


def _longer(steps: int, tau: Array, report: GateReport, gate: Gate) -> int:
    """Return the length of the next attempt: what the slowest parameter needs, plus a fifth."""
    ess = np.concatenate([report.ess_bulk, report.ess_tail])
    short = np.concatenate([gate.taus_min * tau / steps, gate.ess_min / ess])
    known = short[np.isfinite(short)]
    needed = 1.2 * float(known.max(initial=0.0))
    return int(steps * (np.clip(needed, 1.25, 4.0) if needed > 1.2 else 2.0))


def _start(log_prob: LogProb, proposal: Proposal, walkers: int, rng: np.random.Generator) -> Array:
    """Overdispersed starting points, every one of positive probability.

    emcee accepts walkers that start where the density is zero without a word.
    """
    coords = np.empty((0, proposal.n_dim))
    for _ in range(500):
        drawn = proposal.draw(rng, walkers)
        coords = np.concatenate([coords, drawn[np.isfinite(log_prob(drawn))]])
        if len(coords) >= walkers:
            return coords[:walkers]
    raise CalibError(
        "the sampler could not be started: almost no parameters near the mode are allowed",
        hint="widen the priors' bounds, or check the data's units",
    )


def _thinned(t: Array, log_prob: Array, draws: int) -> tuple[Array, Array]:
    """About so many draws of each ensemble, of evenly picked walkers and among its steps.

    Shape (ensembles, steps, walkers, d) to (ensembles, walkers, kept, d), and their log densities.
    """
    _, steps, walkers, _ = t.shape
    kept = min(steps, max(32, draws // walkers))  # of fewer, ESS comes out a tenth too large
    few = min(walkers, max(1, draws // kept))
    at = np.linspace(0, steps - 1, kept).round().astype(np.intp)
    who = np.linspace(0, walkers - 1, few).round().astype(np.intp)[:, None]
    return t[:, at, who], log_prob[:, at, who]


def _neglected(
    proposal: Proposal, t: Array, log_prob: Array, steps: int, least_ess: float
) -> NDArray[np.bool_]:
    """Which draws lie where walkers neither were sent nor came by local moves, as `log_prob`.

    A walker that started in a mode of which the proposal knows nothing stays there, and the others
    never follow: R-hat sees little of it, and what the walkers say of the region is luck. Of draws
    from pi, those in a region stand for a part of the proposal q that is proportional to the mean
    of q/pi over them. `steps` is the length of the chain that the draws were taken from. Walkers
    must have entered the region so often that its mass is known as well as by `least_ess` draws.
    Proposals and entries are counted for the walkers and steps that were kept: a strict count.
    """
    log_ratio = proposal.log_prob(t.reshape(-1, t.shape[-1])).reshape(log_prob.shape) - log_prob
    ratio = np.exp(log_ratio - log_ratio.max())
    ordered = np.sort(ratio, axis=None)
    n_proposed = log_prob.shape[0] * log_prob.shape[1] * steps
    proposed = n_proposed * np.cumsum(ordered) / ordered.sum()
    size = int(np.searchsorted(proposed, 5.0))  # draws that stand for five proposals at most
    inside = ratio < ordered[size]
    entered = (inside[:, :, 1:] & ~inside[:, :, :-1]).sum()
    share = size / ratio.size
    if share < 0.003 or entered >= max(1.0, least_ess * share / (1.0 - share)):
        return np.zeros_like(inside)
    return np.asarray(inside)


type Moves = Sequence[tuple[Any, float]]


def local_moves() -> Moves:
    """Differential evolution; a tenth are jumps by whole differences, from mode to mode.

    Steps of many lengths: short ones are accepted in corners.
    """
    import emcee  # late: half a second, which predicting from a posterior does without

    return [(emcee.moves.DEMove(sigma=1.0), 0.9), (emcee.moves.DEMove(gamma0=1.0), 0.1)]


def fitted_moves(proposal: Proposal, rng: np.random.Generator) -> Moves:
    """Independent draws from a proposal in most steps, local moves in the others."""
    import emcee

    def draw(coords: Array, _: Any) -> tuple[Array, Array]:
        new = proposal.draw(rng, len(coords))
        before, after = np.split(proposal.log_prob(np.concatenate([coords, new])), 2)
        return new, before - after

    local = [(move, (1.0 - PROPOSED) * share) for move, share in local_moves()]
    return [(emcee.moves.MHMove(draw), PROPOSED), *local]


def run_walkers(
    log_prob: LogProb, start: Array, moves: Moves, steps: int, rng: np.random.Generator
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
    sampler.random_state = np.random.RandomState(rng.integers(2**32)).get_state()
    with warnings.catch_warnings():
        # numpy 2 deprecates what emcee does inside its moves.
        warnings.simplefilter("ignore", DeprecationWarning)
        sampler.run_mcmc(start, steps, skip_initial_state_check=True)
    accepted = float(np.mean(sampler.acceptance_fraction))
    return sampler.get_chain(), sampler.get_log_prob(), accepted


def anneal(first: LogProb, second: LogProb, draws: Array, rng: np.random.Generator) -> Array | None:
    """Move draws (k, d) of one unnormalised density to another by sequential Monte Carlo.

    The target moves in steps that leave half of the draws effective; after each, draws are
    resampled and moved by differential evolution (Del Moral, Doucet & Jasra 2006,
    doi:10.1111/j.1467-9868.2006.00553.x). The second density must be zero wherever the first is;
    None if it is zero at all draws.
    """
    from scipy.optimize import brentq  # late: a tenth of a second

    done = 0.0
    while True:
        gain = second(draws) - first(draws)
        possible = gain[np.isfinite(gain)]
        if not possible.size:
            return None

        def excess(step: float, gain: Array = possible) -> float:
            """Effective draws of a step, beyond half of the possible ones."""
            log_size = 2.0 * logsumexp(step * gain) - logsumexp(2.0 * step * gain)
            return float(np.exp(log_size)) - 0.5 * gain.size

        step = 1.0 - done
        if excess(step) < 0.0:
            step = brentq(excess, 0.0, step, xtol=1e-300, rtol=1e-3)
        done = 1.0 if step == 1.0 - done else done + step
        log_weight = step * gain
        weight = np.exp(log_weight - logsumexp(log_weight))
        draws = draws[systematic(weight, weight.size, rng)]

        def tempered(t: Array, share: float = done) -> Array:
            low, high = first(t), second(t)
            with np.errstate(invalid="ignore"):  # where both are zero
                value = low + share * (high - low)
            return np.where(np.isfinite(high), value, -np.inf)

        draws = run_walkers(tempered, draws, local_moves(), 8, rng)[0][-1]
        if done >= 1.0:
            return draws
