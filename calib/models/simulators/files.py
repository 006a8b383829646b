"""A simulator file: TOML that says how a simulator is run, what it takes and what it gives."""

from __future__ import annotations

import hashlib
import shlex
import tomllib
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import AfterValidator, BaseModel, ConfigDict, Field, ValidationError

from calib.batch.user_code import load, run_file
from calib.data.files import MEND_TOML, read_text, read_toml
from calib.errors import CalibError, in_words, meant
from calib.models.simulators.base import Way
from calib.models.simulators.emulator import use_emulator
from calib.models.simulators.registered import SIMULATED, Budget, Simulated, declare, written
from calib.models.simulators.ways import (
    CallableWay,
    CommandWay,
    TableWay,
    UmbridgeWay,
    check_template,
)

_WAYS = ("run", "python", "url", "table")


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
        content = read_toml(path)
    except OSError as error:
        raise CalibError(
            f"the simulator file cannot be read ({error.strerror})", where=str(path),
            hint="give the path of a TOML file",
        ) from None  # fmt: skip
    except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
        raise CalibError(f"not valid TOML: {error}", where=str(path), hint=MEND_TOML) from None
    try:
        file = SimulatorFile.model_validate(content)
    except ValidationError as error:
        raise _explain(error, path) from None
    priors = "\n".join(written(name, table) for name, table in file.parameters.items())
    try:
        return declare(
            file.name, _way(file, path), priors, file.conditions, file.outputs,
            folder=path.parent / (file.cache or f"{path.stem}.runs"),
            budget=file.emulator.model_dump(exclude_unset=True),
            title=file.title, source=file.source, limit=file.limit, retries=file.retries,
            deterministic=file.deterministic,
            emulate=file.emulate, ranges=_ranges(file, path), made_of=_made_of(file, path),
            file=str(path),
        )  # fmt: skip
    except CalibError as error:
        where = str(path) if error.where is None else f"{path}, {error.where}"
        found = where if str(path) not in (error.where or "") else error.where
        raise CalibError(
            error.message, where=found, expected=error.expected, hint=error.hint
        ) from None


def _explain(error: ValidationError, path: Path) -> CalibError:
    errors = error.errors()
    # A missing key is most often a misspelt one.
    first = next((e for e in errors if e["type"] == "extra_forbidden"), errors[0])
    key = ".".join(str(part) for part in first["loc"])
    known = list((Budget if key.startswith("emulator.") else SimulatorFile).model_fields)
    hint = "correct it"
    if first["type"] == "extra_forbidden":
        hint = meant(str(first["loc"][-1]), known, "correct its name, or leave it out")
        return CalibError(
            f"unknown key {key}", where=str(path), expected=", ".join(known), hint=hint
        )
    missing = first["type"] == "missing"
    return CalibError(in_words(first), where=f"{path}, {key}", hint="add it" if missing else hint)


def _ranges(file: SimulatorFile, path: Path) -> dict[str, tuple[float, float]]:
    """Ranges by canonical condition; they are given by the simulator's own names, in its units."""
    from calib.data.table import parse_header

    found = {}
    for name, (low, high) in file.ranges.items():
        column = parse_header(file.conditions.get(name, ""))
        if column is None or not low < high:
            raise CalibError(
                f"the range [{low:g}, {high:g}] is of no condition, or not from low to high",
                where=f"{path}, ranges.{name}", expected=", ".join(file.conditions),
                hint="name a condition, and give [low, high]",
            )  # fmt: skip
        low, high = (float(column.to_canonical(v)) for v in (low, high))
        found[column.quantity.canonical] = (low, high)
    return found


def _way(file: SimulatorFile, path: Path) -> Way:
    given = [key for key in _WAYS if getattr(file, key)]
    if len(given) != 1:
        raise CalibError(
            f"it is not clear how to run it: {', '.join(given) or 'nothing'} is given",
            where=str(path), expected=f"exactly one of {', '.join(_WAYS)}",
            hint="give one of them",
        )  # fmt: skip
    makers: dict[str, Callable[[SimulatorFile, Path], Way]] = {
        "run": _command, "python": _callable, "url": _umbridge, "table": _of_table,
    }  # fmt: skip
    return makers[given[0]](file, path)


