"""Runners of a simulator: a Python function, a program, an UM-Bridge server, a table of runs.

And what is written for a program to read, and read of what it has written.
"""

from __future__ import annotations

import csv
import io
import json
import os
import re
import shutil
import socket
import tempfile
import urllib.error
import urllib.request
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from http.client import HTTPException
from pathlib import Path
from typing import Any, ClassVar, Literal
from urllib.parse import urlsplit
from uuid import uuid4

import numpy as np

from calib.batch.user_code import call, content_of, declared_in, fingerprint
from calib.data.files import read_text
from calib.data.quantities import real_array
from calib.errors import CalibError
from calib.models.base import Array
from calib.models.simulators.child import of_surroundings
from calib.models.simulators.process import call_function, run_program
from calib.models.simulators.simulator import Failure, Given, Printed, no_output, not_made, tail


@dataclass(frozen=True)
class UmbridgeRunner:
    """A model behind an UM-Bridge server (protocol 1.0, doi:10.21105/joss.04748).

    The client of the package `umbridge` has no limit of time and stops at a NaN in a reply, so the
    protocol, one POST of JSON, is spoken here. `columns` are the outputs in the order of the
    server's output vectors. `rows` is ``each`` (one call for each row of conditions, parameters
    then conditions as one input vector) or ``config`` (one call, the conditions as lists in its
    ``config``, output vectors of n numbers). `limit` is in seconds for each call.
    """

    url: str
    model: str
    columns: tuple[str, ...]
    rows: Literal["each", "config"] = "each"
    limit: float = 600.0

    key: ClassVar[str] = "url"
    runs: ClassVar[bool] = True

    @property
    def identity(self) -> str:
        """Where it is and how it is called."""
        return json.dumps(["umbridge", self.url, self.model, self.columns, self.rows])

    def run(self, parameters: Mapping[str, float], conditions: Mapping[str, Array]) -> Given:
        """Call the server."""
        theta = list(parameters.values())
        lists = {name: values.tolist() for name, values in conditions.items()}
        if self.rows == "config":
            calls = [self.ask("Evaluate", {"input": [theta], "config": lists})]
        else:
            calls = []
            for row in zip(*lists.values(), strict=True):
                calls.append(self.ask("Evaluate", {"input": [[*theta, *row]], "config": {}}))
                if isinstance(calls[-1], Failure):
                    break
        outputs: dict[str, list[Any]] = {name: [] for name in self.columns}
        for reply in calls:
            if isinstance(reply, Failure):
                return reply
            vectors = reply.get("output")
            vectors, what = vectors if isinstance(vectors, list) else [], ""
            if len(vectors) != len(self.columns):
                what = f"the reply has {len(vectors)} output vectors for {', '.join(self.columns)}"
            elif not all(isinstance(values, list) for values in vectors):
                what = "the reply is not of output vectors of numbers"
            if what:
                return Failure("unreadable", what, tail(str(reply)))
            for name, values in zip(self.columns, vectors, strict=True):
                outputs[name].append(values)
        return Printed(outputs, tail(str(calls[-1])))

    def ask(self, what: str, content: Mapping[str, Any]) -> dict[str, Any] | Failure:
        """Send one request of the protocol; a CalibError if there is no server."""
        body = json.dumps({"name": self.model, **content}).encode()
        try:
            request = urllib.request.Request(
                f"{self.url.rstrip('/')}/{what}", body, {"Content-Type": "application/json"}
            )
            with urllib.request.urlopen(request, timeout=self.limit) as reply:
                answer = reply.read()
        except urllib.error.HTTPError as error:
            if error.code not in (400, 500):  # of a refused call and of a failed model
                raise self._not_there(f"{error.code} {error.reason}") from None
            said = tail(error.read().decode(errors="replace"))
            return Failure("error", f"the server answered {error.code}", said)
        except (urllib.error.URLError, ValueError) as error:  # before anything was asked
            raise self._not_there(getattr(error, "reason", error)) from None
        except (OSError, HTTPException) as error:
            if not self._listens():
                raise self._not_there(error) from None
            if isinstance(error, TimeoutError):
                return Failure("time", f"the server took longer than {self.limit:g} s")
            return Failure("error", f"the server at {self.url} did not answer: {error}")
        try:
            # Python's reader accepts NaN and Infinity.
            found = json.loads(answer)
        except ValueError:
            said = tail(answer.decode(errors="replace"))
            return Failure("unreadable", "the server's reply is not JSON", said)
        if not isinstance(found, dict) or "error" in found:
            return Failure("error", "the server reports an error", tail(str(found)))
        return found

    def _not_there(self, why: object) -> CalibError:
        return not_made(f"the server at {self.url} is not there ({why})", "start it")

    def _listens(self) -> bool:
        """Whether something listens: a dead server is not due to the parameters."""
        try:
            place = urlsplit(self.url)
            port = place.port or (443 if place.scheme == "https" else 80)
            socket.create_connection((place.hostname or "", port), self.limit).close()
        except (OSError, ValueError):
            return False
        return True


