"""A table, and how its column names say which quantity they hold, and in which unit.

A column name is a quantity followed by a unit (``rut_depth_mm``). Upper and lower case, spaces
and brackets make no difference (``Rut depth [mm]``). Behind it may stand ``(checked)``: its values
are right, however unusual.
"""

from __future__ import annotations

import difflib
import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from functools import cached_property
from types import MappingProxyType

import numpy as np
from numpy.typing import ArrayLike, NDArray

from calib.data.files import plain_number
from calib.data.quantities import QUANTITIES, UNITS, Quantity, Range, convert
from calib.errors import CalibError, meant
from calib.shown import Shown

# A column such as drawbar_pull_sd or slip_angle_deg is about a quantity without being it.
_QUALIFIERS = frozenset({
    "sd", "std", "stdev", "se", "sem", "cv", "var", "variance", "err", "error", "uncertainty",
    "min", "max", "mean", "median", "count", "note", "notes", "comment", "comments", "flag",
    "id", "raw", "source", "before", "after", "lower", "upper", "angle", "setting", "target",
    "level", "class", "method", "sensor", "channel", "time", "date",
})  # fmt: skip

# What a user puts behind a header whose values are to be believed as they are.
CHECKED = "(checked)"
# In the header of a slip κ = ωr/v - 1, between its name and its unit.
KAPPA = "kappa"


@dataclass(frozen=True)
class Column:
    """A header that was understood: its quantity and the pint unit its values are in."""

    header: str
    quantity: Quantity
    unit: str
    position: int = 0

    @property
    def checked(self) -> bool:
        """Whether the user says that its values are right, however unusual."""
        return self.header.rstrip().lower().endswith(CHECKED)

    @property
    def kappa(self) -> bool:
        """Whether its values are slips κ = ωr/v - 1 and not s = 1 - v/(ωr)."""
        return self.quantity.kind == "slip" and KAPPA in normal(self.header).split("_")

    def to_canonical(self, values: ArrayLike) -> NDArray[np.float64]:
        """Convert values in this column's unit to the canonical unit, any shape."""
        found = convert(values, self.unit, self.quantity.unit)
        if not self.kappa:
            return found
        with np.errstate(divide="ignore", invalid="ignore"):  # a locked wheel has no s
            return np.asarray(found / (1.0 + found))

    def written(self, values: ArrayLike) -> NDArray[np.float64]:
        """Convert canonical values to this column's unit, any shape."""
        if self.kappa:
            with np.errstate(divide="ignore", invalid="ignore"):  # a wheel on the spot has no κ
                values = np.asarray(values, dtype=np.float64) / (1.0 - np.asarray(values))
        return convert(values, self.quantity.unit, self.unit)

    @property
    def unit_word(self) -> str:
        """The unit as messages say it; empty for a plain number."""
        return "" if self.unit == "dimensionless" else self.unit.replace("**", "")

    def words(self, *values: float) -> str:
        """Canonical values in this column's unit as messages say them, such as 18 to 42 psi."""
        said = " to ".join(plain_number(float(v), 4) for v in self.written(values))
        return f"{said} {self.unit_word}".rstrip()

    @property
    def expected(self) -> str:
        """The allowed values, in this column's unit."""
        allowed = self.quantity.range
        if self.kappa:
            low, high = self.written([allowed.low, allowed.high]).tolist()
            return Range(low, high).describe(self.unit, self.unit)
        return allowed.describe(self.quantity.unit, self.unit)


def accepted_headers(quantity: Quantity) -> tuple[str, ...]:
    """Return every header that names a quantity by its main stem, canonical first."""
    names = [quantity.canonical]
    names += [quantity.stem] if quantity.bare_unit else []
    names += [f"{quantity.stem}_{suffix}" for suffix in quantity.units]
    if quantity.kind == "slip":
        names += [f"{quantity.stem}_{KAPPA}_{suffix}" for suffix in ("ratio", "percent")]
    return tuple(dict.fromkeys(names))


def normal(header: str) -> str:
    """Bring a header to lower case words joined by underscores, without `CHECKED`."""
    text = header.lower().rstrip().removesuffix(CHECKED)
    text = text.replace("%", " percent ").replace("³", "3").replace("²", "2").replace("κ", KAPPA)
    return re.sub(r"[\s_\-/()\[\]{},.:·]+", "_", re.sub(r"\^|\*\*", "", text)).strip("_")


