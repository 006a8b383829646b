"""When a simulator is refused because its runs have no value, and what is said then.

What is written for a command to read, and read of what it has written.
"""

from __future__ import annotations

import csv
import io
import json
import re
from collections.abc import Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np

from calib.data.files import plain_number
from calib.data.table import real_array
from calib.errors import CalibError
from calib.models.base import Array
from calib.models.simulators.base import Failure, Given, Kind, Simulator
from calib.models.simulators.runs import Run

# Of a simulator with values in half of its prior, so many runs fail all of them once in 32 times at
# most, and less often as they are spread evenly. A mistake in its file or program fails in every
# run, and need not be paid for sixty times, or for every draw of a sampler.
FIRST = 5
FROM_THE_START = "it fails from the start, and no more runs were made"
_MEND: dict[Kind, str] = {
    "time": "give it more time (limit)",
    "exit": "correct the simulator where it fails: each run is made in a new folder (calib-run-... "
    "among the temporary files), and finds its own files where the variable CALIB_SIMULATOR says",
    "short": "have it give a number for each row, or ask for one row at a time (rows)",
    "unreadable": "have it give what [outputs] names, as output and patterns say, or correct these",
}


def fail_alike(runs: Sequence[Run]) -> bool:
    """Whether all runs have failed, and in the same way."""
    kinds = {None if run.failure is None else run.failure.kind for run in runs}
    return len(kinds) == 1 and None not in kinds


def without_value(
    why: str, simulator: Simulator, runs: Sequence[Run], folder: Path | None
) -> CalibError:
    """Return what to say where runs that failed are in the way; the folder is that of the runs."""
    failures = [run.failure for run in runs if run.failure is not None]
    if not failures:
        return CalibError(
            f"{why}, although every run has a value", where=simulator.place(),
            mend="check that the data's units and the priors' scales fit each other",
        )  # fmt: skip
    first, names = failures[0], simulator.parameters
    ok = np.array([run.ok for run in runs])
    theta = np.stack([run.theta for run in runs])
    at = f", at {_ranges(names, theta[~ok])}"
    at += f"; those with a value are at {_ranges(names, theta[ok])}" if ok.any() else ""
    kept = "" if folder is None else (
        f"; the runs, failed ones too, are kept in {folder}: delete it after a mend outside "
        "the files that the simulator's own names"
    )  # fmt: skip
    printed = f"; it printed: {first.printed.strip()}" if first.printed.strip() else ""
    mend = _MEND.get(first.kind, "correct the simulator where it fails")
    mend += "; or give priors that do not reach there" if ok.any() else ""
    some = f"only {ok.sum()} of the {ok.size} runs have"
    have = some if ok.any() else f"none of the {ok.size} runs has"
    return CalibError(
        f"{why}: {have} a value ({first.kind}: {first.reason}{printed}){at}",
        where=simulator.place(first.kind),
        allowed="a simulator with values in at least half of its prior, and where the data are",
        mend=f"{mend}{kept}",
    )


def _ranges(names: Sequence[str], theta: Array) -> str:
    low, high = theta.min(axis=0), theta.max(axis=0)
    return ", ".join(
        f"{n} {plain_number(a, 4)} to {plain_number(b, 4)}"
        for n, a, b in zip(names, low, high, strict=True)
    )  # fmt: skip


_MARK = re.compile(r"@([^\W\d]\w*)@")
# What follows a number that was cut off: a decimal comma, more digits, an exponent.
_GOES_ON = re.compile(r"[.,]?\d+|[eEdD][-+]?\d+", re.ASCII)


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
    marks = set(_MARK.findall(template))
    missing = [name for name in names if name not in marks]
    unknown = sorted(marks - set(names))
    if missing or unknown:
        what = [f"no place for {', '.join(missing)}"] * bool(missing)
        what += [f"unknown {', '.join(f'@{name}@' for name in unknown)}"] * bool(unknown)
        raise CalibError(
            f"the template has {'; '.join(what)}", where=where,
            allowed=", ".join(f"@{name}@" for name in names),
            mend="write each of these marks where its value belongs, and no other",
        )  # fmt: skip


def filled(template: str, parameters: Mapping[str, float], conditions: Mapping[str, Array]) -> str:
    """Put values in the place of a template's marks, those of a condition apart by spaces."""
    values = {name: repr(value) for name, value in parameters.items()}
    values |= {name: " ".join(map(repr, v.tolist())) for name, v in conditions.items()}
    return _MARK.sub(lambda mark: values[mark[1]], template)


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
    for one in found:
        more = _GOES_ON.match(text, one.end(group))
        if more and starts.isdisjoint(range(one.end(group), more.end() + 1)):
            raise ValueError(f"{one[group]!r} is the beginning of {one[group] + more[0]!r} only")
    return real_array([one[group] for one in found])
