"""Figures of the audit and of the source's gaps; one that fails does not stop the rest."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import NullFormatter

from calib.data import Table
from calib.data.quantities import OUTPUTS
from calib.he2019.audit import Audit
from calib.he2019.audit.table6 import InverseStudy, attenuation
from calib.he2019.audit.tables_1_to_4 import features
from calib.he2019.gaps import FoundGap
from calib.he2019.published import PUBLISHED
from calib.models.base import Array
from calib.models.magic_formula import magic_formula
from calib.models.soil import rut_depth
from calib.report.figures.style import (
    BLACK,
    BLUE,
    CYCLE,
    DASHES,
    DOUBLE_MM,
    GREY,
    MARKERS,
    ORANGE,
    SKY,
    SMALLEST_PT,
    VERMILION,
    Plate,
    draw_all,
    legend_below,
    note,
    panels,
    style,
)
from calib.report.gap_words import chance, short_name
from calib.report.labels import MINUS, NO_UNIT, axis_of, short
from calib.report.page.template import words
from calib.report.reference import FittedTable
from calib.report.rows import output_rows


def _line(ax: Axes, x: Any, y: Any, colour: str, label: str = "", **how: Any) -> None:
    ax.plot(x, y, color=colour, label=label or None, **how)


def _marks(ax: Axes, x: Any, y: Any, marker: str, colour: str, label: str = "", **how: Any) -> None:
    ax.plot(x, y, marker, **{"color": colour, "ls": "none", "label": label or None, **how})


def _band(ax: Axes, x: Array, low: Array, high: Array, label: str = "") -> None:
    ax.fill_between(x, low, high, color="#bcd6ea", lw=0.0, label=label or None)


def _legend(fig: Figure) -> None:
    """Draw one legend of all labels below a figure."""
    shown: dict[str, Any] = {}
    for ax in fig.axes:
        for handle, label in zip(*ax.get_legend_handles_labels(), strict=True):
            shown.setdefault(label, handle)
    legend_below(fig, shown, 3)


def _plate(fig: Figure, audit: Audit, name: str, heading: str, **facts: Any) -> Plate:
    _legend(fig)
    said = words("captions.j2", "calib.he2019", figure=name, audit=audit, **facts)
    return Plate(fig, name, said, heading)


def costs_plate(audit: Audit) -> Plate:
    """Draw where the minimum of Eq 16 can lie, and where the genetic algorithm ends."""
    fig, axes = panels(1, 2, height=46.0, left=42.0, bottom=21.0, top=7.0, gap_x=43.0)
    _bounds(axes[0, 0], audit)
    _runs(axes[0, 1], audit)
    return _plate(fig, audit, "audit_costs", "The cost of Table 5, and the genetic algorithm")


def _bounds(ax: Axes, audit: Audit) -> None:
    rows = audit["table5_joint_cost"].found
    names = ["minimum,\nany slips", "minimum,\nassumed slips", "the same, Table 4\noptimal",
             "minimum,\nreconstructed data"]  # fmt: skip
    for i, q in enumerate(rows):
        if np.isnan(q.value):
            _line(ax, [q.lower, q.upper], [i, i], BLUE, "where the minimum can lie", lw=5.0,
                  solid_capstyle="butt")  # fmt: skip
        else:
            _marks(ax, q.value, i, "D", BLUE, "minimum on reconstructed data", ms=5)
    for j, signs in enumerate(audit.curvature.order[:2]):
        _marks(ax, audit.curvature.least[signs], len(rows) + j, "s", VERMILION,
               "least cost of Table 5's digits, Table 4 optimal", ms=5)  # fmt: skip
        names.append(f"digits of Table 5,\nc9 {'positive' if signs[2] > 0 else 'negative'}")
    ax.axvline(
        audit.curvature.published_cost, color=ORANGE, lw=1.4, ls=DASHES[1], label="printed cost"
    )
    _named_rows(ax, names)
    ax.set(xlim=(0.055, 0.16), xticks=[0.06, 0.08, 0.10, 0.12, 0.14], xlabel="Cost, Eq 16 (kN²)")
    ax.set_title("Table 5: where can 0.1050 come from?", loc="left")


def _runs(ax: Axes, audit: Audit) -> None:
    spread = np.random.default_rng(0)
    names = []
    for i, search in enumerate(audit.genetic.searches):
        y = i + spread.uniform(-0.25, 0.25, search.costs.size)
        _marks(ax, search.costs / search.optimum, y, "o", BLUE, "final cost, one dot a seed",
               ms=3.4, mec="white", mew=0.3)  # fmt: skip
        _marks(ax, float(search.published) / search.optimum, i, "d", ORANGE,
               "printed cost over the least cost", ms=6.5, mec=BLACK, mew=0.6,
               zorder=4)  # fmt: skip
        names.append(f"{search.name}\n{search.arrived} of {search.costs.size} arrive")
    ax.axvline(1.0, color=GREY, lw=0.6)
    ax.set(xscale="log", xlim=(0.9, 15.0), xlabel=f"Cost over the least cost ({NO_UNIT})")
    ax.set_xticks([1.0, 2.0, 5.0, 10.0], ["1", "2", "5", "10"])
    ax.xaxis.set_minor_formatter(NullFormatter())
    _named_rows(ax, names)
    ax.set_title("Genetic algorithm over seeds", loc="left")


def _named_rows(ax: Axes, names: list[str]) -> None:
    """Name rows at 0, 1, ... from the top."""
    ax.set_yticks(range(len(names)), names)
    ax.set_ylim(len(names) - 0.5, -0.5)


def _curve(table: FittedTable, slips: Array, sign: int = 1) -> Array:
    return magic_formula(slips, **{**table.values, "E": sign * table.values["E"]})


def signs_plate(audit: Audit) -> Plate:
    """Draw the curves of Tables 3 and 4 under both signs of E."""
    published = audit.published
    rows = (published.geometric, published.genetic)
    fig, axes = panels(
        2, 3, height=38.0, bottom=17.0, top=6.0, gap_x=10.0, gap_y=8.0, sharex=True, sharey="col"
    )
    slips = np.linspace(0.0, 75.0, 301)
    for row, tables in zip(axes, rows, strict=True):
        for ax, table in zip(row, tables.values(), strict=True):
            D = table.values["D"]
            _line(ax, slips, _curve(table, slips), BLUE, "E as read (negative)", lw=1.5)
            _line(ax, slips, _curve(table, slips, -1), VERMILION, "E with the other sign", lw=1.3,
                  ls=DASHES[1])  # fmt: skip
            ax.axhline(D, color=GREY, lw=0.8, ls=DASHES[2], label="D: the peak that is printed")
            ax.axhline(0.0, color=GREY, lw=0.5)
            ax.set(xlim=(0.0, slips[-1]), ylim=(-0.35 * D, 1.2 * D))
            ax.set_title(f"{table.source}: E = {table.estimates['E'].text}".replace("-", MINUS))
    for ax in axes[-1]:
        ax.set_xlabel("Slip (%)")
    for ax in axes[:, 0]:
        ax.set_ylabel("Drawbar pull (kN)")
    open_ones = [
        f.where.split(", Eqs")[0]
        for f in audit.findings
        if f.key.endswith("sign_of_E") and f.verdict == "consistent"
    ]
    return _plate(fig, audit, "audit_signs", "The signs of E", open_ones=open_ones)


def chord_plate(audit: Audit) -> Plate:
    """Draw Table 3's curves with the chord to their peak, beside Table 4's."""
    published = audit.published
    fig, axes = panels(1, 3, height=48.0, bottom=20.0, top=6.0, gap_x=9.0)
    slips = np.linspace(0.0, 30.0, 241)
    for ax, (psi, table) in zip(axes[0], published.geometric.items(), strict=True):
        fitted, found, top = published.genetic[psi], features(table), table.values["D"]
        slope, steep = (float(f.slope.middle) for f in (found, features(fitted)))
        reach = np.array([0.0, 1.12 * top])
        _line(ax, slips, _curve(fitted, slips), BLACK, "Table 4 (genetic algorithm)", lw=1.5)
        _line(ax, reach / steep, reach, BLACK, "its initial slope", lw=0.9, ls=DASHES[2])
        _line(ax, slips, _curve(table, slips), BLUE, "Table 3 (geometric)", lw=1.5, ls=DASHES[1])
        _line(
            ax, reach / slope, reach, VERMILION, "BCD of Table 3, printed as initial slope", lw=1.2
        )
        if found.x_peak is not None:
            _marks(ax, float(found.x_peak.middle), top, "o", ORANGE, "peak of Table 3", ms=6.0,
                   mfc="none", mew=1.4)  # fmt: skip
        ax.set(xlim=(0.0, slips[-1]), ylim=(0.0, 1.15 * max(top, fitted.values["D"])))
        ax.set_title(f"{psi} psi")
        ax.set_xlabel("Slip (%)")
    axes[0, 0].set_ylabel("Drawbar pull (kN)")
    return _plate(fig, audit, "audit_chord", "The slope of Table 3")


def digits_plate(audit: Audit) -> Plate:
    """Draw the pull that Table 5's digits allow at each pressure."""
    study = audit.rounding
    fig, axes = panels(1, 3, height=50.0, bottom=17.0, top=6.0, gap_x=4.0, sharey=True)
    for ax, psi in zip(axes[0], study.allowed, strict=True):
        allowed, table4 = study.allowed[psi], study.table4[psi]
        _band(
            ax, study.slips, allowed.lower, allowed.upper, "all coefficients that print as Table 5"
        )
        for edge in (allowed.lower, allowed.upper):
            _line(ax, study.slips, edge, BLUE, lw=0.6)
        curve = study.as_printed[psi]
        if np.isfinite(curve).all():
            _line(ax, study.slips, curve, VERMILION, "Table 5 as printed", lw=1.3, ls=DASHES[1])
        _line(ax, study.slips, table4.middle, BLACK, "Table 4", lw=1.4)
        D = audit.published.genetic[psi].values["D"]
        open_by = 100.0 * float(allowed.half_width.max()) / D
        note(ax, f"open by ±{short(open_by)} % of D", x=0.97, y=0.04)
        ax.set_title(f"{psi} psi")
        ax.set_xlim(0.0, study.slips[-1])
        ax.set_xlabel("Slip (%)")
    axes[0, 0].set_ylim(0.0, None)
    axes[0, 0].set_ylabel("Drawbar pull (kN)")
    return _plate(fig, audit, "audit_digits", "What the digits of Table 5 leave open")


