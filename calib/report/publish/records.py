"""Methods and tables for print and for programs, from a manifest and a summary."""

from __future__ import annotations

import csv
import io
import re
import shlex
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, fields
from typing import Any

from jinja2 import UndefinedError

from calib.data.reader import KNOWN_DATA
from calib.inference.calibration import ParameterSummary
from calib.inference.estimators import METHODS
from calib.models import get_model
from calib.report.labels import Axis, axis_of, units_of
from calib.report.numbers import (
    NOTHING,
    ascii_number,
    ascii_text,
    format_number,
    format_value,
    last_place,
)
from calib.report.page.template import template
from calib.report.publish.markup import joined_symbols, to_latex
from calib.report.reference import Reference, reference_of
from calib.report.study_tasks import HoldOut

# Digits of a hash that tell two files apart; the manifest has all of them.
_HASH = 12

type Paragraph = tuple[str, tuple[str, ...]]
"""A heading, empty for the first, and sentences with marks (`calib.report.publish.markup`)."""


def methods(manifest: Mapping[str, Any], outputs: Sequence[Output]) -> list[Paragraph]:
    """Return the methods; a KeyError where manifest or summary lack a number."""
    labels = sorted({o.label for o in outputs if o.label})
    try:
        text = template("methods.j2", "calib.report.publish", html=False).render(
            v=manifest["versions"], s=manifest["settings"], ga=manifest["genetic_algorithm"],
            seed=manifest["seed"], command=shlex.join(map(str, manifest["command"])),
            labels=[label for label in labels if label in KNOWN_DATA], known=KNOWN_DATA,
            genetic=any("genetic" in o.found["estimates"] for o in outputs), digits=_HASH,
            outputs=[(o, _words(o)) for o in outputs], format_value=format_value,
        )  # fmt: skip
    except UndefinedError as error:
        raise KeyError(str(error)) from None
    blocks = [" ".join(map(str.strip, block.splitlines())) for block in _blocks(text)]
    starts = [0, *(i for i, block in enumerate(blocks) if block.startswith("# "))]
    return [
        (blocks[a][2:] if a else "", tuple(blocks[a + bool(a) : b]))
        for a, b in zip(starts, [*starts[1:], len(blocks)], strict=True)
    ]


def _blocks(text: str) -> list[str]:
    return [block.strip() for block in re.split(r"\n\s*\n", text) if block.strip()]


def _words(o: Output) -> dict[str, Any]:
    """What is said of an output beside what stands in its records."""
    model, v, axis = get_model(o.model), o.found["validation"], o.axis(o.found["output"])
    hits = (f"{round(share * v['n'])}" for share in v["coverage"].values())
    return {
        "model": model,
        "noise": {"family": "", "correlated_along": "", "depends_on": None, "against_normal": None}
        | o.found.get("noise", {}),
        "output_word": _lower(axis.name),
        "ranges": [_range(o.axis(name), r) for name, r in o.found["data"]["ranges"].items()],
        "sampled": joined_symbols(
            name for name, p in o.found["posterior"].items()
            if p["posterior_to_prior_sd"] is not None
        ),
        "methods": [METHODS[m].words if m in METHODS else m for m in o.found["estimates"]],
        "rmse": f"{format_number(axis.factor * (v['rmse'] or 0.0))} {axis.unit}",
        "levels": [f"{level} %" for level in v["coverage"]],
        "hits": list(hits),
    }  # fmt: skip


def _range(axis: Axis, found: Mapping[str, float]) -> str:
    low, high = axis.value_text(found["lower"]), axis.value_text(found["upper"])
    both = {1: low, 2: f"{low} and {high}"}.get(int(found["distinct"]), f"{low} to {high}")
    return f"{_lower(axis.name)} {both} {axis.unit}"


def _lower(name: str) -> str:
    return name[0].lower() + name[1:]


type Row = Mapping[str, str]
"""Cells by the head of their column."""

_NAN = float("nan")


