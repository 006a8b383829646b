"""Tables for print and for programs: scores of the held-out rows, and convergence."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from calib.report.numbers import (
    NOTHING,
    ascii_number,
    ascii_text,
    format_number,
    format_value,
    last_place,
)
from calib.report.publish.records import LatexTable, Output, Row

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
