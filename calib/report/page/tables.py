"""The page's tables as rows of text: everything is worded and rounded here, the template places."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from markupsafe import Markup

from calib.inference.estimators import PointEstimate, method_name
from calib.report.numbers import (
    NOTHING,
    centre_text,
    format_as_printed,
    format_like,
    format_number,
    interval_text,
    skewed,
)
from calib.report.page.template import symbol_html, unit_html
from calib.report.reference import NOTHING as NONE
from calib.report.reference import Figure, FittedTable, Reference
from calib.report.study import OutputResult
from calib.validation.scores import CONTRACTION_MIN, SENSITIVITY_MIN, role

_TICK = "\N{CHECK MARK}"
_MINUS = "\N{MINUS SIGN}"


@dataclass(frozen=True)
class Grid:
    """A table: a caption, column heads, rows and rows at the foot."""

    caption: str
    head: list[Any]
    rows: list[list[Any]]
    foot: list[list[Any]]
    notes: list[str]


def prior_rows(result: OutputResult) -> list[dict[str, Any]]:
    """One row for every prior."""
    return [
        {
            "symbol": symbol_html(p.name),
            "distribution": p.text.replace(" x ", " \N{MULTIPLICATION SIGN} "),
            "unit": unit_html(p.unit),
            "reason": p.reason,
            "source": p.source,
        }
        for p in result.calibration.problem.priors.entries
    ]


def posterior_rows(result: OutputResult) -> list[dict[str, Any]]:
    """One row for every published or sampled parameter that varies."""
    calibration = result.calibration
    sampled = set(calibration.problem.names)
    return [
        {
            "symbol": symbol_html(s.name),
            "unit": unit_html(s.unit),
            "value": centre_text(s),
            "hdi": interval_text(s),
            "ess": f"{s.ess_bulk:.0f} / {s.ess_tail:.0f}",
            "rhat": f"{s.rhat:.3f}",
            "ratio": format_number(s.sd_ratio, 2),
            "role": role(calibration, s.name),
            "derived": s.name not in sampled,
        }
        for s in calibration.summary.values()
    ]


def sensitivity_grid(result: OutputResult) -> Grid:
    """What each parameter owes to the prior, what to the data, and which are not identified."""
    found = result.sensitivity
    unknown = [symbol_html(name) for name, s in found.items() if not s.identified]
    said = (
        Markup("Not identified by these data: {}.").format(Markup(", ").join(unknown))
        if unknown
        else "Every parameter is identified by these data."
    )
    rows = [
        [
            symbol_html(name), format_number(s.contraction, 2), format_number(s.prior, 2),
            format_number(s.likelihood, 2),
            s.reading if s.identified else Markup("<strong>{}</strong>").format(s.reading),
        ]
        for name, s in found.items()
    ]  # fmt: skip
    head = ["Parameter", "Contraction", "Reacts to prior", "Reacts to data", "Identified by"]
    notes = [
        f"A parameter is not identified if its contraction, 1 {_MINUS} (posterior variance)/(prior "
        f"variance), is below {CONTRACTION_MIN:g}, or if it reacts to the prior (at least "
        f"{SENSITIVITY_MIN:g}) and not to the data (less).",
        "Reacts to: how far its posterior moves per doubling of the power of the prior, or of the "
        "likelihood (cumulative Jensen-Shannon distance; Kallioinen et al. 2024, "
        "doi:10.1007/s11222-023-10366-5).",
    ]
    return Grid(said, head, rows, [], notes)


def estimates_grid(result: OutputResult, *, reference: Reference = NONE) -> Grid | None:
    """Point estimates by method, beside the published figures and the posterior."""
    if not result.estimates:
        return None
    model = result.calibration.problem.bound.model
    table = reference.table(model.name)
    quality = reference.quality(model.name) if table else None
    head: list[Any] = ["Parameter", "Unit"]
    head += [table.source] if table else []
    head += [method_name(e.method) for e in result.estimates]
    head += ["Posterior mean ± sd, or median and 95 % HDI"]
    varying = [name for name, v in result.calibration.reported.items() if np.ptp(v) > 0.0]
    rows = [_estimate_row(result, name, unit, table) for name, unit in model.reported.items()
            if name in varying]  # fmt: skip
    notes = [f"{method_name(e.method)}: {e.note}" for e in result.estimates if e.note]
    fitted, shown = len(result.calibration.problem.table), len(result.task.table)
    caption = ""
    if fitted < shown and model.estimates_all_rows:
        caption = (
            f"Not the same rows: the estimates are of all {shown} rows"
            f"{', as in the source' if table else ''}; the posterior is of the {fitted} that were "
            "not held out."
        )
    if table:
        notes.insert(0, f"{_TICK}: equal to {table.source} in every printed digit.")
        notes += [f"{table.source}: {table.note}"] if table.note else []
    return Grid(caption, head, rows, _quality_rows(result.estimates, quality), notes)


def _estimate_row(
    result: OutputResult, name: str, unit: str, table: FittedTable | None
) -> list[Any]:
    printed = table.estimates.get(name) if table else None
    row: list[Any] = [symbol_html(name), unit_html(unit)]
    if table:
        row.append(format_like(printed.value, printed.text) if printed else NOTHING)
    row += [_cell(e.reported[name], printed) for e in result.estimates]
    s = result.calibration.summary[name]
    if skewed(s):
        row.append(Markup("{}<br>HDI {}").format(centre_text(s), interval_text(s)))
    else:
        row.append(centre_text(s))
    return row


def _cell(value: float, printed: Figure | None) -> Any:
    """An estimate in the digits of what was printed, with a tick if it is the same."""
    if printed is None:
        return format_number(value, 4)
    return _ticked(format_as_printed(value, printed.text), printed.agrees(value))


def _ticked(text: str, agrees: bool) -> Markup:
    """A number with a tick, or with the width of one, so that digits stay aligned."""
    return Markup('{}<span class="tick">{}</span>').format(text, _TICK if agrees else "")


def _quality_rows(
    estimates: tuple[PointEstimate, ...], quality: Mapping[str, Figure] | None
) -> list[list[Any]]:
    """Rows on the fit; with a column of published figures, unless there is no table of them."""

    def row(label: str, unit: Any, key: str, values: list[str]) -> list[Any]:
        printed = []
        if quality is not None:
            printed = [quality[key].text if key in quality else NOTHING]
        return [label, unit, *printed, *values, NOTHING]

    unit, rmse_unit = (unit_html(u) for u in (estimates[0].cost_unit, estimates[0].rmse_unit))
    return [
        row("Cost (sum of squares)", unit, "cost", [format_number(e.cost, 4) for e in estimates]),
        row("RMSE", rmse_unit, "rmse", [format_number(e.rmse, 3) for e in estimates]),
        row("R²", NOTHING, "r_squared", [format_number(e.r_squared, 3) for e in estimates]),
        row("Evaluations", NOTHING, "", [f"{e.n_evaluations:,}" for e in estimates]),
        row("Stopped by its own rule", NOTHING, "",
            ["yes" if e.converged else "NO" for e in estimates]),
    ]  # fmt: skip


def pressure_grids(result: OutputResult, *, reference: Reference = NONE) -> list[Grid]:
    """The Magic Formula at each pressure on its own."""
    grids = []
    for psi, estimates in result.by_pressure.items():
        rows = []
        for e in estimates:
            beside = reference.beside(e.method, psi)
            printed = beside.figures if beside else {}
            values = {**{k: e.reported[k] for k in "BCDE"}, "cost": e.cost}
            cells = [_cell(v, printed.get(k)) for k, v in values.items()]
            rows.append([method_name(e.method), *cells])
            if beside is not None and e.method in reference.alone:
                shown = (printed[k] for k in values)
                cells = [_ticked(format_like(f.value, f.text), False) for f in shown]
                rows.append([f"published ({beside.place})", *cells])
        head: list[Any] = ["Method", *(Markup("<i>{}</i>").format(k) for k in "BCDE"), "Cost (kN²)"]
        head[1] += " (1/%)"
        head[3] += " (kN)"
        grids.append(Grid(f"{psi:g} psi alone", head, rows, [], []))
    return grids
