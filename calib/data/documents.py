"""What is wrong in files that are checked against a schema, or hold columns of numbers."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from pydantic import ValidationError

from calib.data.files import number_in, open_csv
from calib.errors import CalibError, in_words, several


def invalid(error: ValidationError, where: str) -> list[CalibError]:
    """Return what is wrong in a file, each with its place in it."""
    places = (".".join(map(str, e["loc"])) for e in error.errors())
    return [
        CalibError(in_words(e), where=f"{where}, {place}" if place else where)
        for e, place in zip(error.errors(), places, strict=True)
    ]


def read_numbers(
    path: Path, wanted: Sequence[str], rows: int | None, *, missing_ok: bool = False
) -> dict[str, NDArray[np.float64]]:
    """Return columns (rows,) of a CSV file; a CalibError has all faults: columns, rows, cells."""
    file = open_csv(path)
    faults = [
        CalibError(f"there is no column {name}", where=file.source)
        for name in wanted if name not in file.header and not missing_ok
    ]  # fmt: skip
    if rows is not None and len(file.rows) != rows:
        faults.append(CalibError(f"{len(file.rows)} rows, not {rows}", where=file.source))
    found: dict[str, NDArray[np.float64]] = {}
    for name in (name for name in wanted if name in file.header):
        j, values = file.header.index(name), []
        for line, cells in file.rows:
            try:
                values.append(number_in(cells[j], file.delimiter != ","))
            except (ValueError, IndexError):
                values.append(np.nan)
            if not np.isfinite(values[-1]):
                where = f"{file.source}, line {line}, column {name!r}"
                faults.append(CalibError("it is no finite number", where=where))
        found[name] = np.array(values)
    if faults:
        raise several(faults)
    return found
