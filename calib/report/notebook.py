"""Results as tables, figures and short pages, for a notebook."""

from __future__ import annotations

from collections.abc import Sequence
from functools import singledispatch
from html import escape
from typing import Any

import numpy as np
import pandas as pd
from matplotlib.figure import Figure

from calib.data import Table
from calib.data.quantities import OUTPUTS, QUANTITIES, role_of
from calib.gap.corrected import CorrectedPrediction
from calib.gap.describe import gap_document
from calib.gap.diagnose import Diagnosis
from calib.gap.mixture import UNLISTED
from calib.imports import Imported
from calib.inference.calibration import Calibration
from calib.inference.random import generator
from calib.report.comparison import comparison_figure
from calib.report.figures import bands, gap, style
from calib.report.figures.imported import imported_figure
from calib.report.gap_words import Words
from calib.report.labels import axis_of, parameter_unit, units_of
from calib.report.rows import Fitted
from calib.report.verdict import verdict
from calib.validation.comparison import Comparison
from calib.validation.plan import NextTests
from calib.validation.prediction import Prediction, band_columns, row_draws
from calib.validation.validate import Validation


@singledispatch
def frame(found: Any) -> pd.DataFrame:
    """Return a result as a table."""
    raise TypeError(f"{type(found).__name__} has no table")


@frame.register
def _(found: Table) -> pd.DataFrame:
    lines = pd.Index(found.lines, name="line") if not found.index else list(found.index)
    return pd.DataFrame(dict(found.columns), index=lines)


@frame.register
def _(found: Imported) -> pd.DataFrame:
    return pd.DataFrame(dict(found.columns), index=pd.Index(found.table.lines, name="line"))


@frame.register
def _(found: Calibration) -> pd.DataFrame:
    columns = ["unit", "median", "mean", "sd", "hdi_lower", "hdi_upper", "ess_bulk", "rhat"]
    columns += ["sd_ratio"]
    # What was sampled, then what is published of it.
    names = sorted(found.summary, key=lambda name: name not in found.problem.names)
    rows = {name: [getattr(found.summary[name], c) for c in columns] for name in names}
    named = pd.DataFrame.from_dict(rows, orient="index", columns=columns).rename_axis("parameter")
    return named.rename(columns={"sd_ratio": "sd_over_prior_sd"})


@frame.register
def _(found: Prediction) -> pd.DataFrame:
    return pd.DataFrame({**found.conditions, **band_columns(found)}, index=found.index)


@frame.register
def _(found: CorrectedPrediction) -> pd.DataFrame:
    columns = dict(found.columns)
    return pd.DataFrame(columns, index=found.index).transform(_as_numbers)


def _as_numbers(cells: pd.Series[Any]) -> pd.Series[Any]:
    """Return cells as numbers, if all of them are."""
    try:
        return pd.to_numeric(cells)
    except (TypeError, ValueError):
        return cells


@frame.register
def _(found: Validation) -> pd.DataFrame:
    low, middle, high = np.nanquantile(found.draws, [0.05, 0.5, 0.95], axis=0)
    scored = {"observed": found.observed, "median": middle, "90_lower": low, "90_upper": high}
    columns = {n: v for n, v in found.table.columns.items() if n not in OUTPUTS.values()} | scored
    lines = pd.Index(found.table.lines, name="line") if found.index is None else found.index
    return pd.DataFrame(columns, index=lines)


@frame.register
def _(found: Comparison) -> pd.DataFrame:
    rows = {
        c.model: {
            "weight": found.weights[c.model],
            "elpd": float(c.rows.sum()),
            "elpd_behind_best": found.differences[c.model].elpd,
            "se": found.differences[c.model].se,
            "sound": c.sound,
        }
        for c in found.candidates
    }
    return pd.DataFrame.from_dict(rows, orient="index").rename_axis("model")


@frame.register
def _(found: Diagnosis) -> pd.DataFrame:
    causes = {**found.inclusion.causes, UNLISTED: found.inclusion.residual_discrepancy}
    rows = {
        name: {
            "probability": cause.probability,
            "share": cause.share,
            "share_lower": cause.share_interval[0],
            "share_upper": cause.share_interval[1],
        }
        for name, cause in causes.items()
    }
    return pd.DataFrame.from_dict(rows, orient="index").rename_axis("cause")


