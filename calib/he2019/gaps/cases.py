"""Four gaps of the source paper as cases: a laboratory campaign, and a field that has more in it.

A diagnosis lets an effect act in the field only. So each case puts into the laboratory the rows in
which the effect is absent, or already allowed for, and into the field those in which it acts; and
no row stands in both, since it would bring its own error along. That rules out two cases that come
to mind first: plain Bekker calibrated on all slips at 18 and 42 psi, and the Magic Formula
calibrated on all slips at 18 psi, have the effect in both campaigns.

The data are reconstructed from published results. What a finding can therefore mean, and what it
cannot, is part of every case (`PaperGap.limits`).

References
----------
He, Sandu & Osorio (2019), doi:10.1016/j.jterra.2019.07.003.
"""

from __future__ import annotations

import hashlib
import textwrap
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cache
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from calib.data import Table, table_from_arrays, write_table
from calib.data.quantities import OUTPUTS
from calib.errors import CalibError
from calib.gap.case import Case
from calib.he2019 import declared
from calib.he2019.datasets.embedded import LABEL, load_he2019

RECONSTRUCTED = "the data are reconstructed from published results; they are not measurements"

_RUT = (
    "inflation_pressure_psi", "average_ground_pressure_kpa", "slip_ratio", "rut_depth_mm",
)  # fmt: skip
_PULL = ("inflation_pressure_psi", "slip_ratio", "drawbar_pull_kn")
_PULL_MODEL = {"drawbar_pull": "magic_formula_pressure"}
# The wheel hardly slips up to this one: the two smallest nominal slips.
_TOWED = 0.03


_WORDS = declared("gaps/gaps.toml")


@dataclass(frozen=True)
class PaperGap:
    """One gap, as a question to a diagnosis.

    Parameters
    ----------
    name : str
        Of its folder.
    limits : str
        What a finding can mean and what it cannot, the data being reconstructed.
    withheld : str, optional
        The effect that the field has and the laboratory has not, where the source names one.
    unfitted : Table, optional
        The conditions of `case.new_conditions` with the outcomes that the diagnosis is not shown.
    variants : mapping of str to Case
        The same question asked otherwise, by how it differs.
    """

    name: str
    title: str
    question: str
    lab_rows: str
    field_rows: str
    limits: str
    case: Case
    withheld: str | None = None
    unfitted: Table | None = None
    variants: Mapping[str, Case] = field(default_factory=dict)


@cache
def paper_gaps() -> tuple[PaperGap, ...]:
    """Return the four gaps, made from the embedded data."""
    return (_plain_bekker(), _nominal_slip(), _held_out_pull(), _post_peak())


def _gap(
    case: Case, unfitted: Table | None = None, variants: Mapping[str, Case] | None = None
) -> PaperGap:
    words = _WORDS[case.name]
    said = {key: " ".join(text.split()) for key, text in words.items()}
    return PaperGap(case.name, case=case, unfitted=unfitted, variants=variants or {}, **said)


def _plain_bekker() -> PaperGap:
    data = load_he2019("rut_depth")
    towed, at_30 = data["slip_ratio"] < _TOWED, data["inflation_pressure_psi"] == 30.0
    unfitted = _rows(data, ~towed & at_30, _RUT, "fresh.csv")
    case = _case(
        "plain_bekker", {"rut_depth": "bekker"}, _rows(data, towed, _RUT, "lab.csv"),
        _rows(data, ~towed & ~at_30, _RUT, "field.csv"), unfitted,
    )  # fmt: skip
    return _gap(case, unfitted)


def _nominal_slip() -> PaperGap:
    data = load_he2019("drawbar_pull")
    # By the order of the slips at each pressure; the field has the row at nominal zero.
    first = _slip_level(data) % 2 == 0
    at_30 = data["inflation_pressure_psi"] == 30.0

    def case(name: str, field_rows: NDArray[np.bool_], *, nominal: bool) -> Case:
        return _case(
            name, _PULL_MODEL, _rows(data, ~field_rows, _PULL, "lab.csv"),
            _rows(data, field_rows & ~at_30, _PULL, "field.csv", nominal=nominal),
            _rows(data, field_rows & at_30, _PULL, "fresh.csv", nominal=nominal),
        )  # fmt: skip

    variants = {
        "halves swapped": case("nominal_slip_swapped", ~first, nominal=True),
        "slips given back": case("nominal_slip_given_back", first, nominal=False),
    }
    unfitted = _rows(data, first & at_30, _PULL, "fresh.csv", nominal=True)
    return _gap(case("nominal_slip", first, nominal=True), unfitted, variants)