def parse_header(header: str, *, where: str = "", position: int = 0) -> Column | None:
    """Read the quantity and the unit off a column name.

    Parameters
    ----------
    header : str
        The column name, such as ``"Rut_Depth_cm"``.
    where : str
        File and line to name in errors.
    position : int
        Index of the column, kept in the result.

    Returns
    -------
    Column or None
        None for a column that names none of the quantities.

    Raises
    ------
    CalibError
        If a quantity is named without its unit, or with an unknown or an unfitting one.
    """
    name = normal(header)
    named = _named(name)
    if named is None:
        return None
    quantity, suffix = named
    if quantity.kind == "slip":
        suffix = suffix.removeprefix(KAPPA).removeprefix("_")
    unit = quantity.units.get(suffix) if suffix else quantity.bare_unit
    if unit is not None:
        return Column(header, quantity, unit, position)
    if suffix and _is_about(suffix, quantity) and not _is_repeat(suffix, quantity):
        return None
    raise _unit_error(header, quantity, suffix, where)


def names_quantity(header: str) -> bool:
    """Whether a column name begins with a quantity, whatever its unit."""
    return _named(normal(header)) is not None


def _named(name: str) -> tuple[Quantity, str] | None:
    """Return the quantity that a normal name begins with, by its longest stem, and what follows."""
    fits = [
        (stem, quantity)
        for quantity in QUANTITIES.values()
        for stem in quantity.stems
        if name == stem or (name.startswith(f"{stem}_") and quantity.units)
    ]
    if not fits:
        return None
    stem, quantity = max(fits, key=lambda pair: len(pair[0]))
    return quantity, name[len(stem) + 1 :]


def _is_repeat(suffix: str, quantity: Quantity) -> bool:
    """Whether a suffix is a unit and the number of a repeat (``1_n``, ``n_run_2``)."""
    mark = re.compile(r"(rep|repeat|replicate|run|test|trial|no)?\d*")
    rest = "_".join(word for word in suffix.split("_") if not mark.fullmatch(word))
    return rest != suffix and (rest in quantity.units or not rest)


def _is_about(suffix: str, quantity: Quantity) -> bool:
    """Tell a column derived from a quantity (``kn_lower``, ``sd_kn``) from a mistaken unit."""
    derived = any(suffix.startswith(f"{unit}_") for unit in quantity.units)
    return derived or not _QUALIFIERS.isdisjoint(suffix.split("_"))


def _at(where: str, header: str) -> str:
    return f"{where}, column {header!r}" if where else f"column {header!r}"


def _unit_error(header: str, quantity: Quantity, suffix: str, where: str) -> CalibError:
    kinds = [kind for kind, units in UNITS.items() if suffix in units]
    if not suffix:
        found = f"the column name {header!r} does not say the unit"
    elif kinds:
        found = f"{suffix!r} is a unit of {kinds[0]}, but {quantity.stem} is a {quantity.kind}"
    else:
        found = f"{suffix!r} is not a known unit of {quantity.stem}"
    stem, example = quantity.stem, quantity.canonical
    if Column(header, quantity, "").kappa:
        stem, example = f"{stem}_{KAPPA}", f"{stem}_{KAPPA}_ratio"
    near = difflib.get_close_matches(suffix, quantity.units, n=1, cutoff=0.5)
    factor = _foreign_unit(header, suffix, quantity) if suffix else 0.0
    if factor:
        hint = f"multiply the readings by {factor:g}, and name the column {quantity.canonical}"
    elif near:
        hint = f"did you mean {stem}_{near[0]}?"
    else:
        hint = f"rename the column, for example {example}, with the unit of its readings"
    if suffix and not factor:
        hint += "; what is in no such unit must be converted first"
    return CalibError(
        found,
        where=_at(where, header),
        expected=", ".join(accepted_headers(quantity)),
        hint=hint,
    )


def _foreign_unit(header: str, suffix: str, quantity: Quantity) -> float:
    """Return how many canonical units one of a unit is that headers do not know; 0 if it is none.

    It is another unit, not a known one misspelt: renamed, the readings would be in the wrong one.
    """
    bracketed = re.search(r"[\[(]([^\])]+)[\])]", header)
    # Units as pint spells them: suffixes are lower case.
    spelt = {name: unit for units in UNITS.values() for name, unit in units.items()}
    text = "/".join(spelt.get(word, word) for word in suffix.split("_"))
    text = bracketed[1] if bracketed else text
    text = text.replace("²", "2").replace("³", "3").replace("^", "")
    try:
        return float(convert(1.0, re.sub(r"([A-Za-z])(\d)", r"\1**\2", text), quantity.unit))
    except (CalibError, ValueError):
        return 0.0


