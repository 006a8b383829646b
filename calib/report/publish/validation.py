"""Tables of what was checked: scores on unseen rows, and convergence."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from calib.report.labels import axis_of
from calib.report.numbers import (
    NOTHING,
    ascii_number,
    ascii_text,
    format_number,
    format_value,
    last_place,
)
from calib.report.publish.grid import CsvTable, LatexTable
from calib.report.publish.records import Output

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
        small=True,
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
        small=True,
    )  # fmt: skip