_AT_SLIP = 0.10


def rut_plate(audit: Audit) -> Plate:
    """Draw R^2 and RMSE against n, the exponents, and the ruts by pressure and at 30 psi."""
    fig, axes = panels(2, 2, height=50.0, left=15.0, bottom=24.0, gap_x=17.0, gap_y=15.0, top=7.0)
    for ax, draw in zip(axes.flat, (_points, _exponents, _by_pressure, _held_out), strict=True):
        draw(ax, audit)
    titles = (
        "How many points were fitted?",
        "Exponents: Eq 22 and the likelihood",
        f"Ruts brought to {100 * _AT_SLIP:g} % slip",
        f"Rut at {audit.published.setup.held_out_psi} psi, not fitted",
    )
    for ax, title in zip(axes.flat, titles, strict=True):
        ax.set_title(title, loc="left")
    return _plate(fig, audit, "audit_rut", "Table 6: points, exponents and prediction")


def _points(ax: Axes, audit: Audit) -> None:
    study = audit.quality
    _band(
        ax, study.n, study.implied.lower, study.implied.upper, "from R² and RMSE, digits propagated"
    )
    contact = float(study.from_contact.middle)
    ax.axhline(contact, color=BLACK, lw=1.1, label="from the contact lengths")
    ax.axvline(study.assumed_n, color=GREY, lw=0.8, ls=DASHES[2])
    ax.text(study.assumed_n + 2, 0.408, f"n = {study.assumed_n}", fontsize=6.5)
    found = study.reconciled
    if found.size:
        ax.axvspan(found.min(), found.max(), color=ORANGE, alpha=0.25, lw=0)
        ax.text(found.min(), 0.408, f"n = {found.min():g} to {found.max():g}", fontsize=6.5)
    ax.set(xlim=(4, study.n[-1]), xlabel=f"Points fitted, n ({NO_UNIT})")
    ax.set(ylim=(0.40, 0.54), ylabel=f"ln(pgr42/pgr18) ({NO_UNIT})")


