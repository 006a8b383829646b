"""Declarations of simulators, in a TOML file or Python, and the models that stand for them."""

from __future__ import annotations

import hashlib
import json
import math
import re
import shlex
import tomllib
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from types import FunctionType
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import AfterValidator, BaseModel, ConfigDict, Field, ValidationError

from calib.batch.user_code import load, run_file
from calib.data.files import TOML_HINT, read_text, read_toml
from calib.data.quantities import QUANTITIES
from calib.data.registry import Registry, run_again
from calib.data.table import parse_header
from calib.errors import CalibError, in_words, meant
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
from calib.models.constants import LISTED_FAILURES
from calib.models.simulators.emulator import use_emulator
from calib.models.simulators.runner import (
    CallableRunner,
    CommandRunner,
    TableRunner,
    UmbridgeRunner,
    check_template,
)
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
        said = {k: v for k, v in vars(self.simulator).items() if k != "runner"}
        return self.simulator.digest, said, self.folder, self.budget

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
            self.failed += [run] * (len(self.failed) < LISTED_FAILURES)


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
            asked = self.simulator.asked(conditions)
            try:
                return self.simulator.converted(runner.call(theta.copy(), asked), self.output)
            except CalibError as error:
                raise error.within(self.simulator.place()) from None
        empty = np.full(next(iter(conditions.values())).shape[-1], np.nan)
        runs = [self._run(t, conditions) for t in theta]
        return np.stack([run.outputs.get(self.output, empty) for run in runs])

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


def models_of(simulator: Simulator) -> tuple[Model, ...]:
    """Return a model for each output of a simulator."""
    return tuple(_model(simulator, output) for output in simulator.outputs)


def _model(simulator: Simulator, output: Output) -> Model:
    column = simulator.canonical(output.header)
    quantity = QUANTITIES[column]
    alone = len(simulator.outputs) == 1
    name = simulator.name if alone else f"{simulator.name}_{quantity.stem}"
    return Model(
        name=name,
        title=simulator.title or f"The simulator {simulator.name}",
        output=column,
        conditions=simulator.takes,
        parameters=simulator.parameters,
        predict=Direct(simulator, column),
        response="log" if quantity.log_scale else "identity",
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
    try:
        tables = tomllib.loads(parameters).get("parameters", {})
    except tomllib.TOMLDecodeError as error:
        raise CalibError(
            f"the priors are not valid TOML: {error}", where=f"simulator {name}", hint=TOML_HINT
        ) from None
    return declare(
        name or getattr(f, "__name__", "simulator"),
        CallableRunner(f, tuple(named), batched, limit),
        tables,
        taken,
        named,
        folder=folder,
        emulate=emulate,
        deterministic=deterministic,
        budget=budget,
        **({} if limit is None else {"limit": limit}),
    )


def declare(
    name: str,
    runner: Runner,
    priors: Mapping[str, Any],
    conditions: Mapping[str, str],
    outputs: Mapping[str, str],
    *,
    folder: Path | None = None,
    budget: Mapping[str, float] | None = None,
    **details: Any,
) -> Simulated:
    """Put a simulator together from its parts, `details` being other fields of `Simulator`.

    Priors are the tables ``parameters.NAME``, those of the noise among them; conditions and outputs
    map the simulator's own names to headers.
    """
    where = f"simulator {name}"
    _check_budget(runner, budget or {}, where)
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
    declared = [
        Output(header, own, written("sigma", priors[sigmas[own]]))
        for own, header in outputs.items()
    ]
    parameters = tuple(p for p in priors if p not in sigmas.values())
    text = "\n".join(written(p, priors[p]) for p in parameters)
    simulator = Simulator(name, runner, parameters, text, conditions, tuple(declared), **details)
    _check_own_names(simulator, outputs)
    return Simulated(simulator, folder, budget)


def _check_own_names(simulator: Simulator, outputs: Mapping[str, str]) -> None:
    """Check that each name, and then each column, is that of one thing."""
    where = f"simulator {simulator.name}"
    parameters = [(p, f"the parameter {p}", f"parameters.{p}") for p in simulator.parameters]
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


def _check_budget(runner: Runner, budget: Mapping[str, float], where: str) -> None:
    """Refuse a setting of an emulator that does not exist, is impossible, or has no effect."""
    try:
        Budget.model_validate(budget)
    except ValidationError as error:
        first = error.errors()[0]
        key = ".".join(map(str, first["loc"]))
        raise CalibError(
            in_words(first),
            where=f"{where}, emulator.{key}",
            expected=", ".join(Budget.model_fields),
            hint="correct it, or leave it out",
        ) from None
    idle = sorted(set(budget) - {"tolerance"}) if isinstance(runner, TableRunner) else []
    if idle:
        raise CalibError(
            f"{', '.join(idle)} can do nothing for a table, whose runs and rows are made already",
            where=f"{where}, emulator",
            expected="tolerance",
            hint="leave it out",
        )


def written(name: str, table: Mapping[str, Any]) -> str:
    """Write a table ``[parameters.NAME]``."""
    lines = [f"{key} = {_toml(value)}" for key, value in table.items()]
    key = name if re.fullmatch(r"[A-Za-z0-9_-]+", name) else _toml(name)  # else in quotes
    return "\n".join([f"[parameters.{key}]", *lines]) + "\n"


def _toml(value: Any) -> str:
    # TOML's nan and inf are Python's, not those of JSON.
    if isinstance(value, float) and not math.isfinite(value):
        return repr(value)
    return json.dumps(value, ensure_ascii=False)


def _without_null(text: str) -> str:
    if "\x00" in text:
        raise ValueError("no path and no command holds a null character")
    return text


_Text = Annotated[str, AfterValidator(_without_null)]


class SimulatorFile(BaseModel):
    """What a simulator file may say; exactly one of run, python, url and table."""

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)
    name: str = Field(pattern=r"^[A-Za-z]\w*$")
    title: str = ""
    source: str = ""
    run: _Text = ""
    python: _Text = ""
    url: _Text = ""
    model: _Text = ""
    table: _Text = ""
    input: Literal["json", "csv", "template"] = "json"
    template: _Text = ""
    output: Literal["json", "csv", "pattern"] = "json"
    rows: Literal["all", "each"] = "all"
    batched: bool = True
    limit: float = Field(default=600.0, gt=0.0)
    retries: int = Field(default=1, ge=0)
    deterministic: bool = True
    emulate: bool = True
    cache: _Text = ""
    files: tuple[_Text, ...] = ()
    conditions: dict[str, str] = Field(min_length=1)
    outputs: dict[str, str] = Field(min_length=1)
    patterns: dict[str, str] = {}
    ranges: dict[str, tuple[float, float]] = {}
    emulator: Budget = Budget()
    parameters: dict[str, dict[str, Any]] = Field(min_length=1)


