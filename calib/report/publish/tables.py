"""Tables for print and for programs: estimates, posteriors, priors, scores, convergence."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import Any

from calib.inference.calibration import ParameterSummary
from calib.inference.estimators import METHODS, method_name
from calib.models import get_model
from calib.report.labels import axis_of
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
    format_value,
    interval_text,
    last_place,
    skewed,
)
from calib.report.publish.markup import in_brackets, with_symbols
from calib.report.publish.records import CsvTable, LatexTable, Output
from calib.report.reference import Figure, FittedTable, reference_of

_HEAD = (
    "output", "model", "rows", "n_rows", "quantity", "unit", "method", "value", "published",
    "published_in", "same_printed_digits",
)  # fmt: skip
_ALONE = {"B": "1/%", "C": "1", "D": "kN", "E": "1", "cost": "kN^2"}
_QUALITY = {"cost": "Sum of squares", "rmse": "RMSE", "r_squared": "R²"}


def _short(method: str) -> str:
    return METHODS[method].short if method in METHODS else method


def _printed(o: Output) -> FittedTable | None:
    return reference_of(o.label).table(o.model)


def _varying(o: Output) -> dict[str, str]:
    """Published parameters that were not held fixed, with their units."""
    return {k: u for k, u in get_model(o.model).reported.items() if k in o.found["posterior"]}


def _n_rows(o: Output) -> int:
    return int(o.found["data"]["n_all" if o.estimates_use_all_rows else "n"])


def _digits(value: float | None, printed: Figure | None) -> str:
    if value is None:
        return NOTHING
    return format_number(value, 4) if printed is None else format_as_printed(value, printed.text)


def _rows_of(o: Output) -> Iterator[tuple[str, str, str, float | None, Figure | None, str]]:
    """Yield (quantity, unit, method, value, printed figure, its table) of all rows together."""
    table = _printed(o)
    source, quality = (table.source, reference_of(o.label).quality(o.model)) if table else ("", {})
    for method, values in o.found["estimates"].items():
        fit = o.found["fit"][method]
        units = {"cost": fit["cost_unit"], "rmse": fit["rmse_unit"], "r_squared": "1"}
        for name, unit in _varying(o).items():
            printed = table.estimates.get(name) if table else None
            yield name, unit, method, values[name], printed, source
        for name in _QUALITY:
            yield name, units[name], method, fit[name], quality.get(name), source


def estimates_csv(outputs: Sequence[Output]) -> CsvTable:
    """Return every estimate of every output: all rows together, then each pressure alone."""
    rows = []
    for o in outputs:
        for found in _rows_of(o):
            rows.append((o.key, o.model, "together", str(_n_rows(o)), *_csv_cells(*found)))
        for psi, by_method in o.found["by_pressure"].items():
            for method, values in by_method.items():
                beside = _beside(o, psi, method)
                shown = {**beside.estimates, **beside.quality} if beside else {}
                source = beside.source.partition(",")[0] if beside else ""
                for name, unit in _ALONE.items():
                    cells = _csv_cells(name, unit, method, values[name], shown.get(name), source)
                    rows.append((o.key, "magic_formula", psi, "", *cells))
    return CsvTable(_HEAD, tuple(rows))


def _csv_cells(
    name: str, unit: str, method: str, value: float | None, printed: Figure | None, source: str
) -> tuple[str, ...]:
    beside = ("", "", "")
    if printed is not None and value is not None:
        beside = (printed.text, source, "yes" if printed.agrees(value) else "no")
    return (name, unit, method, ascii_text(_digits(value, printed)), *beside)


def estimates_latex(o: Output) -> LatexTable | None:
    """Return the estimates of an output; None where no method gave one."""
    methods = list(o.found["estimates"])
    if not methods:
        return None
    table = _printed(o)
    posterior = {s.name: s for s in o.posterior}
    cells: dict[str, list[str]] = {}
    for name, unit, _, value, printed, _ in _rows_of(o):
        known = [format_like(printed.value, printed.text) if printed else NOTHING] if table else []
        row = cells.setdefault(name, [_name_cell(name, unit), *known])
        row.append(_ticked(value, printed))
    for name, row in cells.items():
        row.append(_posterior(posterior[name]) if name in posterior else NOTHING)
    data = o.found["data"]
    rows = f"all {_n_rows(o)}" if o.estimates_use_all_rows else str(_n_rows(o))
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
        head=(
            "Parameter", *([table.source] if table else []),
            *(_short(m) for m in methods), "Posterior",
        ),
        groups=(
            tuple(tuple(row) for name, row in cells.items() if name not in _QUALITY),
            tuple(tuple(row) for name, row in cells.items() if name in _QUALITY),
        ),
    )  # fmt: skip


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


def _beside(o: Output, pressure: str, method: str) -> FittedTable | None:
    return reference_of(o.label).beside(method, float(pressure.partition(" ")[0]))


def pressure_latex(o: Output) -> LatexTable | None:
    """Return the Magic Formula at each pressure alone; None for other models."""
    groups = []
    for pressure, by_method in o.found["by_pressure"].items():
        group = []
        for method, values in by_method.items():
            beside = _beside(o, pressure, method)
            shown = {**beside.estimates, **beside.quality} if beside else {}
            group.append((pressure, method_name(method),
                          *(_ticked(values[k], shown.get(k)) for k in _ALONE)))  # fmt: skip
        for tables in reference_of(o.label).alone.values():
            table = tables.get(round(float(pressure.partition(" ")[0])))
            if table is not None:
                figures = {**table.estimates, **table.quality}
                group.append((pressure, f"published ({table.source.partition(',')[0]})",
                              *(format_like(figures[k].value, figures[k].text)
                                for k in _ALONE)))  # fmt: skip
        groups.append(tuple(group))
    if not groups:
        return None
    head = (f"{_QUALITY.get(k) or f'[${k}]'}{in_brackets(u)}" for k, u in _ALONE.items())
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
        head=("Pressure", "Method", *head),
        groups=tuple(groups),
    )  # fmt: skip


_POSTERIOR_HEAD = (
    "output", "model", "parameter", "unit", "mean", "sd", "mcse_mean", "median", "hdi95_lower",
    "hdi95_upper", "ess_bulk", "ess_tail", "rhat", "posterior_sd_over_prior_sd", "converged",
)  # fmt: skip


def posterior_csv(outputs: Sequence[Output]) -> CsvTable:
    """Return the posterior summaries of all outputs, one row for every parameter."""
    return CsvTable(
        _POSTERIOR_HEAD,
        tuple((o.key, o.model, *_csv_row(s, o)) for o in outputs for s in o.posterior),
    )


def _csv_row(s: ParameterSummary, o: Output) -> tuple[str, ...]:
    last = last_place(s.sd, s.mcse_mean)
    low, high = end_places(s)
    return (
        s.name,
        s.unit,
        ascii_number(s.mean, last),
        ascii_number(s.sd, last),
        ascii_text(format_number(s.mcse_mean, 2)),
        ascii_number(s.median, centre_place(s)),
        ascii_number(s.hdi_lower, low),
        ascii_number(s.hdi_upper, high),
        f"{s.ess_bulk:.0f}",
        f"{s.ess_tail:.0f}",
        f"{s.rhat:.4f}",
        ascii_text(format_number(s.sd_ratio, 2)),
        "yes" if o.converged else "no",
    )


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
        head=("Parameter", "Posterior", "95 % HDI", "ESS bulk", "ESS tail", "R-hat",
              "sd/prior sd"),
        groups=(tuple(map(_latex_row, derived)), tuple(map(_latex_row, sampled))),
    )  # fmt: skip


def _latex_row(s: ParameterSummary) -> tuple[str, ...]:
    ratio = format_number(s.sd_ratio, 2) if s.sd_ratio == s.sd_ratio else NOTHING
    return (
        f"[${s.name}]{in_brackets(s.unit)}", centre_text(s), interval_text(s), f"{s.ess_bulk:.0f}",
        f"{s.ess_tail:.0f}", f"{s.rhat:.3f}", ratio,
    )  # fmt: skip


def priors_csv(outputs: Sequence[Output]) -> CsvTable:
    """Return the priors of all outputs."""
    head = ("output", "model", "parameter", "unit", "distribution", "reason", "source",
            "file_sha256")  # fmt: skip
    return CsvTable(head, tuple(
        (o.key, o.model, name, p["unit"], p["distribution"], p["reason"], p["source"],
         o.task["priors"]["sha256"])
        for o in outputs for name, p in o.found["priors"].items()
    ))  # fmt: skip


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
        head=("Parameter", "Distribution", "Reason", "Source"),
        groups=(tuple(
            (f"[${name}]{in_brackets(p['unit'])}", p["distribution"].replace(
                " x ", " \N{MULTIPLICATION SIGN} "),
             *(with_symbols(p[k], o.found["priors"]) for k in ("reason", "source")))
            for name, p in o.found["priors"].items()
        ),),
    )  # fmt: skip


_LEVELS = ("50", "90", "95")


def _number(value: float | None, digits: int = 3) -> str:
    return NOTHING if value is None else format_number(value, digits)


def _hits(v: Mapping[str, Any], level: str) -> int:
    return round(float(v["coverage"][level]) * int(v["n"]))


def _scale(o: Output) -> tuple[str, float]:
    """Unit in which an output is shown, and the factor to it."""
    axis = axis_of(o.found["output"])
    return axis.unit, axis.factor


def validation_csv(outputs: Sequence[Output]) -> CsvTable:
    """Return the scores of every output on rows that were not fitted."""
    head = ["output", "model", "method", "held_out", "n", "unit", "rmse", "crps",
            "max_relative_error_percent", "n_relative_error_above_6_percent"]  # fmt: skip
    for level in _LEVELS:
        head += [f"covered_{level}", f"coverage_{level}_percent",
                 f"coverage_{level}_jeffreys95_lower_percent",
                 f"coverage_{level}_jeffreys95_upper_percent"]  # fmt: skip
    head += ["elpd", "elpd_se", "largest_pareto_k", "n_refitted"]
    return CsvTable(tuple(head), tuple(map(_validation_row, outputs)))


def _validation_row(o: Output) -> tuple[str, ...]:
    v = o.found["validation"]
    unit, factor = _scale(o)
    worst = v["max_relative_error"]
    cells = [
        o.key, o.model, v["method"], o.held_out, str(v["n"]), unit,
        *(ascii_text(_number(None if v[k] is None else factor * v[k])) for k in ("rmse", "crps")),
        ascii_text(_number(None if worst is None else 100.0 * worst, 2)),
        str(v["n_relative_error_above_6_percent"]),
    ]  # fmt: skip
    for level in _LEVELS:
        shares = (v["coverage"][level], *v["coverage_interval"][level])
        cells += [str(_hits(v, level)), *(f"{100.0 * share:.0f}" for share in shares)]
    elpd, se = v.get("elpd"), v.get("elpd_se")
    last = last_place(se) if se else 0
    cells += ["" if x is None else ascii_number(x, last) for x in (elpd, se)]
    cells += [ascii_text(_number(v.get("largest_pareto_k"), 2)), str(len(v.get("refitted", ())))]
    return tuple(cells)


def validation_latex(outputs: Sequence[Output]) -> LatexTable:
    """Return the scores of every output on rows that were not fitted."""
    rows = []
    for o in outputs:
        v = o.found["validation"]
        unit, factor = _scale(o)
        worst = v["max_relative_error"]
        elpd = v.get("elpd")
        rows.append((
            f"{o.name} ({unit})",
            f"held out: {o.held_out}" if o.held_out else "leave-one-out",
            str(v["n"]),
            *(_number(None if v[k] is None else factor * v[k]) for k in ("rmse", "crps")),
            _number(None if worst is None else 100.0 * worst, 2),
            *(str(_hits(v, level)) for level in _LEVELS),
            NOTHING if elpd is None else format_value(elpd, v["elpd_se"] or 0.0),
        ))  # fmt: skip
    labels = sorted({o.label for o in outputs if o.label})
    words = f" ({', '.join(labels)} data)" if labels else ""
    return LatexTable(
        label="validation",
        caption=(
            f"Predictions of rows that were not fitted{words}: number of rows n, root mean square "
            "error of the predictive median (RMSE), mean continuous ranked probability score "
            "(CRPS), largest relative error, rows in the central 50, 90 and 95 % predictive bands, "
            "and expected log predictive density (elpd) of leave-one-out [@Vehtari_2017]. RMSE and "
            "CRPS in the unit of the output."
        ),
        columns="llrrrrrrrr",
        head=("Output", "Rows", "n", "RMSE", "CRPS", "Error (%)",
              *(f"in {level} %" for level in _LEVELS), "elpd"),
        groups=(tuple(rows),),
    )  # fmt: skip


def convergence_csv(outputs: Sequence[Output]) -> CsvTable:
    """Return what the convergence gate saw."""
    head = ("output", "model", "passed", "ensembles", "walkers", "steps", "largest_rhat",
            "smallest_ess_bulk", "smallest_ess_tail", "smallest_steps_over_tau",
            "acceptance_percent", "density_evaluations", "log_evidence")  # fmt: skip
    return CsvTable(head, tuple(
        (o.key, o.model, "yes" if o.converged else "no", *map(ascii_text, _convergence(o)),
         ascii_text(_number(o.found["sampling"]["log_evidence"], 4)))
        for o in outputs
    ))  # fmt: skip


def _convergence(o: Output) -> tuple[str, ...]:
    s = o.found["sampling"]
    gate = s["gate"]
    rhat = gate["largest_rhat"]
    return (
        str(s["ensembles"]),
        str(s["walkers"]),
        str(s["steps"]),
        NOTHING if rhat is None else f"{rhat:.4f}",
        *(NOTHING if gate[k] is None else f"{gate[k]:.0f}"
          for k in ("smallest_ess_bulk", "smallest_ess_tail")),
        _number(gate["smallest_steps_over_tau"], 3),
        f"{100.0 * s['acceptance']:.0f}",
        str(s["evaluations"]),
    )  # fmt: skip


def convergence_latex(outputs: Sequence[Output], gate: Mapping[str, float]) -> LatexTable:
    """Return what the convergence gate saw, with its limits as in the manifest."""
    return LatexTable(
        label="convergence",
        caption=(
            "Convergence of the posteriors: independently seeded ensembles, walkers in each, kept "
            f"steps, largest rank-normalised R-hat [@Vehtari_2021] (at most {gate['rhat_max']:g} "
            "passes), smallest bulk and tail effective sample size (at least "
            f"{gate['ess_min']:g}), smallest length in autocorrelation times (at least "
            f"{gate['taus_min']:g}), accepted proposals, evaluations of the density."
        ),
        columns="lrrrrrrrrrl",
        head=("Output", "Ensembles", "Walkers", "Steps", "R-hat", "ESS bulk", "ESS tail",
              "Steps/\N{GREEK SMALL LETTER TAU}", "Accepted (%)", "Evaluations", "Passed"),
        groups=(tuple(
            (o.name, *_convergence(o), "yes" if o.converged else "NO") for o in outputs
        ),),
    )  # fmt: skip
