"""The tables of a report, each declared once: for the page, for LaTeX and for programs.

To add one, write a function that returns it and one that yields its rows for programs, and list
both in `TOPICS`. Cells, heads and captions are text with marks (`calib.report.markup`).
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass

from calib.inference.calibration import ParameterSummary
from calib.inference.estimators import METHODS, method_name
from calib.report.document import Output
from calib.report.markup import to_latex, with_symbols
from calib.report.numbers import (
    NOTHING,
    TIMES,
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
from calib.report.page.template import words
from calib.report.reference import Figure

TICK = "\N{CHECK MARK}"
_LEVELS = ("50", "90", "95")

type Row = Mapping[str, str]
"""Cells by the head of their column."""


@dataclass(frozen=True)
class Table:
    """Rows for people, in groups with a rule between them.

    The label names its file; `columns` is LaTeX's column specification, in which text is l or p.
    """

    label: str
    caption: str
    columns: str
    groups: Sequence[Sequence[Row]]

    @property
    def head(self) -> list[str]:
        """Heads of the columns."""
        return list(next(row for group in self.groups for row in group))

    @property
    def texts(self) -> list[bool]:
        """Whether each column is of text; one that only a page has is."""
        found = [kind != "r" for kind in re.findall(r"([lrp])(?:\{[^}]*\})?", self.columns)]
        return found + [True] * (len(self.head) - len(found))

    @property
    def rows(self) -> list[list[str]]:
        """The cells of all groups."""
        return [list(row.values()) for group in self.groups for row in group]

    def latex(self) -> str:
        """Return it as a LaTeX float that needs the package booktabs."""
        # Justified text in a narrow column has gaps; after \raggedright a row's end is spelt out.
        ragged = "\\raggedright " if "p{" in self.columns else ""

        def line(cells: Iterable[str]) -> str:
            first, *others = map(to_latex, cells)
            return f"    {' & '.join([first, *(ragged + c for c in others)])} \\tabularnewline"

        groups = ["\n".join(line(row.values()) for row in group) for group in self.groups if group]
        return "\n".join(
            [
                "% Needs \\usepackage{booktabs}; the references cited are in references.bib.",
                "\\begin{table}",
                "  \\centering",
                "  \\footnotesize",
                f"  \\caption{{{to_latex(self.caption)}}}",
                f"  \\label{{tab:{self.label.replace('_', '-')}}}",
                f"  \\begin{{tabular}}{{{self.columns}}}",
                "    \\toprule",
                line(self.head),
                "    \\midrule",
                "\n    \\midrule\n".join(groups),
                "    \\bottomrule",
                "  \\end{tabular}",
                "\\end{table}\n",
            ]
        )


def _caption(table: str, **facts: object) -> str:
    return words("captions.j2", "calib.report.publish", table=table, **facts)


def _named(name: str, unit: str) -> str:
    """Return symbol and unit of a parameter."""
    return f"[${name}]" + ("" if unit in ("1", "") else f" ([u:{unit}])")


def _yes(value: bool) -> str:
    return "yes" if value else "NO"


def _number(value: float | None, digits: int = 3, form: str = "") -> str:
    if value is None:
        return NOTHING
    return format(value, form) if form else format_number(value, digits)


# The posterior


def posterior_table(o: Output) -> Table:
    """Return the posterior summary: sampled parameters, then what follows from them."""
    sampled, derived = _sampled_and_derived(o)
    groups = [[_posterior_row(s) for s in group] for group in (sampled, derived)]
    said = _caption("posterior", o=o, derived=derived)
    return Table(f"posterior_{o.key}", said, "lrrrrrr", groups)


def _sampled_and_derived(o: Output) -> tuple[list[ParameterSummary], list[ParameterSummary]]:
    """Return the parameters that were sampled, and those that follow and are not the same again."""
    sampled = [s for s in o.posterior if s.sd_ratio == s.sd_ratio]
    known = {(s.mean, s.sd) for s in sampled}
    follow = [s for s in o.posterior if s.sd_ratio != s.sd_ratio and (s.mean, s.sd) not in known]
    return sampled, follow


def parameters_table(o: Output) -> Table:
    """Return what a page says first of the parameters: meaning, posterior, what identifies each."""
    known, priors = o.found["prior_sensitivity"]["parameters"], o.facts["priors"]
    meanings = {"sigma": "standard deviation of the noise", **o.model.meanings}

    def row(s: ParameterSummary) -> Row:
        said = known[s.name]["reading"] if s.name in known else NOTHING
        sure = s.name not in known or known[s.name]["identified"]
        return {
            "Parameter": _named(s.name, s.unit),
            "Meaning": meanings.get(s.name, NOTHING),
            "Prior, 95 %": " to ".join(_number(end, 2) for end in priors.get(s.name, (None,))),
            "Posterior": centre_text(s),
            "95 % HDI": interval_text(s),
            "Identified by": said if sure else f"[!{said}]",
        }

    groups = [[row(s) for s in group] for group in _sampled_and_derived(o)]
    return Table(f"parameters_{o.key}", "", "llrrrl", groups)


def chains_table(o: Output) -> Table:
    """Return what a page says of convergence by parameter: the posterior is said before."""
    groups = [[_posterior_row(s) for s in group] for group in _sampled_and_derived(o)]
    for row in (row for group in groups for row in group):
        del row["Posterior"], row["95 % HDI"]
    return Table(f"chains_{o.key}", "", "lrrrr", groups)


def _posterior_row(s: ParameterSummary) -> dict[str, str]:
    return {
        "Parameter": _named(s.name, s.unit),
        "Posterior": centre_text(s),
        "95 % HDI": interval_text(s),
        "ESS bulk": f"{s.ess_bulk:.0f}",
        "ESS tail": f"{s.ess_tail:.0f}",
        "R-hat": f"{s.rhat:.3f}",
        "sd/prior sd": format_number(s.sd_ratio, 2),
    }


def posterior_rows(o: Output) -> Iterator[Row]:
    """Yield a row for every parameter."""
    for s in o.posterior:
        last, (low, high) = last_place(s.sd, s.mcse_mean), end_places(s)
        yield {
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


def sensitivity_rows(o: Output) -> Iterator[Row]:
    """Yield what each parameter owes to the prior and to the data."""
    for name, s in o.found["prior_sensitivity"]["parameters"].items():
        yield {
            "parameter": name,
            "contraction": ascii_text(_number(s["contraction"], 4)),
            "reacts_to_prior": ascii_text(_number(s["prior"], 2)),
            "reacts_to_data": ascii_text(_number(s["likelihood"], 2)),
            "identified": _yes(s["identified"]).lower(),
            "reading": s["reading"],
        }


def sensitivity_table(o: Output) -> Table | None:
    """Return what each parameter owes to the prior and to the data; None if that is not known."""
    known = o.found["prior_sensitivity"]
    found = known["parameters"]
    if not found:
        return None
    unknown = [f"[${name}]" for name, s in found.items() if not s["identified"]]
    rows = [
        {
            "Parameter": f"[${name}]",
            "Contraction": _number(s["contraction"], 2),
            "Reacts to prior": _number(s["prior"], 2),
            "Reacts to data": _number(s["likelihood"], 2),
            "Identified by": s["reading"] if s["identified"] else f"[!{s['reading']}]",
        }
        for name, s in found.items()
    ]
    said = _caption("sensitivity", unknown=unknown, criteria=known["criteria"])
    return Table(f"sensitivity_{o.key}", said, "lrrrl", [rows])


# Point estimates

_ALONE = {"B": "1/%", "C": "1", "D": "kN", "E": "1", "cost": "kN^2"}
_QUALITY = {"cost": "Sum of squares", "rmse": "RMSE", "r_squared": "R²"}

type _Estimate = tuple[str, str, str, float | None, Figure | None, str]
"""Quantity, unit, method, value, printed figure, and where that is."""


def _together(o: Output) -> Iterator[_Estimate]:
    """Yield the estimates from all rows together, and how well they fit."""
    table, quality = o.reference.table(o.model.name), o.reference.quality(o.model.name)
    shown, source = ({**table.estimates, **quality}, table.source) if table else ({}, "")
    varying = {k: u for k, u in o.model.reported.items() if k in o.found["posterior"]}
    for method, values in o.found["estimates"].items():
        fit = o.found["fit"][method]
        units = {"cost": fit["cost_unit"], "rmse": fit["rmse_unit"], "r_squared": "1"}
        for name, unit in (varying | units).items():
            value = (fit if name in _QUALITY else values)[name]
            yield name, unit, method, value, shown.get(name), source


def _psi(pressure: str) -> float:
    return float(pressure.partition(" ")[0])


def _alone(o: Output) -> Iterator[tuple[str, str, list[_Estimate]]]:
    """Yield each pressure and method, and the estimates from the rows of that pressure alone."""
    for pressure, by_method in o.found["by_pressure"].items():
        for method, values in by_method.items():
            beside = o.reference.beside(method, _psi(pressure))
            shown, place = (beside.figures, beside.place) if beside else ({}, "")
            yield pressure, method, [
                (k, u, method, values[k], shown.get(k), place) for k, u in _ALONE.items()
            ]  # fmt: skip


def _digits(value: float | None, printed: Figure | None) -> str:
    if value is None:
        return NOTHING
    return format_number(value, 4) if printed is None else format_as_printed(value, printed.text)


def _ticked(value: float | None, printed: Figure | None) -> str:
    same = printed is not None and value is not None and printed.agrees(value)
    return _digits(value, printed) + (TICK if same else "")


def estimates_table(o: Output) -> Table | None:
    """Return the estimates beside published figures and the posterior; None if there are none."""
    methods = list(o.found["estimates"])
    if not methods:
        return None
    short = {m: METHODS[m].short if m in METHODS else m for m in methods}
    table, fit = o.reference.table(o.model.name), o.found["fit"]
    rows: dict[str, dict[str, str]] = {}
    for name, unit, method, value, printed, source in _together(o):
        named = _named(name, unit).replace(f"[${name}]", _QUALITY.get(name, f"[${name}]"))
        row = rows.setdefault(name, {"Parameter": named})
        if table:
            row[source] = format_like(printed.value, printed.text) if printed else NOTHING
        row[short[method]] = _ticked(value, printed)
    ended = {
        "Evaluations": {short[m]: f"{fit[m]['evaluations']:,}" for m in methods},
        "Stopped by its own rule": {short[m]: _yes(fit[m]["converged"]) for m in methods},
    }
    beside = {table.source: NOTHING} if table else {}
    rows |= {name: {"Parameter": name, **beside, **cells} for name, cells in ended.items()}
    posterior = {s.name: s for s in o.posterior}
    for name, row in rows.items():
        row["Posterior"] = NOTHING
        if name in posterior:
            s = posterior[name]
            row["Posterior"] = centre_text(s) + (f" ({interval_text(s)})" if skewed(s) else "")
    said = _caption(
        "estimates",
        o=o,
        printed=table,
        tick=TICK,
        titles=[f"{short[m]}: {METHODS[m].title}" for m in methods if m in METHODS],
        notes=[
            f"{method_name(m).capitalize()}: {fit[m]['note']}" for m in methods if fit[m]["note"]
        ],
    )
    parameters = [row for name, row in rows.items() if name in posterior]
    others = [row for row in rows.values() if row not in parameters]
    columns = f"l{'r' * (len(methods) + 1 + bool(table))}"
    return Table(f"estimates_{o.key}", said.replace("..", "."), columns, [parameters, others])


def pressure_table(o: Output) -> Table | None:
    """Return the Magic Formula at each pressure alone; None for other models."""
    groups: dict[str, list[Row]] = {}
    names = [_named(k, u).replace("[$cost]", _QUALITY["cost"]) for k, u in _ALONE.items()]

    def add(pressure: str, method: str, cells: Iterable[str]) -> None:
        row = {"Pressure": pressure, "Method": method} | dict(zip(names, cells, strict=True))
        groups.setdefault(pressure, []).append(row)

    for pressure, method, found in _alone(o):
        add(pressure, method_name(method), (_ticked(e[3], e[4]) for e in found))
    for pressure in groups:
        for tables in o.reference.alone.values():
            if (table := tables.get(round(_psi(pressure)))) is not None:
                printed = [table.figures[k] for k in _ALONE]
                cells = (format_like(figure.value, figure.text) for figure in printed)
                add(pressure, f"published ({table.place})", cells)
    if not groups:
        return None
    said = _caption("by_pressure", o=o, tick=TICK)
    return Table(f"estimates_by_pressure_{o.key}", said, "llrrrrr", list(groups.values()))


def estimates_rows(o: Output) -> Iterator[Row]:
    """Yield every estimate: all rows together, then each pressure alone."""
    found = [(o.model.name, "together", str(o.n_estimated), e) for e in _together(o)]
    found += [("magic_formula", at, "", e) for at, _, estimates in _alone(o) for e in estimates]
    for model, at, n, (name, unit, method, value, printed, source) in found:
        agrees = _yes(printed.agrees(value)).lower() if printed and value is not None else ""
        yield {
            "model": model,
            "rows": at,
            "n_rows": n,
            "quantity": name,
            "unit": unit,
            "method": method,
            "value": ascii_text(_digits(value, printed)),
            "published": printed.text if printed and agrees else "",
            "published_in": source if agrees else "",
            "same_printed_digits": agrees,
        }


# Scores on rows that were not fitted


def _errors(o: Output) -> list[str]:
    """Return RMSE and CRPS as `Output.axis` says, and the largest relative error in per cent."""
    v, factor = o.found["validation"], o.axis().factor
    wanted = (("rmse", factor, 3), ("crps", factor, 3), ("max_relative_error", 100.0, 2))
    return [_number(None if v[k] is None else f * v[k], n) for k, f, n in wanted]


def validation_table(found: Sequence[Output], gate: Mapping[str, float]) -> Table:
    """Return the scores of every output."""
    rows = []
    for o in found:
        v = o.found["validation"]
        elpd = v.get("elpd")
        row = {
            "Output": f"{o.name} ({o.axis().unit})",
            "Rows": f"held out: {o.held_out}" if o.held_out else "leave-one-out",
            "n": str(v["n"]),
            **dict(zip(("RMSE", "CRPS", "Error (%)"), _errors(o), strict=True)),
            **{f"in {level} %": str(o.hits(level)) for level in _LEVELS},
            "elpd": NOTHING if elpd is None else format_value(elpd, v["elpd_se"] or 0.0),
        }
        rows.append(row)
    said = _caption("validation", labels=sorted({o.label for o in found if o.label}))
    return Table("validation", said, "llrrrrrrrr", [rows])


def validation_rows(o: Output) -> Iterator[Row]:
    """Yield the scores."""
    v = o.found["validation"]
    rmse, crps, worst = map(ascii_text, _errors(o))
    above = "n_relative_error_above_6_percent"
    cells = {
        "method": v["method"],
        "held_out": o.held_out,
        "n": str(v["n"]),
        "unit": o.axis().unit,
        "rmse": rmse,
        "crps": crps,
        "max_relative_error_percent": worst,
        above: str(v[above]),
    }
    for level in _LEVELS:
        cells[f"covered_{level}"] = str(o.hits(level))
        low, high, *_ = v["coverage_interval"][level]
        ends = {"": v["coverage"][level], "jeffreys95_lower_": low, "jeffreys95_upper_": high}
        for end, share in ends.items():
            cells[f"coverage_{level}_{end}percent"] = f"{100.0 * share:.0f}"
    last = last_place(v["elpd_se"]) if v.get("elpd_se") else 0
    for key in ("elpd", "elpd_se"):
        cells[key] = "" if v.get(key) is None else ascii_number(v[key], last)
    yield cells | {
        "largest_pareto_k": ascii_text(_number(v.get("largest_pareto_k"), 2)),
        "n_refitted": str(len(v.get("refitted", ()))),
    }


# Convergence


def _convergence(o: Output) -> dict[str, str]:
    s = o.found["sampling"]
    gate = s["gate"]
    return {
        **{k: str(s[k]) for k in ("ensembles", "walkers", "steps")},
        "largest_rhat": _number(gate["largest_rhat"], form=".4f"),
        "smallest_ess_bulk": _number(gate["smallest_ess_bulk"], form=".0f"),
        "smallest_ess_tail": _number(gate["smallest_ess_tail"], form=".0f"),
        "smallest_steps_over_tau": _number(gate["smallest_steps_over_tau"], 3),
        "acceptance_percent": f"{100.0 * s['acceptance']:.0f}",
        "density_evaluations": str(s["evaluations"]),
    }


def convergence_table(found: Sequence[Output], gate: Mapping[str, float]) -> Table:
    """Return what the convergence gate saw, with its limits as in the manifest."""
    heads = ["Ensembles", "Walkers", "Steps", "R-hat", "ESS bulk", "ESS tail", "Steps/τ"]
    heads += ["Accepted (%)", "Evaluations"]
    rows = [
        {"Output": o.name}
        | dict(zip(heads, _convergence(o).values(), strict=True))
        | {"Passed": _yes(o.converged)}
        for o in found
    ]
    return Table("convergence", _caption("convergence", gate=gate), "lrrrrrrrrrl", [rows])


def convergence_rows(o: Output) -> Iterator[Row]:
    """Yield what the convergence gate saw."""
    evidence = ascii_text(_number(o.found["sampling"]["log_evidence"], 4))
    seen = {name: ascii_text(text) for name, text in _convergence(o).items()}
    yield {"passed": _yes(o.converged).lower(), **seen, "log_evidence": evidence}


# Priors


def priors_table(o: Output) -> Table:
    """Return the priors of an output."""
    priors = o.found["priors"]
    rows = [
        {
            "Parameter": _named(name, p["unit"]),
            "Distribution": p["distribution"].replace(" x ", f" {TIMES} "),
            **{k.capitalize(): with_symbols(p[k], priors) for k in ("reason", "source")},
        }
        for name, p in priors.items()
    ]
    columns = r"lp{0.2\textwidth}p{0.36\textwidth}p{0.24\textwidth}"
    return Table(f"priors_{o.key}", _caption("priors", o=o, file=o.task["priors"]), columns, [rows])


def priors_rows(o: Output) -> Iterator[Row]:
    """Yield the priors."""
    for name, p in o.found["priors"].items():
        said = {k: p[k] for k in ("unit", "distribution", "reason", "source")}
        yield {"parameter": name, **said, "file_sha256": o.task["priors"]["sha256"]}


@dataclass(frozen=True)
class Topic:
    """A subject of tables: rows of an output for programs, and what people read.

    That is tables of one output, None where it has none, and one of all outputs, given the limits
    of the gate.
    """

    rows: Callable[[Output], Iterator[Row]]
    each: tuple[Callable[[Output], Table | None], ...] = ()
    together: Callable[[Sequence[Output], Mapping[str, float]], Table] | None = None

    def of_output(self, o: Output) -> list[Table]:
        """Return the tables of an output."""
        return [table for make in self.each if (table := make(o)) is not None]


TOPICS: Mapping[str, Topic] = {
    "posterior": Topic(posterior_rows, (posterior_table,)),
    "sensitivity": Topic(sensitivity_rows, (sensitivity_table,)),
    "estimates": Topic(estimates_rows, (estimates_table, pressure_table)),
    "validation": Topic(validation_rows, together=validation_table),
    "convergence": Topic(convergence_rows, together=convergence_table),
    "priors": Topic(priors_rows, (priors_table,)),
}
"""All tables. One whose place the page's template does not name stands at the end of its output."""
