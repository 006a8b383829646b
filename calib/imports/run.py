"""Apply a mapping to a file: columns in the units asked for, cropped, and independent rows."""

from __future__ import annotations

import os
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from os import PathLike
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from calib.arguments import takes
from calib.data.files import plain_number
from calib.data.quantities import OUTPUTS, UNITS, convert
from calib.data.reader import table_from_arrays
from calib.data.table import Column, Table, parse_header
from calib.errors import CalibError, meant
from calib.imports.independence import Array, autocorrelation_time, rows_apart
from calib.imports.mapping import DERIVED, INPUTS, Bin, Mapped, Source, read_mapping, to_unit
from calib.imports.tables import RawTable, read_raw
from calib.shown import Shown

if TYPE_CHECKING:
    from pandas import DataFrame, Series


@dataclass(frozen=True)
class Report:
    """What became of a file's columns and rows.

    Parameters
    ----------
    source, sha256 : str
        The file, and the hash of its bytes.
    notes : tuple of str
        How it was read.
    doubts : tuple of str
        What the file contradicts in the mapping.
    columns : mapping of str to str
        By column that is written the columns of the file that it is made of.
    unused : tuple of str
        Columns of the file that are used for nothing.
    rows_read : int
        Rows of the file, repeats side by side counted as rows.
    rows_without_value, rows_cropped : int
        Left out, for a condition or every output is missing, or by ``[crop]``.
    runs : int
        Continuous runs: rows with the same text in all columns of text, such as `run`.
    autocorrelation_times : mapping of str to float
        By output, in rows, before bins or thinning; NaN where the rows are too few to tell.
    worth : int or None
        How many independent rows the rows that are left are worth; None if that is not known.
    reduced_by : str
        "bins", "thinning" or nothing.
    every : int
        One of how many rows is written, or how many rows the median bin holds.
    rows_written : int
    """

    source: str
    sha256: str
    notes: tuple[str, ...]
    doubts: tuple[str, ...]
    columns: Mapping[str, str]
    unused: tuple[str, ...]
    rows_read: int
    rows_without_value: int
    rows_cropped: int
    runs: int
    autocorrelation_times: Mapping[str, float]
    worth: int | None
    reduced_by: str
    every: int
    rows_written: int

    @property
    def apart(self) -> int:
        """How far apart rows must be to count as independent."""
        return rows_apart(self.autocorrelation_times)

    @property
    def warning(self) -> str:
        """What is doubtful, and what to do if rows are not independent; empty if all is well."""
        return "; ".join([*self.doubts, *self._dependent()])

    def _dependent(self) -> Iterator[str]:
        if self.apart <= self.every:
            return
        done = {"bins": f"means of {self.every} are", "thinning": f"one of {self.every} is"}
        yield (
            f"neighbouring rows are alike: independent ones are {self.apart} apart, and "
            f'{done.get(self.reduced_by, "all are")} written: thin (every = "auto" in [thin]), use '
            "wider bins, or write correlated_along in the prior file"
        )

    def lines(self) -> Iterator[str]:
        """Say it in lines."""
        yield f"{self.source}: {self.rows_read} rows"
        yield from (f"  {note}" for note in self.notes)
        yield from (f"  {name} from {of}" for name, of in self.columns.items())
        yield from (f"  not used: {', '.join(names)}" for names in [self.unused] if names)
        left_out = {
            "without a condition or any output": self.rows_without_value,
            "cropped": self.rows_cropped,
        }
        yield from (f"  left out, {why}: {n} rows" for why, n in left_out.items() if n)
        for name, time in self.autocorrelation_times.items():
            if time == time:
                yield f"  autocorrelation time of {name}: at least {plain_number(time)} rows"
        if self.worth is not None:
            yield f"  worth at most {self.worth} independent rows"
        how = {
            "bins": f", means of {self.every} (the median); predictions are of such means too",
            "thinning": f", one in {self.every}, numbered in run_order",
        }
        yield f"  {self.rows_written} rows written{how.get(self.reduced_by, '')}"


