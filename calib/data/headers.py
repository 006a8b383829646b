"""How a column name says which quantity it holds, and in which unit.

A column name is a quantity followed by a unit (``rut_depth_mm``). Upper and lower case, spaces
and brackets make no difference (``Rut depth [mm]``). Behind it may stand ``(checked)``: its values
are right, however unusual.
"""

from __future__ import annotations

import difflib
import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from calib.data.quantities import QUANTITIES, UNITS, Quantity
from calib.data.units import convert
from calib.errors import CalibError

# A column such as drawbar_pull_sd or slip_angle_deg is about a quantity without being it.
_QUALIFIERS = frozenset({
    "sd", "std", "stdev", "se", "sem", "cv", "var", "variance", "err", "error", "uncertainty",
    "min", "max", "mean", "median", "count", "note", "notes", "comment", "comments", "flag",
    "id", "raw", "source", "before", "after", "lower", "upper", "angle", "setting", "target",
    "level", "class", "method", "sensor", "channel", "time", "date",
})  # fmt: skip

# What a user puts behind a header whose values are to be believed as they are.
CHECKED = "(checked)"


def _stems() -> list[tuple[str, Quantity]]:
    """Every stem and the quantity it names, the longest first."""
    pairs = [(stem, q) for q in QUANTITIES.values() for stem in (q.stem, *q.synonyms)]
    return sorted(pairs, key=lambda pair: -len(pair[0]))


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

    def to_canonical(self, values: ArrayLike) -> NDArray[np.float64]:
        """Convert values in this column's unit to the canonical unit, any shape."""
        return convert(values, self.unit, self.quantity.unit)

    def written(self, values: ArrayLike) -> NDArray[np.float64]:
        """Convert canonical values to this column's unit, any shape."""
        return convert(values, self.quantity.unit, self.unit)

    @property
    def unit_word(self) -> str:
        """The unit as messages say it; empty for a plain number."""
        return "" if self.unit == "dimensionless" else self.unit.replace("**", "")

    @property
    def allowed(self) -> str:
        """The allowed values, in this column's unit."""
        return self.quantity.range.describe(self.quantity.unit, self.unit)


def accepted_headers(quantity: Quantity) -> tuple[str, ...]:
    """Return every header that names a quantity by its main stem, canonical first."""
    names = [quantity.canonical]
    names += [quantity.stem] if quantity.bare_unit else []
    names += [f"{quantity.stem}_{suffix}" for suffix in quantity.units]
    return tuple(dict.fromkeys(names))


def _normal(header: str) -> str:
    """Bring a header to lower case words joined by underscores."""
    text = header.lower().replace("%", " percent ").replace("³", "3").replace("²", "2")
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
    name = _normal(re.sub(rf"{re.escape(CHECKED)}\s*$", "", header, flags=re.IGNORECASE))
    for stem, quantity in _stems():
        if name == stem:
            if quantity.bare_unit is None:
                raise _unit_error(header, quantity, "", where)
            return Column(header, quantity, quantity.bare_unit, position)
        if name.startswith(f"{stem}_") and quantity.units:
            suffix = name[len(stem) + 1 :]
            if suffix in quantity.units:
                return Column(header, quantity, quantity.units[suffix], position)
            if _is_about(suffix, quantity):
                return None
            raise _unit_error(header, quantity, suffix, where)
    return None


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
    near = difflib.get_close_matches(suffix, quantity.units, n=1, cutoff=0.5)
    name = f"{quantity.stem}_{near[0]}" if near else quantity.canonical
    hint = "did you mean" if near else "rename the column, for example"
    return CalibError(
        found,
        where=_at(where, header),
        allowed=", ".join(accepted_headers(quantity)),
        mend=f"{hint} {name}{'?' if near else ''}",
    )


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
    ignored: list[str] = []
    errors: dict[str, CalibError] = {}
    for position, header in enumerate(headers):
        try:
            column = parse_header(header, position=position)
        except CalibError as error:
            errors[header] = error
            continue
        if column is None:
            ignored.append(header)
            continue
        first = found.setdefault(column.quantity.canonical, column)
        if first is not column:
            raise CalibError(
                f"columns {first.position + 1} ({first.header!r}) and {position + 1} "
                f"({header!r}) both give {column.quantity.stem}",
                where=_at(where, header),
                allowed="one column per quantity",
                mend="delete or rename one of the two",
            )
    if errors:
        raise _together(errors, where)
    if missing := [name for name in required if name not in found]:
        raise missing_columns(missing, headers, ignored, where)
    return tuple(found.values()), tuple(ignored)


def _together(errors: Mapping[str, CalibError], where: str) -> CalibError:
    """Return one error of all headers whose units cannot be read: they are mended at once."""
    if len(errors) == 1:
        return next(iter(errors.values())).within(where)
    said = "; ".join(error.message for error in errors.values())
    allowed = "; ".join(error.allowed or "" for error in errors.values())
    mend = "; ".join(f"{header!r}: {error.mend}" for header, error in errors.items())
    columns = f"columns {', '.join(map(repr, errors))}"
    return CalibError(
        said, where=f"{where}, {columns}" if where else columns, allowed=allowed, mend=mend
    )


def missing_columns(
    names: Sequence[str], headers: Sequence[str], ignored: Sequence[str], where: str
) -> CalibError:
    """Return the error of quantities, by their canonical names, that no header names.

    The ignored headers are those that name none.
    """
    wanted = [QUANTITIES[name] for name in dict.fromkeys(names)]
    added = ", ".join(f"{q.canonical} ({q.description})" for q in wanted)
    return CalibError(
        f"there is no column for {', '.join(q.stem for q in wanted)}; "
        f"found {', '.join(map(repr, headers))}",
        where=_at(where, names[0]) if len(wanted) == 1 else where,
        allowed="; ".join(", ".join(accepted_headers(q)) for q in wanted),
        mend=f"{renamed(ignored, names)}add the {'column' if len(wanted) == 1 else 'columns'} "
        f"{added}",
    )


def renamed(headers: Iterable[str], names: Iterable[str]) -> str:
    """Begin a way to mend with what headers may have been meant to be; empty if nothing."""
    guesses = "; ".join(columns_meant(headers, names, shortened=True))
    return f"{guesses} Rename it, or " if guesses else ""


def columns_meant(
    headers: Iterable[str], names: Iterable[str], cutoff: float = 0.7, *, shortened: bool = False
) -> list[str]:
    """Ask of headers that name no quantity whether one of some was meant.

    Parameters
    ----------
    headers : iterable of str
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
    name = _normal(header)
    near = difflib.get_close_matches(name, known, n=1, cutoff=cutoff)
    if shortened and not near:
        # A unit alone ("kn") is the end of a name too, but no word of it.
        near = [k for k, q in known.items() if k.endswith(f"_{name}") and name not in q.units][:1]
    if not near:
        return ""
    quantity = known[near[0]]
    stems = (quantity.stem, *quantity.synonyms)
    if any(near[0] == stem or name.endswith(near[0].removeprefix(stem)) for stem in stems):
        return f"{header!r}: did you mean {near[0]}?"
    # The header says nothing about the unit, so neither may the suggestion.
    return f"{header!r}: did you mean {quantity.stem}, with its unit (as {quantity.canonical})?"
