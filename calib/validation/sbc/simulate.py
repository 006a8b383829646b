"""One simulated campaign: parameters from the prior, measurements from the parameters."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np

from calib.data import Table
from calib.errors import CalibError
from calib.inference.problem import Problem
from calib.models.base import Array
from calib.validation.sbc.designs import Design

_MOST_ATTEMPTS = 10_000


@dataclass(frozen=True)
class Simulated:
    """A campaign whose truth is known.

    Parameters
    ----------
    truth : ndarray, shape (d,)
        Internal coordinates.
    problem : Problem
        Of the simulated calibration data.
    held : mapping of str to ndarray, shape (m,)
        Conditions of the held-out rows.
    location, measured : ndarray, shape (m,)
        At the held-out rows: the model's output at the truth, and a measurement of it; NaN where
        the model has no value.
    attempts : int
        Draws from the prior until the model had a value at every row.
    """

    truth: Array
    problem: Problem
    held: dict[str, Array]
    location: Array
    measured: Array
    attempts: int


def simulate(
    template: Problem, design: Design, rng: np.random.Generator, attempts: int = _MOST_ATTEMPTS
) -> Simulated:
    """Simulate a campaign at the design's conditions.

    Parameters for which the equation has no value at some row have no likelihood: the posterior
    excludes them, so the prior that the truths come from does too. Data that a float cannot hold
    are drawn again with new parameters; a choice made by looking at data alone keeps ranks uniform
    (Modrak et al. 2023, doi:10.1214/23-BA1404).

    Raises
    ------
    CalibError
        If the model has no value at the design, however often the prior is asked.
    """
    bound = template.bound
    for attempt in range(1, attempts + 1):
        truth = template.priors.sample(rng, 1)
        natural = template.theta(truth)
        noisy = _noisy(template, natural, template.conditions, template.draw_noise(natural, rng))[1]
        apart = template.noise.draw(natural, design.held, rng, _count(design.held))
        location, measured = _noisy(template, natural, design.held, apart)
        if np.isfinite(noisy).all() and (bound.model.response != "log" or (noisy > 0.0).all()):
            return Simulated(
                truth[0], template.with_table(_measured(template, noisy)), design.held, location,
                measured, attempt,
            )  # fmt: skip
    raise CalibError(
        f"the prior of {bound.model.name} gave no data in {attempts} draws",
        where=template.priors.source,
        hint="look for conditions at which the model has no value",
    )


def _noisy(
    problem: Problem, natural: Array, conditions: Mapping[str, Array], noise: Array
) -> tuple[Array, Array]:
    """Output at some conditions and a measurement of it, each of shape (n,)."""
    location = problem.bound.mean_response(problem.of_model(natural), conditions)[0]
    with np.errstate(over="ignore"):
        back = problem.bound.from_response
        return back(location), back(location + noise[0])


def _count(conditions: Mapping[str, Array]) -> int:
    return next(iter(conditions.values())).size


def _measured(template: Problem, output: Array) -> Table:
    # Not checked as a file is: a prior may expect values that no instrument reads.
    columns = {**template.table.columns, template.bound.model.output: output}
    return replace(template.table, columns=columns, source="simulated", label="simulated", text=())