@dataclass(eq=False)
class CallableRunner:
    """A Python function, ``(theta, conditions) -> output``.

    Theta is (k, d), conditions (n,) by the simulator's own names; it returns (k, n), or a mapping
    of such by output (`columns`). With `batched` false theta is (d,), the output (n,). With a
    `limit` in seconds a run is made in a process of its own. `identity` is what the function was
    when this was made, or as others have changed it since; `unshared` says why it cannot be told
    from others, so that its runs are not shared.
    """

    function: Callable[[Array, Mapping[str, Array]], Any]
    columns: tuple[str, ...]
    batched: bool = True
    limit: float | None = None
    unshared: str = field(default="", init=False, repr=False)

    key: ClassVar[str] = "python"
    runs: ClassVar[bool] = True

    def __post_init__(self) -> None:
        self._is = self._left = self._looked()

    def _looked(self) -> str:
        """Return what the function is now."""
        try:
            return fingerprint(self.function)
        except ValueError as error:
            self.unshared = str(error)
            return uuid4().hex

    @property
    def identity(self) -> str:
        """What the function is, and how it is called."""
        return f"callable {self.batched} {self._is}"

    @contextmanager
    def watched(self) -> Iterator[None]:
        """Notice changes of the function between such blocks, but not within."""
        if not self.unshared and (now := self._looked()) != self._left:
            self._is = now
        yield
        if not self.unshared:
            self._left = self._looked()

    def run(self, parameters: Mapping[str, float], conditions: Mapping[str, Array]) -> Given:
        """Call it for one parameter vector."""
        theta = np.array([*parameters.values()], dtype=np.float64)
        arguments = (theta[None] if self.batched else theta, conditions)
        try:
            if self.limit is None:
                found = call(self.function, *arguments)
            else:
                found = call_function(self.function, arguments, self.limit)
            return found if isinstance(found, Failure) else self._named(found)
        except CalibError:
            raise
        except (Exception, SystemExit) as error:
            if of_surroundings(error):
                raise not_made(f"{type(error).__name__}: {error}") from error
            return Failure("error", f"{type(error).__name__}: {error}")

    def call(self, theta: Array, conditions: Mapping[str, Array]) -> Mapping[str, Any]:
        """Call it here and now, and name what it returns."""
        return self._named(call(self.function, theta, conditions))

    @property
    def _place(self) -> str:
        """The function and its file, for messages."""
        called = getattr(self.function, "__qualname__", repr(self.function))
        return ", ".join(filter(None, (declared_in(self.function), f"function {called}")))

    def _named(self, found: Any) -> Mapping[str, Any]:
        named: Mapping[str, Any] = dict.fromkeys(self.columns[:1], found)
        if isinstance(found, Mapping):
            named = found
        elif hasattr(found, "columns") and not hasattr(found, "dims"):  # a table, not an array
            named = {str(column): found[column] for column in found.columns}
        missing = [column for column in self.columns if column not in named]
        if missing:
            # Not due to the parameters: other runs would not give it either.
            raise CalibError(
                no_output(missing[0], named),
                where=self._place,
                expected=", ".join(self.columns),
                hint="return a mapping with these names, or rename the outputs declared",
            )
        return named