def match_headers(
    headers: Sequence[str], *, where: str, required: Sequence[str] = ()
) -> tuple[tuple[Column, ...], tuple[str, ...]]:
    """Read a whole header line: columns that name a quantity, and the names of the others.

    `required` has canonical names that must be among them.

    Raises
    ------
    CalibError
        For wrong or missing units, of all columns at once, a quantity given twice, or a required
        one that is missing.
    """
    found: dict[str, Column] = {}
    given: dict[str, list[tuple[int, str]]] = {}
    ignored: list[str] = []
    errors: dict[str, CalibError] = {}
    for position, header in enumerate(headers):
        quantity, suffix = _named(normal(header)) or (None, "")
        try:
            column = parse_header(header, position=position)
        except CalibError as error:
            errors[header] = error
            if quantity is None or not _is_repeat(suffix, quantity):
                continue
        else:
            if column is None:
                ignored.append(header)
                continue
            found.setdefault(column.quantity.canonical, column)
        if quantity is not None:
            given.setdefault(quantity.canonical, []).append((position, header))
    if any(len(columns) > 1 for columns in given.values()):
        raise _side_by_side(given, where)
    if len(errors) == 1:
        raise next(iter(errors.values())).within(where)
    if errors:
        columns = f"columns {', '.join(map(repr, errors))}"
        raise CalibError(
            "; ".join(error.message for error in errors.values()),
            where=f"{where}, {columns}" if where else columns,
            expected="; ".join(error.expected or "" for error in errors.values()),
            hint="; ".join(f"{header!r}: {error.hint}" for header, error in errors.items()),
        )
    if missing := [name for name in required if name not in found]:
        raise missing_columns(missing, headers, ignored, where)
    return tuple(found.values()), tuple(ignored)


def _side_by_side(given: Mapping[str, list[tuple[int, str]]], where: str) -> CalibError:
    """Return the error of quantities that several columns give, (position, header) each."""
    several = {name: columns for name, columns in given.items() if len(columns) > 1}
    said = []
    for name, columns in several.items():
        *most, last = [f"{position + 1} ({column!r})" for position, column in columns]
        both = "both" if len(columns) == 2 else "all"
        said.append(f"columns {', '.join(most)} and {last} {both} give {QUANTITIES[name].stem}")
    return CalibError(
        "; ".join(said),
        where=_at(where, [*several.values()][-1][-1][1]),
        expected="one column per quantity",
        hint="of one reading in several units, delete or rename one; of repeats side by side, "
        "write each reading in a row of its own, below one another, with the conditions of its "
        "row copied and the number of the repeat in a column 'repeat': calib import FILE --out "
        "imported.csv does so",
    )


def missing_columns(
    names: Sequence[str], headers: Sequence[str], ignored: Sequence[str], where: str
) -> CalibError:
    """Return the error of quantities, by their canonical names, that no header names.

    The ignored headers are those that name none.
    """
    wanted = [QUANTITIES[name] for name in dict.fromkeys(names)]
    added = ", ".join(f"{q.canonical} ({q.description})" for q in wanted)
    derived = "".join(
        f"; {header!r} is read as derived from the {of[0].word}, unless it is renamed to the "
        "quantity and its unit alone"
        for header in ignored
        if (of := _named(normal(header))) and of[0] in wanted
    )
    return CalibError(
        f"there is no column for {', '.join(q.stem for q in wanted)}; "
        f"found {', '.join(map(repr, headers))}",
        where=_at(where, names[0]) if len(wanted) == 1 else where,
        expected="; ".join(", ".join(accepted_headers(q)) for q in wanted),
        hint=f"{renamed(ignored, names)}add the {'column' if len(wanted) == 1 else 'columns'} "
        f"{added}{derived}",
    )


def renamed(headers: Iterable[str], names: Iterable[str]) -> str:
    """Begin a hint with what headers may have been meant to be; empty if nothing."""
    guesses = "; ".join(columns_meant(headers, names, shortened=True))
    return f"{guesses} Rename it, or " if guesses else ""


