"""At which parameters and conditions a simulator is run, and whether its outputs make sense."""

from __future__ import annotations

import logging
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from threading import Timer
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from calib.data.files import plain_number
from calib.data.quantities import QUANTITIES
from calib.errors import CalibError
from calib.inference.constants import PATIENCE, SAME_OUTPUT
from calib.inference.problem import Problem
from calib.inference.random import generator
from calib.models.base import Array

if TYPE_CHECKING:
    from calib.models.simulators.simulator import Simulator


def prior_design(problem: Problem, count: int, seed: int) -> Array:
    """Return natural parameters of the model spread over the prior, shape (count, d).

    By Sobol's sequence, of which every beginning is even.
    """
    from scipy.stats import qmc  # late: half a second, and few commands emulate

    d = len(problem.priors.free)
    bits = int(np.ceil(np.log2(max(count, 2))))
    rng = generator(seed, "emulate", "design")
    u = qmc.Sobol(d, scramble=True, rng=rng).random_base2(bits)[:count]
    t = problem.priors.ppf(0.002 + 0.996 * u)  # without the outermost tails
    return problem.of_model(problem.theta(t))


def prior_middle(problem: Problem) -> Array:
    """Return natural parameters of the model at the medians of the prior, shape (1, d)."""
    t = problem.priors.ppf(np.full((1, len(problem.priors.free)), 0.5))
    return problem.of_model(problem.theta(t))


_log = logging.getLogger(__name__)


def try_simulator(problem: Problem) -> None:
    """Try the simulator that a problem asks for each parameter vector, if it does.

    At the middle of the prior and at five points spread over it, and twice more at the first of
    them that has a value; once for each process. Of another model's function only whether it gives
    the same again is tried, at the middle.

    Raises
    ------
    CalibError
        If all of these fail in one way: with file and key, what the first printed, and where. If
        the output is in another unit than declared, or another at equal parameters.
    """
    direct = problem.bound.model.predict
    if direct is None:
        return
    # They take some time to import: only where a function is behind the model.
    from calib.models.constants import FIRST_RUNS
    from calib.models.simulators.declaration import Direct

    if not isinstance(direct, Direct):
        _check_repeats(problem, prior_middle(problem), f"model {problem.bound.model.name}")
        return
    if direct.simulator.emulate or direct.tally.tried:
        return
    spread = prior_design(problem, FIRST_RUNS, 0)
    thetas = np.concatenate([prior_middle(problem), spread])
    with _warned_if_long(direct.simulator):
        direct.try_first(thetas, problem.conditions)
        outputs = problem.bound.predict(thetas, problem.conditions)
    check_scale(problem, outputs, direct.simulator)
    check_moves(problem, outputs, direct.simulator)
    for i in np.flatnonzero(np.isfinite(outputs).all(axis=1))[:1]:
        _check_repeats(problem, thetas[i : i + 1], direct.simulator.place())
    direct.tally.tried = True


@contextmanager
def _warned_if_long(simulator: Simulator) -> Iterator[None]:
    """Say what is waited for if it is not over soon."""
    timer = Timer(
        PATIENCE, _log.warning,
        ("still trying the simulator %s, after %g s, at a few points of its prior; with emulate = "
         "false it is then asked 300,000 times or more, so one that takes seconds is emulated",
         simulator.name, PATIENCE),
    )  # fmt: skip
    timer.daemon = True
    timer.start()
    try:
        yield
    finally:
        timer.cancel()


def _check_repeats(problem: Problem, theta: Array, where: str) -> None:
    """Check that equal parameters (1, d) give equal outputs.

    Raises
    ------
    CalibError
        If not: a sampler that meets other values where it has been does not converge.
    """
    with np.errstate(all="ignore"):
        first, again = (problem.bound.predict(theta, problem.conditions) for _ in range(2))
    apart = np.abs(again - first) / max(np.abs(first).max(), 1e-300)
    # No value the second time is a failure, and counted as such.
    if not (apart > SAME_OUTPUT).any():
        return
    raise CalibError(
        "called twice with equal parameters and conditions it gives other outputs (apart by "
        f"{plain_number(100.0 * float(np.nanmax(apart)), 2)} % of the largest)",
        where=where,
        expected="equal output for equal input, unless it is emulated: no sampler converges on a "
        "posterior that changes under it",
        hint="fix the seed of its random numbers; or, if a simulator is to scatter, have it "
        "emulated with deterministic = false, which allows for it",
    )