@frame.register
def _(found: NextTests) -> pd.DataFrame:
    after = {f"{name}_after": values[1:] for name, values in found.forecast.items()}
    flags = {"outside_calibrated_range": ["+".join(row) for row in found.outside]}
    return pd.DataFrame({**found.table.columns, "cost": found.cost, **after, **flags})


@singledispatch
def figure(found: Any) -> Figure:
    """Draw the one figure that shows a result."""
    raise TypeError(f"{type(found).__name__} has no figure")


@figure.register
def _(found: Imported) -> Figure:
    return imported_figure(found)


@figure.register
def _(found: Calibration) -> Figure:
    problem = found.problem
    rng = generator(found.seed, found.label, "replicate")
    replicated = row_draws(found, problem.table, rng)
    with style.style(), units_of(problem.table.header):
        return bands.bands_figure(Fitted(found, None, replicated))


@figure.register
def _(found: Prediction) -> Figure:
    measured = found.predictive
    return _bars(
        dict(found.conditions),
        {found.output: (measured.median, measured.lower[0.9], measured.upper[0.9])},
    )


@figure.register
def _(found: CorrectedPrediction) -> Figure:
    columns = found.columns
    outputs = [name.removesuffix("_after") for name in columns if name.endswith("_after")]
    shown = {
        o: tuple(columns[f"{o}_after{end}"] for end in ("", "_lower", "_upper")) for o in outputs
    }
    return _bars(dict(found.conditions), shown)


@figure.register
def _(found: Comparison) -> Figure:
    return comparison_figure(found)


@figure.register
def _(found: Diagnosis) -> Figure:
    document = gap_document(found)
    with style.style():
        plate = gap.corrected_plate(document, Words(document))
        drawn = (plate or gap.which_plate(document, Words(document))).figure
    if drawn is None:
        raise TypeError("there is nothing to draw")
    return drawn


def _bars(conditions: dict[str, Any], shown: dict[str, Any]) -> Figure:
    """Draw medians and 90 % bars of outputs along slip, or the condition that has most values."""
    known = {n: v for n, v in conditions.items() if n in QUANTITIES and role_of(n) != "order"}
    along = max(known, key=lambda n: (role_of(n) == "slip", np.unique(known[n]).size))
    x = axis_of(along)
    with style.style():
        drawn, axes = style.panels(1, len(shown), height=60.0, bottom=14.0, gap_x=16.0)
        for ax, (output, values) in zip(axes.flat, shown.items(), strict=True):
            y = axis_of(output)
            middle, low, high = (y.scale(np.asarray(v)) for v in values)
            at = x.scale(known[along])
            ax.vlines(at, low, high, color=style.BLUE, alpha=0.4, linewidth=2.0)
            ax.plot(at, middle, "o", color=style.BLUE, ms=3.5)
            ax.set(xlabel=x.label, ylabel=f"{y.label}, 90 % bars")
    return drawn


@singledispatch
def html(found: Any) -> str:
    """Return a verdict, where there is one, and the table."""
    return str(frame(found).to_html(float_format="%.4g", max_rows=20, border=0))


@html.register
def _(found: Calibration) -> str:
    said = verdict(found)
    lines = [f"Warning: {text}." for text in said.warnings]
    lines += [f"Trust: {said.trust}." * bool(said.trust), f"Not: {said.doubt}." * bool(said.doubt)]
    problem, table = found.problem, frame(found)
    with units_of(problem.table.header):
        columns = (problem.bound.model.output, *problem.conditions)
        units = [parameter_unit(unit, columns) for unit in table["unit"]]
    table["unit"] = [unit for unit, _ in units]
    sizes = ["median", "mean", "sd", "hdi_lower", "hdi_upper"]
    table[sizes] = table[sizes].mul([factor for _, factor in units], axis=0)
    return _page(said.headline, lines, table)


@html.register
def _(found: Comparison) -> str:
    return _page(found.sentence, (), frame(found))


@html.register
def _(found: Diagnosis) -> str:
    said = Words(gap_document(found)).verdict()
    facts = dict(said.facts)
    lines = [f"{label}: {facts[label]}" for label in ("Size", "Next") if label in facts]
    return _page(said.headline, lines, frame(found))


def _page(headline: str, lines: Sequence[str], table: pd.DataFrame) -> str:
    said = "".join(f"<p>{escape(text)}</p>" for text in lines if text)
    shown = table.to_html(float_format="%.4g", max_rows=40, border=0)
    return f"<div><p><strong>{escape(headline)}</strong></p>{said}{shown}</div>"
