"""A published table beside the same computed again, its posterior, and what the audit says of it.

The data are reconstructed so that the published estimates are their optimum: that a figure returns
shows that program and equations are those of the source. The posterior and the audit judge it.
"""

from __future__ import annotations

import math
import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import Any, ClassVar

from calib.he2019.audit import Audit, Finding, Verdict
from calib.he2019.audit.searches import at_pressure
from calib.he2019.embedded import he2019_tasks
from calib.he2019.published import DOI
from calib.inference.calibration import ParameterSummary, calibrate
from calib.inference.estimators import PointEstimate
from calib.inference.problem import Problem, build_problem
from calib.report.numbers import NOTHING, format_number
from calib.report.reference import Figure, FittedTable
from calib.report.study import estimate_task, fitted_rows

# The output of a table, and the method that it was found by; Table 2 has the settings of one.
_FITTED = {
    1: ("bulk_density", "least_squares"), 3: ("drawbar_pull", "geometric"),
    4: ("drawbar_pull", "genetic"), 5: ("drawbar_pull", "genetic"),
    6: ("rut_depth", "published_regression"),
}  # fmt: skip
_SUPPORT = (
    Verdict.CONTRADICTED, Verdict.CORRECTED, Verdict.UNTESTABLE, Verdict.CONSISTENT,
    Verdict.CONFIRMED,
)  # fmt: skip


@dataclass(frozen=True)
class Row:
    """One printed figure, the same computed again, and its posterior median with the 95 % HDI.

    NaN and None where there is none. `finding` is the one that supports the figure least.
    """

    where: str
    name: str
    unit: str
    published: str
    recomputed: float
    posterior: tuple[float, float, float] | None
    returns: bool | None  # to the printed digits
    inside: bool | None  # the HDI
    verdict: str
    finding: str

    @property
    def judgement(self) -> str:
        """What is to be thought of it, in a few words."""
        returns = {True: "same digits", False: "other digits", None: ""}[self.returns]
        inside = {True: "inside the HDI", False: "OUTSIDE THE HDI", None: ""}[self.inside]
        audited = f"{self.verdict} ({self.finding})" if self.finding else ""
        return "; ".join(word for word in (returns, inside, audited) if word)

    @property
    def cells(self) -> tuple[str, ...]:
        """The row as it is shown, under `PublishedTable.HEAD`."""
        again = format_number(self.recomputed, 4)
        texts = [format_number(v, 4) for v in self.posterior or ()]
        band = f"{texts[0]} ({texts[1]} to {texts[2]})" if texts else NOTHING
        unit = "" if self.unit == "1" else f", {self.unit}"
        return f"{self.where}: {self.name}{unit}", self.published, again, band, self.judgement


@dataclass(frozen=True)
class PublishedTable:
    """A table of the source, figure by figure, with the findings of the audit on it."""

    number: int
    seed: int
    rows: tuple[Row, ...]
    findings: tuple[Finding, ...]
    HEAD: ClassVar = (
        "figure", "published", "computed again", "posterior median (95 % HDI)", "judgement",
    )  # fmt: skip

    def document(self) -> dict[str, Any]:
        """Return it as plain data."""
        return {
            "schema": "calib/published-table/1", "source": f"doi:{DOI}", "table": self.number,
            "seed": self.seed,
            "rows": [{**asdict(row), "judgement": row.judgement} for row in self.rows],
            "findings": {f.key: f"{f.verdict.value}: {f.evidence}" for f in self.findings},
        }  # fmt: skip


def published_table(number: int, audit: Audit) -> PublishedTable:
    """Work out a table of the source, 1 to 6; its posterior takes seconds.

    Examples
    --------
    >>> from calib.he2019.audit import run_audit
    >>> published_table(4, run_audit()).rows[0].published  # doctest: +SKIP
    '0.0794'
    """
    rows = tuple(_rows(number, audit))
    keys = {row.finding for row in rows}
    named = tuple(f for f in audit.findings if f.key in keys)
    return PublishedTable(number, audit.seed, rows, named)


def _rows(number: int, audit: Audit) -> Iterator[Row]:
    published, seed = audit.published, audit.seed
    if number not in _FITTED:
        for name, figure in published.setup.genetic_settings.items():
            yield _row(f"Table {number}", name, figure, audit, None, {})
        return
    output, method = _FITTED[number]
    [task] = he2019_tasks([output])
    estimates, by_pressure = estimate_task(task, seed)
    fits: list[tuple[FittedTable, Sequence[PointEstimate], Problem]]
    if number in (3, 4):
        tables = published.geometric if number == 3 else published.genetic
        fits = [(t, by_pressure[psi], at_pressure(task.table, psi)) for psi, t in tables.items()]
    else:
        whole = {1: published.bulk_density, 5: published.pressure, 6: published.rut_depth}
        rows = fitted_rows(task)[0] if number == 6 else task.table
        fits = [(whole[number], estimates, build_problem(task.model, rows))]
    for table, found, problem in fits:
        point = next(e for e in found if e.method == method)
        calibration = calibrate(problem, seed, label=f"Table {number}")
        summary = calibration.summary if calibration.converged else {}
        of = table.source if number in (3, 4) else table.place
        for name, figure in table.figures.items():
            yield _row(of, name, figure, audit, point, summary)


def _tables_of(found: Finding) -> list[str]:
    return re.findall(r"\d+", found.where.partition(", Eq")[0])


def _row(
    where: str, name: str, figure: Figure, audit: Audit, point: PointEstimate | None,
    summary: Mapping[str, ParameterSummary],
) -> Row:  # fmt: skip
    again, s = math.nan, summary.get(name)
    # The goodness of fit of Table 6 is that of ln pgr, that of the estimate is of the rut.
    if point is not None and (name in point.reported or where != "Table 6"):
        again = point.reported.get(name, getattr(point, name, math.nan))
    number = where.removeprefix("Table ").partition(",")[0]
    named = [f for f in audit.findings if f"{where}: {name}" in f.figures]
    # One on this table itself, and of several the one that supports the figure least.
    named.sort(key=lambda f: (number not in _tables_of(f), _SUPPORT.index(f.verdict)))
    return Row(
        where, name, figure.unit, figure.text, again,
        None if s is None else (s.median, s.hdi_lower, s.hdi_upper),
        None if math.isnan(again) else figure.agrees(again),
        None if s is None else s.hdi_lower <= figure.value <= s.hdi_upper,
        named[0].verdict.value if named else "", named[0].key if named else "",
    )  # fmt: skip