@dataclass(frozen=True, eq=False)
class Imported(Shown):
    """A file that was read by a mapping: its table, and how it came about.

    Parameters
    ----------
    table : Table
        What models take.
    report : Report
        What became of columns and rows.
    columns : mapping of str to ndarray, shape (n,)
        What is written, in the units asked for; text too.
    before : mapping of str to ndarray, shape (m,)
        The same for all rows that have values, before they were cropped, binned or thinned.
    kept : ndarray of bool, shape (m,)
        Which of these are not cropped.
    lines : ndarray of int, shape (m,)
        Where they stand in the file.
    """

    table: Table
    report: Report
    columns: Mapping[str, NDArray[Any]]
    before: Mapping[str, NDArray[Any]]
    kept: NDArray[np.bool_]
    lines: NDArray[np.int64]


@takes(path=PathLike, mapping=(PathLike, Mapping))
def read_log(
    path: str | os.PathLike[str], mapping: str | os.PathLike[str] | Mapping[str, Any]
) -> Imported:
    r"""Read a file as a rig wrote it: a CSV with other lines above, a workbook, .mat or Parquet.

    Parameters
    ----------
    path : path-like
    mapping : path-like or mapping
        A TOML file that says which column is what, or what it would hold; `suggest_mapping` writes
        one to start from.

    Returns
    -------
    Imported
        Its `table` goes wherever a table goes, its `report` says what became of the rows.

    Raises
    ------
    CalibError
        Naming file, line and column, or the place in the mapping.

    Examples
    --------
    >>> import calib
    >>> from pathlib import Path
    >>> text = "rig 7\nSlip;Fx;Fz\n%;N;N\n5,0;410;-3000\n20,0;930;-3010\n"
    >>> _ = Path("rig7.txt").write_text(text)
    >>> columns = {"slip_percent": {"from": "Slip"}, "drawbar_pull_kn": {"from": "Fx"}}
    >>> log = calib.read_log("rig7.txt", {"columns": columns})
    >>> log.table["drawbar_pull_kn"].tolist(), log.report.rows_written
    ([0.41, 0.93], 2)
    """
    mapped, where = read_mapping(mapping)
    return apply(read_raw(path, mapped.sheet), mapped, where)


def apply(raw: RawTable, mapped: Mapped, where: str = "mapping") -> Imported:
    """Return what a mapping makes of a file; a CalibError as `read_log`."""
    import pandas as pd

    read = _Read(raw, mapped, where)
    whole = pd.DataFrame(read.columns)
    quantities = {n: c.quantity for n, c in read.targets.items() if c is not None}
    text = [n for n in whole if whole[n].dtype.kind == "O"]
    outputs = [n for n, q in quantities.items() if q.role == "output"]
    conditions = [n for n, q in quantities.items() if q.role == "condition"]
    there = whole.drop(columns=outputs).notna().all(axis=1)
    there &= whole[outputs].notna().any(axis=1) if outputs else True
    inside = read.inside()
    if not (there & inside).any():
        raise CalibError(
            f"no row is left of {len(whole)}: {int((~there).sum())} lack a value, and "
            f"{int((there & ~inside).sum())} are cropped",
            where=raw.source,
            expected="rows with a value of every condition and of an output, inside of [crop]",
            hint="correct the columns or [crop] in the mapping",
        )
    rows = whole[there & inside].set_index(pd.Index(read.lines[there & inside], name="line"))
    table = _table(rows, raw)
    runs = rows.groupby(text, sort=False).ngroup() if text else pd.Series(0, index=rows.index)
    times: dict[str, float] = {}
    for name in outputs:
        ok = rows[name].notna()
        settings = [rows.loc[ok.to_numpy(), c].to_numpy() for c in conditions]
        times[name] = autocorrelation_time(
            rows[name][ok.to_numpy()].to_numpy(), settings, runs[ok.to_numpy()].to_numpy()
        )
    every, written, by = 1, rows, "bins" if mapped.bins else "thinning" if mapped.thin else ""
    if mapped.bins:
        counted = [n for n, q in quantities.items() if q.kind == "number"]
        written, every = _binned(rows, mapped.bins, runs, [*text, *counted])
        table = _table(written, raw)
    elif mapped.thin:
        every = rows_apart(times) if mapped.thin.every == "auto" else mapped.thin.every
        left = (runs.groupby(runs.to_numpy()).cumcount() % every == 0).to_numpy()
        written = rows[left]
        if "run_order" not in rows:
            # One continuous run is thinned: its rows come as they were measured.
            written = written.assign(run_order=np.arange(1, len(written) + 1))
        table = _table(written, raw)
    longest = max((t for t in times.values() if t == t), default=None)
    report = Report(
        raw.source, raw.sha256, tuple(raw.notes), tuple(read.doubts), read.words,
        tuple(str(n) for n in raw.frame if n not in read.used), len(whole),
        int((~there).sum()), int((there & ~inside).sum()), int(runs.nunique()), times,
        None if longest is None else round(len(rows) / longest), by, every, len(written),
    )  # fmt: skip
    columns, before = (
        {str(n): frame[n].to_numpy() for n in frame} for frame in (written, whole[there])
    )
    return Imported(table, report, columns, before, inside[there], read.lines[there])


