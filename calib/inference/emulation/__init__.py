"""Emulate a problem's simulator: a space-filling design, then runs where the posterior needs them.

    1. Runs spread over the prior give a first emulator.
    2. The posterior under the emulator, its own variance in the likelihood, is sampled.
    3. Of draws of it, and of points somewhat farther out, those are run where the emulator knows
       least, apart from each other. Back to 2, until the error that the emulator expects is a
       small part of the noise.
    4. Runs at further draws are predicted first: these are its held-out check.

After Kennedy & O'Hagan (2001, doi:10.1111/1467-9868.00294) and, for the choice of runs, Sinsbeck &
Nowak (2017, doi:10.1137/15M1047659) in the simplest form that does.
"""

from __future__ import annotations

import logging
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray
from scipy.special import ndtr

from calib.batch.environment import one_thread
from calib.data.files import plain_number
from calib.data.quantities import QUANTITIES
from calib.inference.constants import FORESEEN_FROM, NEGLIGIBLE
from calib.inference.design import (
    across_zero,
    check_moves,
    check_scale,
    choose_nodes,
    prior_design,
    prior_middle,
)
from calib.inference.emulation.state import (
    Emulation,
    HeldOut,
    Known,
    Progress,
    State,
    across_too,
    has_value,
)
from calib.inference.joint import JointProblem
from calib.inference.problem import Problem
from calib.inference.random import generator
from calib.models.base import Array
from calib.models.constants import FIRST_RUNS
from calib.models.simulators.declaration import EmulationSettings
from calib.models.simulators.emulator import Emulator
from calib.models.simulators.kriging import correlation
from calib.models.simulators.simulator import (
    FROM_THE_START,
    Run,
    RunKeeper,
    Simulator,
    fail_alike,
)

__all__ = ["Emulation", "EmulationSettings", "HeldOut", "emulate", "emulate_together", "extend"]

_log = logging.getLogger(__name__)


@one_thread()
def emulate(
    problem: Problem,
    keeper: RunKeeper,
    seed: int,
    *,
    settings: EmulationSettings | None = None,
    elsewhere: Sequence[Mapping[str, Array]] = (),
    progress: Progress | None = None,
) -> Emulation:
    """Emulate the simulator of a problem as well as its posterior needs it.

    Read ``passed`` before use. `elsewhere` has conditions that will be predicted beside the data's.

    Raises
    ------
    CalibError
        If the first five runs over the prior fail in one way, fewer than half of its runs have a
        value, or none where the data are: with where the others failed and what they printed.
    """
    (found,) = emulate_together(
        [problem], keeper, seed, settings=settings, elsewhere=elsewhere, progress=progress
    )
    return found


@one_thread()
def emulate_together(
    problems: Sequence[Problem],
    keeper: RunKeeper,
    seed: int,
    *,
    joint: JointProblem | None = None,
    settings: EmulationSettings | None = None,
    elsewhere: Sequence[Mapping[str, Array]] = (),
    progress: Progress | None = None,
) -> tuple[Emulation, ...]:
    """Emulate several outputs of one simulator from the same runs, as `emulate` does one.

    Runs are made where the posterior of `joint` needs them, of which the problems are outputs: it
    may have others. The budget is that of all, and each output has to be emulated well enough.
    """
    chosen = settings or EmulationSettings()
    takes = problems[0].bound.model.select
    recorded = [*(p.conditions for p in problems), *map(takes, elsewhere)]
    nodes, across, tried = _nodes(problems[0], keeper, recorded, chosen.nodes)
    state = State(
        problems, keeper, nodes, seed, chosen.runs, across=across, tried=tried, progress=progress,
        joint=joint,
    )  # fmt: skip
    _first_design(state, chosen)
    state.rebuild()
    return _improved(state, chosen, chosen.runs)