@dataclass(frozen=True)
class Output:
    """One output that was worked out: its entries in manifest and summary."""

    key: str
    model: str
    task: Mapping[str, Any]
    found: Mapping[str, Any]

    @property
    def name(self) -> str:
        """In words."""
        return self.key.replace("_", " ").capitalize()

    @property
    def model_words(self) -> str:
        """The model by its title and its place in the source, with marks."""
        model = get_model(self.model)
        source = f"the source [@{model.cited}]" if model.cited else model.source
        numbers = model.numbers.replace("-", "\N{EN DASH}")
        origin = f"{numbers} of {source}" if numbers and source else source
        return f"\u201c{model.title}\u201d" + (f" ({origin})" if origin else "")

    @property
    def label(self) -> str:
        """What the data are called; empty for measurements."""
        return str(self.found["data"]["label"])

    @property
    def reference(self) -> Reference:
        """What was printed on these data."""
        return reference_of(self.label)

    @property
    def data_words(self) -> str:
        """What to call the data."""
        return f"{self.label} data" if self.label else "data"

    def axis(self, column: str) -> Axis:
        """Return how a column is shown, in the unit of the file."""
        with units_of(self.task["data"].get("header", ())):
            return axis_of(column)

    @property
    def converged(self) -> bool:
        """Whether the posterior passed the gate."""
        return bool(self.found["sampling"]["converged"])

    @property
    def held_out(self) -> str:
        """Which rows were held out, in words; empty where none were."""
        held = self.task["held_out"]
        if held is None or self.found["validation"]["method"] != "held_out":
            return ""
        return HoldOut(**held).words

    @property
    def estimates_use_all_rows(self) -> bool:
        """Whether point estimates are of more rows than the posterior: the source's were."""
        data = self.found["data"]
        return get_model(self.model).estimates_all_rows and bool(data["n_all"] > data["n"])

    @property
    def n_estimated(self) -> int:
        """Of how many rows the point estimates are."""
        return int(self.found["data"]["n_all" if self.estimates_use_all_rows else "n"])

    @property
    def posterior(self) -> tuple[ParameterSummary, ...]:
        """Summaries of all parameters."""
        return tuple(_read_summary(name, entry) for name, entry in self.found["posterior"].items())


def outputs(manifest: Mapping[str, Any], summary: Mapping[str, Any]) -> list[Output]:
    """Return the outputs that were worked out; those that failed are left out."""
    return [
        Output(key, str(manifest["tasks"][key]["model"]), manifest["tasks"][key], found)
        for key, found in summary["models"].items()
        if "error" not in found
    ]


def _read_summary(name: str, entry: Mapping[str, Any]) -> ParameterSummary:
    """Read a posterior summary back; what JSON has no number for is NaN."""
    spelled = {**entry, "sd_ratio": entry["posterior_to_prior_sd"]}
    numbers: dict[str, Any] = {
        f.name: _NAN if spelled.get(f.name) is None else spelled[f.name]
        for f in fields(ParameterSummary)
        if f.name != "name"
    }
    return ParameterSummary(name=name, **numbers)


@dataclass(frozen=True)
class LatexTable:
    """Rows for print, cells by the head of their column, in groups with a rule between them.

    The label names its file too. Caption, heads and cells have marks, see
    `calib.report.publish.markup`; `columns` is LaTeX's column specification.
    """

    label: str
    caption: str
    columns: str
    groups: Sequence[Sequence[Row]]


def write_csv(rows: Sequence[Row]) -> str:
    """Return rows for programs as CSV (RFC 4180, but for line ends).

    Numbers are in ASCII, units in a column or in the header.
    """
    text = io.StringIO()
    writer = csv.DictWriter(text, rows[0], lineterminator="\n")
    writer.writeheader()
    writer.writerows(rows)
    return text.getvalue()


def write_latex(table: LatexTable) -> str:
    """Return a table as a LaTeX float that needs the package booktabs."""
    groups = [group for group in table.groups if group]
    body = "\n    \\midrule\n".join(
        "\n".join(f"    {_latex_row(row.values(), table.columns)}" for row in group)
        for group in groups
    )
    return "\n".join(
        [
            "% Needs \\usepackage{booktabs}; the references cited are in references.bib.",
            "\\begin{table}",
            "  \\centering",
            "  \\footnotesize",
            f"  \\caption{{{to_latex(table.caption)}}}",
            f"  \\label{{tab:{table.label.replace('_', '-')}}}",
            f"  \\begin{{tabular}}{{{table.columns}}}",
            "    \\toprule",
            f"    {_latex_row(groups[0][0], table.columns)}",
            "    \\midrule",
            body,
            "    \\bottomrule",
            "  \\end{tabular}",
            "\\end{table}",
            "",
        ]
    )


def _latex_row(cells: Iterable[str], columns: str) -> str:
    # Justified text in a narrow column has gaps; after \raggedright a row's end is spelt out.
    ragged = "\\raggedright " if "p{" in columns else ""
    first, *others = map(to_latex, cells)
    return " & ".join([first, *(ragged + cell for cell in others)]) + r" \tabularnewline"


_LEVELS = ("50", "90", "95")