def load_files(paths: Sequence[Path]) -> None:
    """Load files that register things, here and in processes to come.

    Python files of quantities, models or effects; simulator files (``.toml``); emulators
    (``.npz``). In this order, for each kind may name what those before it register.

    Raises
    ------
    CalibError
        If one cannot be run, or what it declares does not hold together.
    """
    loaders = {".toml": register_file, ".npz": use_emulator}
    ordered = sorted(
        map(Path, paths),
        key=lambda path: ("", *loaders).index(path.suffix if path.suffix in loaders else ""),
    )
    load({path: loaders.get(path.suffix, run_file) for path in ordered})


def register_file(path: Path) -> Simulated:
    """Read a simulator file (see `read_simulator`) and make its models known, once."""
    found = read_simulator(path)
    found.register()
    return SIMULATED[found.name]


def read_simulator(path: Path) -> Simulated:
    """Read a simulator file.

    A CalibError names the file and the key: it is not TOML, a key is unknown, missing or
    impossible, a parameter has no prior, the command does not exist, or a template lacks a place.
    """
    path = Path(path).resolve()
    try:
        return _declared(path)
    except CalibError as error:
        raise error.within(None if str(path) in (error.where or "") else str(path)) from None


def _declared(path: Path) -> Simulated:
    try:
        file = SimulatorFile.model_validate(read_toml(path))
    except OSError as error:
        raise _unreadable("simulator file", error, None) from None
    except ValidationError as error:  # which is a ValueError
        raise _explained(error) from None
    except ValueError as error:
        raise CalibError(f"not valid TOML: {error}", hint=TOML_HINT) from None
    made_of = tuple(
        hashlib.sha256(_content(path.parent / name, "files", f"file {name!r}")).hexdigest()
        for name in file.files
    )
    told = ("title", "source", "limit", "retries", "deterministic", "emulate")
    return declare(
        file.name,
        _runner(file, path.parent),
        file.parameters,
        file.conditions,
        file.outputs,
        folder=path.parent / (file.cache or f"{path.stem}.runs"),
        budget=file.emulator.model_dump(exclude_unset=True),
        ranges=_ranges(file),
        made_of=made_of,
        file=str(path),
        **{key: getattr(file, key) for key in told},
    )


def _explained(error: ValidationError) -> CalibError:
    errors = error.errors()
    # A missing key is most often a misspelt one.
    first = next((e for e in errors if e["type"] == "extra_forbidden"), errors[0])
    key = ".".join(str(part) for part in first["loc"])
    if first["type"] == "extra_forbidden":
        known = list((Budget if key.startswith("emulator.") else SimulatorFile).model_fields)
        hint = meant(str(first["loc"][-1]), known, "correct its name, or leave it out")
        return CalibError(f"unknown key {key}", expected=", ".join(known), hint=hint)
    hint = "add it" if first["type"] == "missing" else "correct it"
    return CalibError(in_words(first), where=key, hint=hint)


