"""Try a simulator before a sampler or an estimator calls it thousands of times."""

from __future__ import annotations

import logging
from collections.abc import Iterator
from contextlib import contextmanager
from threading import Timer
from typing import TYPE_CHECKING

import numpy as np

from calib.data.files import plain_number
from calib.errors import CalibError
from calib.inference.problem import Problem
from calib.inference.random import generator
from calib.models.base import Array

if TYPE_CHECKING:
    from calib.models.simulators.base import Simulator

_TRIMMED = 0.002


def prior_design(problem: Problem, count: int, seed: int, *, latin: bool = False) -> Array:
    """Return natural parameters of the model spread over the prior, shape (count, d).

    By Sobol's sequence, of which every beginning is even, or a Latin hypercube.
    """
    from scipy.stats import qmc  # late: half a second, and few commands emulate

    d = len(problem.priors.free)
    bits = int(np.ceil(np.log2(max(count, 2))))
    rng = generator(seed, "emulate", "design")
    if latin:
        u = qmc.LatinHypercube(d, rng=rng).random(count)
    else:
        u = qmc.Sobol(d, scramble=True, rng=rng).random_base2(bits)[:count]
    t = problem.priors.ppf(_TRIMMED + (1.0 - 2.0 * _TRIMMED) * u)
    return problem.of_model(problem.theta(t))


def prior_middle(problem: Problem) -> Array:
    """Return natural parameters of the model at the medians of the prior, shape (1, d)."""
    t = problem.priors.ppf(np.full((1, len(problem.priors.free)), 0.5))
    return problem.of_model(problem.theta(t))


_log = logging.getLogger(__name__)

_SEED = 0
# A trial that takes so many seconds is spoken of.
_PATIENCE = 5.0
# What rounding makes of equal runs, which may add up in another order, is less than this part.
_SAME = 1e-6
# Outputs that differ by this factor from what was measured, wherever in the prior, are in another
# unit: kN and N differ by 1000, mm and cm with m by 1000 and 100, a ratio and percent by 100.
_FAR = 30.0


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
    from calib.models.simulators.registered import Direct
    from calib.models.simulators.runs import FIRST

    if not isinstance(direct, Direct):
        _check_repeats(problem, prior_middle(problem), f"model {problem.bound.model.name}")
        return
    if direct.simulator.emulate or direct.tally.tried:
        return
    spread = prior_design(problem, FIRST, _SEED)
    thetas = np.concatenate([prior_middle(problem), spread])
    with _told_if_long(direct.simulator):
        direct.try_first(thetas, problem.conditions)
        outputs = problem.bound.predict(thetas, problem.conditions)
    check_scale(problem, outputs, direct.simulator)
    check_moves(problem, outputs, direct.simulator)
    for i in np.flatnonzero(np.isfinite(outputs).all(axis=1))[:1]:
        _check_repeats(problem, thetas[i : i + 1], direct.simulator.place())
    direct.tally.tried = True


@contextmanager
def _told_if_long(simulator: Simulator) -> Iterator[None]:
    """Say what is waited for if it is not over soon."""
    timer = Timer(
        _PATIENCE, _log.warning,
        ("still trying the simulator %s, after %g s, at a few points of its prior; with emulate = "
         "false it is then asked 300,000 times or more, so one that takes seconds is emulated",
         simulator.name, _PATIENCE),
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
    if not (apart > _SAME).any():
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
    if not names or len(values) < 2 or np.ptp(values, axis=0).max() > _SAME * np.abs(values).max():
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
    if times.max() > 1.0 / _FAR and times.min() < _FAR:
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
