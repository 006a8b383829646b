"""Tables for print and for programs: estimates, posteriors, priors."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence

from calib.inference.calibration import ParameterSummary
from calib.inference.estimators import METHODS, method_name
from calib.models import get_model
from calib.report.numbers import (
    NOTHING,
    ascii_number,
    ascii_text,
    centre_place,
    centre_text,
    end_places,
    format_as_printed,
    format_like,
    format_number,
    interval_text,
    last_place,
    skewed,
)
from calib.report.publish.markup import in_brackets, with_symbols
from calib.report.publish.records import LatexTable, Output, Row
from calib.report.reference import Figure

_ALONE = {"B": "1/%", "C": "1", "D": "kN", "E": "1", "cost": "kN^2"}
_QUALITY = {"cost": "Sum of squares", "rmse": "RMSE", "r_squared": "R²"}


def _short(method: str) -> str:
    return METHODS[method].short if method in METHODS else method


def _varying(o: Output) -> dict[str, str]:
    """Published parameters that were not held fixed, with their units."""
    return {k: u for k, u in get_model(o.model).reported.items() if k in o.found["posterior"]}


def _digits(value: float | None, printed: Figure | None) -> str:
    if value is None:
        return NOTHING
    return format_number(value, 4) if printed is None else format_as_printed(value, printed.text)


type _Estimate = tuple[str, str, str, float | None, Figure | None, str]
"""Quantity, unit, method, value, printed figure, and where that is."""


def _together(o: Output) -> Iterator[_Estimate]:
    """Yield the estimates from all rows together, and how well they fit."""
    table, quality = o.reference.table(o.model), o.reference.quality(o.model)
    shown, source = ({**table.estimates, **quality}, table.source) if table else ({}, "")
    for method, values in o.found["estimates"].items():
        fit = o.found["fit"][method]
        units = {"cost": fit["cost_unit"], "rmse": fit["rmse_unit"], "r_squared": "1"}
        for name, unit in (_varying(o) | units).items():
            value = (fit if name in _QUALITY else values)[name]
            yield name, unit, method, value, shown.get(name), source


def _alone(o: Output) -> Iterator[tuple[str, list[_Estimate]]]:
    """Yield each pressure, and the estimates of each method from its rows alone."""
    for pressure, by_method in o.found["by_pressure"].items():
        for method, values in by_method.items():
            beside = o.reference.beside(method, _psi(pressure))
            shown, place = (beside.figures, beside.place) if beside else ({}, "")
            yield pressure, [(k, u, method, values[k], shown.get(k), place)
                             for k, u in _ALONE.items()]  # fmt: skip


def _psi(pressure: str) -> float:
    return float(pressure.partition(" ")[0])


def estimates_csv(outputs: Sequence[Output]) -> list[Row]:
    """Return every estimate of every output: all rows together, then each pressure alone."""
    rows: list[Row] = []
    for o in outputs:
        found = [(o.model, "together", str(o.n_estimated), e) for e in _together(o)]
        found += [("magic_formula", at, "", e) for at, estimates in _alone(o) for e in estimates]
        for model, at, n, (name, unit, method, value, printed, source) in found:
            row = {
                "output": o.key, "model": model, "rows": at, "n_rows": n, "quantity": name,
                "unit": unit, "method": method, "value": ascii_text(_digits(value, printed)),
                "published": "", "published_in": "", "same_printed_digits": "",
            }  # fmt: skip
            if printed is not None and value is not None:
                row |= {"published": printed.text, "published_in": source}
                row["same_printed_digits"] = "yes" if printed.agrees(value) else "no"
            rows.append(row)
    return rows


def estimates_latex(o: Output) -> LatexTable | None:
    """Return the estimates of an output; None where no method gave one."""
    methods = list(o.found["estimates"])
    if not methods:
        return None
    table = o.reference.table(o.model)
    posterior = {s.name: s for s in o.posterior}
    cells: dict[str, dict[str, str]] = {}
    for name, unit, method, value, printed, source in _together(o):
        row = cells.setdefault(name, {"Parameter": _name_cell(name, unit)})
        if table:
            row[source] = format_like(printed.value, printed.text) if printed else NOTHING
        row[_short(method)] = _ticked(value, printed)
    for name, row in cells.items():
        row["Posterior"] = _posterior(posterior[name]) if name in posterior else NOTHING
    data = o.found["data"]
    rows = f"all {o.n_estimated}" if o.estimates_use_all_rows else str(o.n_estimated)
    beside = f", beside its {table.source}" if table else ""
    star = " An asterisk: equal to the source in every printed digit." if table else ""
    return LatexTable(
        label=f"estimates_{o.key}",
        caption=(
            f"Point estimates of the parameters of {o.model_words} from {rows} rows of "
            f"{o.data_words}{beside}, and the posterior from {data['n']} rows (mean ± standard "
            f"deviation, or median and 95 % highest-density interval). {_explained(methods)}{star}"
        ),
        columns=f"l{'r' * (len(methods) + 1 + bool(table))}",
        groups=[
            [row for name, row in cells.items() if (name in _QUALITY) is fit]
            for fit in (False, True)
        ],
    )


def _explained(methods: Sequence[str]) -> str:
    words = [f"{METHODS[m].short}: {METHODS[m].title}" for m in methods if m in METHODS]
    return f"{'; '.join(words)}." if words else ""


def _posterior(s: ParameterSummary) -> str:
    return f"{centre_text(s)} ({interval_text(s)})" if skewed(s) else centre_text(s)


def _name_cell(name: str, unit: str) -> str:
    return f"{_QUALITY.get(name) or f'[${name}]'}{in_brackets(unit)}"


def _ticked(value: float | None, printed: Figure | None) -> str:
    mark = "\N{CHECK MARK}" if printed and value is not None and printed.agrees(value) else ""
    return _digits(value, printed) + mark


def pressure_latex(o: Output) -> LatexTable | None:
    """Return the Magic Formula at each pressure alone; None for other models."""
    groups: dict[str, list[Row]] = {}
    names = [_name_cell(k, u) for k, u in _ALONE.items()]

    def add(pressure: str, method: str, cells: Iterable[str]) -> None:
        named = dict(zip(names, cells, strict=True))
        groups.setdefault(pressure, []).append({"Pressure": pressure, "Method": method} | named)

    for pressure, found in _alone(o):
        add(pressure, method_name(found[0][2]), (_ticked(e[3], e[4]) for e in found))
    for pressure in groups:
        for tables in o.reference.alone.values():
            if (table := tables.get(round(_psi(pressure)))) is not None:
                printed = (table.figures[k] for k in _ALONE)
                add(pressure, f"published ({table.place})",
                    (format_like(figure.value, figure.text) for figure in printed))  # fmt: skip
    if not groups:
        return None
    return LatexTable(
        label=f"estimates_by_pressure_{o.key}",
        caption=(
            f"The Magic Formula (Eqs 3\N{EN DASH}5 of the source [@He_2019]) at each inflation "
            f"pressure alone, {o.data_words}."
            + (" An asterisk: equal to the source's table of that method (least squares and "
               "differential evolution: of the genetic algorithm) in every printed digit."
               if o.label else "")
        ),
        columns="llrrrrr",
        groups=list(groups.values()),
    )  # fmt: skip


def posterior_csv(outputs: Sequence[Output]) -> list[Row]:
    """Return the posterior summaries of all outputs, one row for every parameter."""
    return [_csv_row(s, o) for o in outputs for s in o.posterior]


def _csv_row(s: ParameterSummary, o: Output) -> Row:
    last = last_place(s.sd, s.mcse_mean)
    low, high = end_places(s)
    return {
        "output": o.key,
        "model": o.model,
        "parameter": s.name,
        "unit": s.unit,
        "mean": ascii_number(s.mean, last),
        "sd": ascii_number(s.sd, last),
        "mcse_mean": ascii_text(format_number(s.mcse_mean, 2)),
        "median": ascii_number(s.median, centre_place(s)),
        "hdi95_lower": ascii_number(s.hdi_lower, low),
        "hdi95_upper": ascii_number(s.hdi_upper, high),
        "ess_bulk": f"{s.ess_bulk:.0f}",
        "ess_tail": f"{s.ess_tail:.0f}",
        "rhat": f"{s.rhat:.4f}",
        "posterior_sd_over_prior_sd": ascii_text(format_number(s.sd_ratio, 2)),
        "converged": "yes" if o.converged else "no",
    }


def posterior_latex(o: Output) -> LatexTable:
    """Return the posterior summary of an output."""
    found = o.posterior
    sampled = [s for s in found if s.sd_ratio == s.sd_ratio]
    derived = [s for s in found if s.sd_ratio != s.sd_ratio]
    below = ""
    if derived:
        below = " The parameters above the rule follow from the sampled ones below it."
    warning = "" if o.converged else "NOT CONVERGED, not to be used. "
    return LatexTable(
        label=f"posterior_{o.key}",
        caption=(
            f"{warning}Posterior of the parameters of {o.model_words} from {o.found['data']['n']} "
            f"rows of {o.data_words}: mean ± standard deviation (sd), or the median where the "
            "interval is lopsided or spans decades; 95 % highest-density interval (HDI); effective "
            "sample sizes (ESS), R-hat [@Vehtari_2021], and the sd over that of the "
            f"prior.{below}"
        ),
        columns="lrrrrrr",
        groups=[[_latex_row(s) for s in group] for group in (derived, sampled)],
    )


def _latex_row(s: ParameterSummary) -> Row:
    return {
        "Parameter": f"[${s.name}]{in_brackets(s.unit)}",
        "Posterior": centre_text(s),
        "95 % HDI": interval_text(s),
        "ESS bulk": f"{s.ess_bulk:.0f}",
        "ESS tail": f"{s.ess_tail:.0f}",
        "R-hat": f"{s.rhat:.3f}",
        "sd/prior sd": format_number(s.sd_ratio, 2),
    }


def priors_csv(outputs: Sequence[Output]) -> list[Row]:
    """Return the priors of all outputs."""
    return [
        {"output": o.key, "model": o.model, "parameter": name,
         **{k: p[k] for k in ("unit", "distribution", "reason", "source")},
         "file_sha256": o.task["priors"]["sha256"]}
        for o in outputs for name, p in o.found["priors"].items()
    ]  # fmt: skip


def priors_latex(o: Output) -> LatexTable:
    """Return the priors of an output."""
    file = o.task["priors"]
    return LatexTable(
        label=f"priors_{o.key}",
        caption=(
            f"Priors of the parameters of {o.model_words}, from `{file['source']}` (SHA-256 "
            f"`{file['sha256'][:12]}`): normal(mean, sd), lognormal(median, sd of the logarithm), "
            "on [lower, upper] where truncated."
        ),
        columns=r"lp{0.2\textwidth}p{0.36\textwidth}p{0.24\textwidth}",
        groups=[[
            {"Parameter": f"[${name}]{in_brackets(p['unit'])}",
             "Distribution": p["distribution"].replace(" x ", " \N{MULTIPLICATION SIGN} "),
             **{k.capitalize(): with_symbols(p[k], o.found["priors"])
                for k in ("reason", "source")}}
            for name, p in o.found["priors"].items()
        ]],
    )  # fmt: skip