def _unreadable(what: str, error: Exception, key: str | None) -> CalibError:
    why = getattr(error, "strerror", None) or error
    hint = (
        "correct the path, which is relative to the simulator file" if key else "correct the path"
    )
    return CalibError(f"the {what} cannot be read ({why})", where=key, hint=hint)


def _content(path: Path, key: str, what: str) -> bytes:
    try:
        return path.read_bytes()
    except OSError as error:
        raise _unreadable(what, error, key) from None


def _ranges(file: SimulatorFile) -> dict[str, tuple[float, float]]:
    """Ranges by canonical condition; they are given by the simulator's own names, in its units."""
    found = {}
    for name, (low, high) in file.ranges.items():
        column = parse_header(file.conditions.get(name, ""))
        if column is None or not low < high:
            raise CalibError(
                f"the range [{low:g}, {high:g}] is of no condition, or not from low to high",
                where=f"ranges.{name}",
                expected=", ".join(file.conditions),
                hint="name a condition, and give [low, high]",
            )
        low, high = (float(column.to_canonical(v)) for v in (low, high))
        found[column.quantity.canonical] = (low, high)
    return found


def _runner(file: SimulatorFile, folder: Path) -> Runner:
    makers: dict[str, Callable[[SimulatorFile, Path], Runner]] = {
        "run": _command,
        "python": _callable,
        "url": _umbridge,
        "table": _of_table,
    }
    given = [key for key in makers if getattr(file, key)]
    if len(given) != 1:
        raise CalibError(
            f"it is not clear how to run it: {', '.join(given) or 'nothing'} is given",
            expected=f"exactly one of {', '.join(makers)}",
            hint="give one of them",
        )
    return makers[given[0]](file, folder)


def _command(file: SimulatorFile, folder: Path) -> CommandRunner:
    try:
        arguments, found = tuple(shlex.split(file.run)), "no words"
    except ValueError as error:
        arguments, found = (), str(error)
    if not arguments:
        raise CalibError(
            f"{file.run!r} is no command ({found})",
            where="run",
            expected='run = "program {input} {output}", in quotes what has spaces in it',
            hint="correct it",
        )
    takes, template = file.input, ""
    if file.template or takes == "template":
        takes, template = "template", _template(file, folder)
    if file.output == "pattern" and set(file.patterns) != set(file.outputs):
        raise CalibError(
            "patterns and outputs differ",
            where="patterns",
            expected=", ".join(file.outputs),
            hint="give each output a regular expression",
        )
    each = file.rows == "each"
    runner = CommandRunner(
        arguments, folder, takes, template, file.output, file.patterns, each, file.limit
    )
    if runner.program is None:
        raise CalibError(
            f"there is no program {arguments[0]!r}",
            where="run",
            expected=f"a program on the search path, or a path relative to {folder.name}/",
            hint="build or install it, or correct its path",
        )
    return runner


def _template(file: SimulatorFile, folder: Path) -> str:
    try:
        template = read_text(folder / file.template)
    except (OSError, UnicodeDecodeError) as error:
        raise _unreadable("template", error, "template") from None
    noise = {"sigma", *(f"sigma_{own}" for own in file.outputs)}
    names = tuple(p for p in file.parameters if p not in noise)
    check_template(template, (*names, *file.conditions), f"template {file.template}")
    return template


def _callable(file: SimulatorFile, folder: Path) -> CallableRunner:
    script, _, name = file.python.rpartition(":")
    function = getattr(run_file(folder / script, "simulator"), name, None)
    if not callable(function):
        raise CalibError(
            f"there is no function {name!r} in {script}",
            where="python",
            expected='python = "file.py:function"',
            hint="correct the name",
        )
    # Only a limit needs a process of its own.
    limit = file.limit if "limit" in file.model_fields_set else None
    return CallableRunner(function, tuple(file.outputs), file.batched, limit)


def _umbridge(file: SimulatorFile, folder: Path) -> UmbridgeRunner:
    if not file.model:
        raise CalibError(
            "the model of the server is not named",
            where="model",
            expected='model = "NAME"',
            hint="add it: GET /Info of the server lists them",
        )
    rows: Literal["each", "config"] = "each" if file.rows == "each" else "config"
    return UmbridgeRunner(file.url, file.model, tuple(file.outputs), rows, file.limit)


def _of_table(file: SimulatorFile, folder: Path) -> TableRunner:
    if not file.emulate:
        raise CalibError(
            "a table of runs has none where a sampler asks",
            where="emulate",
            expected="emulate = true, which is so by itself",
            hint="leave emulate out",
        )
    content = _content(folder / file.table, "table", "table of runs")
    return TableRunner(folder / file.table, hashlib.sha256(content).hexdigest())
