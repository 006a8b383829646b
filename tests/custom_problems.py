"""Problems made of any function of slip, whose posteriors are known in closed form or by grid."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np

from calib.data import table_from_arrays
from calib.inference.priors import Prior, Priors
from calib.inference.problem import Problem
from calib.models.base import Model

type Array = np.ndarray


def normal(name: str, mean: float, sd: float, *, log: bool = False) -> Prior:
    return Prior(name, "1", "a test", "nobody", "normal", log, mean, sd)


def fixed(name: str, value: float) -> Prior:
    return Prior(name, "1", "a test", "nobody", "fixed", False, value, 0.0)


def problem_of(
    function: Callable[..., Array], priors: Sequence[Prior], slip: Array, pull: Array
) -> Problem:
    """A problem of pull against slip; `function` takes each parameter, then slip, broadcast.

    The last prior is that of sigma.
    """

    def mean_response(conditions, **parameters):
        return np.asarray(function(*parameters.values(), conditions["slip_ratio"]))

    names = tuple(p.name for p in priors)[:-1]
    model = Model(
        name="custom", title="a test", output="drawbar_pull_kn",
        conditions=("slip_ratio",), parameters=names, mean_response=mean_response,
    )  # fmt: skip
    table = table_from_arrays({"slip_ratio": slip, "drawbar_pull_kn": pull})
    return Problem(model.bind(table.columns), table, Priors(tuple(priors)))
