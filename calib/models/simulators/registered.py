"""Simulators by the names of their models, and the models that stand for them."""

from __future__ import annotations

import json
import math
import re
import tomllib
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from types import FunctionType
from typing import Any

import numpy as np
from pydantic import BaseModel, ConfigDict, Field, ValidationError

from calib.data.files import MEND_TOML
from calib.data.registry import Registry, run_again
from calib.data.table import parse_header
from calib.errors import CalibError, in_words
from calib.models import MODELS
from calib.models.base import (
    DIMENSIONS,
    Array,
    Conditions,
    Model,
    check_model,
    check_names,
    check_word,
)
from calib.models.simulators.base import FAILED, Failure, Output, Simulator
from calib.models.simulators.runs import FROM_THE_START, Run, fail_alike, without_value
from calib.models.simulators.ways import CallableWay, TableWay

# Failed runs that are listed at most.
_LISTED = 200
# Keys that need no quotes in TOML.
_BARE = re.compile(r"[A-Za-z0-9_-]+")


class Budget(BaseModel):
    """What a user may say of an emulator (see `calib.inference.emulation.EmulationSettings`)."""

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)
    runs: int = Field(default=200, ge=10)
    first: int | None = Field(default=None, ge=4)
    checks: int | None = Field(default=None, ge=0)
    tolerance: float = Field(default=0.1, gt=0.0)
    nodes: int | None = Field(default=None, ge=2)


@dataclass(frozen=True)
class Simulated:
    """A simulator that is calibrated as one or several models.

    Its runs are kept in a `folder`, or in memory; `budget` are fields of
    `calib.inference.emulation.EmulationSettings` that the user gave.
    """

    simulator: Simulator
    folder: Path | None = None
    budget: Mapping[str, float] | None = None

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
        told = {k: v for k, v in vars(self.simulator).items() if k != "way"}
        return self.simulator.digest, told, self.folder, self.budget

    @property
    def _functions(self) -> list[FunctionType]:
        found = getattr(self.simulator.way, "function", None)
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
    """Runs that this process made of a simulator, and those that failed."""

    tried: bool = False
    made: int = 0
    lost: int = 0
    failed: list[Run] = field(default_factory=list)

    def add(self, run: Run) -> None:
        """Count a run."""
        self.made += 1
        if run.failure is not None:
            self.lost += 1
            self.failed += [run] * (len(self.failed) < _LISTED)


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
        way = self.simulator.way
        if isinstance(way, CallableWay) and self._at_once:
            asked = self.simulator.asked(conditions)
            try:
                return self.simulator.converted(way.call(theta.copy(), asked), self.output)
            except CalibError as error:
                raise error.within(self.simulator.place()) from None
        empty = np.full(next(iter(conditions.values())).shape[-1], np.nan)
        runs = [self._run(t, conditions) for t in theta]
        return np.stack([run.outputs.get(self.output, empty) for run in runs])

    @property
    def _at_once(self) -> bool:
        """Whether the simulator takes all parameter vectors in one call."""
        return isinstance(self.simulator.way, CallableWay) and self.simulator.way.batched

    def _run(self, theta: Array, conditions: Conditions) -> Run:
        found = self.simulator.run(theta, conditions)
        run = Run(theta, {}, found) if isinstance(found, Failure) else Run(theta, found)
        self.tally.add(run)
        return run


def models_of(simulator: Simulator) -> tuple[Model, ...]:
    """Return a model for each output of a simulator."""
    return tuple(_model(simulator, output) for output in simulator.outputs)