def check_moves(problem: Problem, outputs: Array, simulator: Simulator) -> None:
    """Check that outputs over the prior, (k, n), are not all the same.

    Raises
    ------
    CalibError
        If they are, and there are parameters: the simulator does not read them, or writes what
        does not depend on them.
    """
    values = outputs[np.isfinite(outputs).all(axis=1)]
    names = [name for name in problem.names if name in problem.bound.model.parameters]
    if (
        not names
        or len(values) < 2
        or np.ptp(values, axis=0).max() > SAME_OUTPUT * np.abs(values).max()
    ):
        return
    raise CalibError(
        f"no parameter changes the output: it is the same in all of {len(values)} runs over the "
        f"prior of {', '.join(names)}",
        where=simulator.place("unreadable"), expected="an output that depends on its parameters",
        hint="see whether the simulator reads the parameters that it is given, and returns what it "
        "works out from them",
    )  # fmt: skip


def check_scale(problem: Problem, outputs: Array, simulator: Simulator) -> None:
    """Check that outputs over the prior, (k, n), are of the size of what was measured.

    Raises
    ------
    CalibError
        If none is: the simulator gives another unit than its file says, or the priors are of
        another one.
    """
    values = np.abs(outputs[np.isfinite(outputs).all(axis=1)])
    if not values.size:
        return
    times = values.max(axis=1) / np.abs(problem.observed).max()
    if times.max() > 1.0 / 30.0 and times.min() < 30.0:  # kN and N differ by 1000
        return
    output = problem.bound.model.output
    header = next(o.header for o in simulator.outputs if simulator.canonical(o.header) == output)
    least, most = (plain_number(t, 2) for t in (times.min(), times.max()))
    raise CalibError(
        f"in all of {times.size} runs over the prior the largest output is {least} to {most} times "
        "the largest that was measured",
        where=simulator.place("unreadable"),
        expected=f"outputs in the unit of {header}, and priors that reach the data",
        hint="name the column with the unit that it gives, or correct the priors or the data's "
        "unit",
    )