def _exponents(ax: Axes, audit: Audit) -> None:
    study, values = audit.inverse, audit.published.rut_depth.values
    factor = float(attenuation(audit.published).middle)
    shown = 1500
    n0_n1 = np.column_stack([study.draws["n0"], study.draws["n1"]])
    every = max(1, len(n0_n1) // shown)
    clouds = (
        ("Eq 22 in simulated campaigns, 95 %", study.simulated[:shown, :2], "#8f8f8f", DASHES[1]),
        ("posterior, 95 %", n0_n1[::every], BLUE, "-"),
    )
    for name, points, colour, dashes in clouds:
        _marks(ax, points[:, 0], points[:, 1], ".", colour, ms=1.5, alpha=0.35)
        _line(ax, *_ellipse(points), colour, name, lw=1.3, ls=dashes)
    direct = study.direct.reported
    marks = (
        ("Table 6 (Eq 22)", values["n0"], values["n1"], "D", ORANGE),
        ("Table 6 divided by R²", factor * values["n0"], factor * values["n1"], "s", VERMILION),
        ("least squares of ln z, the truth simulated", direct["n0"], direct["n1"], "^", "white"),
    )
    for name, n0, n1, marker, colour in marks:
        _marks(ax, n0, n1, marker, colour, name, ms=6.0, mec=BLACK, mew=0.8)
    ax.set(xlim=(0.8, 4.8), xlabel=f"n$_0$ ({NO_UNIT})")
    ax.set(ylim=(0.0, 3.2), ylabel=f"n$_1$ ({NO_UNIT})")


def _ellipse(points: Array) -> tuple[Array, Array]:
    """Return the outline that holds 95 % of a normal cloud with these points' covariance."""
    turn = np.linspace(0.0, 2.0 * np.pi, 181)
    root = np.linalg.cholesky(np.cov(points.T))
    radius = np.sqrt(-2.0 * np.log(0.05))
    x, y = points.mean(axis=0)[:, None] + radius * root @ np.stack([np.cos(turn), np.sin(turn)])
    return x, y


def _by_pressure(ax: Axes, audit: Audit) -> None:
    study, values = audit.inverse, audit.published.rut_depth.values
    pressure = np.geomspace(60.0, 320.0, 60)
    draws = (study.draws[name] for name in ("k", "n0", "n1"))
    some = (v[:: max(1, v.size // 2000), None] for v in draws)
    ruts = 1000.0 * rut_depth(pressure, _AT_SLIP, *some)
    low, middle, high = np.quantile(ruts, [0.025, 0.5, 0.975], axis=0)
    _band(ax, pressure, low, high, "mean rut, posterior 95 %")
    _line(ax, pressure, middle, BLUE, "mean rut, posterior median", lw=1.4)
    printed = 1000.0 * rut_depth(pressure, _AT_SLIP, values["k"], values["n0"], values["n1"])
    _line(ax, pressure, printed, ORANGE, "Eq 21 with Table 6", lw=1.6, ls=DASHES[1])
    _marks(ax, *_at_one_slip(study, study.calibration.problem.table), "o", BLACK,
           "reconstructed, 18 and 42 psi (fitted)", ms=3.2, mec="white", mew=0.4)  # fmt: skip
    _marks(ax, *_at_one_slip(study, study.held_out), "o", VERMILION, mfc="white", ms=4.2, mew=1.1)
    ax.set(xlabel="Average ground pressure (kPa)", ylabel="Rut depth (mm)")


def _at_one_slip(study: InverseStudy, table: Table) -> tuple[Array, Array]:
    """Return ground pressures and ruts, brought to one slip by the least-squares fit."""
    pressure = table["average_ground_pressure_kpa"]
    v = study.direct.reported
    there, here = (
        rut_depth(pressure, slip, v["k"], v["n0"], v["n1"])
        for slip in (np.full_like(pressure, _AT_SLIP), table["slip_ratio"])
    )
    return pressure, table["rut_depth_mm"] * there / here


def _held_out(ax: Axes, audit: Audit) -> None:
    study = audit.inverse
    slip = 100.0 * study.held_out["slip_ratio"]
    low, middle, high = np.quantile(study.mean_30, [0.025, 0.5, 0.975], axis=0)
    _band(ax, slip, low, high)
    _line(ax, slip, middle, BLUE, lw=1.4)
    _line(ax, slip, study.published_30, ORANGE, lw=1.6, ls=DASHES[1])
    _marks(ax, slip, study.held_out["rut_depth_mm"], "o", VERMILION,
           "reconstructed, 30 psi (held out)", mfc="white", ms=5.0, mew=1.3)  # fmt: skip
    ax.set(xlabel="Slip (%)", ylabel="Rut depth (mm)")


def audit_plates(audit: Audit) -> list[Plate]:
    """Draw the figures of an audit; one that failed has a caption saying why instead."""
    drawings: dict[str, Callable[[Audit], Plate]] = {
        "audit_costs": costs_plate, "audit_digits": digits_plate, "audit_rut": rut_plate,
        "audit_chord": chord_plate, "audit_signs": signs_plate,
    }  # fmt: skip
    return draw_all({name: partial(draw, audit) for name, draw in drawings.items()})


# The source's gaps


@style()
def gap_plate(result: FoundGap) -> Plate:
    """Draw errors over slip before and after the correction, and the probabilities."""
    own, kept_out = output_rows(result.document)[0], result.gap.unfitted
    fig, axes = panels(1, 3, height=46.0, top=6.0, bottom=16.0 if kept_out is None else 20.0)
    # The names of the hypotheses need the room beside the last panel.
    for ax, left, width in zip(axes[0], (15.0, 70.0, 145.0), (52.0, 39.0, 32.0), strict=True):
        box = ax.get_position()
        ax.set_position((left / DOUBLE_MM, box.y0, width / DOUBLE_MM, box.height))
    before, after, which = axes[0]
    z_90 = 1.645  # quantile of the ends of a 90 % band
    left_open: dict[str, Any] = {"lw": 0.8, "ls": (0, (4, 2)), "zorder": 1}
    conditions, x_axis = result.found.data.view.conditions, axis_of("slip_ratio")
    x = x_axis.scale(conditions["slip_ratio"][own.rows])
    pressure = conditions["inflation_pressure_psi"][own.rows]
    for psi in np.unique(pressure):
        at, mark = pressure == psi, _mark(psi)
        _marks(before, x[at], (own.measured - own.before)[at], *mark, mfc="none", mew=0.9, ms=4.0,
               zorder=3)  # fmt: skip
        _marks(after, x[at], (own.measured - own.after)[at], *mark, f"{psi:g} psi", mec="white",
               mew=0.4, ms=4.6, zorder=3)  # fmt: skip
        order = np.argsort(x[at])
        for z in (-z_90, z_90):
            _line(before, x[at][order], z * result.open_sd[at][order], mark[1], **left_open)
    if kept_out is not None:
        _neither_campaign(before, after, kept_out, result)
    # 90 % of the noise about zero; a straight line through the rows' own, as it may grow.
    ends = np.array([x.min(), x.max()])
    level = z_90 * np.polyval(np.polyfit(x, own.noise, 1), ends)
    for ax in (before, after):
        ax.fill_between(ends, -level, level, color="#e6e6e6", lw=0.0, zorder=0,
                        label="90 % of the noise" if ax is after else None)  # fmt: skip
        ax.axhline(0.0, color=GREY, lw=0.6, zorder=1)
        ax.set_xlabel(x_axis.label)
    _line(after, [], [], GREY, "90 % of what the calibration left open", **left_open)
    heights = [end for ax in (before, after) for end in ax.get_ylim()]
    for ax in (before, after):
        ax.set_ylim(min(heights), max(heights))
        ax.ticklabel_format(axis="y", style="plain")
    after.tick_params(labelleft=False)
    before.set_ylabel(f"Data minus prediction ({own.axis.unit})")
    before.set_title(f"Before: {own.name.replace('_', ' ')}", loc="left")
    after.set_title("After: corrected model", loc="left")
    _which(which, result)
    _legend(fig)
    before_rms, after_rms = (
        float(np.sqrt(np.mean((own.measured - v) ** 2))) for v in (own.before, own.after)
    )
    said = words(
        "captions.j2", "calib.he2019", figure="gap", output=own.name.replace("_", " "),
        rows=own.rows.size, unit=own.axis.unit, before=before_rms, after=after_rms,
        noise=float(np.median(own.noise)), kept_out=kept_out is not None,
    )  # fmt: skip
    return Plate(fig, result.gap.name, said, result.gap.title)


def _neither_campaign(before: Axes, after: Axes, rows: Table, result: FoundGap) -> None:
    """Draw the errors at rows that stood in neither campaign."""
    predicted = result.found.new_predictions[result.output]
    column = OUTPUTS[result.output]
    psi = float(rows["inflation_pressure_psi"][0])
    for ax, values in ((before, predicted.before), (after, predicted.after)):
        _marks(
            ax, axis_of("slip_ratio").scale(rows["slip_ratio"]),
            axis_of(column).factor * (rows[column] - values), *_mark(psi),
            f"{psi:g} psi, used in neither campaign" if ax is after else "", mfc="white", mew=0.9,
            ms=4.4, zorder=2,
        )  # fmt: skip


def _which(ax: Axes, result: FoundGap) -> None:
    """Draw the probabilities of the five most probable hypotheses."""
    p, names = result.found.ranking.probability, result.found.ranking.order[:5]
    for i, name in enumerate(names):
        ax.barh(i, p[name], color=SKY if i else BLUE, height=0.62)
        ax.text(p[name] + 0.03, i, chance(p[name]), va="center", fontsize=SMALLEST_PT)
    _named_rows(ax, [short_name(name).replace(" + ", "\n+ ") for name in names])
    ax.tick_params(axis="y", length=0.0, labelsize=SMALLEST_PT)
    ax.set(xlim=(0.0, 1.0), xlabel=f"Probability ({NO_UNIT})")
    ax.set_xticks([0.0, 0.5, 1.0], ["0", "0.5", "1"])
    ax.set_title("Which", loc="left")


def _mark(psi: float) -> tuple[str, str]:
    """Return marker and colour of a pressure."""
    i = list(PUBLISHED.setup.inflation_pressures_psi).index(round(psi))
    return MARKERS[i], CYCLE[i]
