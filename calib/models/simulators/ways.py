"""A simulator behind an UM-Bridge server, asked over HTTP.

Ways to carry out a simulator: a Python function, a command, a table.
"""

from __future__ import annotations

import json
import os
import shutil
import socket
import tempfile
import urllib.error
import urllib.request
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from http.client import HTTPException
from pathlib import Path
from typing import Any, Literal
from urllib.parse import urlsplit
from uuid import uuid4

import numpy as np

from calib.batch.foreign import call
from calib.batch.plugins import declared_in
from calib.batch.sources import content_of, fingerprint
from calib.data.files import read_text
from calib.errors import CalibError
from calib.models.base import Array
from calib.models.simulators.base import Failure, Given, Printed, no_output, not_made, tail
from calib.models.simulators.child import of_surroundings
from calib.models.simulators.exchange import filled, input_csv, input_json, output_of_text
from calib.models.simulators.process import call_function, run_program


@dataclass(frozen=True)
class UmbridgeWay:
    """A model behind an UM-Bridge server (protocol 1.0, doi:10.21105/joss.04748).

    The protocol is one POST of JSON. The client of the package `umbridge` has no limit of time and
    stops at a NaN in a reply, so it is spoken here.

    Parameters
    ----------
    columns : tuple of str
        The outputs, in the order of the server's output vectors.
    rows : {"each", "config"}
        ``each``: one call for each row of conditions, parameters then conditions as one input
        vector, an output vector of one number each. ``config``: one call, the conditions as lists
        in the call's ``config``, an output vector of n numbers each.
    limit : float
        Seconds for each call.
    """

    url: str
    model: str
    columns: tuple[str, ...]
    rows: Literal["each", "config"] = "each"
    limit: float = 600.0

    @property
    def identity(self) -> str:
        """Where it is and how it is called."""
        return json.dumps(["umbridge", self.url, self.model, self.columns, self.rows])

    @property
    def key(self) -> str:
        """The key of a simulator file."""
        return "url"

    @property
    def runs(self) -> bool:
        """Always."""
        return True

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
            if not isinstance(vectors, list) or len(vectors) != len(self.columns):
                given = len(vectors) if isinstance(vectors, list) else 0
                what = f"the reply has {given} output vectors for {', '.join(self.columns)}"
                return Failure("unreadable", what, tail(str(reply)))
            if not all(isinstance(values, list) for values in vectors):
                what = "the reply is not of output vectors of numbers"
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
            if error.code not in _OF_THE_MODEL:
                raise self._not_there(f"{error.code} {error.reason}") from None
            return Failure("error", f"the server answered {error.code}", tail(_body(error)))
        except (urllib.error.URLError, ValueError) as error:  # before anything was asked
            raise self._not_there(getattr(error, "reason", error)) from None
        except (OSError, HTTPException) as error:
            if not self._listens():
                raise self._not_there(error) from None
            if isinstance(error, TimeoutError):
                return Failure("time", f"the server took longer than {self.limit:g} s")
            return Failure("error", f"the server at {self.url} did not answer: {error}")
        try:
            # Python's reader takes the NaN and Infinity that JSON does not have.
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
        """Whether something is there to answer: a server that died has no faulty parameters."""
        try:
            place = urlsplit(self.url)
            port = place.port or (443 if place.scheme == "https" else 80)
            socket.create_connection((place.hostname or "", port), self.limit).close()
        except (OSError, ValueError):
            return False
        return True


# What a server answers of itself with (protocol 1.0): a call that its model will not have, a model
# that failed. With any other code it was not the model that answered.
_OF_THE_MODEL = (400, 500)


def _body(error: urllib.error.HTTPError) -> str:
    return error.read().decode(errors="replace")