def choose_nodes(
    recorded: Sequence[Mapping[str, Array]],
    ranges: Mapping[str, tuple[float, float]],
    count: int | None = None,
    *,
    across_zero: bool = False,
    along: str = "",
) -> dict[str, Array]:
    """Choose the conditions of every run: the distinct recorded ones, then others between them.

    Parameters
    ----------
    recorded : sequence of mapping of str to ndarray, shape (n,)
        The conditions of every table that will be predicted, in canonical columns.
    ranges : mapping of str to (float, float)
        Bounds that the user gave, which the nodes then span.
    count : int, optional
        How many, of whole numbers fewer if there are no more; by default as many as the number of
        varying conditions asks for. Of more rows so many are taken, and spread evenly.
    across_zero : bool
        Whether the margin may change a condition's sign, as a slip's does with another rolling
        radius: many formulas and some simulators end there.
    along : str
        A condition of which series are given: `count` is then of series, which all have the same
        values of it, as many of those recorded as leave some 600 nodes.
    """
    if along:
        own = np.concatenate([r[along] for r in recorded])
        others = [{c: v for c, v in r.items() if c != along} for r in recorded]
        settings = {"": np.zeros(1)}
        if others[0]:
            settings = choose_nodes(others, ranges, count, across_zero=across_zero)
        series = next(iter(settings.values())).size
        most = min(max(600 // series, 8), np.unique(own).size)
        span = {along: ranges.get(along, (float(own.min()), float(own.max())))}
        each = choose_nodes([{along: own}], span, most)[along]
        nodes = {c: np.repeat(v, each.size) for c, v in settings.items() if c}
        return {c: nodes.get(c, np.tile(each, series)) for c in recorded[0]}
    columns = tuple(recorded[0])
    rows = np.concatenate([np.stack([r[c] for c in columns], axis=1) for r in recorded])
    rows = np.unique(rows, axis=0)
    low, high = _box(columns, rows, ranges, across_zero)
    varying = high > low
    unit = np.where(varying, high - low, 1.0)
    inside = (rows - low) / unit
    most = count or 160
    if len(inside) > most:
        inside = inside[_spread(inside, np.zeros((0, len(columns))), most)]
    # A curve is smooth, a surface needs more nodes.
    wanted = count or {0: 1, 1: 24, 2: 56}.get(int(varying.sum()), 90)
    more = max(wanted - len(inside), 0)
    if more:
        inside = np.concatenate([inside, *_between(inside, varying, more)])
    found = np.where(varying, low + inside * unit, low)
    for i, column in enumerate(columns):
        if QUANTITIES[column].range.integer:
            found[:, i] = np.round(found[:, i])
    found = found[np.sort(np.unique(found, axis=0, return_index=True)[1])]
    return {c: found[:, i].copy() for i, c in enumerate(columns)}


def across_zero(
    nodes: Mapping[str, Array], recorded: Sequence[Mapping[str, Array]] = ()
) -> NDArray[np.bool_]:
    """Whether each node has a condition below zero that no recorded row has below zero, (m,)."""
    found = np.zeros(next(iter(nodes.values())).size, dtype=bool)
    for column, values in nodes.items():
        if all((r[column] >= 0.0).all() for r in recorded):
            found |= values < 0.0
    return found


def _box(
    columns: Sequence[str],
    rows: Array,
    ranges: Mapping[str, tuple[float, float]],
    across_zero: bool,
) -> tuple[Array, Array]:
    low, high = rows.min(axis=0), rows.max(axis=0)
    wide = 0.1 * (high - low)  # an effect on a gauge takes the simulator beyond what was recorded
    for i, column in enumerate(columns):
        if column in ranges:
            low[i], high[i] = min(low[i], ranges[column][0]), max(high[i], ranges[column][1])
            continue
        span = QUANTITIES[column].range
        least = max(span.low, 0.0 if low[i] >= 0.0 and not across_zero else -np.inf)
        low[i] = max(
            low[i] - wide[i], min(least, low[i]), 0.5 * low[i] if span.low_open else -np.inf
        )
        high[i] = min(high[i] + wide[i], span.high)
    return low, high


def _between(inside: Array, varying: NDArray[np.bool_], more: int) -> tuple[Array, Array]:
    """Corners of the box, and points far from all nodes, as dense as the data are.

    Far is measured half by the conditions and half by their ranks: where readings were taken
    close together the output changes fast.
    """
    from scipy.stats import qmc  # late: half a second, and few commands emulate

    d = int(varying.sum())
    corners = np.zeros((2**d if d <= 3 else 0, inside.shape[1]))
    if len(corners):
        corners[:, varying] = np.stack(np.meshgrid(*[[0.0, 1.0]] * d), axis=-1).reshape(-1, d)
    candidates = np.zeros((512, inside.shape[1]))
    candidates[:, varying] = qmc.Sobol(d, scramble=False).random_base2(9)
    apart = np.abs(corners[:, None] - inside).max(axis=2).min(axis=1, initial=np.inf)
    corners = corners[apart > 1e-9][:more]
    there = np.concatenate([inside, corners])
    rest = more - len(corners)
    picked = _spread(_ranked(candidates, inside), _ranked(there, inside), rest)
    return corners, np.asarray(candidates[picked])


def _ranked(points: Array, inside: Array) -> Array:
    found = points.copy()
    for i, column in enumerate(inside.T):
        known = np.unique(np.concatenate([[0.0], column, [1.0]]))
        rank = np.interp(points[:, i], known, np.linspace(0.0, 1.0, known.size))
        found[:, i] = 0.5 * (points[:, i] + rank)
    return found


def _spread(candidates: Array, there: Array, count: int) -> list[int]:
    """Pick candidates, each as far as can be from those that are there and those picked."""
    far = np.full(len(candidates), np.inf)
    for point in there:
        far = np.minimum(far, np.square(candidates - point).sum(axis=1))
    picked: list[int] = []
    for _ in range(count):
        i = int(np.argmax(far))
        picked.append(i)
        far = np.minimum(far, np.square(candidates - candidates[i]).sum(axis=1))
    return picked