@one_thread()
def extend(
    emulator: Emulator,
    problem: Problem,
    keeper: RunKeeper,
    seed: int,
    *,
    settings: EmulationSettings | None = None,
    more: int = 100,
    progress: Progress | None = None,
) -> Emulation:
    """Make runs where another problem of the same simulator needs them, a field campaign's.

    It has the same model and priors. Where the emulator, which serves the calibration, is good it
    stays so. The emulation's runs are the new ones, `more` at the most, and none where the other
    problem's posterior lies within that for which the emulator was found good.
    """
    state = State.beyond(emulator, problem, keeper, seed, more, progress)
    (found,) = _improved(state, settings or EmulationSettings(), more)
    return found


def _improved(state: State, chosen: EmulationSettings, most: int) -> tuple[Emulation, ...]:
    """Make runs where the posterior needs them, then some to check the emulator on."""
    history: list[tuple[int, float]] = []
    checks = chosen.checks_of(most)
    z = state.sample(0)
    if state.serves(z) and state.error(z) <= 0.8 * chosen.tolerance:
        return judged(state, z, chosen, [None] * len(state.outputs), [(0, state.error(z))])
    while True:
        z = _needed(state, chosen, checks, history)
        # Runs that failed across zero and were made again may have taken some of them.
        checks = min(checks, state.left)
        measured = _check(state, z, checks, len(history)) if checks else [None] * len(state.outputs)
        state.rebuild()
        # One that was surer of itself, or of where there are values, than it had reason to be has
        # learned from its check.
        seen = [m for m in measured if m is not None]
        ran = seen[0].runs if seen else 0
        good = ran >= 0.75 * checks and all(m.rmse <= chosen.tolerance for m in seen)
        partly = state.emulator.support is not None
        if partly and state.emulator.holds(z).any():
            # Where no run was made among those that failed there may seem to be room.
            z = state.sample(len(history) + 2)
            good &= not state.lost(z)
        if good or state.left <= checks:
            break
    if not state.emulator.holds(z).any():
        raise state.without_value("no parameters are left for the data")
    if partly and state.lost(z):
        raise state.without_value("the posterior lies among runs that failed")
    for name in idle(state, z):
        _log.warning(
            "%s: %s changes no output where the posterior is, so that the data say nothing of it; "
            'hold it with dist = "fixed", or see whether the simulator reads it',
            state.name, name,
        )  # fmt: skip
    return judged(state, z, chosen, measured, history)


