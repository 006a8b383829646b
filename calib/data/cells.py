"""From the cells of a column to checked numbers, with every complaint at its line and column.

Whole columns are converted at once; only when that fails, or a value lies outside its range,
are single cells looked at, to say what is wrong with them.
"""

from __future__ import annotations

import math
import re
from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from calib.data.headers import CHECKED, Column
from calib.errors import CalibError

type Array = NDArray[np.float64]
type Lines = Sequence[int] | NDArray[np.int64]

MAX_SHOWN = 5
_MISSING = frozenset({"", "nan", "na", "n/a", "null", "none"})
# Squares and cubes of larger numbers leave the range of double precision.
_LARGEST = 1e100
_THOUSANDS = re.compile(r"[-+]?[1-9]\d{0,2},\d{3}")
_MINUS = "\N{MINUS SIGN}"
# What instruments and databases write where there is no value; of the positive ones from 9999 on.
_NINES = [10.0**d - 1.0 + more for d in range(2, 7) for more in (0.0, 0.9, 0.99)]
_CODES = np.array([
    *(-x for x in _NINES), *(x for x in _NINES if x >= 9999.0), -999.25, -32768.0,
])  # fmt: skip
# The driven wheel's slip of SAE J670 has no upper bound.
_OTHER_SLIP = (
    "slip is s = 1 - v/(ωr) here, at most 1: if it was recorded as κ = ωr/v - 1, convert every "
    "row, s = κ/(1 + κ)"
)


@dataclass(frozen=True, order=True)
class _Problem:
    line: int
    column: str
    found: str
    expected: str
    hint: str


@dataclass
class Problems:
    """What is wrong with a table, collected to be told at once.

    The source is a file, or the label of arrays; its rows are counted in ``"line"`` or ``"row"``.
    """

    source: str
    place: str = "line"
    total: int = 0
    _kept: dict[str, list[_Problem]] = field(default_factory=dict)

    def add(self, line: int, column: str, found: str, expected: str, hint: str) -> None:
        """Note a problem; the first few of each column are kept, the rest counted."""
        self.total += 1
        kept = self._kept.setdefault(column, [])
        if len(kept) < MAX_SHOWN:
            kept.append(_Problem(line, column, found, expected, hint))

    def raise_any(self) -> None:
        """Raise what was noted, up to five problems in the order of the lines, if anything."""
        if not self.total:
            return
        shown = sorted(p for kept in self._kept.values() for p in kept)[:MAX_SHOWN]
        if self.total == 1:
            only = shown[0]
            raise CalibError(
                only.found,
                where=f"{self.source}, {self._at(only)}",
                expected=only.expected,
                hint=only.hint,
            )
        rows = [f"  {self._at(p)}: {p.found}; expected: {p.expected}" for p in shown]
        if self.total > len(shown):
            rows.append(f"  and {self.total - len(shown)} more")
        raise CalibError(
            "\n".join([f"{self.total} problems in the data", *rows]),
            where=self.source,
            hint="".join(f"\n    - {hint}" for hint in dict.fromkeys(p.hint for p in shown)),
        )

    def _at(self, problem: _Problem) -> str:
        column = f", column {problem.column!r}" if problem.column else ""
        return f"{self.place} {problem.line}{column}"


@dataclass
class Decimals:
    """The first decimal comma and the first decimal point of a file, as (line, column, cell).

    A file that has both could mean 1,234 either way, so it is refused; so is one whose commas are
    all such that they may separate thousands.
    """

    comma: tuple[int, str, str] | None = None
    point: tuple[int, str, str] | None = None
    certain: bool = False

    def complain(self, problems: Problems) -> None:
        """Note a problem if the file has both, or commas that can be either."""
        if self.comma and self.point:
            line, column, cell = self.comma
            other = f"{self.point[2]!r} in line {self.point[0]}, column {self.point[1]!r}"
            problems.add(
                line, column, f"{cell!r} has a decimal comma, but {other} has a decimal point",
                "one decimal sign in the whole file",
                "write every number with a decimal point, without thousands separators",
            )  # fmt: skip
        elif self.comma and not self.certain:
            line, column, cell = self.comma
            problems.add(
                line, column, f"{cell!r} may be {cell.replace(',', '')} or "
                f"{cell.replace(',', '.')}, and no comma of the file tells which",
                "numbers of one reading",
                "write every number with a decimal point, without thousands separators",
            )  # fmt: skip


