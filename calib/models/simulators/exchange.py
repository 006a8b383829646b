"""What is written for a command to read, and read of what it has written."""

from __future__ import annotations

import csv
import io
import json
import re
from collections.abc import Mapping, Sequence
from contextlib import suppress
from typing import Any

from calib.data.values import real_array
from calib.errors import CalibError
from calib.models.base import Array
from calib.models.simulators.base import Failure, Given

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