def columns_meant(
    headers: Iterable[str], names: Iterable[str], cutoff: float = 0.7, *, shortened: bool = False
) -> list[str]:
    """Ask of headers that name no quantity whether one of some was meant.

    Parameters
    ----------
    names : iterable of str
        Canonical names of the quantities.
    cutoff : float
        How like one a header must be, up to 1.
    shortened : bool
        Whether the last words of a name will do, as of what a file must have.
    """
    known = {
        name: quantity
        for quantity in (QUANTITIES[name] for name in names)
        for stem in (quantity.stem, *quantity.synonyms)
        for name in (*accepted_headers(quantity), *(f"{stem}_{unit}" for unit in quantity.units))
    }
    return [guess for header in headers if (guess := _guess(header, known, cutoff, shortened))]


def _guess(header: str, known: Mapping[str, Quantity], cutoff: float, shortened: bool) -> str:
    name = normal(header)
    named = _named(name)
    if named is not None and _is_about(named[1], named[0]):
        # Renamed, an uncertainty or a limit would be taken for the reading.
        return ""
    near = difflib.get_close_matches(name, known, n=1, cutoff=cutoff)
    if shortened and not near:
        # A unit alone ("kn") is the end of a name too, but no word of it.
        of_word = ((k, q) for k, q in known.items() if name not in q.units)
        near = [k for k, q in of_word if any(n.endswith(f"_{name}") for n in (k, q.stem))][:1]
    if not near:
        return ""
    quantity = known[near[0]]
    stems = (quantity.stem, *quantity.synonyms)
    if any(near[0] == stem or name.endswith(near[0].removeprefix(stem)) for stem in stems):
        return f"{header!r}: did you mean {near[0]}?"
    # The header says nothing about the unit, so neither may the suggestion.
    return f"{header!r}: did you mean {quantity.stem}, with its unit (as {quantity.canonical})?"


MAX_TEXT_ROWS = 10_000