def _model(simulator: Simulator, output: Output) -> Model:
    parsed = parse_header(output.header, where=f"simulator {simulator.name}")
    column = simulator.canonical(output.header)
    alone = len(simulator.outputs) == 1 or parsed is None
    name = simulator.name if alone else f"{simulator.name}_{parsed.quantity.stem}"  # type: ignore[union-attr]
    log = parsed is not None and parsed.quantity.log_scale
    return Model(
        name=name,
        title=simulator.title or f"The simulator {simulator.name}",
        output=column,
        conditions=simulator.takes,
        parameters=simulator.parameters,
        predict=Direct(simulator, column),
        response="log" if log else "identity",
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
    output: str | Mapping[str, str],
    name: str = "",
    batched: bool = True,
    emulate: bool = False,
    folder: Path | None = None,
    deterministic: bool = True,
    limit: float | None = None,
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
    output : str or mapping of str to str
        A column name with the unit of what it returns; of several, by the function's own names.
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
    **budget
        ``runs``, ``first``, ``checks``, ``tolerance``, ``nodes``: see
        `calib.inference.emulation.EmulationSettings`.

    Returns
    -------
    Simulated

    Raises
    ------
    CalibError
        If the priors are not valid TOML, or a column names no known quantity.
    """
    named = {output: output} if isinstance(output, str) else dict(output)
    taken = dict(conditions) if isinstance(conditions, Mapping) else {c: c for c in conditions}
    return declare(
        name or getattr(f, "__name__", "simulator"),
        CallableWay(f, tuple(named), batched, limit),
        parameters, taken, named, folder=folder, emulate=emulate, deterministic=deterministic,
        budget=budget, **({} if limit is None else {"limit": limit}),
    )  # fmt: skip


def declare(
    name: str, way: Any, priors: str, conditions: Mapping[str, str], outputs: Mapping[str, str],
    *, folder: Path | None = None, budget: Mapping[str, float] | None = None, **details: Any,
) -> Simulated:  # fmt: skip
    """Put a simulator together from its parts, `details` being other fields of `Simulator`.

    Priors are the TOML text of all prior tables, those of the noise among them; conditions and
    outputs map the simulator's own names to headers.
    """
    _check_budget(name, way, budget or {})
    tables = split_tables(priors, name)
    sigmas = {own: "sigma" if len(outputs) == 1 else f"sigma_{own}" for own in outputs}
    missing = [s for s in sigmas.values() if s not in tables]
    if missing:
        raise CalibError(
            f"there is no prior of the noise: {', '.join(missing)}", where=f"simulator {name}",
            expected=f"[parameters.{missing[0]}] with dist, unit, reason and source",
            hint="add it: how far may readings lie from a perfect simulator's?",
        )  # fmt: skip
    declared = tuple(
        Output(header, own, tables[sigmas[own]].replace(sigmas[own], "sigma", 1))
        for own, header in outputs.items()
    )
    parameters = tuple(t for t in tables if t not in sigmas.values())
    where = f"simulator {name}"
    given = [(p, f"the parameter {p}", f"parameters.{p}") for p in parameters]
    for key, table in (("conditions", conditions), ("outputs", outputs)):
        given += [(own, f"the {key[:-1]} {own}", f"{key}.{own}") for own in table]
    noise = {"sigma": "the noise"} | {f"sigma_{own}": f"the noise of {own}" for own in outputs}
    check_names(noise, given, where)
    text = "\n".join(tables[t] for t in parameters)
    simulator = Simulator(name, way, parameters, text, conditions, declared, **details)
    given = given[: len(parameters)]
    for key, table in (("conditions", conditions), ("outputs", outputs)):
        known = set()
        for own, header in table.items():
            try:
                column = simulator.canonical(header)
            except CalibError as error:
                raise CalibError(
                    error.message, where=f"{where}, {key}.{own}", expected=error.expected,
                    hint=error.hint,
                ) from None  # fmt: skip
            # A program may take a condition in two units.
            if key == "outputs" or column not in known:
                given.append((column, f"the column {column} of {key}.{own}", f"{key}.{own}"))
            known.add(column)
    reserved = dict.fromkeys(FAILED, "a column of the list of failed runs")
    check_names(DIMENSIONS | reserved, given, where)
    return Simulated(simulator, folder, budget)


def _check_budget(name: str, way: Any, budget: Mapping[str, float]) -> None:
    """Refuse a setting of an emulator that does not exist, is impossible, or has no effect."""
    where = f"simulator {name}, emulator"
    try:
        Budget.model_validate(budget)
    except ValidationError as error:
        first = error.errors()[0]
        raise CalibError(
            in_words(first),
            where=f"{where}.{'.'.join(map(str, first['loc']))}",
            expected=", ".join(Budget.model_fields), hint="correct it, or leave it out",
        ) from None  # fmt: skip
    idle = sorted(set(budget) - {"tolerance"}) if isinstance(way, TableWay) else []
    if idle:
        raise CalibError(
            f"{', '.join(idle)} can do nothing for a table, whose runs and rows are made already",
            where=where, expected="tolerance", hint="leave it out",
        )  # fmt: skip


def split_tables(priors: str, name: str) -> dict[str, str]:
    """Return the text of each table ``[parameters.NAME]``."""
    try:
        known = tomllib.loads(priors).get("parameters", {})
    except tomllib.TOMLDecodeError as error:
        raise CalibError(
            f"the priors are not valid TOML: {error}", where=f"simulator {name}",
            hint=MEND_TOML,
        ) from None  # fmt: skip
    if not isinstance(known, Mapping) or not known:
        raise CalibError(
            "there are no parameters with priors", where=f"simulator {name}",
            expected="[parameters.NAME] with dist, unit, reason and source", hint="add them",
        )  # fmt: skip
    for key in known:
        check_word(key, "parameter", f"simulator {name}")
    return {key: written(key, table) for key, table in known.items()}


def written(name: str, table: Mapping[str, Any]) -> str:
    """Write a table ``[parameters.NAME]``."""
    lines = [f"{key} = {_toml(value)}" for key, value in table.items()]
    key = name if _BARE.fullmatch(name) else _toml(name)
    return "\n".join([f"[parameters.{key}]", *lines]) + "\n"


def _toml(value: Any) -> str:
    # TOML's nan and inf are Python's, not those of JSON.
    if isinstance(value, float) and not math.isfinite(value):
        return repr(value)
    return json.dumps(value, ensure_ascii=False)
