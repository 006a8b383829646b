"""What every simulator is: parameters and conditions in, outputs or a reason why not out.

A run is one parameter vector at all conditions asked for. That is the unit that is counted, kept
and limited in time, whatever carries it out (`ways` and `umbridge`, beside this).
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from typing import Any, Literal, Protocol

import numpy as np

from calib.data.files import real_array
from calib.data.quantities import QUANTITIES, convert
from calib.data.table import parse_header
from calib.errors import CalibError
from calib.models.base import Array

type Kind = Literal["time", "exit", "nan", "short", "unreadable", "error"]
type Values = Mapping[str, Array]
# Raw outputs by the simulator's own names.
type Found = Mapping[str, Any]

# Columns of the list of failed runs, next to their parameters.
FAILED = ("kind", "reason", "printed")
# Characters kept of what a failed run printed.
_TAIL = 600
# Keys of a simulator file that kinds of failure point to; others point to how it is run.
_KEYS: Mapping[str, str] = {"time": "limit", "short": "outputs", "unreadable": "outputs"}


@dataclass(frozen=True)
class Failure:
    """A run without a value: its kind, the reason in a sentence, and the tail of what it printed.

    ``time`` (limit passed), ``exit`` (code other than zero), ``nan``, ``short`` (fewer values than
    rows), ``unreadable`` (no output, or none that can be read), ``error`` (an exception).
    """

    kind: Kind
    reason: str
    printed: str = ""


type Result = Values | Failure
type Given = Found | Failure


class Printed(dict[str, Any]):
    """Outputs of a run with what it printed, for error messages."""

    def __init__(self, outputs: Found, printed: str) -> None:
        super().__init__(outputs)
        self.printed = printed


class Way(Protocol):
    """How a simulator is run."""

    @property
    def identity(self) -> str:
        """What else results depend on, as text."""

    @property
    def key(self) -> str:
        """The key of a simulator file that says how it is run."""

    @property
    def runs(self) -> bool:
        """Whether new runs can be made."""

    def run(self, parameters: Mapping[str, float], conditions: Mapping[str, Array]) -> Given:
        """Return the outputs by the simulator's own names, n values each, or a failure."""


@dataclass(frozen=True)
class Output:
    """An output that is calibrated.

    `header` is a column name of `calib.data.quantities` in the simulator's own unit, such as
    ``drawbar_pull_n``, `column` the simulator's name for it, and `sigma` the prior of its noise as
    the TOML text of a table.
    """

    header: str
    column: str
    sigma: str


