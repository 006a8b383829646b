"""What is written for a command to read, and read of what it has written."""

from __future__ import annotations

import csv
import io
import json
import re
from collections.abc import Mapping
from typing import Any

import numpy as np

from calib.errors import CalibError
from calib.models.base import Array
from calib.models.simulators.base import Failure, Result

_MARK = re.compile(r"@([^\W\d]\w*)@")


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


def output_of_text(text: str, how: str, patterns: Mapping[str, str]) -> Result:
    """Read outputs: of JSON an object of lists or numbers, of CSV a column each.

    A pattern is a regular expression whose first group is the number, found once for each row.
    """
    try:
        match how:
            case "json":
                return _numbers(json.loads(text))
            case "csv":
                return _table(text)
            case _:
                found = {name: re.findall(p, text, re.M) for name, p in patterns.items()}
                return _numbers(found)
    except (ValueError, TypeError, KeyError) as error:
        return Failure("unreadable", f"its output is not the {how} asked for: {error}")


def _numbers(found: Any) -> dict[str, Array]:
    if not isinstance(found, dict):
        raise TypeError("not an object of outputs by name")
    lists = {k: v if isinstance(v, list) else [v] for k, v in found.items()}
    return {
        k: np.array([np.nan if x is None else float(x) for x in v])
        for k, v in lists.items()
        if not any(isinstance(x, (dict, list)) for x in v)
    }


def _table(text: str) -> dict[str, Array]:
    rows = [row for row in csv.reader(io.StringIO(text)) if row]
    if not rows:
        raise ValueError("it is empty")
    names, *values = [[cell.strip() for cell in row] for row in rows]
    if any(len(row) != len(names) for row in values):
        raise ValueError("its rows have different numbers of cells")
    found = {}
    for name, *column in zip(names, *values, strict=True):
        try:
            found[name] = np.array([float(cell) for cell in column])
        except ValueError:
            continue  # a label, not an output
    return found
