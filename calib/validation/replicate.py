"""One replicate of simulation-based calibration: simulate, calibrate, rank the truth.

Each simulated campaign is emulated and calibrated as `calib fit` would. The seed of the emulation
is that of the whole run, so all campaigns begin with the same runs over the prior, which are kept
and made once.

A replicate is a pure function of its item, so it can run anywhere and in any order.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np

from calib.data import Table, read_for_model, table_from_arrays
from calib.data.registry import Registry
from calib.errors import CalibError
from calib.inference.calibration import Calibration, calibrate
from calib.inference.emulation import Emulation
from calib.inference.emulation.prepared import emulated
from calib.inference.emulation.state import EmulationSettings
from calib.inference.estimators import estimate
from calib.inference.prior_files import PriorFile
from calib.inference.problem import Problem, build_problem
from calib.inference.random import generator
from calib.inference.sampler import Draws, SamplerSettings
from calib.models import Model, example_csv, get_model
from calib.models.base import Array, Conditions
from calib.models.simulators.declaration import Simulated as SlowSimulator
from calib.models.simulators.declaration import slow_simulator
from calib.models.simulators.simulator import RunKeeper
from calib.validation.prediction import predict
from calib.validation.scores import LEVELS


@dataclass(frozen=True)
class Design:
    """Where a model is measured.

    Parameters
    ----------
    table : Table
        The rows to calibrate on; their outputs are placeholders for simulated ones.
    held : mapping of str to ndarray, shape (m,)
        Conditions of the rows that are held out.
    text : str
        Both in words.
    """

    model: str
    table: Table
    held: dict[str, Array]
    text: str

    @property
    def watched(self) -> int:
        """The held-out row at which a single prediction is followed."""
        return len(next(iter(self.held.values()))) // 2


@dataclass(frozen=True)
class ModelDesign:
    """Where a model is measured, unless at the conditions of its own example.

    Parameters
    ----------
    make : callable
        ``() -> Design``.
    """

    model: str
    make: Callable[[], Design]

    def register(self) -> None:
        """Have the model simulated there."""
        DESIGNS.add(self)


DESIGNS: Registry[ModelDesign] = Registry("design", lambda design: design.model)


def design_of(model_name: str, data: Path | None = None) -> Design:
    """Return the design of a model, or that of a campaign's CSV if one is given.

    Raises
    ------
    CalibError
        If it has neither a design nor an example, or the file cannot be read.
    """
    model = get_model(model_name)
    known = DESIGNS.get(model.name)
    if data is not None:
        design = _of_file(model, data, str(data))
    else:
        design = known.make() if known is not None else _of_example(model)
    # For noise that is correlated along a run, if the priors ask for it.
    order = {"run_order": np.arange(1.0, len(design.table) + 1.0)}
    return replace(design, table=replace(design.table, columns=order | dict(design.table.columns)))


def _of_example(model: Model) -> Design:
    """The conditions of a model's own example."""
    with TemporaryDirectory() as folder:
        path = Path(folder) / f"{model.name}.csv"
        path.write_text(example_csv(model.name), encoding="utf-8")
        return _of_file(model, path, "the model's example")


def _of_file(model: Model, path: Path, where: str) -> Design:
    table = read_for_model(path, (*model.conditions, model.output))
    held = {name: 0.5 * (v[1:] + v[:-1]) for name, v in model.select(table.columns).items()}
    n = len(table)
    text = f"{n} conditions of {where}; held out: {n - 1} midway between them"
    return Design(model.name, table, held, text)


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
    asking = replace(model, predict=_Runs(keeper, model.output), mean_response=None)
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
    if not found.simulator.runner.runs:
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