@dataclass(frozen=True)
class CallableWay:
    """A Python function.

    Parameters
    ----------
    function : callable
        ``(theta, conditions) -> output``: theta of shape (k, d), conditions of shape (n,) by the
        simulator's own names; returns (k, n), or a mapping of such by output. With `batched`
        false theta has the shape (d,), the output (n,).
    columns : tuple of str
        The outputs.
    limit : float, optional
        Seconds for a run, which is then made in a process of its own; without one, in this.

    Attributes
    ----------
    identity : str
        What the function was when this was made, or as others have changed it since; what it
        counts or remembers itself as it runs is no part of it.
    unshared : str
        Why it cannot be told from others, so that its runs are not shared; empty if it can.
    """

    function: Callable[[Array, Mapping[str, Array]], Any]
    columns: tuple[str, ...]
    batched: bool = True
    limit: float | None = None
    identity: str = field(init=False, repr=False, compare=False)
    unshared: str = field(init=False, repr=False, compare=False)
    _left: str = field(init=False, repr=False, compare=False)

    def __post_init__(self) -> None:
        object.__setattr__(self, "unshared", "")
        try:
            what = fingerprint(self.function)
        except ValueError as error:
            what = uuid4().hex
            object.__setattr__(self, "unshared", str(error))
        self._is(what)

    def _is(self, what: str) -> None:
        object.__setattr__(self, "identity", f"callable {self.batched} {what}")
        object.__setattr__(self, "_left", what)

    @contextmanager
    def watched(self) -> Iterator[None]:
        """Have what was changed between such blocks, not within, make another simulator of it."""
        if self.unshared:
            yield
            return
        with suppress(ValueError):
            if (now := fingerprint(self.function)) != self._left:
                self._is(now)
        yield
        with suppress(ValueError):
            object.__setattr__(self, "_left", fingerprint(self.function))

    @property
    def key(self) -> str:
        """The key of a simulator file."""
        return "python"

    @property
    def runs(self) -> bool:
        """Always."""
        return True

    def run(self, parameters: Mapping[str, float], conditions: Mapping[str, Array]) -> Given:
        """Call it for one parameter vector."""
        theta = np.array(list(parameters.values()))
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
            # No fault of the parameters: the next run would not give it either.
            raise CalibError(
                no_output(missing[0], named),
                where=self._place,
                allowed=", ".join(self.columns),
                mend="return a mapping with these names, or rename the outputs declared",
            )
        return named


@dataclass(frozen=True)
class CommandWay:
    """A program, run without a shell in a scratch folder of its own.

    Parameters
    ----------
    arguments : tuple of str
        With ``{input}`` and ``{output}`` for the paths of the two files; without ``{output}``
        what it prints is read.
    folder : Path
        Of the simulator file: a program named by a relative path is looked for here.
    takes : {"json", "csv", "template"}
    template : str
        The input in the program's own format, ``@name@`` where a value belongs.
    gives : {"json", "csv", "pattern"}
    each_row : bool
        Whether the program is run for each row of conditions by itself.
    limit : float
        Seconds for each time it is run.
    """

    arguments: tuple[str, ...]
    folder: Path
    takes: Literal["json", "csv", "template"] = "json"
    template: str = ""
    gives: Literal["json", "csv", "pattern"] = "json"
    patterns: Mapping[str, str] = field(default_factory=dict)
    each_row: bool = False
    limit: float = 600.0

    @property
    def identity(self) -> str:
        """The command, the formats, and what is in the files that it names and they import."""
        named = [self._found(a) for a in self.arguments]
        files = [content_of(p) if p else "" for p in named]
        what = [self.arguments, files, self.takes, self.template, self.gives]
        return json.dumps(["command", *what, dict(self.patterns), self.each_row])

    @property
    def key(self) -> str:
        """The key of a simulator file."""
        return "run"

    @property
    def runs(self) -> bool:
        """Always."""
        return True

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
            # As it is named: what a link leads to may be another program by its own name.
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
            given, taken = scratch / f"input.{self._ending}", scratch / f"output.{self.gives}"
            given.write_text(self._input(parameters, conditions), encoding="utf-8")
            paths = {"{input}": str(given), "{output}": str(taken)}
            whole = not self._leaves_file
            printed = run_program(
                self._arguments(paths), scratch, self.limit, whole=whole, home=str(self.folder)
            )
            if isinstance(printed, Failure):
                return printed
            return self._read(taken, printed)

    def _read(self, taken: Path, printed: str) -> Printed | Failure:
        text = printed
        if self._leaves_file:
            try:
                text = read_text(taken)
            except (OSError, UnicodeDecodeError):
                return Failure("unreadable", "it left no readable output file", tail(printed))
        found = output_of_text(text, self.gives, self.patterns)
        if isinstance(found, Failure):
            return Failure(found.kind, found.reason, tail(printed))
        return Printed(found, tail(printed))

    @property
    def _leaves_file(self) -> bool:
        return any("{output}" in a for a in self.arguments)

    @property
    def _ending(self) -> str:
        return "txt" if self.takes == "template" else self.takes

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
class TableWay:
    """Runs that were made already; nothing is carried out.

    Parameters
    ----------
    path : Path
        CSV with a column for each parameter, condition and output, a row for each row of
        conditions of each run.
    sha256 : str
        Of the file.
    """

    path: Path
    sha256: str

    @property
    def identity(self) -> str:
        """The content of the table."""
        return f"table {self.sha256}"

    @property
    def key(self) -> str:
        """The key of a simulator file."""
        return "table"

    @property
    def runs(self) -> bool:
        """Never."""
        return False

    def run(self, parameters: Mapping[str, float], conditions: Mapping[str, Array]) -> Given:
        """Refuse: there is nothing to carry out."""
        return Failure("error", "there are the runs of the table and no others")
