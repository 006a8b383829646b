"""One replicate of simulation-based calibration: simulate, calibrate, rank the truth.

Each simulated campaign is emulated and calibrated as `calib fit` would. The seed of the emulation
is that of the whole run, so all campaigns begin with the same runs over the prior, which are kept
and made once.

A replicate is a pure function of its item, so it can run anywhere and in any order.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from calib.data import table_from_arrays
from calib.errors import CalibError
from calib.inference.calibration import Calibration, calibrate
from calib.inference.emulation import Emulation
from calib.inference.emulation.prepared import emulated
from calib.inference.emulation.settings import EmulationSettings
from calib.inference.estimators import estimate
from calib.inference.prior_files import PriorFile
from calib.inference.problem import Problem, build_problem
from calib.inference.random import generator
from calib.inference.sampling.sampler import Draws, SamplerSettings
from calib.models.base import Array, Conditions, not_given
from calib.models.simulators.registered import Simulated as SlowSimulator
from calib.models.simulators.registered import slow_simulator
from calib.models.simulators.runs import RunKeeper
from calib.validation.prediction import predict
from calib.validation.sbc.designs import Design, design_of
from calib.validation.sbc.simulate import Simulated, simulate
from calib.validation.scores import LEVELS

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


def run_each(
    template: Problem, found: SlowSimulator, workers: int, scheduler: str | None
) -> Problem:
    """Return a problem that asks the simulator itself, to draw truths and their data from."""
    keeper = RunKeeper(found.simulator, found.folder, workers, scheduler)
    model = template.bound.model
    # What is evaluated follows from the equation.
    asking = replace(model, predict=_Runs(keeper, model.output), mean_response=not_given)
    return replace(template, bound=replace(template.bound, model=asking))


def emulate_campaign(
    problem: Problem, held: Mapping[str, Array], seed: int, workers: int, scheduler: str | None
) -> Emulation:
    """Emulate the simulator for a simulated campaign as `calib fit` would for a measured one."""
    elsewhere = table_from_arrays(dict(held), source="held out")
    return emulated(problem, seed, elsewhere=[elsewhere], workers=workers, scheduler=scheduler)


def most_runs(model: str, found: SlowSimulator, design: Design, simulations: int) -> str:
    """Say how many runs of a slow simulator so many campaigns may take.

    Raises
    ------
    CalibError
        If it cannot be run: a table of runs has none at a new truth.
    """
    if not found.simulator.way.runs:
        raise CalibError(
            f"{model} is a table of runs already made: there is none at the truths that are drawn",
            where=f"simulator {found.name}", expected="a simulator that can be run",
            hint="declare the program that made the table, or leave the model out",
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


# Steps of each walker that are kept for ranks. The gate asks for 50 autocorrelation times, so five
# steps are at least ten of them apart: as good as independent.
_KEPT_STEPS = 5


@dataclass(frozen=True)
class Item:
    """What a replicate, by its number, needs; the seed is of the whole run.

    The design is the model's own if none is given. A slow simulator's runs are spread over the
    workers of this machine, or of a scheduler.
    """

    model: str
    index: int
    seed: int
    settings: SamplerSettings = field(default_factory=SamplerSettings)
    priors: PriorFile | None = None
    design: Design | None = None
    workers: int = 1
    scheduler: str | None = None

    @property
    def where(self) -> Design:
        """Where the model is measured."""
        return self.design or design_of(self.model)


def replicate(item: Item) -> dict[str, Any]:
    """Run one replicate, and return plain numbers.

    Convergence, ranks by quantity as ``[rank, draws]``, and how many held-out measurements each
    band covered.
    """
    case = simulated(item)
    emulator_fails: tuple[str, ...] = ()
    if slow_simulator(item.model) is not None:
        emulation = emulate_campaign(
            case.problem, case.held, item.seed, item.workers, item.scheduler
        )
        case, emulator_fails = replace(case, problem=emulation.problem), emulation.reasons
    calibration = calibrated(case, item)
    report = calibration.draws.report
    return {
        "model": item.model,
        "index": item.index,
        "seed": item.seed,
        "attempts": case.attempts,
        # Of a posterior by an emulator that is not good enough a user is told as much.
        "converged": report.passed and not emulator_fails,
        "reasons": [*report.reasons, *emulator_fails],
        "steps": report.steps,
        "extended": report.steps > item.settings.steps,
        **measure(case, calibration, item.where),
    }


def simulated(item: Item) -> Simulated:
    """Return the campaign of an item."""
    design = item.where
    template = build_problem(item.model, design.table, item.priors)
    rng = generator(item.seed, "sbc", item.model, item.index)
    slow = slow_simulator(item.model)
    if slow is None:
        return simulate(template, design, rng)
    asking = run_each(template, slow, item.workers, item.scheduler)
    found = simulate(asking, design, rng, attempts=MOST_TRUTHS)
    return replace(found, problem=template.with_table(found.problem.table))


def calibrated(case: Simulated, item: Item) -> Calibration:
    """Return the posterior of a campaign, by the same steps as `calib fit`."""
    label = f"sbc {item.model} {item.index}"
    point = estimate(case.problem, "least_squares", generator(item.seed, label, "least_squares"))
    return calibrate(
        case.problem, item.seed, label=label, estimates=(point,), settings=item.settings
    )


def measure(case: Simulated, calibration: Calibration, design: Design) -> dict[str, Any]:
    """Rank the truth and count what the bands covered."""
    return {
        "design": design.text,
        "ranks": ranks(case, calibration, design.watched),
        **_coverage(case, calibration),
    }


def ranks(case: Simulated, calibration: Calibration, watched: int) -> dict[str, list[int]]:
    """Rank the truth of every quantity among nearly independent posterior draws.

    Return draws below the truth, and draws; a quantity whose truth has no value is left out. A
    prediction is ranked at the held-out row `watched`.
    """
    drawn = _quantities(calibration, _thinned(calibration.draws), case, watched)
    true = _quantities(calibration, case.truth[None], case, watched)
    rng = generator(calibration.seed, calibration.label, "measurement")
    natural = calibration.problem.theta(_thinned(calibration.draws))
    row = _row(case, watched)
    response = calibration.problem.bound.to_response
    with np.errstate(all="ignore"):
        noise = calibration.problem.noise.draw(natural, row, rng, 1)[:, 0]
        noisy = response(drawn["prediction"]) + noise
        drawn["measurement"] = calibration.problem.bound.from_response(noisy)
    # Of a slow simulator the truth is its run, which its emulator only comes near.
    true["prediction"] = case.location[watched : watched + 1]
    true["measurement"] = case.measured[watched : watched + 1]
    found = {}
    for name, values in drawn.items():
        finite = values[np.isfinite(values)]
        # A truth that is excluded is below all draws.
        excluded = name == "log_likelihood" and true[name][0] == -np.inf
        if excluded or np.isfinite(true[name][0]):
            found[name] = [int((finite < true[name][0]).sum()), int(finite.size)]
    return found


def _thinned(draws: Draws) -> Array:
    """All walkers at a few steps far apart, shape (ensembles * walkers * steps, d).

    Walkers of an ensemble are independent of each other at any one step of a stationary chain.
    """
    steps = np.linspace(0, draws.t.shape[2] - 1, min(_KEPT_STEPS, draws.t.shape[2]))
    kept = draws.t[:, :, steps.round().astype(int)]
    return np.asarray(kept.reshape(-1, draws.t.shape[-1]))


def _quantities(
    calibration: Calibration, t: Array, case: Simulated, watched: int
) -> dict[str, Array]:
    """Everything that is ranked but the measurement, of internal coordinates (k, d): (k,) each."""
    problem = calibration.problem
    natural = problem.theta(t)
    theta = problem.of_model(natural)
    reported: Mapping[str, Array] = problem.bound.report(theta)
    entries = {p.name: natural[:, i] for i, p in enumerate(problem.priors.entries)}
    known = {**reported, **entries}
    return {
        **{name: known[name] for name in calibration.parameters},
        "log_likelihood": problem.log_likelihood(t),
        "prediction": problem.bound.predict(theta, _row(case, watched))[:, 0],
    }


def _row(case: Simulated, watched: int) -> dict[str, Array]:
    return {name: v[watched : watched + 1] for name, v in case.held.items()}


def _coverage(case: Simulated, calibration: Calibration) -> dict[str, Any]:
    """Held-out measurements inside each predictive band, of those that have one."""
    defined = np.isfinite(case.measured)
    if not defined.any():
        return {"covered": {}, "rows": 0, "no_band": 0}
    rows = {name: v[defined] for name, v in case.held.items()}
    bands = predict(calibration, table_from_arrays(rows, source="held out")).predictive
    given = np.isfinite(bands.median)
    measured = case.measured[defined]
    return {
        "covered": {
            f"{100 * level:g}": int(
                ((measured >= bands.lower[level]) & (measured <= bands.upper[level]))[given].sum()
            )
            for level in LEVELS
        },
        "rows": int(given.sum()),
        "no_band": int((~given).sum()),
    }
