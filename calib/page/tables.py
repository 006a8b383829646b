"""The page's tables as rows of text: everything is worded and rounded here, the template places."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from markupsafe import Markup

from calib.datasets.published import PUBLISHED, FittedTable
from calib.estimate import PointEstimate
from calib.figures.estimates import METHOD_NAMES
from calib.figures.labels import axis_of, percent
from calib.figures.reference import published_table
from calib.figures.roles import role
from calib.page.equations import symbol_html, unit_html
from calib.page.numbers import (
    NOTHING,
    TIMES,
    format_interval,
    format_like,
    format_number,
    format_value,
)
from calib.study import OutputResult

__all__ = [
    "Grid", "estimates_grid", "posterior_rows", "pressure_grids", "prior_rows",
    "sampling_facts", "validation_facts", "worst_row",
]  # fmt: skip

_TICK = "\N{CHECK MARK}"


@dataclass(frozen=True)
class Grid:
    """A table: a caption, column heads, rows and rows at the foot.

    Parameters
    ----------
    caption : str
    head : list of str
    rows, foot : list of list of str
    notes : list of str
    """

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
            "value": format_value(s.mean, s.sd),
            "median": format_number(s.median, 3),
            "hdi": _interval(s.hdi_lower, s.hdi_upper, s.sd),
            "ess": f"{s.ess_bulk:.0f} / {s.ess_tail:.0f}",
            "rhat": f"{s.rhat:.3f}",
            "ratio": format_number(s.sd_ratio, 2),
            "role": role(calibration, s.name),
            "derived": s.name not in sampled,
        }
        for s in calibration.summary.values()
    ]


def _interval(lower: float, upper: float, sd: float) -> str:
    # Where the sd is inflated by a long tail, its digits would round a bound away.
    if min(abs(lower), abs(upper)) < 0.05 * sd:
        return f"{format_number(lower, 2)} to {format_number(upper, 2)}"
    return format_interval(lower, upper, sd)


def estimates_grid(result: OutputResult, *, published: bool) -> Grid | None:
    """Point estimates by method, beside the published figures and the posterior."""
    if not result.estimates:
        return None
    model = result.calibration.problem.bound.model
    table = published_table(model.name) if published else None
    head: list[Any] = ["Parameter", "Unit"]
    head += [table.source] if table else []
    head += [METHOD_NAMES.get(e.method, e.method) for e in result.estimates]
    head += ["Posterior mean ± sd"]
    varying = [name for name, v in result.calibration.reported.items() if np.ptp(v) > 0.0]
    rows = [_estimate_row(result, name, unit, table) for name, unit in model.reported.items()
            if name in varying]  # fmt: skip
    notes = [
        f"{METHOD_NAMES.get(e.method, e.method)}: {e.note}" for e in result.estimates if e.note
    ]
    fitted, shown = len(result.calibration.problem.table), len(result.task.table)
    if fitted < shown and model.name.startswith("magic_formula"):
        notes.insert(
            0,
            f"The estimates are of all {shown} rows, as in the source; the posterior is of the "
            f"{fitted} that were not held out.",
        )
    if table:
        notes.insert(0, f"{_TICK}: equal to {table.source} in every printed digit.")
        notes += [f"{table.source}: {table.note}"] if table.note else []
    return Grid("", head, rows, _quality_rows(result.estimates, table), notes)


def _estimate_row(
    result: OutputResult, name: str, unit: str, table: FittedTable | None
) -> list[Any]:
    printed = table.estimates.get(name) if table else None
    row: list[Any] = [symbol_html(name), unit_html(unit)]
    if table:
        row.append(format_like(printed.value, printed.text) if printed else NOTHING)
    for e in result.estimates:
        value = e.reported[name]
        if printed is None:
            row.append(format_number(value, 4))
        else:
            row.append(_ticked(_as_printed(value, printed.text), printed.agrees(value)))
    s = result.calibration.summary[name]
    row.append(format_value(s.mean, s.sd))
    return row


def _ticked(text: str, agrees: bool) -> Markup:
    """A number with a tick, or with the room for one, so that digits stay aligned."""
    return Markup('{}<span class="tick">{}</span>').format(text, _TICK if agrees else "")


def _as_printed(value: float, printed: str) -> str:
    """As printed, unless that would leave no digit of an estimate that is far smaller."""
    text = format_like(value, printed)
    return text if any(c in "123456789" for c in text.split(TIMES)[0]) else format_number(value, 3)


def _quality_rows(
    estimates: tuple[PointEstimate, ...], table: FittedTable | None
) -> list[list[Any]]:
    quality = table.quality if table else {}

    def row(label: str, unit: Any, key: str, values: list[str]) -> list[Any]:
        printed = [quality[key].text if key in quality else NOTHING] if table else []
        return [label, unit, *printed, *values, NOTHING]

    unit = unit_html(estimates[0].cost_unit.replace("(", "").replace(")", ""))
    return [
        row("Cost (sum of squares)", unit, "cost", [format_number(e.cost, 4) for e in estimates]),
        row("RMSE", NOTHING, "rmse", [format_number(e.rmse, 3) for e in estimates]),
        row("R²", NOTHING, "r_squared", [format_number(e.r_squared, 3) for e in estimates]),
        row("Evaluations", NOTHING, "", [f"{e.n_evaluations:,}" for e in estimates]),
        row("Time", "s", "", [f"{e.seconds:.2f}" for e in estimates]),
        row("Stopped by its own rule", NOTHING, "",
            ["yes" if e.converged else "NO" for e in estimates]),
    ]  # fmt: skip


def pressure_grids(result: OutputResult, *, published: bool) -> list[Grid]:
    """The Magic Formula at each pressure on its own."""
    grids = []
    for psi, estimates in result.by_pressure.items():
        geometric, genetic = (
            (PUBLISHED.geometric.get(round(psi)), PUBLISHED.genetic.get(round(psi)))
            if published
            else (None, None)
        )
        rows = []
        for e in estimates:
            beside = geometric if e.method == "geometric" else genetic
            rows.append(_pressure_row(METHOD_NAMES.get(e.method, e.method), e, beside))
            if beside is not None and e.method in ("geometric", "genetic"):
                shown = {**beside.estimates, **beside.quality}
                cells = [format_like(shown[k].value, shown[k].text) for k in (*"BCDE", "cost")]
                rows.append([f"published ({beside.source.partition(',')[0]})", *cells])
        head: list[Any] = ["Method", *(Markup("<i>{}</i>").format(k) for k in "BCDE"), "Cost (kN²)"]
        head[1] += " (1/%)"
        head[3] += " (kN)"
        grids.append(Grid(f"{psi:g} psi alone", head, rows, [], []))
    return grids


def _pressure_row(name: str, e: PointEstimate, beside: FittedTable | None) -> list[Any]:
    values = {**{k: e.reported[k] for k in "BCDE"}, "cost": e.cost}
    if beside is None:
        return [name, *(format_number(v, 4) for v in values.values())]
    printed = {**beside.estimates, **beside.quality}
    return [
        name,
        *(
            _ticked(format_like(v, printed[k].text), printed[k].agrees(v))
            for k, v in values.items()
        ),
    ]


def validation_facts(result: OutputResult, effective: float, low_p: float) -> list[list[str]]:
    """Label and value of every validation figure."""
    v, s = result.validation, result.validation.scores
    unit = axis_of(result.calibration.problem.bound.model.output).unit
    facts = [
        ["Root mean square error of the median", f"{format_number(s.rmse, 3)} {unit}"],
        ["Mean CRPS", f"{format_number(s.crps, 3)} {unit}"],
    ]
    judged = np.abs(s.relative_error[np.isfinite(s.relative_error)])
    if judged.size:
        at_row = percent(float(judged.max())) + f", at {worst_row(result)}"
        left = s.n - judged.size
        facts.append([
            "Largest relative error",
            at_row + (f" ({left} rows near zero left out)" if left else ""),
        ])  # fmt: skip
        facts.append(
            ["Rows off by more than 6 %", f"{int((judged > 0.06).sum())} of {judged.size}"]
        )
    if_independent = ", were the rows independent" if effective < 0.5 * s.n else ""
    for level, c in s.coverage.items():
        share, low, high = (f"{100 * x:.0f}" for x in (c.proportion, c.lower, c.upper))
        facts.append([
            f"Covered by the {100 * level:g} % band",
            f"{c.hits} of {c.n} = {share} % (95 % interval {low} to {high} %{if_independent})",
        ])  # fmt: skip
    facts.append(["Chance of covering so few at 90 %, or fewer", format_number(low_p, 2)])
    if np.isfinite(effective):
        facts.append(["Independent rows that would say as much", format_number(effective, 2)])
    if v.pareto_k is not None:
        facts += [
            ["Expected log predictive density", format_value(v.elpd, v.elpd_se)],
            ["Largest Pareto k", format_number(float(np.max(v.pareto_k)), 2)],
            ["Rows refitted (k above 0.7)", f"{len(v.refitted)} of {s.n}"],
        ]
    return facts


def worst_row(result: OutputResult, *, first: bool = False) -> str:
    """Conditions, or the first of them, of the row with the largest relative error."""
    v = result.validation
    i = int(np.nanargmax(np.abs(v.scores.relative_error)))
    names = result.calibration.problem.bound.model.conditions[: 1 if first else None]
    axes = {name: axis_of(name) for name in names}
    return ", ".join(
        f"{a.name.lower()} {a.value_text(float(v.table[name][i]))} {a.unit}"
        for name, a in axes.items()
    )


def sampling_facts(result: OutputResult) -> list[list[str]]:
    """Label and value of everything that is known of the sampling."""
    d = result.calibration.draws
    r = d.report
    ensembles, walkers, stored, _ = d.t.shape
    facts: Mapping[str, str] = {
        "Convergence gate": "passed" if r.passed else f"NOT PASSED: {'; '.join(r.reasons)}",
        f"Ensembles {TIMES} walkers {TIMES} steps": (
            f"{ensembles} {TIMES} {walkers} {TIMES} {r.steps} ({stored} stored)"
        ),
        "Largest R-hat (at most 1.01)": f"{np.max(r.rhat):.4f}",
        "Smallest ESS, bulk and tail (at least 400)": (
            f"{np.min(r.ess_bulk):.0f} and {np.min(r.ess_tail):.0f}"
        ),
        "Steps over autocorrelation time (at least 50)": format_number(
            float(np.min(r.steps / r.tau)), 3
        ),
        "Acceptance": f"{100 * d.acceptance:.0f} %",
        "Log evidence": format_number(d.log_evidence, 4),
        "Density evaluations": f"{d.evaluations:,}",
        "Time": f"{d.seconds:.1f} s",
    }
    return [[label, value] for label, value in facts.items()]