@dataclass(frozen=True)
class Simulator:
    """A simulator of the user's own.

    Parameters
    ----------
    priors : str
        TOML text of their tables ``parameters.NAME``, as in a prior file.
    conditions : mapping of str to str
        The simulator's own name of each condition to a header in the unit it takes.
    limit : float
        Seconds a run may take.
    retries : int
        How often a failed run is tried again.
    deterministic : bool
        Whether equal input gives equal output.
    emulate : bool
        Whether it is too slow for the sampler to evaluate it.
    ranges : mapping of str to (float, float)
        Bounds within which it may be asked, by canonical condition.
    made_of : tuple of str
        SHA-256 of what else its results depend on: libraries, tables of soils.
    file : str
        The simulator file, if any.
    """

    name: str
    way: Way
    parameters: tuple[str, ...]
    priors: str
    conditions: Mapping[str, str]
    outputs: tuple[Output, ...]
    title: str = ""
    source: str = ""
    limit: float = 600.0
    retries: int = 1
    deterministic: bool = True
    emulate: bool = True
    ranges: Mapping[str, tuple[float, float]] = field(default_factory=dict)
    made_of: tuple[str, ...] = ()
    file: str = ""

    @property
    def digest(self) -> str:
        """SHA-256 of whatever else its results depend on."""
        what = [self.way.identity, list(self.parameters), dict(self.conditions)]
        what += [[o.header, o.column] for o in self.outputs]
        what += [list(self.made_of)] if self.made_of else []
        return hashlib.sha256(json.dumps(what).encode()).hexdigest()

    def canonical(self, header: str) -> str:
        """Return the canonical column of one of its headers, which must name a known quantity."""
        return _parsed(header, self.name)[0]

    def place(self, kind: Kind = "error") -> str:
        """Return where to look if runs fail in some way: the file and the key, for messages."""
        if not self.file:
            return f"simulator {self.name}"
        return f"{self.file}, {_KEYS.get(kind, self.way.key)}"

    @property
    def takes(self) -> tuple[str, ...]:
        """Canonical columns of its conditions."""
        return tuple(dict.fromkeys(map(self.canonical, self.conditions.values())))

    def run(self, theta: Array, conditions: Mapping[str, Array]) -> Result:
        """Make one run, and try again if it fails.

        Parameters (d,) are in the order and units of the priors; conditions and outputs (n,) by
        canonical column, in canonical units.
        """
        parameters = dict(zip(self.parameters, map(float, theta), strict=True))
        n = next(iter(conditions.values())).size
        found: Result = Failure("error", "it was not run")
        try:
            for _ in range(1 + self.retries):
                # Each try gets copies.
                found = self._once(dict(parameters), self.asked(conditions), n)
                if not isinstance(found, Failure):
                    return found
        except CalibError as error:
            raise error.within(self.place()) from None
        return found

    def asked(self, conditions: Mapping[str, Array]) -> dict[str, Array]:
        """Return conditions by the simulator's own names and in its units."""
        found = {}
        for name, header in self.conditions.items():
            column, unit = _parsed(header, self.name)
            found[name] = convert(conditions[column], QUANTITIES[column].unit, unit)
        return found

    def converted(self, found: Found, output: str) -> Array:
        """Return an output, by its canonical column, in its canonical unit."""
        own = next(o for o in self.outputs if self.canonical(o.header) == output)
        unit = _parsed(own.header, self.name)[1]
        try:
            values = real_array(found[own.column], unit)
        except CalibError as error:
            raise error.within(own.column) from None
        return convert(values, unit, QUANTITIES[output].unit)

    def _once(
        self, parameters: Mapping[str, float], conditions: Mapping[str, Array], n: int
    ) -> Result:
        found = self.way.run(parameters, conditions)
        if isinstance(found, Failure):
            return found
        canonical: dict[str, Array] = {}
        for output in self.outputs:
            column, unit = _parsed(output.header, self.name)
            values = checked(found, output.column, n, unit)
            if isinstance(values, Failure):
                return values
            canonical[column] = convert(values, unit, QUANTITIES[column].unit)
        return canonical


def _parsed(header: str, name: str) -> tuple[str, str]:
    found = parse_header(header, where=f"simulator {name}")
    if found is None:
        raise CalibError(
            f"{header!r} is no known quantity with a unit", where=f"simulator {name}",
            expected=", ".join(QUANTITIES) + ", or the same in another unit",
            hint="correct the name, or register a Quantity for it in a file given by --models",
        )  # fmt: skip
    return found.quantity.canonical, found.unit


def not_made(why: str, hint: str = "mend that") -> CalibError:
    """Return the error for a run that its surroundings prevented; it is not kept."""
    return CalibError(
        f"the run could not be made: {why}",
        hint=f"{hint}, and call the same command again: the runs that were made are kept",
    )


def no_output(column: str, found: Iterable[str]) -> str:
    """Name a missing output and those that were given."""
    return f"there is no output {column!r}; it gave {', '.join(map(str, found)) or 'nothing'}"


def checked(found: Found, column: str, n: int, unit: str) -> Array | Failure:
    """Return one output as n numbers in a unit, or a failure."""
    printed = found.printed if isinstance(found, Printed) else ""
    if column not in found:
        return Failure("unreadable", no_output(column, found), printed)
    try:
        values = real_array(found[column], unit)
    except CalibError as error:
        return Failure("unreadable", f"{column}: {error.message}", printed)
    if values.size != n:
        what = f"{column} has {values.size} values for {n} rows of conditions"
        return Failure("short", what, printed)
    if max(values.shape, default=1) != n:
        what = f"{column} has the shape {values.shape} for {n} rows of conditions"
        return Failure("short", what, printed)
    values = values.ravel()
    bad = np.flatnonzero(~np.isfinite(values))
    if bad.size:
        what = f"{column} is not finite in {bad.size} of {n} rows, first in row {bad[0] + 1}"
        return Failure("nan", what, printed)
    return values


def tail(printed: str) -> str:
    """Return the end of what a run printed, without control characters."""
    end = printed if len(printed) <= _TAIL else "..." + printed[-_TAIL:]
    return "".join(c if c.isprintable() or c in "\n\t" else "\ufffd" for c in end)
