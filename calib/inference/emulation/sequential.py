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
from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from calib.batch.environment import one_thread
from calib.inference.design import (
    across_zero,
    check_moves,
    check_scale,
    choose_nodes,
    prior_design,
    prior_middle,
)
from calib.inference.emulation import (
    FORESEEN_FROM,
    WORTH,
    foreseen,
    held_out,
    idle,
    judged,
)
from calib.inference.emulation.state import (
    Emulation,
    EmulationSettings,
    HeldOut,
    Progress,
    State,
    across_too,
)
from calib.inference.problem import Problem
from calib.inference.random import generator
from calib.models.base import Array
from calib.models.simulators.emulator import Emulator
from calib.models.simulators.kriging import correlation
from calib.models.simulators.runs import FIRST, FROM_THE_START, Run, RunKeeper, fail_alike

_log = logging.getLogger(__name__)
_CANDIDATES = 400
# As `WORTH`, where some runs fail.
_SURE = 0.3
# So many times as far from the posterior's middle as its draws, where some runs fail.
_WIDER = 1.6
# How far in posterior sds a run is taken to tell of others when a batch is picked.
_APART = 2.0
_LEAST_OK = 0.5
# So many of the runs that an emulator is checked on have to have a value.
_RAN = 0.75
# A posterior most of whose draws are closer to a run that failed than to any other has no value
# that is known. At the edge of where there are values some are.
_AMONG_FAILED = 0.5


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
    chosen = settings or EmulationSettings()
    recorded = [problem.conditions, *(problem.bound.model.select(e) for e in elsewhere)]
    nodes, across, tried = _nodes(problem, keeper, recorded, chosen.nodes)
    state = State(
        problem, keeper, nodes, seed, chosen.runs, across=across, tried=tried, progress=progress
    )
    own_noise = _first_design(state, chosen)
    state.rebuild()
    return _improved(state, chosen, chosen.runs, own_noise)


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
    stays so. The emulation's runs are the new ones, `more` at the most.
    """
    state = State.beyond(emulator, problem, keeper, seed, more, progress)
    return _improved(state, settings or EmulationSettings(), more, 0.0)


def _improved(state: State, chosen: EmulationSettings, most: int, own_noise: float) -> Emulation:
    """Make runs where the posterior needs them, then some to check the emulator on."""
    history: list[tuple[int, float]] = []
    checks = chosen.checks_of(most)
    state.sample(0)
    while True:
        z = _needed(state, chosen, checks, history)
        # Runs that failed across zero and were made again may have taken some of them.
        checks = min(checks, state.left)
        measured = _check(state, z, checks, len(history)) if checks else None
        state.rebuild()
        # One that was surer of itself, or of where there are values, than it had reason to be has
        # learned from its check.
        ran = 0 if measured is None else measured.runs
        good = ran >= _RAN * checks and (measured is None or measured.rmse <= chosen.tolerance)
        partly = state.emulator is not None and state.emulator.support is not None
        if partly and state.holds(z).any():
            # Where no run was made among those that failed there may seem to be room.
            z = state.sample(len(history) + 2)
            good &= state.among_failed(z) <= _AMONG_FAILED
        if good or state.left <= checks:
            break
    if not state.holds(z).any():
        raise state.without_value("no parameters are left for the data")
    if partly and state.among_failed(z) > _AMONG_FAILED:
        raise state.without_value("the posterior lies among runs that failed")
    for name in idle(state, z):
        _log.warning(
            "%s: %s changes no output where the posterior is, so that the data say nothing of it; "
            'hold it with dist = "fixed", or see whether the simulator reads it',
            state.problem.bound.model.name, name,
        )  # fmt: skip
    return judged(state, z, chosen, measured, own_noise, history)


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
        small = history[-1][1] <= WORTH * chosen.tolerance
        if state.emulator is not None and state.emulator.support is not None:
            # An edge has to be found besides: so many more batches as make the error small twice.
            last = [error for _, error in history[began:]][-2:]
            small = len(last) > 1 and max(last) <= _SURE * chosen.tolerance
        if room < 1 or (all_ran and small):
            return z
        off = history[-1][1]
        if told is None and len(state.runs) >= FORESEEN_FROM and off > chosen.tolerance:
            told = foreseen(state, z, chosen, history)
            _log.warning(
                "%s: after %d runs the emulator is off by %.2g noise sds (rms), where %g are "
                "allowed; %s; at most %d are made (emulator.runs)", state.problem.bound.model.name,
                len(state.runs), off, chosen.tolerance, told, state.most,
            )  # fmt: skip
        # The more there are the less a few others say.
        batch = max(2 * int(state.free.sum()), 4, len(state.runs) // 8)
        theta = state.axes.natural(_next(state, z, min(batch, room), len(history)))
        values = state.carry_out(theta)
        all_ran = bool(np.isfinite(values).all())
        state.learn(theta, values)


def _nodes(
    problem: Problem, keeper: RunKeeper, recorded: Sequence[Mapping[str, Array]], count: int | None
) -> tuple[dict[str, Array], NDArray[np.bool_] | None, tuple[Run, ...]]:
    """Choose nodes, across zero if the simulator has values there in the middle of the prior.

    Return with them which of them lie across zero, and the run that told, if one was made.
    """
    ranges = keeper.simulator.ranges
    inside = choose_nodes(recorded, ranges, count)
    wide = choose_nodes(recorded, ranges, count, across_zero=True)
    if all(np.array_equal(inside[name], wide[name]) for name in inside):
        return inside, None, ()
    tried = tuple(keeper.runs(prior_middle(problem), wide))
    if not tried[0].ok:
        return inside, None, tried
    across = across_zero({n: v for n, v in wide.items() if n not in ranges}, recorded)
    return wide, across, tried


def _first_design(state: State, chosen: EmulationSettings) -> float:
    """Spread runs over the prior, some of them twice; return the sd of the simulator's noise."""
    d, deterministic = int(state.free.sum()), state.keeper.simulator.deterministic
    before = len(state.runs)
    theta = prior_design(
        state.problem, chosen.spread(d, deterministic, before), state.seed,
        latin=not chosen.sequential,
    )  # fmt: skip
    values, across = state.carry_out(theta[:FIRST]), state.across
    if fail_alike(state.runs[before:]) and fail_alike(state.runs):
        raise state.without_value(FROM_THE_START)
    # An output in another unit, too, need not be paid for with the whole design.
    check_scale(state.problem, state.outputs(values), state.keeper.simulator)
    state.runs = [*map(across_too, state.runs[:before]), *state.runs[before:]]
    # Runs that failed across zero and were made again may have taken some of them.
    theta = theta[: FIRST + state.left]
    more = state.carry_out(theta[FIRST:])
    if more.shape[1] < values.shape[1]:  # one of these had a value but for the nodes across zero
        values = values[:, ~across]
    values = np.concatenate([values, more])
    ok = np.isfinite(values).all(axis=1)
    if ok.mean() < _LEAST_OK:
        raise state.without_value("the simulator fails in most of its prior")
    check_scale(state.problem, state.outputs(values), state.keeper.simulator)
    check_moves(state.problem, state.outputs(values), state.keeper.simulator)
    state.learn(theta, values)
    count, times = chosen.repeats(deterministic)
    repeats = np.flatnonzero(ok)[: min(count, state.left // times)]
    if not repeats.size:
        return 0.0
    again = [state.repeat(theta[repeats], r) for r in range(1, times + 1)]
    apart = state.tamed(np.stack([values[repeats], *again]))
    own = float(np.sqrt(np.nanmean(apart.var(axis=0, ddof=1))))
    if own > 1e-6 * float(np.nanstd(state.tamed(values))):
        state.training = replace(state.training, noisy=True)
        for found in again:
            state.learn(theta[repeats], found)
        state.own_noise = own
        return own
    return 0.0


def _next(state: State, z: Array, count: int, step: int) -> Array:
    """Pick the runs to make next: where the emulator knows least of what the posterior needs."""
    rng = generator(state.seed, state.label, "next", step)
    candidates = inner = z[rng.permutation(len(z))[:_CANDIDATES]]
    if state.emulator is None or state.region is None:
        return candidates[:count]
    if state.emulator.support is not None:
        # There may be values beyond where some are known: half are looked for farther out.
        middle = z.mean(axis=0)
        candidates = np.concatenate([inner[::2], middle + _WIDER * (inner[1::2] - middle)])
    edge = state.emulator.from_edge(inner)
    # Where there may be no value the edge matters as much as the values do.
    at_edge = inner[np.argsort(edge)[: count // 2]] if state.emulator.support else inner[:0]
    candidates = candidates[state.emulator.holds(candidates)]
    count -= len(at_edge)
    unknown = state.row_variance(candidates)
    x = state.region.coordinates(candidates)
    lengths = np.full(x.shape[1], _APART)
    picked: list[int] = []
    for _ in range(min(count, len(candidates))):
        i = int(np.argmax(unknown))
        picked.append(i)
        unknown = unknown * (1.0 - correlation(x, x[i : i + 1], lengths)[:, 0] ** 2)
        unknown[i] = -1.0
    return np.concatenate([candidates[picked], at_edge])


def _check(state: State, z: Array, count: int, step: int) -> HeldOut | None:
    """Predict runs at fresh draws before the emulator sees them, then let it."""
    rng = generator(state.seed, state.label, "check", step)
    theta = state.axes.natural(z[rng.choice(len(z), count, replace=False)])
    values = state.carry_out(theta)
    found = held_out(state, theta, state.tamed(values))
    state.learn(theta, values)
    return found
