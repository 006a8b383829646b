"""Suggest a mapping from what columns are usually called: a text to look at and to correct."""

from __future__ import annotations

import json
import os
import re
import tomllib
from collections.abc import Iterator, Mapping
from contextlib import suppress
from dataclasses import dataclass
from os import PathLike

import numpy as np
from numpy.typing import NDArray

from calib.arguments import takes
from calib.data.quantities import QUANTITIES, UNITS, Quantity
from calib.data.table import CHECKED, normal, parse_header
from calib.errors import CalibError
from calib.imports.mapping import INPUTS, Mapped, to_unit
from calib.imports.run import apply
from calib.imports.tables import _NAMES, RawTable, is_unit, read_raw


@takes(path=PathLike, sheet=str)
def suggest_mapping(path: str | os.PathLike[str], *, sheet: str = "") -> str:
    r"""Suggest which column of a file is what, by names usual in the field and the tyre world.

    Parameters
    ----------
    path : path-like
    sheet : str
        That of a workbook which has several.

    Returns
    -------
    str
        The text of a ``mapping.toml``, with a remark on every column.

    Raises
    ------
    CalibError
        If the file cannot be read, or no column is known by its name.

    Examples
    --------
    >>> import calib
    >>> from pathlib import Path
    >>> _ = Path("run7.dat").write_text("FX\tFZ\nkN\tkN\n0.41\t-3.0\n0.93\t-3.1\n")
    >>> print(calib.suggest_mapping("run7.dat"))  # doctest: +ELLIPSIS
    # ...
    [columns]
    drawbar_pull_kn = {from = "FX", unit = "kN"}  # ...
    normal_load_kn = {from = "FZ", unit = "kN", factor = -1}  # ...
    <BLANKLINE>
    """
    return suggest(read_raw(path, sheet))


def suggest(raw: RawTable) -> str:
    """Suggest a mapping of a file that was read."""
    found = dict(_proposals(raw))
    if not found:
        raise CalibError(
            f"no column is known by its name: {', '.join(map(str, raw.frame))}",
            where=raw.source,
            expected="a quantity, as `calib quantities` lists them, or a usual name of one",
            hint="write a mapping: [columns] drawbar_pull_kn = "
            f'{{from = "{raw.frame.columns[0]}", unit = "N"}}',
        )
    head = [
        f"# What the columns of {raw.source} are, as far as their names tell. Look at every line."
    ]
    head += [f"# {note}" for note in raw.notes]
    head += [f"sheet = {json.dumps(raw.sheet)}"] * bool(raw.sheet)
    lines = [*head, "", "[columns]", *(proposal.line(name) for name, proposal in found.items())]
    text = "\n".join(lines)
    used = {name for proposal in found.values() for name in proposal.columns}
    unused = [str(name) for name in raw.frame if name not in used]
    if unused:
        lines.append(f"# not used: {', '.join(unused)}")
    try:
        report = apply(raw, Mapped.model_validate(tomllib.loads(text))).report
    except CalibError:
        report = None  # a unit is to be filled in, or rows are to be cropped
    if report is not None and report.apart > 1:
        times = [t for t in report.autocorrelation_times.values() if np.isfinite(t)]
        lines += [
            "",
            f"# Neighbouring rows are alike: their autocorrelation time is {max(times):.3g} rows.",
            "# Means are another way: [bins] with a line such as slip_ratio = {width = 0.02}",
            "[thin]",
            'every = "auto"',
        ]
    return "\n".join([*lines, ""])


@dataclass(frozen=True)
class _Meaning:
    """What a column may hold, why, and the name of the input if slip is derived from it."""

    quantity: Quantity
    why: str
    derived_from: str = ""


@dataclass(frozen=True)
class _Proposal:
    """The right side of a line of ``[columns]``, the columns that it takes, and a remark."""

    columns: tuple[str, ...]
    source: str
    remarks: tuple[str, ...]

    def line(self, name: str) -> str:
        said = "; ".join(filter(None, self.remarks))
        return f"{name} = {self.source}{f'  # {said}' if said else ''}"


def _proposals(raw: RawTable) -> Iterator[tuple[str, _Proposal]]:
    """Yield what to write and where it comes from, in the order of the file."""
    given: dict[str, str] = {}
    for columns in _side_by_side(raw):
        unit = raw.units.get(columns[0], "")
        name = columns[0] if len(columns) == 1 else re.sub(r"\d+", "", columns[0])
        meanings = [m for m in _meanings(name, unit) if m.quantity.canonical not in given]
        if meanings:
            given[meanings[0].quantity.canonical] = columns[0]
            yield _proposal(raw, columns, unit, meanings)
    if "slip_ratio" not in given and "speed_m_s" in given:
        yield from _slip_of_speeds(raw, given["speed_m_s"])