def _table(rows: DataFrame, raw: RawTable) -> Table:
    """Return the table of rows by their lines, checked as a file's; faults may be cropped too."""
    arrays = {str(name): rows[name].to_numpy() for name in rows}
    outputs, place = tuple(OUTPUTS.values()), str(raw.frame.index.name)
    try:
        table = table_from_arrays(
            arrays, source=raw.source, allow_missing=outputs, lines=rows.index, place=place
        )
    except CalibError as error:
        hint = f"{error.hint}; rows that are no measurements can be left out by [crop]"
        found, where, expected = error.message, error.where, error.expected
        raise CalibError(found, where=where, expected=expected, hint=hint) from None
    return replace(table, sha256=raw.sha256)


def _binned(
    rows: DataFrame, bins: Mapping[str, Bin], runs: Series, counted: list[str]
) -> tuple[DataFrame, int]:
    """Return the means of the rows of a run in each bin, in order, and the median of their number.

    Of what is counted or text the first is taken.
    """
    cells = [runs.to_numpy()]
    for name, one in bins.items():
        values = rows[name].to_numpy()
        low, width = 0.0, one.width
        if width is None:
            low, width = values.min(), np.ptp(values) / (one.count or 1) or 1.0
        cell = np.floor((values - low) / width)
        cells.append(cell if one.count is None else np.minimum(cell, one.count - 1))
    groups = rows.reset_index().groupby(cells, sort=False)
    how = {name: "first" if name in counted else "mean" for name in rows}
    found = groups.agg({"line": "first", **how}).sort_values("line", kind="stable")
    return found.set_index("line"), round(float(groups.size().median()))


