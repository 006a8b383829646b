"""Simulators too slow to be asked by a sampler: truths are runs, posteriors are by emulation.

Each simulated campaign is emulated and calibrated as `calib fit` would. The seed of the emulation
is that of the whole run, so all campaigns begin with the same runs over the prior, which are kept
and made once.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np

from calib.data import table_from_arrays
from calib.errors import CalibError
from calib.inference.emulation import Emulation
from calib.inference.emulation.prepared import emulated
from calib.inference.emulation.settings import EmulationSettings
from calib.inference.problem import Problem, build_problem
from calib.models.base import Array, Conditions, not_given
from calib.models.simulators.registered import Simulated
from calib.models.simulators.runs import RunKeeper
from calib.validation.sbc.designs import Design

# Of which at least half has to have a value, or the emulation refuses.
MOST_TRUTHS = 50
# A truth is run at the conditions of the design and at those held out.
_EACH_TRUTH = 2


@dataclass(frozen=True)
class _Runs:
    """An equation that makes a run for each parameter vector; those that fail have no value."""

    keeper: RunKeeper
    output: str

    def __call__(self, theta: Array, conditions: Conditions) -> Array:
        empty = np.full(next(iter(conditions.values())).shape[-1], np.nan)
        runs = self.keeper.runs(theta, conditions)
        return np.stack([run.outputs[self.output] if run.ok else empty for run in runs])


def run_each(template: Problem, found: Simulated, workers: int, scheduler: str | None) -> Problem:
    """Return a problem that asks the simulator itself, to draw truths and their data from."""
    keeper = RunKeeper(found.simulator, found.folder, workers, scheduler)
    model = template.bound.model
    # What is evaluated follows from the equation.
    asking = replace(model, predict=_Runs(keeper, model.output), location=not_given)
    return replace(template, bound=replace(template.bound, model=asking))


def emulate_campaign(
    problem: Problem, held: Mapping[str, Array], seed: int, workers: int, scheduler: str | None
) -> Emulation:
    """Emulate the simulator for a simulated campaign as `calib fit` would for a measured one."""
    elsewhere = table_from_arrays(dict(held), source="held out")
    return emulated(problem, seed, elsewhere=[elsewhere], workers=workers, scheduler=scheduler)


def most_runs(model: str, found: Simulated, design: Design, simulations: int) -> str:
    """Say how many runs of a slow simulator so many campaigns may take.

    Raises
    ------
    CalibError
        If it cannot be run: a table of runs has none at a new truth.
    """
    if not found.simulator.way.runs:
        raise CalibError(
            f"{model} is a table of runs already made: there is none at the truths that are drawn",
            where=f"simulator {found.name}", allowed="a simulator that can be run",
            mend="declare the program that made the table, or leave the model out",
        )  # fmt: skip
    settings = EmulationSettings(**(found.budget or {}))  # type: ignore[arg-type]
    free = len(build_problem(model, design.table).priors.free) - 1
    # Without a folder nothing is kept from one campaign to the next.
    shared = found.folder is not None and settings.sequential
    first = settings.spread(free, found.simulator.deterministic) if shared else 0
    each = settings.runs - first + _EACH_TRUTH
    return (
        f"{model}: {first} runs that all campaigns share and at most {each} for each of "
        f"{simulations}, at most {first + each * simulations} runs of the simulator in all"
    )