def _needed(
    state: State, chosen: EmulationSettings, checks: int, history: list[tuple[int, float]]
) -> Array:
    """Make runs until the expected error is small, or as many as the check needs are left.

    Return draws of the posterior.
    """
    began = len(history)
    all_ran, told = True, None if len(state.runs) < FORESEEN_FROM or not history else ""
    while True:
        state.rebuild()
        z = state.sample(len(history) + 1)
        history.append((len(state.runs), state.error(z)))
        room = state.left - checks
        small = history[-1][1] <= 0.8 * chosen.tolerance
        if state.emulator.support is not None:
            # An edge has to be found as well: the error has to be small twice in a row.
            last = [error for _, error in history[began:]][-2:]
            small = len(last) > 1 and max(last) <= 0.3 * chosen.tolerance
        if room < 1 or (all_ran and small):
            return z
        off = history[-1][1]
        if told is None and len(state.runs) >= FORESEEN_FROM and off > chosen.tolerance:
            told = foreseen(state, z, chosen, history)
            _log.warning(
                "%s: after %d runs the emulator is off by %.2g noise sds (rms), where %g are "
                "allowed; %s; at most %d are made (emulator.runs)",
                state.name, len(state.runs), off, chosen.tolerance, told, state.most,
            )  # fmt: skip
        # The more there are the less a few others say.
        batch = max(2 * int(state.free.sum()), 4, len(state.runs) // 8)
        theta = state.axes.natural(_next(state, z, min(batch, room), len(history)))
        values = state.carry_out(theta)
        all_ran = bool(has_value(values).all())
        state.learn(theta, values)


def _nodes(
    problem: Problem, keeper: RunKeeper, recorded: Sequence[Mapping[str, Array]], count: int | None
) -> tuple[dict[str, Array], NDArray[np.bool_] | None, tuple[Run, ...]]:
    """Choose nodes, across zero if the simulator has values there in the middle of the prior.

    Return with them which of them lie across zero, and the run that told, if one was made.
    """
    ranges = keeper.simulator.ranges
    along = keeper.simulator.series_along
    inside = choose_nodes(recorded, ranges, count, along=along)
    wide = choose_nodes(recorded, ranges, count, across_zero=True, along=along)
    if all(np.array_equal(inside[name], wide[name]) for name in inside):
        return inside, None, ()
    tried = tuple(keeper.runs(prior_middle(problem), wide))
    if not tried[0].ok:
        return inside, None, tried
    across = across_zero({n: v for n, v in wide.items() if n not in ranges}, recorded)
    return wide, across, tried


def _first_design(state: State, chosen: EmulationSettings) -> None:
    """Spread runs over the prior, some of them twice, to see the simulator's noise."""
    d, deterministic = int(state.free.sum()), state.keeper.simulator.deterministic
    before = len(state.runs)
    theta = prior_design(
        state.outputs[0].problem, chosen.spread(d, deterministic, before), state.seed
    )
    values, across = state.carry_out(theta[:FIRST_RUNS]), state.across
    if fail_alike(state.runs[before:]) and fail_alike(state.runs):
        raise state.without_value(FROM_THE_START)
    # An output in another unit, too, need not be paid for with the whole design.
    check_outputs(state, values, check_scale)
    state.runs = [*map(across_too, state.runs[:before]), *state.runs[before:]]
    # Runs that failed across zero and were made again may have taken some of them.
    theta = theta[: FIRST_RUNS + state.left]
    more = state.carry_out(theta[FIRST_RUNS:])
    if more.shape[2] < values.shape[2]:  # one of these had a value but for the nodes across zero
        values = values[..., ~across]
    values = np.concatenate([values, more])
    ok = has_value(values)
    if ok.mean() < 0.5:
        raise state.without_value("the simulator fails in most of its prior")
    check_outputs(state, values, check_scale, check_moves)
    state.learn(theta, values)
    count, times = chosen.repeats(deterministic)
    repeats = np.flatnonzero(ok)[: min(count, state.left // times)]
    if not repeats.size:
        return
    again = [state.repeat(theta[repeats], r) for r in range(1, times + 1)]
    apart, tamed = state.tamed(np.stack([values[repeats], *again])), state.tamed(values)
    for i, known in enumerate(state.outputs):
        own = float(np.sqrt(np.nanmean(apart[:, :, i].var(axis=0, ddof=1))))
        if own > 1e-6 * float(np.nanstd(tamed[:, i])):
            known.training = replace(known.training, noisy=True)
            known.own_noise = own
    if any(known.own_noise for known in state.outputs):
        for found in again:
            state.learn(theta[repeats], found)


def check_outputs(
    state: State, values: Array, *checks: Callable[[Problem, Array, Simulator], None]
) -> None:
    """Check runs (k, o, m) output by output."""
    for check in checks:
        for i, known in enumerate(state.outputs):
            check(known.problem, known.outputs(values[:, i]), state.keeper.simulator)


def _next(state: State, z: Array, count: int, step: int) -> Array:
    """Pick the runs to make next: where the emulator knows least of what the posterior needs."""
    rng = generator(state.seed, state.label, "next", step)
    candidates = inner = z[rng.permutation(len(z))[:400]]
    if state.region is None:
        return candidates[:count]
    if state.emulator.support is not None:
        # There may be values beyond where some are known: half are looked for farther out.
        middle = z.mean(axis=0)
        candidates = np.concatenate([inner[::2], middle + 1.6 * (inner[1::2] - middle)])
    edge = state.emulator.from_edge(inner)
    # Where there may be no value the edge matters as much as the values do.
    at_edge = inner[np.argsort(edge)[: count // 2]] if state.emulator.support else inner[:0]
    candidates = candidates[state.emulator.holds(candidates)]
    count -= len(at_edge)
    unknown = np.sum([known.row_variance(candidates) for known in state.outputs], axis=0)
    x = state.region.coordinates(candidates)
    lengths = np.full(x.shape[1], 2.0)  # posterior sds within which a run tells of others
    picked: list[int] = []
    for _ in range(min(count, len(candidates))):
        i = int(np.argmax(unknown))
        picked.append(i)
        unknown = unknown * (1.0 - correlation(x, x[i : i + 1], lengths)[:, 0] ** 2)
        unknown[i] = -1.0
    return np.concatenate([candidates[picked], at_edge])


def _check(state: State, z: Array, count: int, step: int) -> list[HeldOut | None]:
    """Predict runs at fresh draws before the emulator sees them, then let it."""
    rng = generator(state.seed, state.label, "check", step)
    theta = state.axes.natural(z[rng.choice(len(z), count, replace=False)])
    values = state.carry_out(theta)
    found = [
        held_out(known, theta, known.tamed(values[:, i])) for i, known in enumerate(state.outputs)
    ]
    state.learn(theta, values)
    return found


_SCATTERS = "its output scatters: write deterministic = false in the simulator file"


def held_out(known: Known, theta: Array, values: Array) -> HeldOut | None:
    """Compare an emulator with runs that it has not seen; None where none has a value."""
    emulator = known.emulator
    means, variances = emulator.with_variance(theta)
    ok = np.isfinite(values).all(axis=1) & np.isfinite(means).all(axis=1)
    true = (values[ok] - emulator.mean) @ emulator.curves.T
    # What the basis cannot hold is an error as well.
    rest = values[ok] - emulator.mean - true @ emulator.curves
    return _compared(known, true - means[ok], rest, variances[ok]) if ok.any() else None


def left_out(known: Known) -> HeldOut | None:
    """Compare each run where the posterior is with what the others say; None of a few."""
    emulator = known.emulator
    training, region = emulator.training, known.regions[-1]
    there = region.inside(known.axes.of(training.theta[training.ok]))
    if there.sum() < 5:  # they do not tell how good the emulator is there
        return None
    off, unknown = emulator.functions.left_out()
    rest = training.values[training.ok] - emulator.mean
    rest -= (rest @ emulator.curves.T) @ emulator.curves
    variances = unknown[:, None] * emulator.variances
    return _compared(known, off[there], rest[there], variances[there])


def _compared(known: Known, off: Array, rest: Array, variances: Array) -> HeldOut:
    """Judge errors of the coefficients (k, j), and of what the basis cannot hold, (k, m)."""
    rows = known.emulator.curves_at(known.problem.conditions)[:, 1:]
    errors = off @ rows.T
    total = np.square(errors).sum(axis=1) + np.square(rest).mean(axis=1) * len(rows)
    # The noise of a stochastic simulator is no error of the emulator. It is in each coefficient,
    # the curves being orthonormal, and in the part that the curves leave out.
    own = known.own_noise**2
    left = 1.0 - rows.shape[1] / rest.shape[1]
    squared = max(float(total.mean()) - own * (np.square(rows).sum() + left * len(rows)), 0.0)
    z = off / np.sqrt(np.maximum(variances + own, 1e-300))
    return HeldOut(
        len(off), float(np.sqrt(squared / len(rows))) / known.sigma, z, ndtr(z).ravel(),
        float((np.abs(z) < 1.645).mean()), errors,
    )  # fmt: skip


def judged(
    state: State, z: Array, chosen: EmulationSettings, measured: Sequence[HeldOut | None],
    history: Sequence[tuple[int, float]],
) -> tuple[Emulation, ...]:  # fmt: skip
    """Put together what became of each output's emulation, and whether it is good enough."""
    return tuple(
        _judged(state, known, z, chosen, of, history)
        for known, of in zip(state.outputs, measured, strict=True)
    )


def _judged(
    state: State, known: Known, z: Array, chosen: EmulationSettings, measured: HeldOut | None,
    history: Sequence[tuple[int, float]],
) -> Emulation:  # fmt: skip
    expected, (between, at_rows) = known.error(z), _between(known, z)
    wider, shifted = _consequences(state, known, z, measured)
    reasons = []
    off = measured.rmse if measured is not None else expected
    if off > chosen.tolerance:
        more = "give it more runs, or tighter priors"
        if state.scatters:
            more = _SCATTERS
        elif state.most:
            more += f" ({foreseen(state, z, chosen, history)})"
        reasons.append(
            f"the emulator is off by {off:.2f} noise sds (rms), where {chosen.tolerance:g} are "
            f"allowed: {more}. {_usable(known, off, wider, shifted)}"
        )
    if measured is not None and measured.covered < 0.7 and off > 0.3 * chosen.tolerance:
        reasons.append(
            f"its 90 % intervals hold {100 * measured.covered:.0f} % of the runs it had not seen"
        )
    if at_rows > chosen.tolerance:
        reasons.append(
            f"between its nodes, where rows of the data lie, it is off by {at_rows:.2f} noise sds "
            f"(rms), where {chosen.tolerance:g} are allowed: give it more nodes"
        )
    known.use(replace(known.emulator, good=not reasons))
    return Emulation(
        known.emulated, known.emulator, tuple(state.runs), measured, expected, between,
        known.own_noise, not reasons, tuple(reasons), tuple(history), bool(state.earlier), wider,
        shifted,
    )  # fmt: skip


def foreseen(
    state: State, z: Array, chosen: EmulationSettings, history: Sequence[tuple[int, float]]
) -> str:
    """Say how many runs will be needed, by a power of their number, and what would lower it."""
    if state.scatters:
        return _SCATTERS
    # A field's emulator begins before any run of its own.
    runs, errors = np.array([entry for entry in history if entry[0] > 0]).reshape(-1, 2).T
    said = "how many cannot be foreseen, for the error does not fall as it should"
    if runs.size > 1:
        slope, level = np.polyfit(np.log(runs), np.log(np.maximum(errors, 1e-300)), 1)
        needed = float(np.exp((np.log(chosen.tolerance) - level) / slope)) if slope < 0 else np.inf
        rounded = plain_number(needed, 2)
        if len(state.runs) < float(rounded) < 100 * runs[-1]:
            said = f"as its error falls it needs some {rounded} runs"
    names = [p.name for p in state.outputs[0].problem.priors.entries[:-1]]
    ratio = np.where(state.free, z.std(axis=0), 0.0)
    little = [f"{names[i]} ({100 * ratio[i]:.0f} %)" for i in np.argsort(-ratio) if ratio[i] > 0.7]
    if little:
        said += (
            '; fewer if you fix, with dist = "fixed", what you know of '
            f"{', '.join(little)}: of these the data say least (posterior sds in parts of the "
            "prior's)"
        )
    return said


def idle(state: State, z: Array) -> list[str]:
    """Name parameters that move no output by what is looked into, wherever draws have them."""
    z = z[state.emulator.holds(z)]
    found = []
    for i in np.flatnonzero(state.free) if len(z) else ():
        moved = z.copy()
        moved[:, i] = np.roll(z[:, i], len(z) // 2)
        if not any(_moves(known, z, moved) for known in state.outputs):
            found.append(state.outputs[0].problem.priors.entries[i].name)
    return found


def _moves(known: Known, z: Array, moved: Array) -> bool:
    """Whether an output anywhere differs by what is looked into between draws (k, d) and others."""
    at = known.emulator.curves_at(known.problem.conditions)[:, 1:].T
    before, after = (known.emulator.coefficients(known.axes.natural(some)) for some in (z, moved))
    rms = np.sqrt(np.square((after - before) @ at).mean(axis=1))
    return bool(np.nanmax(rms) >= NEGLIGIBLE * known.sigma)


def _between(known: Known, z: Array) -> tuple[float, float]:
    """Rms errors between the nodes and at the rows of the data, in sds of the noise.

    What interpolation leaves unknown at a row is in units of what it leaves at nodes that are left
    out, whose errors are known.
    """
    emulator, over = known.emulator, known.emulator.over
    left_out, unknown = over.left_out(np.concatenate([emulator.mean[None], emulator.curves]))
    # At the ends of the box a node that is left out has none beyond it.
    inner = ((over.nodes > 0.0) & (over.nodes < 1.0)).all(axis=1)
    theta = known.axes.natural(z[emulator.holds(z)][:64])
    c = np.concatenate([np.ones((len(theta), 1)), emulator.coefficients(theta)], axis=1)
    squares = np.square(c @ left_out[:, inner])
    if not squares.size:
        return 0.0, 0.0
    at_rows = over.unknown(known.problem.conditions).mean() * (squares / unknown[inner]).mean()
    return float(np.sqrt(squares.mean())) / known.sigma, float(np.sqrt(at_rows)) / known.sigma


def _consequences(
    state: State, known: Known, z: Array, measured: HeldOut | None
) -> tuple[Mapping[str, float], Mapping[str, float]]:
    """What the emulator's error does to each parameter, to first order.

    How many times as wide its posterior is for the error in the likelihood, and by how many of its
    sds errors like those that were measured shift it (rms). The other outputs' errors are left out.
    """
    emulator = known.emulator
    names = [
        p.name for p, free in zip(known.problem.priors.entries, state.free, strict=False) if free
    ]
    z = z[emulator.holds(z)]
    if len(z) < 2 * len(names) + 2:
        return {}, {}
    unknown = emulator.with_unknown(known.axes.natural(z))[1]
    rows = emulator.curves_at(known.problem.conditions)[:, 1:]
    slopes = _slopes(known, z, state.free)
    # In units of the prior's sds, whose own precision is one.
    prior, noise = np.eye(len(names)), known.sigma**2 * np.eye(len(rows))
    for other in state.outputs:
        if other is not known:
            of_other = _slopes(other, z, state.free) / other.sigma
            prior += of_other @ of_other.T
    both = noise + float(np.median(unknown)) * (rows * emulator.variances) @ rows.T
    weighed = np.linalg.solve(both, slopes.T)
    posterior = np.linalg.inv(prior + slopes @ weighed)
    alone = np.linalg.inv(prior + slopes @ slopes.T / known.sigma**2)
    sd = np.sqrt(np.diag(posterior))
    wider = dict(zip(names, (sd / np.sqrt(np.diag(alone))).tolist(), strict=True))
    if measured is None:
        return wider, {}
    shifts = np.sqrt(np.mean(np.square(measured.errors @ weighed @ posterior), axis=0)) / sd
    return wider, dict(zip(names, shifts.tolist(), strict=True))


def _slopes(known: Known, z: Array, free: NDArray[np.bool_]) -> Array:
    """Derivatives of an output's rows (n) by the free parameters, as draws have them, (d, n)."""
    means = known.emulator.coefficients(known.axes.natural(z))
    rows = known.emulator.curves_at(known.problem.conditions)[:, 1:]
    u = z[:, free] - z[:, free].mean(axis=0)
    return np.linalg.lstsq(u, (means - means.mean(axis=0)) @ rows.T, rcond=None)[0]


def _usable(
    known: Known, off: float, wider: Mapping[str, float], shifted: Mapping[str, float]
) -> str:
    """Say for what an emulator that is not good enough can be used all the same."""
    said = "Its error is in the likelihood"
    if wider:
        most = max(wider, key=wider.__getitem__)
        percent = plain_number(100.0 * (wider[most] - 1.0), 2)
        said += f", which makes the posterior of {most} {percent} % wider and of no other more"
    if shifted:
        most = max(shifted, key=shifted.__getitem__)
        said += f"; estimates are off by at most {shifted[most]:.2f} of their sds (rms, {most})"
    model = known.problem.bound.model
    unit = f"{100.0 * off * known.sigma:.2g} %"
    if model.response != "log":
        unit = f"{plain_number(off * known.sigma, 2)} {QUANTITIES[model.output].unit_word}".rstrip()
    return (
        f"{said}; the simulator's own output is known to {unit} (rms). It is usable for what is "
        "coarser than that, not to compare models or to tell smaller gaps"
    )
