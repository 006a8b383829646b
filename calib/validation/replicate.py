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
from calib.inference.emulation.prepared import emulated
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
from calib.validation.constants import LEVELS
from calib.validation.prediction import predict


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
    """Where a model is measured, as `make` returns it, unless at those of its own example."""

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
    if data is None and known is not None:
        design = known.make()
    elif data is None:
        with TemporaryDirectory() as folder:
            path = Path(folder) / f"{model.name}.csv"
            path.write_text(example_csv(model.name), encoding="utf-8")
            design = _of_file(model, path, "the model's example")
    else:
        design = _of_file(model, data, str(data))
    # For noise that is correlated along a run, if the priors ask for it.
    order = {"run_order": np.arange(1.0, len(design.table) + 1.0)}
    return replace(design, table=replace(design.table, columns=order | dict(design.table.columns)))


def _of_file(model: Model, path: Path, where: str) -> Design:
    table = read_for_model(path, (*model.conditions, model.output))
    held = {name: 0.5 * (v[1:] + v[:-1]) for name, v in model.select(table.columns).items()}
    n = len(table)
    text = f"{n} conditions of {where}; held out: {n - 1} midway between them"
    return Design(model.name, table, held, text)


@dataclass(frozen=True)
class Simulated:
    """A campaign whose truth, (d,) in internal coordinates, is known, and its calibration.

    Held out are m rows: their conditions, the model's output at the truth and a measurement of it,
    NaN where the model has no value. `attempts` counts draws from the prior until the model had a
    value at every row.
    """

    truth: Array
    problem: Problem
    held: dict[str, Array]
    location: Array
    measured: Array
    attempts: int