@dataclass
class CellReader:
    """Read batches of cells of one numeric column.

    Parameters
    ----------
    problems : Problems
        Where complaints go.
    missing_ok : bool
        Whether empty and NaN cells become NaN instead of complaints.
    used : bool
        Whether the column will be used, which a logarithmic output must be fit for.
    decimals : Decimals or None
        None where a comma separates the cells and so cannot be a decimal sign.
    """

    column: Column
    problems: Problems
    missing_ok: bool
    used: bool
    decimals: Decimals | None

    def read(self, cells: Sequence[str], lines: Lines) -> Array:
        """Return the values of cells in the canonical unit, shape (n,)."""
        joined = "".join(cells)
        self._note_point(joined, cells, lines)
        unreadable: set[int] = set()
        try:
            # float() takes 1_000 for a number, a reader of the file would not.
            if "_" in joined:
                raise ValueError
            values = np.fromiter(map(float, cells), dtype=np.float64, count=len(cells))
        except ValueError:
            values = self._read_one_by_one(cells, lines, unreadable)
        return check_values(
            self.column, values, lines, self.problems,
            missing_ok=self.missing_ok, used=self.used, cells=cells, skip=unreadable,
        )  # fmt: skip

    def _note_point(self, joined: str, cells: Sequence[str], lines: Lines) -> None:
        if self.decimals and self.decimals.point is None and "." in joined:
            i = next(i for i, cell in enumerate(cells) if "." in cell)
            self.decimals.point = (int(lines[i]), self.column.header, cells[i])

    def _read_one_by_one(self, cells: Sequence[str], lines: Lines, unreadable: set[int]) -> Array:
        values = np.full(len(cells), np.nan)
        for i, cell in enumerate(cells):
            try:
                values[i] = self._parse(cell, int(lines[i]))
            except ValueError as error:
                unreadable.add(i)
                found, hint = error.args
                name = self.column.header
                self.problems.add(int(lines[i]), name, found, self.column.expected, hint)
        return values

    def _parse(self, cell: str, line: int) -> float:
        text = cell.strip().replace(_MINUS, "-")
        if text.lower() in _MISSING:
            return math.nan
        if "," in text:
            if self.decimals is None or text.count(",") > 1 or "." in text:
                raise ValueError(
                    f"{cell!r} has a comma inside a number",
                    "write numbers with a decimal point and no thousands separators, such as "
                    "1234 or 0.5 (decimal commas are read where semicolons separate the cells)",
                )
            self.decimals.comma = self.decimals.comma or (line, self.column.header, cell)
            self.decimals.certain |= _THOUSANDS.fullmatch(text) is None
            text = text.replace(",", ".")
        try:
            if "_" in text:
                raise ValueError
            return float(text)
        except ValueError:
            raise ValueError(
                f"{cell!r} is not a number",
                "write one plain number, such as 0.05; the unit belongs in the column name",
            ) from None


def check_values(
    column: Column, values: Array, lines: Lines, problems: Problems, *,
    missing_ok: bool, used: bool, cells: Sequence[str] = (), skip: set[int] | None = None,
) -> Array:  # fmt: skip
    """Convert values (n,) to the canonical unit and note those that are not expected.

    Parameters
    ----------
    lines : sequence of int, shape (n,)
        Where the values are.
    missing_ok : bool
        Whether NaN is expected.
    used : bool
        Whether a logarithmic output must be positive.
    cells : sequence of str
        The values as written, for messages.
    skip : set of int, optional
        Positions already complained about.
    """
    with np.errstate(over="ignore"):
        canonical = column.to_canonical(values)
    fine = np.abs(canonical) <= _LARGEST
    if used or not column.quantity.log_scale:
        fine &= column.quantity.range.holds(canonical)
    if missing_ok:
        fine |= np.isnan(canonical)
    fine[list(skip or ())] = True
    bad = np.flatnonzero(~fine)
    for i in bad[:MAX_SHOWN].tolist():
        cell = cells[i] if len(cells) else f"{values[i]:g}"
        found, hint = _complaint(column, float(values[i]), cell, values)
        problems.add(int(lines[i]), column.header, found, column.expected, hint)
    problems.total += max(0, bad.size - MAX_SHOWN)
    return canonical