@dataclass(frozen=True, eq=False, repr=False)
class Table(Shown):
    """Rows of one data set; every quantity in its canonical unit.

    Parameters
    ----------
    columns : mapping of str to ndarray, shape (n,)
        Canonical name to values; copied and made read-only.
    source : str
        Path as given, or a label.
    lines : ndarray of int, shape (n,)
        Line of each row in the file, the header being line 1; rows from 0 for arrays.
    header : tuple of str
        Column names as in the file.
    text : tuple of tuple of str
        Cells as in the file, numbers with a decimal point, row by row; empty for more than 10,000
        rows, to save memory.
    sha256 : str
        Of the bytes of the file, or of the canonical columns. A subset keeps that of the whole.
    label : str
        What to call the data wherever they are shown, such as ``"reconstructed"``.
    ignored : tuple of str
        Column names that name no known quantity.
    extra : mapping of str to tuple of str
        The cells of these; empty where `text` is.
    index : tuple
        Labels of the rows in the data frame that was given; empty of other sources.
    """

    columns: Mapping[str, NDArray[np.float64]]
    source: str
    lines: NDArray[np.int64]
    header: tuple[str, ...]
    text: tuple[tuple[str, ...], ...]
    sha256: str
    label: str = ""
    ignored: tuple[str, ...] = ()
    extra: Mapping[str, tuple[str, ...]] = field(default_factory=dict)
    index: tuple[object, ...] = ()

    def __post_init__(self) -> None:
        frozen = {name: np.array(values, dtype=np.float64) for name, values in self.columns.items()}
        lines = np.array(self.lines, dtype=np.int64)
        for array in (*frozen.values(), lines):
            array.setflags(write=False)
        object.__setattr__(self, "columns", MappingProxyType(frozen))
        object.__setattr__(self, "lines", lines)

    def __reduce__(self) -> tuple[object, ...]:
        # A mapping proxy does not pickle, and worker processes are handed tables.
        return Table, (
            dict(self.columns), self.source, self.lines, self.header, self.text, self.sha256,
            self.label, self.ignored, self.extra, self.index,
        )  # fmt: skip

    def __repr__(self) -> str:
        """Name the source, and say how many rows and which columns there are."""
        label = f", {self.label}" if self.label else ""
        names = list(self.columns)
        more = f" and {len(names) - 6} more" if len(names) > 6 else ""
        return f"<Table {self.source}{label}: {len(self)} rows of {', '.join(names[:6])}{more}>"

    def __len__(self) -> int:
        return len(self.lines)

    def __contains__(self, name: object) -> bool:
        return name in self.columns

    def __iter__(self) -> Iterator[str]:
        return iter(self.columns)

    def __getitem__(self, name: str) -> NDArray[np.float64]:
        """Return the column of a canonical name, shape (n,)."""
        if name not in self.columns:
            raise CalibError(
                f"there is no column {name!r}", where=self.source,
                expected=", ".join(self.columns), hint=self._instead_of(str(name)),
            )  # fmt: skip
        return self.columns[name]

    def _instead_of(self, name: str) -> str:
        """Say which column may have been meant by a name that is none of a column here."""
        with suppress(CalibError):  # an unknown unit
            column = parse_header(name)
            canonical = "" if column is None else column.quantity.canonical
            if canonical in self:
                return f"use {canonical!r}: a table keeps every quantity in one unit"
        return meant(name, self.columns, "add the column to the data")

    def __array__(self, *_: object, **__: object) -> NDArray[np.float64]:
        # NumPy and pandas would take the names of the columns for the values.
        raise CalibError(
            "a table is not an array", where=self.source,
            expected="one of its columns, or all as a DataFrame",
            hint=f"table[{next(iter(self), '')!r}] is a column; table.to_dataframe() has all",
        )  # fmt: skip

    @cached_property
    def _headers(self) -> Mapping[str, Column]:
        columns = [parse_header(header) for header in self.header]
        return {c.quantity.canonical: c for c in columns if c is not None}

    def column(self, name: str) -> Column:
        """Return a quantity's column as the file has it: what messages about its values name.

        Parameters
        ----------
        name : str
            Its canonical name, which stands for the header where the file has none.
        """
        quantity = QUANTITIES[name]
        return self._headers.get(name) or Column(name, quantity, quantity.unit)

    def header_of(self, name: str) -> str:
        """Return the header of a canonical column as it stands in the file."""
        return self.column(name).header if name in QUANTITIES else name

    def to_write[T](self, columns: Mapping[str, T]) -> dict[str, T]:
        """Return columns of this table, by canonical name, under the headers to write them with.

        What was said to be checked is so for whoever reads the file.
        """
        sure = {name for name, column in self._headers.items() if column.checked}
        return {f"{n} {CHECKED}" if n in sure else n: v for n, v in columns.items()}

    def whole(self) -> dict[str, NDArray[np.float64] | tuple[str, ...]]:
        """Return all columns under the headers to write them with, those of no known name too."""
        return {**self.to_write(self.columns), **self.extra}

    def as_in_file(self, columns: Mapping[str, ArrayLike]) -> dict[str, ArrayLike]:
        """Return columns of this table, by canonical name, with its file's headers and units.

        Read again they are the same values, wherever a number in the file's unit gives them.
        """
        found: dict[str, ArrayLike] = {}
        for name, values in columns.items():
            column = self._headers.get(name)
            if column is None:
                found[name] = values
            elif column.unit == column.quantity.unit and not column.kappa:
                found[column.header] = values
            else:
                found[column.header] = _written_exactly(column, np.asarray(values))
        return found

    def must_have(self, *names: str) -> None:
        """Raise a CalibError unless there are columns of these canonical names."""
        if missing := [name for name in names if name not in self.columns]:
            raise missing_columns(missing, self.header, self.ignored, self.source)

    def take(self, rows: NDArray[np.bool_] | NDArray[np.int64] | Sequence[int]) -> Table:
        """Return some of the rows, by a mask (n,) or by indices from 0 in the order wanted."""
        index = np.arange(len(self))[np.asarray(rows, dtype=None if len(rows) else np.int64)]
        return replace(
            self,
            columns={name: values[index] for name, values in self.columns.items()},
            lines=self.lines[index],
            text=tuple(self.text[i] for i in index) if self.text else (),
            extra={name: tuple(cells[i] for i in index) for name, cells in self.extra.items()},
            index=tuple(self.index[i] for i in index) if self.index else (),
        )


def _written_exactly(column: Column, values: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return values in a column's unit with the fewest digits that give them back."""
    written = column.written(values)
    for digits in (17, 16, 15):
        shorter = np.array([float(f"{v:.{digits}g}") for v in written])
        written = np.where(column.to_canonical(shorter) == values, shorter, written)
    return written