def _command(file: SimulatorFile, path: Path) -> CommandWay:
    try:
        arguments = tuple(shlex.split(file.run))
    except ValueError as error:
        found = str(error)
    else:
        found = "" if arguments else "no words"
    if found:
        raise CalibError(
            f"{file.run!r} is no command ({found})", where=f"{path}, run",
            expected='run = "program {input} {output}", in quotes what has spaces in it',
            hint="correct it",
        )  # fmt: skip
    template = ""
    if file.input == "template" or file.template:
        template = _template(file, path)
    if file.output == "pattern" and set(file.patterns) != set(file.outputs):
        raise CalibError(
            "patterns and outputs differ", where=f"{path}, patterns",
            expected=", ".join(file.outputs), hint="give each output a regular expression",
        )  # fmt: skip
    way = CommandWay(
        arguments, path.parent, "template" if template else file.input, template, file.output,
        file.patterns, file.rows == "each", file.limit,
    )  # fmt: skip
    if way.program is None:
        raise CalibError(
            f"there is no program {arguments[0]!r}", where=f"{path}, run",
            expected=f"a program on the search path, or a path relative to {path.parent.name}/",
            hint="build or install it, or correct its path",
        )  # fmt: skip
    return way


def _made_of(file: SimulatorFile, path: Path) -> tuple[str, ...]:
    """Return the SHA-256 of each named file that the program reads or calls."""
    found = []
    for name in file.files:
        try:
            content = (path.parent / name).read_bytes()
        except OSError as error:
            raise CalibError(
                f"the file {name!r} cannot be read ({error.strerror})", where=f"{path}, files",
                expected="files that the simulator is made of, relative to this one",
                hint="correct the path, or leave it out",
            ) from None  # fmt: skip
        found.append(hashlib.sha256(content).hexdigest())
    return tuple(found)


def _template(file: SimulatorFile, path: Path) -> str:
    where = path.parent / file.template
    try:
        template = read_text(where)
    except (OSError, UnicodeDecodeError) as error:
        raise CalibError(
            f"the template cannot be read ({error})", where=f"{path}, template",
            hint="give the path of a text file",
        ) from None  # fmt: skip
    noise = {"sigma", *(f"sigma_{own}" for own in file.outputs)}
    names = tuple(p for p in file.parameters if p not in noise)
    check_template(template, (*names, *file.conditions), f"{path}, template {file.template}")
    return template


def _callable(file: SimulatorFile, path: Path) -> CallableWay:
    script, _, name = file.python.rpartition(":")
    function = getattr(run_file(path.parent / script, "simulator"), name, None)
    if not callable(function):
        raise CalibError(
            f"there is no function {name!r} in {script}", where=f"{path}, python",
            expected='python = "file.py:function"', hint="correct the name",
        )  # fmt: skip
    # Only a limit needs a process of its own.
    limit = file.limit if "limit" in file.model_fields_set else None
    return CallableWay(function, tuple(file.outputs), file.batched, limit)


def _umbridge(file: SimulatorFile, path: Path) -> UmbridgeWay:
    if not file.model:
        raise CalibError(
            "the model of the server is not named", where=f"{path}, model",
            expected='model = "NAME"', hint="add it: GET /Info of the server lists them",
        )  # fmt: skip
    rows: Literal["each", "config"] = "each" if file.rows == "each" else "config"
    return UmbridgeWay(file.url, file.model, tuple(file.outputs), rows, file.limit)


def _of_table(file: SimulatorFile, path: Path) -> TableWay:
    where = path.parent / file.table
    if not file.emulate:
        raise CalibError(
            "a table of runs has none where a sampler asks", where=f"{path}, emulate",
            expected="emulate = true, which is so by itself", hint="leave emulate out",
        )  # fmt: skip
    try:
        content = where.read_bytes()
    except OSError as error:
        raise CalibError(
            f"the table of runs cannot be read ({error.strerror})", where=f"{path}, table",
            hint="give the path of a CSV file",
        ) from None  # fmt: skip
    return TableWay(where, hashlib.sha256(content).hexdigest())