@dataclass(frozen=True)
class CommandRunner:
    """A program, run without a shell in a scratch folder of its own.

    `arguments` have ``{input}`` and ``{output}`` for the paths of the two files; without
    ``{output}`` what it prints is read. `folder` is that of the simulator file, in which relative
    paths are looked up; `template` is the input in the program's own format, ``@name@`` where a
    value belongs. It is run once, or for `each_row` of conditions, within so many seconds each
    time.
    """

    arguments: tuple[str, ...]
    folder: Path
    takes: Literal["json", "csv", "template"] = "json"
    template: str = ""
    gives: Literal["json", "csv", "pattern"] = "json"
    patterns: Mapping[str, str] = field(default_factory=dict)
    each_row: bool = False
    limit: float = 600.0

    key: ClassVar[str] = "run"
    runs: ClassVar[bool] = True

    @property
    def identity(self) -> str:
        """The command, the formats, and what is in the files that it names and they import."""
        named = [self._found(a) for a in self.arguments]
        files = [content_of(p) if p else "" for p in named]
        what = [self.arguments, files, self.takes, self.template, self.gives]
        return json.dumps(["command", *what, dict(self.patterns), self.each_row])

    @property
    def program(self) -> str | None:
        """The program's path; None if there is none."""
        found = self._found(self.arguments[0])
        return str(found) if found else shutil.which(self.arguments[0])

    def _found(self, argument: str) -> Path | None:
        """Return the file beside the simulator file that an argument names."""
        if "{" in argument:
            return None
        try:
            # Links are not resolved: a program may depend on the name it is called by.
            path = Path(os.path.abspath(self.folder / argument))  # noqa: PTH100
            return path if path.is_file() else None
        except (OSError, RuntimeError):  # a text too long for a name, a link to itself
            return None

    def run(self, parameters: Mapping[str, float], conditions: Mapping[str, Array]) -> Given:
        """Run it once, or once for each row."""
        if not self.each_row:
            return self._one(parameters, conditions)
        found: list[Printed] = []
        for i in range(next(iter(conditions.values())).size):
            one = self._one(parameters, {name: v[i : i + 1] for name, v in conditions.items()})
            if isinstance(one, Failure):
                return Failure(one.kind, f"row {i} of the conditions: {one.reason}", one.printed)
            found.append(one)
        common = set(found[0]).intersection(*found)
        outputs = {name: [one[name] for one in found] for name in common}
        return Printed(outputs, found[-1].printed)

    def _one(
        self, parameters: Mapping[str, float], conditions: Mapping[str, Array]
    ) -> Printed | Failure:
        with tempfile.TemporaryDirectory(prefix="calib-run-", ignore_cleanup_errors=True) as name:
            scratch = Path(name)
            ending = "txt" if self.takes == "template" else self.takes
            given, taken = scratch / f"input.{ending}", scratch / f"output.{self.gives}"
            given.write_text(self._input(parameters, conditions), encoding="utf-8")
            paths = {"{input}": str(given), "{output}": str(taken)}
            leaves_file = any("{output}" in a for a in self.arguments)
            printed = run_program(
                self._arguments(paths), scratch, self.limit, whole=not leaves_file,
                home=str(self.folder),
            )  # fmt: skip
            if isinstance(printed, Failure):
                return printed
            text, end = printed, tail(printed)
            if leaves_file:
                try:
                    text = read_text(taken)
                except (OSError, UnicodeDecodeError):
                    return Failure("unreadable", "it left no readable output file", end)
            found = output_of_text(text, self.gives, self.patterns)
            if isinstance(found, Failure):
                return Failure(found.kind, found.reason, end)
            return Printed(found, end)

    def _arguments(self, paths: Mapping[str, str]) -> list[str]:
        written = []
        for argument in self.arguments:
            there = self._found(argument)
            for mark, path in paths.items():
                argument = argument.replace(mark, path)
            written.append(str(there) if there else argument)
        return written

    def _input(self, parameters: Mapping[str, float], conditions: Mapping[str, Array]) -> str:
        if self.takes == "template":
            return filled(self.template, parameters, conditions)
        return (input_json if self.takes == "json" else input_csv)(parameters, conditions)


@dataclass(frozen=True)
class TableRunner:
    """Runs that were made already: a CSV with a column for each parameter, condition and output.

    It has a row for each row of conditions of each run; `sha256` is that of the file.
    """

    path: Path
    sha256: str

    key: ClassVar[str] = "table"
    runs: ClassVar[bool] = False

    @property
    def identity(self) -> str:
        """The content of the table."""
        return f"table {self.sha256}"

    def run(self, parameters: Mapping[str, float], conditions: Mapping[str, Array]) -> Given:
        """Refuse: there is nothing to carry out."""
        return Failure("error", "there are the runs of the table and no others")


def input_json(parameters: Mapping[str, float], conditions: Mapping[str, Array]) -> str:
    """Return both as JSON: numbers by parameter, lists by condition."""
    lists = {name: values.tolist() for name, values in conditions.items()}
    return json.dumps({"parameters": dict(parameters), "conditions": lists}, indent=1) + "\n"


