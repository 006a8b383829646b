"""A simulator is tried before a sampler or an estimator asks it thousands of times."""

from __future__ import annotations

import numpy as np

from calib.inference.design import prior_design, prior_middle
from calib.inference.problem import Problem

_SEED = 0


def try_simulator(problem: Problem) -> None:
    """Try the simulator that a problem asks for each parameter vector, if it does.

    At the middle of the prior and at five points spread over it, until a run has a value.

    Raises
    ------
    CalibError
        If all of these fail in one way: with file and key, what the first printed, and where.
    """
    direct = problem.bound.model.predict
    if direct is None:
        return
    # They take some time to import: only where a function is behind the model.
    from calib.models.simulators.refused import FIRST
    from calib.models.simulators.registered import Direct

    if isinstance(direct, Direct):
        spread = prior_design(problem, FIRST, _SEED)
        direct.try_first(np.concatenate([prior_middle(problem), spread]), problem.conditions)
