"""Declarations of simulators, and the models that stand for them."""

from __future__ import annotations

import json
import math
import re
import tomllib
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from types import FunctionType
from typing import Any, Literal, Self

import numpy as np
from pydantic import BaseModel, ConfigDict, Field, ValidationError, model_validator

from calib.data.files import TOML_HINT
from calib.data.quantities import QUANTITIES
from calib.data.registry import Registry, run_again
from calib.errors import CalibError, in_words
from calib.models import MODELS
from calib.models.base import (
    DIMENSIONS,
    Array,
    Conditions,
    Model,
    Parameters,
    References,
    check_model,
    check_names,
    check_word,
)
from calib.models.simulators.runner import CallableRunner, TableRunner
from calib.models.simulators.simulator import (
    FAILED,
    FROM_THE_START,
    Failure,
    Output,
    Run,
    Runner,
    Simulator,
    fail_alike,
    without_value,
)


class EmulationSettings(BaseModel):
    """How many runs an emulator may take, and how good it has to be.

    Parameters
    ----------
    runs : int
        At most, whatever they are made for, those of an earlier call with the same cache among
        them. A run that is tried again after it failed counts once.
    first : int, optional
        Of the space-filling design over the prior; ten for each parameter by default.
    checks : int, optional
        Runs at draws of the posterior that the emulator is checked on before it sees them, a fifth
        of all at most; 20 by default, or the fifth.
    tolerance : float
        Largest rms error of the emulator over rows and posterior, in sds of the noise. It is
        checked when somewhat less is expected. At 0.1 the error adds 1 % to the variance of a
        reading, which the likelihood accounts for.
    nodes : int, optional
        Conditions at which each run is evaluated, see `calib.inference.design`.
    """

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)
    runs: int = Field(default=200, ge=10)
    first: int | None = Field(default=None, ge=4)
    checks: int | None = Field(default=None, ge=0)
    tolerance: float = Field(default=0.1, gt=0.0)
    nodes: int | None = Field(default=None, ge=2)

    @model_validator(mode="after")
    def _leaves_room(self) -> Self:
        left = self.runs - self.checks_of(self.runs)
        for key, found, most, why in (
            ("checks", self.checks, self.runs // 5, "a fifth of the runs"),
            ("first", self.first, left, "the runs less those that it is checked on"),
        ):
            if found is not None and found > most:
                raise CalibError(
                    f"{key} = {found} is more than runs = {self.runs} leaves room for",
                    where=f"emulator.{key}", expected=f"at most {most}, {why}",
                    hint="lower it, or give more runs",
                )  # fmt: skip
        return self

    def checks_of(self, most: int) -> int:
        """How many of so many runs are kept for the check."""
        return min(20 if self.checks is None else self.checks, most // 5)

    def repeats(self, deterministic: bool) -> tuple[int, int]:
        """How many of the first runs are made again, to see whether they differ, and how often."""
        return (1, 1) if deterministic else (min(5, max(self.runs // 10, 1)), 2)

    def spread(self, free: int, deterministic: bool, made: int = 1) -> int:
        """How many runs are spread over the prior of so many parameters, where some are made."""
        runs, times = self.repeats(deterministic)
        most = max(self.runs - made - runs * times - self.checks_of(self.runs), 1)
        return min(self.first or 10 * free, most)


@dataclass(frozen=True)
class Simulated:
    """A simulator that is calibrated as one or several models.

    Its runs are kept in a `folder`, or in memory; `emulation` says how it is emulated.
    """

    simulator: Simulator
    folder: Path | None = None
    emulation: EmulationSettings = field(default_factory=EmulationSettings)

    @property
    def name(self) -> str:
        """The simulator's."""
        return self.simulator.name

    @property
    def models(self) -> tuple[str, ...]:
        """Names of its models, in the order of its outputs."""
        return tuple(model.name for model in models_of(self.simulator))

    def register(self) -> None:
        """Make the simulator and its models known; nothing is done where they are already.

        A CalibError if a declaration does not hold together, or something else has its name.
        """
        models, known = models_of(self.simulator), SIMULATED.get(self.name)
        for model in models:
            check_model(model)
        if known is not None:
            if self._content == known._content:
                return
            if run_again(known._functions, self._functions):
                SIMULATED.discard(self.name)
                for name in known.models:
                    MODELS.discard(name)
        MODELS.add(*models)
        SIMULATED.add(self)

    @property
    def _content(self) -> tuple[object, ...]:
        said = {k: v for k, v in vars(self.simulator).items() if k != "runner"}
        return self.simulator.digest, said, self.folder, self.emulation

    @property
    def _functions(self) -> list[FunctionType]:
        found = getattr(self.simulator.runner, "function", None)
        return [found] if isinstance(found, FunctionType) else []


SIMULATED: Registry[Simulated] = Registry("simulator", lambda one: one.name)


def simulated_by(model: str) -> Simulated | None:
    """Return the simulator behind a model; None if there is none."""
    return next((s for s in SIMULATED.values() if model in s.models), None)


def slow_simulator(model: str) -> Simulated | None:
    """Return the simulator behind a model if it has to be emulated; None if not."""
    found = simulated_by(model)
    return found if found is not None and found.simulator.emulate else None


@dataclass
class Tally:
    """Runs that this process made of a simulator, and the first 200 that failed."""

    tried: bool = False
    made: int = 0
    lost: int = 0
    failed: list[Run] = field(default_factory=list)

    def add(self, run: Run) -> None:
        """Count a run."""
        self.made += 1
        if run.failure is not None:
            self.lost += 1
            self.failed += [run] * (len(self.failed) < 200)


@dataclass(frozen=True)
class Direct:
    """Runs a quick simulator for each parameter vector."""

    simulator: Simulator
    output: str
    tally: Tally = field(default_factory=Tally, repr=False, compare=False)

    @property
    def declared_in(self) -> str:
        """The simulator file, if any, for messages."""
        return self.simulator.file

    @property
    def broadcasts(self) -> bool | None:
        """Whether vectors may have conditions of their own: no, or to be tried."""
        return None if self._at_once else False

    def try_first(self, thetas: Array, conditions: Conditions) -> None:
        """Refuse a simulator that fails at each of some parameters (k, d), and in the same way.

        One that takes all parameter vectors at once is not tried: what that raises is told at once,
        and its NaN stand for no value.
        """
        if self._at_once:
            return
        runs: list[Run] = []
        for theta in thetas:
            runs.append(self._run(theta, conditions))
            if runs[-1].ok:
                break
        if fail_alike(runs):
            raise without_value(FROM_THE_START, self.simulator, runs, None)

    def __call__(self, theta: Array, conditions: Conditions) -> Array:
        """Return the output of parameters (k, d) at conditions (n,), (k, n); NaN if a run fails."""
        if self.simulator.emulate:
            raise CalibError(
                f"the simulator {self.simulator.name} is not run for each parameter vector that a "
                "sampler asks for",
                expected="calib.emulate(problem), or a verb that takes --simulator",
                hint="emulate it first, or declare it with emulate = false",
            )
        runner = self.simulator.runner
        if isinstance(runner, CallableRunner) and runner.batched:
            try:
                return self._at_all(runner, theta, self.simulator.asked(conditions))
            except CalibError as error:
                raise error.within(self.simulator.place()) from None
        empty = np.full(next(iter(conditions.values())).shape[-1], np.nan)
        runs = [self._run(t, conditions) for t in theta]
        return np.stack([run.outputs.get(self.output, empty) for run in runs])

    def _at_all(self, runner: CallableRunner, theta: Array, asked: Conditions) -> Array:
        """Return the output of a function that takes all parameters at once, by its series."""
        simulator, found = self.simulator, []
        whole, places = simulator.whole(theta), simulator.series(asked)
        for rows in places:
            part = {name: v[rows] for name, v in asked.items()}
            outputs = simulator.resampled(runner.call(whole.copy(), part), part)
            found.append(simulator.converted(outputs, self.output))
        if not simulator.along:
            return found[0]
        return np.concatenate(found, axis=-1)[..., np.argsort(np.concatenate(places))]

    @property
    def _at_once(self) -> bool:
        """Whether the simulator takes all parameter vectors in one call."""
        runner = self.simulator.runner
        return isinstance(runner, CallableRunner) and runner.batched

    def _run(self, theta: Array, conditions: Conditions) -> Run:
        found = self.simulator.run(theta, conditions)
        run = Run(theta, {}, found) if isinstance(found, Failure) else Run(theta, found)
        self.tally.add(run)
        return run


@dataclass(frozen=True)
class Published:
    """Reports parameters that follow from others beside these."""

    simulator: Simulator

    def __call__(self, references: References, /, **parameters: Any) -> Parameters:
        """Return all by name."""
        return self.simulator.with_derived(parameters)


def models_of(simulator: Simulator) -> tuple[Model, ...]:
    """Return a model for each output of a simulator."""
    return tuple(_model(simulator, output) for output in simulator.outputs)


def _model(simulator: Simulator, output: Output) -> Model:
    column = simulator.canonical(output.header)
    quantity = QUANTITIES[column]
    response: Literal["identity", "log"] = "log" if quantity.log_scale else "identity"
    if output.response:
        response = "log" if output.response == "log" else "identity"
    priors = tomllib.loads(simulator.priors)["parameters"] if simulator.derived else {}
    units = {name: str(prior.get("unit", "1")) for name, prior in priors.items()}
    alone = len(simulator.outputs) == 1
    name = simulator.name if alone else f"{simulator.name}_{quantity.stem}"
    return Model(
        name=name,
        title=simulator.title or f"The simulator {simulator.name}",
        output=column,
        conditions=simulator.takes,
        parameters=simulator.parameters,
        predict=Direct(simulator, column),
        response=response,
        reported=units | dict.fromkeys(simulator.derived, ""),
        to_reported=Published(simulator),
        source=simulator.source,
        parametrisation="The parameters of the simulator are sampled.",
        slow=simulator.emulate,
        priors=f'model = "{name}"\n\n{simulator.priors}\n{output.sigma}',
    )


def from_callable(
    f: Callable[..., Any],
    *,
    parameters: str,
    conditions: Mapping[str, str] | Sequence[str],
    output: str | Mapping[str, str | Mapping[str, str]],
    name: str = "",
    batched: bool = True,
    emulate: bool = False,
    folder: Path | None = None,
    deterministic: bool = True,
    limit: float | None = None,
    derived: Mapping[str, str] | None = None,
    along: str = "",
    **budget: float,
) -> Simulated:
    """Make a simulator of a Python function; `calib.register` makes its models known.

    Parameters
    ----------
    f : callable
        ``(theta, conditions) -> output``: theta of shape (k, d), or (d,) if not `batched`, in the
        order of the priors; conditions by name, shape (n,) each. Returns (k, n) or (n,), or a
        mapping of such by the names of `output`.
    parameters : str
        Priors as the TOML text of a prior file: ``[parameters.NAME]`` each, and for the noise of
        the one output ``[parameters.sigma]``, or of several ``[parameters.sigma_OUTPUT]``.
    conditions : mapping of str to str, or sequence of str
        The function's own name of each condition to a column name with the unit that it takes;
        the column names alone where both are the same.
    output : str, or mapping of str to str or mapping
        A column name with the unit of what it returns; of several, by the function's own names. Of
        ``{"column": NAME, "response": "identity"}`` the noise is additive, and values may be
        negative; ``"log"`` has it relative. The quantity says it by default.
    name : str, optional
        That of the function by default.
    batched : bool
    emulate : bool
        Whether it is too slow for the tens of thousands of calls of a sampler.
    folder : Path, optional
        Where runs are kept, if it is emulated.
    deterministic : bool
        Whether equal input gives equal output.
    limit : float, optional
        Seconds that a run may take if it is emulated. It is then made in a process of its own,
        which is ended with what it has started when they have passed; without a limit, in this
        process, for as long as it takes.
    derived : mapping of str to str, optional
        Formulas of parameters that follow from others, ``{"b_rear": "b_front / 2"}``: it gets them
        behind these.
    along : str, optional
        Its own name of a condition, such as time. It is then called for each setting of the other
        conditions, rows in this order, and gives a series. One that returns this condition too is
        interpolated between its own values.
    **budget
        ``runs``, ``first``, ``checks``, ``tolerance``, ``nodes``: see `EmulationSettings`.

    Returns
    -------
    Simulated

    Raises
    ------
    CalibError
        If the priors are not valid TOML, or a column names no known quantity.

    Examples
    --------
    >>> import calib
    >>> import numpy as np
    >>> def pull(theta, x):
    ...     return theta[:, :1] * x["normal_load_kn"] * (1.0 - np.exp(-8.0 * x["slip_ratio"]))
    >>> priors = '''
    ... [parameters]
    ... mu = {dist = "half_normal", sd = 1.0, unit = "1", reason = "soils", source = "Wong"}
    ... sigma = {dist = "half_normal", sd = 0.2, unit = "kN", reason = "cell", source = "ours"}
    ... '''
    >>> simulator = calib.from_callable(
    ...     pull, name="my_wheel", parameters=priors, conditions=["slip_ratio", "normal_load_kn"],
    ...     output="drawbar_pull_kn",
    ... )
    >>> simulator.models
    ('my_wheel',)
    """
    named: dict[str, str | Mapping[str, str]] = (
        {output: output} if isinstance(output, str) else dict(output)
    )
    taken = dict(conditions) if isinstance(conditions, Mapping) else {c: c for c in conditions}
    try:
        given = tomllib.loads(parameters)
    except tomllib.TOMLDecodeError as error:
        raise CalibError(
            f"the priors are not valid TOML: {error}", where=f"simulator {name}", hint=TOML_HINT
        ) from None
    return declare(
        name or getattr(f, "__name__", "simulator"),
        CallableRunner(f, tuple(named), batched, limit),
        given.get("parameters", {}),
        taken,
        named,
        folder=folder,
        emulate=emulate,
        deterministic=deterministic,
        budget=budget,
        likelihood=given.get("likelihood"),
        derived=dict(derived or {}),
        along=along,
        **({} if limit is None else {"limit": limit}),
    )


def declare(
    name: str,
    runner: Runner,
    priors: Mapping[str, Any],
    conditions: Mapping[str, str],
    outputs: Mapping[str, str | Mapping[str, str]],
    *,
    folder: Path | None = None,
    budget: Mapping[str, float] | None = None,
    likelihood: Mapping[str, Any] | None = None,
    **details: Any,
) -> Simulated:
    """Put a simulator together from its parts, `details` being other fields of `Simulator`.

    Priors are the tables ``parameters.NAME``, those of the noise among them, and the `likelihood`
    that of a prior file; conditions and outputs map the simulator's own names to headers.
    """
    where = f"simulator {name}"
    emulation = _emulation(runner, budget or {}, where)
    if not isinstance(priors, Mapping) or not priors:
        raise CalibError(
            "there are no parameters with priors",
            where=where,
            expected="[parameters.NAME] with dist, unit, reason and source",
            hint="add them",
        )
    for parameter in priors:
        check_word(parameter, "parameter", where)
    sigmas = {own: "sigma" if len(outputs) == 1 else f"sigma_{own}" for own in outputs}
    missing = [s for s in sigmas.values() if s not in priors]
    if missing:
        raise CalibError(
            f"there is no prior of the noise: {', '.join(missing)}",
            where=where,
            expected=f"[parameters.{missing[0]}] with dist, unit, reason and source",
            hint="add it: how far may readings lie from a perfect simulator's?",
        )
    noise = _table("likelihood", likelihood) if likelihood else ""
    tables = {own: {"column": o} if isinstance(o, str) else o for own, o in outputs.items()}
    declared = [
        Output(
            o["column"], own, written("sigma", priors[sigmas[own]]) + noise, o.get("response", "")
        )
        for own, o in tables.items()
    ]
    parameters = tuple(p for p in priors if p not in sigmas.values())
    text = "\n".join(written(p, priors[p]) for p in parameters)
    simulator = Simulator(name, runner, parameters, text, conditions, tuple(declared), **details)
    _check_own_names(simulator, {o.column: o.header for o in declared})
    _check_derived(simulator)
    if simulator.along and simulator.along not in conditions:
        raise CalibError(
            f"{simulator.along!r} is no condition", where=f"{where}, along",
            expected=", ".join(conditions), hint="name the condition that its series are along",
        )  # fmt: skip
    return Simulated(simulator, folder, emulation)


def _check_derived(simulator: Simulator) -> None:
    """Check that formulas can be worked out."""
    found = simulator.with_derived(dict.fromkeys(simulator.parameters, 1.0))
    for name in simulator.derived:
        check_word(name, "parameter", f"simulator {simulator.name}")
        if np.ndim(found[name]):
            raise CalibError(f"{name} is no number", where=f"simulator {simulator.name}")


def _check_own_names(simulator: Simulator, outputs: Mapping[str, str]) -> None:
    """Check that each name, and then each column, is that of one thing."""
    where = f"simulator {simulator.name}"
    parameters = [(p, f"the parameter {p}", f"parameters.{p}") for p in simulator.parameters]
    parameters += [(p, f"the parameter {p}", f"derived.{p}") for p in simulator.derived]
    names, columns = list(parameters), list(parameters)
    for key, table in (("conditions", simulator.conditions), ("outputs", outputs)):
        names += [(own, f"the {key[:-1]} {own}", f"{key}.{own}") for own in table]
    noise = {"sigma": "the noise"} | {f"sigma_{own}": f"the noise of {own}" for own in outputs}
    check_names(noise, names, where)
    for key, table in (("conditions", simulator.conditions), ("outputs", outputs)):
        known = set()
        for own, header in table.items():
            try:
                column = simulator.canonical(header)
            except CalibError as error:
                error.where = f"{where}, {key}.{own}"
                raise error.within() from None
            # A program may take a condition in two units.
            if key == "outputs" or column not in known:
                columns.append((column, f"the column {column} of {key}.{own}", f"{key}.{own}"))
            known.add(column)
    reserved = dict.fromkeys(FAILED, "a column of the list of failed runs")
    check_names(DIMENSIONS | reserved, columns, where)


def _emulation(runner: Runner, given: Mapping[str, float], where: str) -> EmulationSettings:
    """Return settings; a CalibError if one does not exist, is impossible, or has no effect."""
    idle = sorted(set(given) - {"tolerance"}) if isinstance(runner, TableRunner) else []
    if idle:
        raise CalibError(
            f"{', '.join(idle)} can do nothing for a table, whose runs and rows are made already",
            where=f"{where}, emulator",
            expected="tolerance",
            hint="leave it out",
        )
    try:
        return EmulationSettings.model_validate(given)
    except CalibError as error:
        raise error.within(where) from None
    except ValidationError as error:
        first = error.errors()[0]
        key = ".".join(map(str, first["loc"]))
        raise CalibError(
            in_words(first),
            where=f"{where}, emulator.{key}",
            expected=", ".join(EmulationSettings.model_fields),
            hint="correct it, or leave it out",
        ) from None


def written(name: str, table: Mapping[str, Any]) -> str:
    """Write a table ``[parameters.NAME]``."""
    key = name if re.fullmatch(r"[A-Za-z0-9_-]+", name) else _toml(name)  # else in quotes
    return _table(f"parameters.{key}", table)


def _table(heading: str, table: Mapping[str, Any]) -> str:
    lines = [f"{key} = {_toml(value)}" for key, value in table.items()]
    return "\n".join([f"[{heading}]", *lines]) + "\n"


def _toml(value: Any) -> str:
    # TOML's nan and inf are Python's, not those of JSON.
    if isinstance(value, float) and not math.isfinite(value):
        return repr(value)
    return json.dumps(value, ensure_ascii=False)