def simulate(
    template: Problem, design: Design, rng: np.random.Generator, attempts: int = 10_000
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
    bound, n_held = template.bound, next(iter(design.held.values())).size
    for attempt in range(1, attempts + 1):
        truth = template.priors.sample(rng, 1)
        natural = template.theta(truth)
        noise = template.draw_noise(natural, rng)
        apart = template.noise.draw(natural, design.held, rng, n_held)
        _, noisy = _measured(template, natural, template.conditions, noise)
        location, measured = _measured(template, natural, design.held, apart)
        if np.isfinite(noisy).all() and (bound.model.response != "log" or (noisy > 0.0).all()):
            # Not checked as a file is: a prior may expect values that no instrument reads.
            columns = {**template.table.columns, bound.model.output: noisy}
            table = replace(
                template.table, columns=columns, source="simulated", label="simulated", text=()
            )
            problem = template.with_table(table)
            return Simulated(truth[0], problem, design.held, location, measured, attempt)
    raise CalibError(
        f"the prior of {bound.model.name} gave no data in {attempts} draws",
        where=template.priors.source,
        hint="look for conditions at which the model has no value",
    )


def _measured(
    problem: Problem, natural: Array, conditions: Mapping[str, Array], noise: Array
) -> tuple[Array, Array]:
    """Output at some conditions and a measurement of it, each of shape (n,)."""
    location = problem.bound.mean_response(problem.of_model(natural), conditions)[0]
    with np.errstate(over="ignore"):
        back = problem.bound.from_response
        return back(location), back(location + noise[0])


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
            where=f"simulator {found.name}",
            expected="a simulator that can be run",
            hint="declare the program that made the table, or leave the model out",
        )
    settings = found.emulation
    free = len(build_problem(model, design.table).priors.free) - 1
    # Without a folder nothing is kept from one campaign to the next.
    shared = found.folder is not None
    first = settings.spread(free, found.simulator.deterministic) if shared else 0
    # A truth is run at the conditions of the design and at those held out.
    each = settings.runs - first + 2
    return (
        f"{model}: {first} runs that all campaigns share and at most {each} for each of "
        f"{simulations}, at most {first + each * simulations} runs of the simulator in all"
    )


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
        held = table_from_arrays(case.held, source="held out")
        emulation = emulated(
            case.problem, item.seed, elsewhere=[held], workers=item.workers,
            scheduler=item.scheduler,
        )  # fmt: skip
        case, emulator_fails = replace(case, problem=emulation.problem), emulation.reasons
    calibration = calibrated(case, item)
    report = calibration.draws.report
    return {
        "model": item.model,
        "index": item.index,
        "seed": item.seed,
        "attempts": case.attempts,
        # A user is warned of a posterior by an emulator that is not good enough.
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
    # Truths and their data are drawn from the simulator itself.
    model = template.bound.model
    keeper = RunKeeper(slow.simulator, slow.folder, item.workers, item.scheduler)

    def by_runs(theta: Array, conditions: Conditions) -> Array:
        empty = np.full(next(iter(conditions.values())).shape[-1], np.nan)
        made = keeper.runs(theta, conditions)
        return np.stack([run.outputs[model.output] if run.ok else empty for run in made])

    runs = replace(model, predict=by_runs, mean_response=None)
    asking = replace(template, bound=replace(template.bound, model=runs))
    # At least half of the prior has to have a value, or the emulation refuses.
    found = simulate(asking, design, rng, attempts=50)
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
    ranked = _ranks(case, calibration, design.watched)
    return {"design": design.text, "ranks": ranked, **_coverage(case, calibration)}


def _ranks(case: Simulated, calibration: Calibration, watched: int) -> dict[str, list[int]]:
    """Rank the truth of every quantity among nearly independent posterior draws.

    Return draws below the truth, and draws; a quantity whose truth has no value is left out. A
    prediction is ranked at the held-out row `watched`.
    """
    problem, bound = calibration.problem, calibration.problem.bound
    row = {name: v[watched : watched + 1] for name, v in case.held.items()}

    def quantities(t: Array) -> dict[str, Array]:
        natural = problem.theta(t)
        theta = problem.of_model(natural)
        entries = {p.name: natural[:, i] for i, p in enumerate(problem.priors.entries)}
        known = {**bound.report(theta), **entries}
        return {
            **{name: known[name] for name in calibration.parameters},
            "log_likelihood": problem.log_likelihood(t),
            "prediction": bound.predict(theta, row)[:, 0],
        }

    thinned = _thinned(calibration.draws)
    drawn, true = quantities(thinned), quantities(case.truth[None])
    rng = generator(calibration.seed, calibration.label, "measurement")
    with np.errstate(all="ignore"):
        noise = problem.noise.draw(problem.theta(thinned), row, rng, 1)[:, 0]
        noisy = bound.to_response(drawn["prediction"]) + noise
        drawn["measurement"] = bound.from_response(noisy)
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
    """All walkers at five steps far apart, shape (ensembles * walkers * steps, d).

    Walkers of an ensemble are independent of each other at any one step of a stationary chain. The
    gate asks for 50 autocorrelation times, so the steps are at least ten of them apart.
    """
    steps = np.linspace(0, draws.t.shape[2] - 1, min(5, draws.t.shape[2]))
    kept = draws.t[:, :, steps.round().astype(int)]
    return np.asarray(kept.reshape(-1, draws.t.shape[-1]))


def _coverage(case: Simulated, calibration: Calibration) -> dict[str, Any]:
    """Held-out measurements inside each predictive band, of those that have one."""
    defined = np.isfinite(case.measured)
    if not defined.any():
        return {"covered": {}, "rows": 0, "no_band": 0}
    rows = {name: v[defined] for name, v in case.held.items()}
    bands = predict(calibration, table_from_arrays(rows, source="held out")).predictive
    given = np.isfinite(bands.median)
    measured = case.measured[defined]
    inside = {
        level: (measured >= bands.lower[level]) & (measured <= bands.upper[level])
        for level in LEVELS
    }
    return {
        "covered": {f"{100 * level:g}": int(part[given].sum()) for level, part in inside.items()},
        "rows": int(given.sum()),
        "no_band": int((~given).sum()),
    }
