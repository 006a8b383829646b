"""A simulator is tried before a sampler or an estimator asks it thousands of times."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from calib.data.numbers import plain_number
from calib.errors import CalibError
from calib.inference.design import prior_design, prior_middle
from calib.inference.problem import Problem
from calib.models.base import Array

if TYPE_CHECKING:
    from calib.models.simulators.base import Simulator

_SEED = 0
# Outputs that differ by this factor from what was measured, wherever in the prior, are in another
# unit: kN and N differ by 1000, mm and cm with m by 1000 and 100, a ratio and percent by 100.
_FAR = 30.0


def try_simulator(problem: Problem) -> None:
    """Try the simulator that a problem asks for each parameter vector, if it does.

    At the middle of the prior and at five points spread over it; once for each process.

    Raises
    ------
    CalibError
        If all of these fail in one way: with file and key, what the first printed, and where. If
        the output is in another unit than declared.
    """
    direct = problem.bound.model.predict
    if direct is None:
        return
    # They take some time to import: only where a function is behind the model.
    from calib.models.simulators.refused import FIRST
    from calib.models.simulators.registered import Direct

    if not isinstance(direct, Direct) or direct.simulator.emulate or direct.tally.tried:
        return
    spread = prior_design(problem, FIRST, _SEED)
    thetas = np.concatenate([prior_middle(problem), spread])
    direct.try_first(thetas, problem.conditions)
    check_scale(problem, problem.bound.predict(thetas, problem.conditions), direct.simulator)
    direct.tally.tried = True


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
        allowed=f"outputs in the unit of {header}, and priors that reach the data",
        mend="name the column with the unit that it gives, or correct the priors or the data's "
        "unit",
    )