def _held_out_pull() -> PaperGap:
    data = load_he2019("drawbar_pull")
    return _gap(_split("held_out_pull", data, data["inflation_pressure_psi"] == 30.0))


def _post_peak() -> PaperGap:
    data = load_he2019("drawbar_pull")
    at_18 = data["inflation_pressure_psi"] == 18.0
    level = _slip_level(data)
    peak = int(level[at_18][np.argmax(data["drawbar_pull_kn"][at_18])])
    found, later, latest = (
        _split(name, data, at_18 & (level > peak + i))
        for i, name in enumerate(("post_peak_18_psi", "post_peak_later", "post_peak_latest"))
    )
    variants = {
        "field begins one slip level later": later,
        "field begins two slip levels later": latest,
    }
    return _gap(found, variants=variants)


def _split(name: str, data: Table, field_rows: NDArray[np.bool_]) -> Case:
    """Make a case of the pull model whose field is some rows, and its laboratory the others."""
    return _case(
        name, _PULL_MODEL, _rows(data, ~field_rows, _PULL, "lab.csv"),
        _rows(data, field_rows, _PULL, "field.csv"),
    )  # fmt: skip


def _slip_level(data: Table) -> NDArray[np.int64]:
    """Return the place of each row's slip among the slips tested, from 0."""
    return np.unique(data["slip_ratio"], return_inverse=True)[1].astype(np.int64)


def _rows(
    data: Table, mask: NDArray[np.bool_], names: Sequence[str], file: str, *, nominal: bool = False
) -> Table:
    """Return some rows of the embedded data as a table, nominal slips in the place of slips."""
    columns = {
        name: data["nominal_slip_ratio" if nominal and name == "slip_ratio" else name][mask]
        for name in names
    }
    return _table(columns, file)


def _table(columns: Mapping[str, NDArray[np.float64]], file: str) -> Table:
    """Make a table that carries the hash of the file `calib.data.write_table` makes of it."""
    cells = zip(*(map(repr, values.tolist()) for values in columns.values()), strict=True)
    text = "".join(f"{','.join(row)}\n" for row in [tuple(columns), *cells])
    table = table_from_arrays(columns, source=file, label=LABEL)
    return replace(table, sha256=hashlib.sha256(text.encode()).hexdigest())


def _case(
    name: str, models: Mapping[str, str], lab: Table, field: Table, unfitted: Table | None = None
) -> Case:
    new = None
    if unfitted is not None:
        conditions = {n: v for n, v in unfitted.columns.items() if n not in OUTPUTS.values()}
        new = _table(conditions, "fresh.csv")
    return Case(name, lab, field, models, new, (RECONSTRUCTED,))


def write_cases(gaps: Sequence[PaperGap], out: Path, *, overwrite: bool = False) -> list[Path]:
    """Write each gap as a case folder, and return the folders.

    With ``case.toml``, ``lab.csv``, ``field.csv`` and, where rows were kept out, ``fresh.csv`` with
    their conditions and ``fresh_measured.csv`` with their outcomes, which no diagnosis reads.

    Raises
    ------
    CalibError, OSError
        If a folder exists and may not be replaced; if one cannot be made or written to.
    """
    folders = [Path(out) / gap.name for gap in gaps]
    existing = [folder.name for folder in folders if folder.exists()]
    if existing and not overwrite:
        raise CalibError(
            f"{', '.join(existing)} exist there already", where=str(out),
            mend="choose another --out, or pass --overwrite",
        )  # fmt: skip
    for gap, folder in zip(gaps, folders, strict=True):
        folder.mkdir(parents=True, exist_ok=True)
        write_table(folder / "lab.csv", gap.case.lab.columns)
        write_table(folder / "field.csv", gap.case.field.columns)
        if gap.case.new_conditions is not None and gap.unfitted is not None:
            write_table(folder / "fresh.csv", gap.case.new_conditions.columns)
            write_table(folder / "fresh_measured.csv", gap.unfitted.columns)
        (folder / "case.toml").write_text(_case_toml(gap), encoding="utf-8")
    return folders


def _case_toml(gap: PaperGap) -> str:
    remarks = (
        f"{gap.title}. {gap.question}",
        f"Calibration: {gap.lab_rows}.",
        f"Field: {gap.field_rows}.",
        f"{RECONSTRUCTED.capitalize()}. {gap.limits}",
    )
    lines = [f"# {line}" for text in remarks for line in textwrap.wrap(text, 96)]
    lines += ['calibration = "lab.csv"', 'field = "field.csv"']
    if gap.case.new_conditions is not None:
        lines.append('predict = "fresh.csv"')
    lines += ["", "[models]", *(f'{o} = "{m}"' for o, m in gap.case.models.items())]
    return "\n".join(lines) + "\n"
