"""Columns that a case declares besides the known quantities: numbers, and categories by name.

In ``case.toml``::

    [covariates]
    tyre_temperature_c = "number"
    operator = "category"             # or its values, ["A. Lind", "B. Berg"]

Each is a recorded condition that no simulator takes; a diagnosis asks whether the gap goes with it.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from calib.data import Table
from calib.data.headers import parse_header
from calib.data.table import MAX_TEXT_ROWS
from calib.errors import CalibError
from calib.models.base import Array

# What stands for the values of a column of numbers.
NUMBER: tuple[str, ...] = ()
_MOST_LEVELS = 12
_WHERE = "[covariates] of case.toml"


def declared_covariates(content: object, tables: tuple[Table, ...]) -> dict[str, tuple[str, ...]]:
    """Return the declared columns and the values of each category; none for numbers.

    Parameters
    ----------
    content : object
        Of the table ``[covariates]``.
    tables : tuple of Table
        In which every column must be.

    Raises
    ------
    CalibError
        If it declares what is known anyway, what is not there, or what is neither.
    """
    if not isinstance(content, dict):
        raise _error(f"it is {content!r}", "a table of names", 'write operator = "category"')
    found: dict[str, tuple[str, ...]] = {}
    for name, kind in content.items():
        if _is_known(name):
            raise _error(
                f"{name} is a quantity that is known",
                "columns of other names",
                "leave it out: a known condition is taken into account by itself",
            )
        given = kind if isinstance(kind, list) and all(isinstance(v, str) for v in kind) else None
        if kind not in ("number", "category") and not given:
            raise _error(
                f"{name} = {kind!r}",
                '"number", "category" or a list of its values',
                "say which it is",
            )
        if kind == "number":
            found[name] = NUMBER
            continue
        seen = sorted({cell for table in tables for cell in _column(table, name)} - {""})
        levels = tuple(dict.fromkeys(given or seen))
        if not 1 < len(levels) <= _MOST_LEVELS:
            raise _error(
                f"{name} has {len(levels)} different values",
                f"from 2 to {_MOST_LEVELS}",
                "group them, declare a number, or leave it out",
            )
        found[name] = levels
    return found


def with_declared(table: Table, covariates: Mapping[str, tuple[str, ...]]) -> Table:
    """Add declared columns to a table: numbers as they are, categories as their place in the list.

    Raises
    ------
    CalibError
        If one is not there, or holds something else.
    """
    if not covariates:
        return table
    added = {name: _codes(table, name, levels) for name, levels in covariates.items()}
    ignored = tuple(name for name in table.ignored if name not in covariates)
    return replace(table, columns={**table.columns, **added}, ignored=ignored)


def words_of(covariates: Mapping[str, tuple[str, ...]], name: str, low: float, high: float) -> str:
    """Say in its own words which values of a category lie between two places; empty for numbers."""
    return ", ".join(covariates.get(name, ())[int(round(low)) : int(round(high)) + 1])


def new_values(covariates: Mapping[str, tuple[str, ...]], lab: Table, field: Table) -> list[str]:
    """Say which values of categories the field has and the laboratory has not."""
    said = []
    for name, levels in covariates.items():
        if not levels:
            continue
        new = [levels[int(j)] for j in np.setdiff1d(field[name], lab[name])]
        if new:
            said.append(
                f"{name}: {', '.join(new)} in the field only; a constant difference of these rows "
                "cannot be separated from anything else that all of them share"
            )
    return said


def cells(
    columns: Mapping[str, Array], covariates: Mapping[str, tuple[str, ...]]
) -> dict[str, Array | list[str]]:
    """Return columns as they are to be written: categories by their names."""
    return {
        name: [covariates[name][int(code)] for code in values] if covariates.get(name) else values
        for name, values in columns.items()
    }


def _is_known(name: str) -> bool:
    try:
        return parse_header(name) is not None
    except CalibError:  # a quantity in an unknown unit
        return True


def _column(table: Table, name: str) -> list[str]:
    if name not in table.header:
        raise CalibError(
            f"there is no column {name!r}", where=table.source,
            expected="every column that the case declares in [covariates]",
            hint="add it; before a diagnosis it can be left out of case.toml as well",
        )  # fmt: skip
    if not table.text:
        raise _error(
            f"{table.source} has {len(table)} rows",
            f"{MAX_TEXT_ROWS} where columns are declared",
            "thin the rows",
        )
    j = table.header.index(name)
    return [row[j].strip() for row in table.text]


def _codes(table: Table, name: str, levels: tuple[str, ...]) -> Array:
    values = np.empty(len(table))
    for i, cell in enumerate(_column(table, name)):
        try:
            if not cell:
                raise ValueError
            values[i] = levels.index(cell) if levels else float(cell)
            if not np.isfinite(values[i]):
                raise ValueError
        except ValueError:
            raise CalibError(
                f"{name} is {cell!r}", where=f"{table.source}, line {table.lines[i]}",
                expected=", ".join(levels) or "a number, with a decimal point",
                hint="write one of these" if levels else "correct it, or delete the row",
            ) from None  # fmt: skip
    return values


def _error(found: str, allowed: str, hint: str) -> CalibError:
    return CalibError(found, where=_WHERE, expected=allowed, hint=hint)
