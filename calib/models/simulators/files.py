"""Simulator files (TOML), and other files of a user's own that register things."""

from __future__ import annotations

import hashlib
import shlex
from collections.abc import Callable, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import AfterValidator, BaseModel, ConfigDict, Field, ValidationError

from calib.batch.user_code import load, run_file
from calib.data.files import TOML_HINT, read_text, read_toml
from calib.data.quantities import convert
from calib.data.table import parse_header
from calib.errors import CalibError, in_words, meant
from calib.models.simulators.declaration import SIMULATED, EmulationSettings, Simulated, declare
from calib.models.simulators.emulator import use_emulator
from calib.models.simulators.fmu import FmuRunner
from calib.models.simulators.runner import (
    CallableRunner,
    CommandRunner,
    TableRunner,
    UmbridgeRunner,
    check_template,
)
from calib.models.simulators.simulator import Runner


def _without_null(text: str) -> str:
    if "\x00" in text:
        raise ValueError("no path and no command holds a null character")
    return text


_Text = Annotated[str, AfterValidator(_without_null)]
_Given = Literal["start_time", "stop_time", "step_size", "output_interval", "relative_tolerance"]


class OutputTable(BaseModel):
    """What a simulator file may say of an output beside its column."""

    model_config = ConfigDict(extra="forbid", frozen=True)
    column: str
    response: Literal["", "identity", "log"] = ""


class SimulatorFile(BaseModel):
    """What a simulator file may say; exactly one of run, python, url, fmu and table."""

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)
    name: str = Field(pattern=r"^[A-Za-z]\w*$")
    title: str = ""
    source: str = ""
    run: _Text = ""
    python: _Text = ""
    url: _Text = ""
    model: _Text = ""
    fmu: _Text = ""
    experiment: dict[_Given, float] = {}
    variables: dict[str, str] = {}
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
    outputs: dict[str, str | OutputTable] = Field(min_length=1)
    derived: dict[str, str] = {}
    along: str = ""
    likelihood: dict[str, Any] = {}
    patterns: dict[str, str] = {}
    ranges: dict[str, tuple[float, float]] = {}
    emulator: EmulationSettings = EmulationSettings()
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

    Examples
    --------
    >>> import calib
    >>> from pathlib import Path
    >>> calib.register(calib.read_simulator(Path("wheel.toml")))  # doctest: +SKIP
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
    told = ("title", "source", "limit", "retries", "deterministic", "emulate", "derived", "along")
    return declare(
        file.name,
        _runner(file, path.parent),
        file.parameters,
        file.conditions,
        {own: o if isinstance(o, str) else o.model_dump() for own, o in file.outputs.items()},
        folder=path.parent / (file.cache or f"{path.stem}.runs"),
        budget=file.emulator.model_dump(exclude_unset=True),
        likelihood=file.likelihood,
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
        kind = EmulationSettings if key.startswith("emulator.") else SimulatorFile
        known = list(kind.model_fields)
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
    if file.along and (file.rows == "each" or file.table):
        raise CalibError(
            "series are neither of a table of runs nor called for row by row", where="along",
            expected='rows = "all", and run, python, url or fmu', hint="leave along out",
        )  # fmt: skip
    makers: dict[str, Callable[[SimulatorFile, Path], Runner]] = {
        "run": _command,
        "python": _callable,
        "url": _umbridge,
        "fmu": _fmu,
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
    check_template(template, (*_without_noise(file), *file.conditions), f"template {file.template}")
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


def _fmu(file: SimulatorFile, folder: Path) -> FmuRunner:
    sha256 = hashlib.sha256(_content(path := folder / file.fmu, "fmu", "FMU")).hexdigest()
    try:
        import fmpy

        found, systems = fmpy.read_model_description(path, False), fmpy.supported_platforms(path)
    except ModuleNotFoundError:
        raise _not_as_fmu("FMPy is missing", "fmpy", "pip install 'terracalib[fmu]'") from None
    except Exception as error:  # of any kind, for whatever is wrong in it
        raise _unreadable("FMU", error, "fmu") from None
    if fmpy.platform not in systems:
        raise _not_as_fmu(f"it is for {systems}", fmpy.platform, "export it for this system")
    ends = getattr(found.defaultExperiment, "stopTime", None) or file.experiment.get("stop_time")
    if not file.along and ends is None:
        raise _not_as_fmu("it does not say when it ends", "stop_time", "add it to [experiment]")
    known = {v.name: v for v in found.modelVariables}
    real = [name for name, v in known.items() if v.type in ("Real", "Float64", "Float32")]
    outputs = {own: str(getattr(o, "column", o)) for own, o in file.outputs.items()}
    headers = file.conditions | outputs
    own = [name for name in (*_without_noise(file), *headers) if name != file.along]
    names = dict(zip(own, own, strict=True)) | file.variables
    for name, variable in names.items():
        if name not in own or variable not in (known if name in outputs else real):
            raise _not_as_fmu(f"{name} is no real number of it", ", ".join(real), "name one")
        column, factor = parse_header(headers.get(name, "")), 1.0
        has = known[variable].unit or getattr(known[variable].declaredType, "unit", None)
        with suppress(CalibError):  # a unit that cannot be told
            factor = float(convert(1.0, has, column.unit)) if has and column else 1.0
        if has and column and abs(factor - 1.0) > 1e-9:
            raise _not_as_fmu(f"{name} is in {has}, not in {column.unit}", has, f"declare {has}")
    return FmuRunner(path, sha256, names, tuple(outputs), file.experiment, file.along, file.limit)


def _not_as_fmu(found: str, expected: str, hint: str) -> CalibError:
    return CalibError(found, where="fmu", expected=expected, hint=hint)


def _without_noise(file: SimulatorFile) -> tuple[str, ...]:
    noise = {"sigma", *(f"sigma_{own}" for own in file.outputs)}
    return (*(p for p in file.parameters if p not in noise), *file.derived)


def _of_table(file: SimulatorFile, folder: Path) -> TableRunner:
    if not file.emulate:
        raise CalibError(
            "a table of runs has no values between its rows, where a sampler needs them",
            where="emulate",
            expected="emulate = true, the default",
            hint="leave emulate out",
        )
    content = _content(folder / file.table, "table", "table of runs")
    return TableRunner(folder / file.table, hashlib.sha256(content).hexdigest())