class _Read:
    """The columns that a mapping names, of all rows: repeats side by side below one another."""

    def __init__(self, raw: RawTable, mapped: Mapped, where: str) -> None:
        self.raw, self.mapped, self.where = raw, mapped, where
        self.repeats = max(map(_repeats, mapped.columns.values()))
        lines = np.tile(raw.frame.index.to_numpy(np.int64), self.repeats)
        self.order = np.argsort(lines, kind="stable")
        self.lines = lines[self.order]
        self.targets: dict[str, Column | None] = {}
        self.columns: dict[str, NDArray[Any]] = {}
        self.words: dict[str, str] = {}
        self.used: set[str] = set()
        self.doubts: list[str] = []
        for name, source in mapped.columns.items():
            try:
                self.targets[name] = target = parse_header(name)
                if source.derive == "kappa" and not (target is None or target.kappa):
                    raise CalibError(
                        "kappa is the slip ωr/v - 1, and this column another",
                        expected="slip_kappa_ratio or slip_kappa_percent",
                        hint='rename the column, or write derive = "slip"',
                    )  # fmt: skip
                self.columns[name] = self._column(source, self.targets[name])[self.order]
            except CalibError as error:
                raise error.within(f"{where}, columns.{name}") from None
            of = ", ".join(_names(source)) or str(source.value)
            self.words[name] = f"{source.derive} of {of}" if source.derive else of
            self.used.update(_names(source))
        if self.repeats > 1 and "repeat" not in self.columns:
            numbers = np.repeat(np.arange(1, self.repeats + 1).astype(str), len(raw.frame))
            self.columns["repeat"] = numbers.astype(object)[self.order]
            self.targets["repeat"] = parse_header("repeat")

    def inside(self) -> NDArray[np.bool_]:
        """Return which rows lie inside of all ranges of ``[crop]``."""
        found = np.ones(len(self.lines), dtype=np.bool_)
        for name, (low, high) in self.mapped.crop.items():
            values = self.columns.get(name)
            if values is None or values.dtype.kind == "O":
                try:
                    values = self._cells(Source(**{"from": name}), numbers=True)[self.order]
                except CalibError as error:
                    raise error.within(f"{self.where}, crop") from None
            found &= (low <= values) & (values <= high)
        return found

    def _column(self, source: Source, column: Column | None) -> NDArray[Any]:
        if column is not None and column.quantity.kind != "label":
            units, bare = column.quantity.units, column.quantity.bare_unit or ""
            return self._numbers(source, units, column.unit, bare)
        if source.derive is not None:
            return self._numbers(source, {}, DERIVED[source.derive][1])
        cells = self._cells(source)
        if column is None and cells.dtype.kind in "fiu":
            return cells * source.factor
        text = [v if v != v or v is None else _plain(v) for v in cells.tolist()]
        return np.array(text, dtype=object)

    def _numbers(
        self, source: Source, known: Mapping[str, str], wanted: str, bare: str = ""
    ) -> Array:
        """Return numbers in a unit of pint's; `bare` is that of what names none."""
        if source.derive is not None:
            function, given = DERIVED[source.derive]
            inputs = {
                name: self._numbers(one, UNITS.get(INPUTS[name][0], {}), INPUTS[name][1])
                for name, one in source.inputs.items()
            }
            with np.errstate(divide="ignore", invalid="ignore"):
                return convert(source.factor * function(**inputs), given, wanted)
        values = source.factor * self._cells(source, numbers=True)
        names = _names(source)
        unit = source.unit or next((self.raw.units[n] for n in names if n in self.raw.units), "")
        own = self.raw.units.get(names[0], "") if source.unit and names else ""
        if own and not _same_size(source.unit, own, known, wanted):
            self.doubts.append(
                f"{names[0]} is read in {source.unit}, as the mapping says; the file says {own}"
            )
        if unit or bare:
            return to_unit(values, unit, known, wanted) if unit else convert(values, bare, wanted)
        raise CalibError(
            f"neither the mapping nor the file says the unit of {names or source.value}",
            expected=f"a unit such as {', '.join(known) or wanted}",
            hint='write it in the mapping: unit = "…"',
        )

    def _cells(self, source: Source, *, numbers: bool = False) -> NDArray[Any]:
        """Return the cells of columns or a constant, one repeat below another."""
        import pandas as pd

        frame, names = self.raw.frame, _names(source)
        for name in names:
            if name not in frame:
                there = [str(n) for n in frame]
                found = f"the file has no column {name!r}"
                raise CalibError(found, expected=", ".join(there), hint=meant(name, there))
            if numbers and frame[name].dtype.kind not in "fiub":
                cells = pd.to_numeric(frame[name], errors="coerce")
                if (bad := cells.isna() & frame[name].notna()).any():
                    place = f"{self.raw.source}, {bad.index.name} {bad.idxmax()}"
                    raise CalibError(
                        f"{frame[name][bad].iloc[0]!r} is not a number",
                        where=f"{place}, column {name!r}",
                        expected="numbers, and empty cells where there are none",
                        hint="correct the cell, or map another column",
                    )
        if numbers and isinstance(source.value, str):
            found, hint = f"the constant {source.value!r} is not a number", "write one"
            raise CalibError(found, expected="a number, without quotes", hint=hint)
        if len(names) not in (0, 1, self.repeats):
            raise CalibError(
                f"{len(names)} columns stand side by side here, and {self.repeats} elsewhere",
                expected="one column, or as many as there are repeats",
                hint="name the column of every repeat",
            )
        parts = [frame[n] for n in names] or [pd.Series([source.value] * len(frame))]
        cells = pd.concat(parts * (self.repeats // len(parts)), ignore_index=True)
        return np.asarray(pd.to_numeric(cells), dtype=np.float64) if numbers else cells.to_numpy()


def _same_size(unit: str, other: str, known: Mapping[str, str], wanted: str) -> bool:
    """Whether two spellings are of units of one size and dimension."""
    try:
        one, two = (float(to_unit(np.ones(1), u, known, wanted)[0]) for u in (unit, other))
    except CalibError:
        return False
    return bool(np.isclose(one, two, rtol=1e-9))


def _plain(value: object) -> str:
    """Write a label: a whole number without a point."""
    return str(int(value)) if isinstance(value, float) and value.is_integer() else str(value)


def _names(source: Source) -> list[str]:
    """Return the columns that a source takes, or those of its inputs."""
    named = [source.from_] if isinstance(source.from_, str) else source.from_ or []
    return [*named, *(name for one in source.inputs.values() for name in _names(one))]


def _repeats(source: Source) -> int:
    named = [1 if isinstance(source.from_, str) else len(source.from_ or [1])]
    return max([*named, *map(_repeats, source.inputs.values())])