def input_csv(parameters: Mapping[str, float], conditions: Mapping[str, Array]) -> str:
    """Return both as CSV: a row for each row of conditions, the parameters the same in all."""
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow([*parameters, *conditions])
    fixed = [repr(value) for value in parameters.values()]
    for row in zip(*conditions.values(), strict=True):
        writer.writerow([*fixed, *(repr(float(value)) for value in row)])
    return text.getvalue()


def check_template(template: str, names: tuple[str, ...], where: str) -> None:
    """Check that a template has a place for each name, and no other; a CalibError if not."""
    marks = set(re.findall(r"@([^\W\d]\w*)@", template))
    missing = [name for name in names if name not in marks]
    unknown = sorted(marks - set(names))
    if missing or unknown:
        what = [f"no place for {', '.join(missing)}"] * bool(missing)
        what += [f"unknown {', '.join(f'@{name}@' for name in unknown)}"] * bool(unknown)
        raise CalibError(
            f"the template has {'; '.join(what)}", where=where,
            expected=", ".join(f"@{name}@" for name in names),
            hint="write each of these marks where its value belongs, and no other",
        )  # fmt: skip


def filled(template: str, parameters: Mapping[str, float], conditions: Mapping[str, Array]) -> str:
    """Fill in a template's marks, values of a condition separated by spaces."""
    values = {name: repr(value) for name, value in parameters.items()}
    values |= {name: " ".join(map(repr, v.tolist())) for name, v in conditions.items()}
    for name, value in values.items():
        template = template.replace(f"@{name}@", value)
    return template


def output_of_text(text: str, how: str, patterns: Mapping[str, str]) -> Given:
    """Read outputs: of JSON an object of lists or numbers, of CSV a column each.

    A pattern is a regular expression whose first group is the number, found once for each row.
    """
    try:
        match how:
            case "json":
                return _of_json(json.loads(text, object_pairs_hook=_once_each))
            case "csv":
                return _table(text)
            case _:
                return {name: _matches(text, pattern) for name, pattern in patterns.items()}
    except (ValueError, TypeError, CalibError) as error:
        reason = error.message if isinstance(error, CalibError) else error
        return Failure("unreadable", f"its output is not the {how} asked for: {reason}")


def _table(text: str) -> dict[str, Any]:
    rows = [row for row in csv.reader(io.StringIO(text)) if row]
    if not rows:
        raise ValueError("it is empty")
    return columns_of(rows[0], rows[1:])


def columns_of(header: Sequence[str], rows: Sequence[Sequence[str]]) -> dict[str, Any]:
    """Return the columns of a table by name: numbers, NaN where a cell is empty, or else texts.

    A ValueError says what is wrong.
    """
    names = [name.strip() for name in header]
    if any(len(row) < len(names) or any(row[len(names) :]) for row in rows):
        raise ValueError("its rows have different numbers of cells")
    named = [(name, [row[i].strip() for row in rows]) for i, name in enumerate(names) if name]
    found: dict[str, Any] = _once_each(named)
    for name, column in found.items():
        with suppress(CalibError):
            found[name] = real_array([cell or None for cell in column])
    return found


def _once_each(pairs: Sequence[tuple[str, Any]]) -> dict[str, Any]:
    """Return pairs as a dictionary; a ValueError if a name is there twice."""
    found = dict(pairs)
    if len(found) < len(pairs):
        names = [name for name, _ in pairs]
        raise ValueError(f"{next(n for n in names if names.count(n) > 1)!r} is there twice")
    return found


def _of_json(found: Any) -> dict[str, Any]:
    if not isinstance(found, dict):
        raise TypeError("not an object of outputs by name")
    lists = {k: v if isinstance(v, list) else [v] for k, v in found.items()}
    lists = {k: v for k, v in lists.items() if not any(isinstance(x, dict) for x in v)}
    return {
        k: v if any(isinstance(x, list) for x in v) else real_array(v) for k, v in lists.items()
    }


def _matches(text: str, pattern: str) -> Array:
    """Return the numbers that a pattern finds, whole ones only."""
    found = list(re.finditer(pattern, text, re.M))
    group = 1 if found and found[0].re.groups else 0
    starts = {one.start(group) for one in found}
    rest = re.compile(r"[.,]?\d+|[eEdD][-+]?\d+", re.ASCII)  # of a number that was cut off
    for one in found:
        more = rest.match(text, one.end(group))
        if more and starts.isdisjoint(range(one.end(group), more.end() + 1)):
            raise ValueError(f"{one[group]!r} is the beginning of {one[group] + more[0]!r} only")
    return real_array([one[group] for one in found])