def check_codes(
    column: Column, canonical: Array, lines: Lines, problems: Problems, *, missing_ok: bool
) -> None:
    """Note codes for missing values, -999 and the like, among values (n,) that can be readings.

    A code is taken for a reading if it is no farther from the other values than these are from one
    another, or if the header says that its values were checked.
    """
    written = column.written(canonical)
    there = np.isfinite(written)
    coded = there & _is_code(written)
    if column.checked or column.quantity.role == "bookkeeping" or not coded.any():
        return
    others = written[there & ~coded]
    low, high = (float(f(others)) for f in (np.min, np.max)) if others.size else (np.inf, -np.inf)
    apart = np.maximum(low - written, written - high) > max(high - low, 0.0)
    among = f", where the others are {low:g} to {high:g}" if others.size else ""
    # Those that cannot be readings have been noted.
    possible = column.quantity.range.holds(canonical)
    for i in np.flatnonzero(coded & apart & possible).tolist():
        problems.add(
            int(lines[i]), column.header,
            f"{written[i]:g} looks like a code for a missing value{among}",
            "an empty cell" if missing_ok else "a measured value", _mend_code(column, missing_ok),
        )  # fmt: skip


def _is_code(written: Array) -> NDArray[np.bool_]:
    # Rounded, for a conversion of units there and back may cost the last bit.
    return np.isin(np.round(written, 6), _CODES)


def _mend_code(column: Column, missing_ok: bool) -> str:
    """Say what to do about a code for a missing value."""
    cell = "leave the cell empty" if missing_ok else "delete the row"
    return f"{cell}; if it is a reading, say so in the column name: '{column.header} {CHECKED}'"


def _complaint(column: Column, value: float, cell: str, values: Array) -> tuple[str, str]:
    """Say what is wrong with a value, one of a column's, and how to fix it."""
    if not math.isfinite(value):
        what = f"{cell.strip()!r} is not a finite number" if cell.strip() else "an empty cell"
        return (
            what,
            "fill in the measured value, or delete the row (the column, if all of it is empty)",
        )
    quantity = column.quantity
    if _is_code(np.array(value)):
        what = f"{cell.strip()!r} is outside the range of {quantity.stem}"
        return what, "if it stands for a missing value, delete the row or leave the cell empty"
    if abs(value) > _LARGEST:
        return f"{cell.strip()!r} is too large for a reading", quantity.hint
    what = f"{cell.strip()!r} is outside the range of {quantity.stem}"
    hint = quantity.hint
    if quantity.kind == "slip" and value > 0.0:
        hint = _OTHER_SLIP
    if "percent" in quantity.units and column.unit == "dimensionless" and abs(value) <= 100.0:
        # Renamed for the sake of a few, the others would be a hundredth of what they are.
        name = f"{quantity.stem}_percent"
        if float(np.nanmedian(np.abs(values))) > 1.0:
            hint = f"did you mean {name}? Then rename the column; otherwise: {hint}"
        else:
            hint += f"; or if all values are percent, rename the column {name}"
    return what, hint


def label_codes(
    column: Column, cells: Sequence[str], lines: Lines, problems: Problems, *, missing_ok: bool
) -> Array:
    """Turn labels into numbers.

    Whole numbers stay as they are; otherwise the codes count the sorted labels from 0, so that
    the order of the rows does not matter. The codes of two tables are not comparable.
    """
    labels = [cell.strip() for cell in cells]
    empty = np.array([not label for label in labels], dtype=np.bool_)
    for i in [] if missing_ok else np.flatnonzero(empty).tolist():
        problems.add(
            int(lines[i]), column.header, "an empty cell", "any label", "fill in the label"
        )
    try:
        codes = np.array([float(label or 0) for label in labels], dtype=np.float64)
    except ValueError:
        codes = np.full(len(labels), np.nan)
    if not (np.isfinite(codes) & (codes == np.round(codes))).all():
        codes = np.unique(labels, return_inverse=True)[1].astype(np.float64)
    codes[empty] = np.nan
    return codes