def _number(value: float | None, digits: int = 3) -> str:
    return NOTHING if value is None else format_number(value, digits)


def _hits(v: Mapping[str, Any], level: str) -> int:
    return round(float(v["coverage"][level]) * int(v["n"]))


def _errors(o: Output) -> list[str]:
    """Return RMSE and CRPS as `Output.axis` says, and the largest relative error in per cent."""
    v, factor = o.found["validation"], o.axis(o.found["output"]).factor
    wanted = (("rmse", factor, 3), ("crps", factor, 3), ("max_relative_error", 100.0, 2))
    return [NOTHING if v[k] is None else format_number(f * v[k], n) for k, f, n in wanted]


def validation_csv(outputs: Sequence[Output]) -> list[Row]:
    """Return the scores of every output on rows that were not fitted."""
    return [_validation_row(o) for o in outputs]


def _validation_row(o: Output) -> Row:
    v = o.found["validation"]
    rmse, crps, worst = map(ascii_text, _errors(o))
    above = "n_relative_error_above_6_percent"
    cells = {
        "output": o.key, "model": o.model, "method": v["method"], "held_out": o.held_out,
        "n": str(v["n"]), "unit": o.axis(o.found["output"]).unit, "rmse": rmse, "crps": crps,
        "max_relative_error_percent": worst, above: str(v[above]),
    }  # fmt: skip
    for level in _LEVELS:
        cells[f"covered_{level}"] = str(_hits(v, level))
        low, high, *_ = v["coverage_interval"][level]
        ends = {"": v["coverage"][level], "jeffreys95_lower_": low, "jeffreys95_upper_": high}
        for end, share in ends.items():
            cells[f"coverage_{level}_{end}percent"] = f"{100.0 * share:.0f}"
    elpd, se = v.get("elpd"), v.get("elpd_se")
    last = last_place(se) if se else 0
    return cells | {
        "elpd": "" if elpd is None else ascii_number(elpd, last),
        "elpd_se": "" if se is None else ascii_number(se, last),
        "largest_pareto_k": ascii_text(_number(v.get("largest_pareto_k"), 2)),
        "n_refitted": str(len(v.get("refitted", ()))),
    }


def _scores(o: Output) -> Row:
    v = o.found["validation"]
    elpd = v.get("elpd")
    return {
        "Output": f"{o.name} ({o.axis(o.found['output']).unit})",
        "Rows": f"held out: {o.held_out}" if o.held_out else "leave-one-out",
        "n": str(v["n"]),
        **dict(zip(("RMSE", "CRPS", "Error (%)"), _errors(o), strict=True)),
        **{f"in {level} %": str(_hits(v, level)) for level in _LEVELS},
        "elpd": NOTHING if elpd is None else format_value(elpd, v["elpd_se"] or 0.0),
    }


def validation_latex(outputs: Sequence[Output]) -> LatexTable:
    """Return the scores of every output on rows that were not fitted."""
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
        groups=[[_scores(o) for o in outputs]],
    )


def convergence_csv(outputs: Sequence[Output]) -> list[Row]:
    """Return what the convergence gate saw."""
    return [
        {"output": o.key, "model": o.model, "passed": "yes" if o.converged else "no",
         **{name: ascii_text(text) for name, text in _convergence(o).items()},
         "log_evidence": ascii_text(_number(o.found["sampling"]["log_evidence"], 4))}
        for o in outputs
    ]  # fmt: skip


def _convergence(o: Output) -> Row:
    s = o.found["sampling"]
    gate = s["gate"]
    rhat = gate["largest_rhat"]
    return {
        **{k: str(s[k]) for k in ("ensembles", "walkers", "steps")},
        "largest_rhat": NOTHING if rhat is None else f"{rhat:.4f}",
        **{k: NOTHING if gate[k] is None else f"{gate[k]:.0f}"
           for k in ("smallest_ess_bulk", "smallest_ess_tail")},
        "smallest_steps_over_tau": _number(gate["smallest_steps_over_tau"], 3),
        "acceptance_percent": f"{100.0 * s['acceptance']:.0f}",
        "density_evaluations": str(s["evaluations"]),
    }  # fmt: skip


_SEEN = (
    "Ensembles", "Walkers", "Steps", "R-hat", "ESS bulk", "ESS tail",
    "Steps/\N{GREEK SMALL LETTER TAU}", "Accepted (%)", "Evaluations",
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
        groups=[[
            {"Output": o.name, **dict(zip(_SEEN, _convergence(o).values(), strict=True)),
             "Passed": "yes" if o.converged else "NO"}
            for o in outputs
        ]],
    )  # fmt: skip