def _proposal(
    raw: RawTable, columns: tuple[str, ...], unit: str, meanings: list[_Meaning]
) -> tuple[str, _Proposal]:
    first, *others = meanings
    quantity, derived_from, remarks = first.quantity, first.derived_from, [first.why]
    values = np.concatenate([_numbers(raw, name) for name in columns])
    fields = {"from": _text(columns[0] if len(columns) == 1 else list(columns))}
    if unit or (quantity.units and quantity.bare_unit is None):
        fields["unit"] = _text(unit)
    if not unit and "unit" in fields:
        remarks.append("the file gives no unit: fill it in")
    if quantity.range.low == 0.0 and values.size and np.median(values) < 0.0:
        fields["factor"] = "-1"
        remarks.append("negative in the file, so turned")
    if quantity.kind == "slip" and unit and values.size and not derived_from:
        largest = to_unit(values, unit, quantity.units, quantity.unit).max()
        derived_from = "kappa" if largest > 1.0 else ""
        remarks += ["above 1, so it is ωr/v - 1 and not 1 - v/(ωr): converted"] * bool(derived_from)
    remarks += ["repeats side by side become rows"] * (len(columns) > 1)
    if others:
        remarks.append(f"or {', '.join(m.quantity.canonical for m in others)}")
    source = _table(fields)
    if derived_from:
        source = _table({"derive": _text("slip_of_kappa"), "inputs": _table({"kappa": source})})
    suffix = normal(unit)
    target = f"{quantity.stem}_{suffix}" if suffix in quantity.units else quantity.canonical
    if columns[0].lower().endswith(CHECKED):
        target = f'"{target} {CHECKED}"'
    return target, _Proposal(columns, source, tuple(remarks))


def _meanings(name: str, unit: str) -> list[_Meaning]:
    """Return what a column may hold by its name, if its unit, where it has one, is of that."""
    words = _words(name)
    own = [_Meaning(q, "") for q in QUANTITIES.values() if words in map(_words, q.stems)]
    usual = [
        _Meaning(QUANTITIES[entry["column"]], entry["source"], entry.get("input", ""))
        for entry in _NAMES["columns"]
        if words in entry["names"]
    ]
    fits = [
        m for m in own + usual if not unit or _measures(unit, m.quantity.units, m.quantity.unit)
    ]
    return list({m.quantity.canonical: m for m in reversed(fits)}.values())[::-1]


def _measures(unit: str, known: Mapping[str, str], wanted: str) -> bool:
    with suppress(CalibError):
        to_unit(np.ones(1), unit, known, wanted)
        return True
    return False


def _slip_of_speeds(raw: RawTable, speed: str) -> Iterator[tuple[str, _Proposal]]:
    """Yield how slip follows from speeds and a radius, where the file has the speeds."""
    inputs = {"speed": speed}
    for entry in _NAMES["inputs"]:
        kind, wanted = INPUTS[entry["input"]]
        named = (str(n) for k in entry["names"] for n in raw.frame if _words(str(n)) == k)
        fits = (n for n in named if _measures(raw.units.get(n, ""), UNITS.get(kind, {}), wanted))
        if name := next(fits, ""):
            inputs[entry["input"]] = name
    if "wheel_speed" not in inputs:
        return
    said = {
        key: _table({"from": _text(name), "unit": _text(raw.units.get(name, ""))})
        for key, name in inputs.items()
    }
    remark = "1 - v/(ωr), with the rolling radius"
    if "radius" not in said:
        said["radius"] = '{value = "…", unit = "m"}'
        remark += ": write it, or delete this line"
    source = _table({"derive": _text("slip"), "inputs": _table(said)})
    yield "slip_ratio", _Proposal(tuple(inputs.values()), source, (remark,))


def _side_by_side(raw: RawTable) -> list[tuple[str, ...]]:
    """Return the columns, those together that differ in a number only."""
    groups: dict[str, list[str]] = {}
    for name in map(str, raw.frame):
        groups.setdefault(re.sub(r"\d+", "#", name), []).append(name)
    return [tuple(columns) for columns in groups.values()]


def _words(name: str) -> str:
    """Return a name in lower case, without a unit at its end and punctuation."""
    with suppress(CalibError):
        if (column := parse_header(name)) is not None:
            name = column.quantity.stem
    name = re.sub(r"^.*\.(?=[^\W\d])", "", name)  # a field of a struct
    bare = re.sub(r"[\[(<][^\])>]*[\])>]\s*$| / \S+$", "", name).strip()
    stem, _, suffix = bare.rpartition("_")
    bare = stem if stem and is_unit(suffix) else bare
    return " ".join(re.sub(r"[\W_]+", " ", bare.lower()).split())


def _numbers(raw: RawTable, name: str) -> NDArray[np.float64]:
    values = raw.frame[name]
    found = values.to_numpy(np.float64) if values.dtype.kind in "fiu" else np.empty(0)
    return found[np.isfinite(found)]


def _text(value: str | list[str]) -> str:
    return json.dumps(value, ensure_ascii=False)


def _table(fields: Mapping[str, str]) -> str:
    return f"{{{', '.join(f'{key} = {value}' for key, value in fields.items())}}}"
