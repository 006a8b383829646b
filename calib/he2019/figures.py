"""Figures of the audit and of the source's gaps; one that fails does not stop the rest."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch
from matplotlib.ticker import FixedLocator, NullFormatter

from calib.data import Table
from calib.data.quantities import OUTPUTS
from calib.he2019.audit import Audit
from calib.he2019.audit.pull import features
from calib.he2019.audit.regressions import InverseStudy, attenuation
from calib.he2019.gaps import FoundGap
from calib.models.base import Array
from calib.models.magic_formula import magic_formula
from calib.models.soil import rut_depth
from calib.report.figures.gap import OutputRows, output_rows
from calib.report.figures.plate import Plate, draw_all
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
    legend_below,
    note,
    panels,
    style,
)
from calib.report.gap_words import chance, short_name
from calib.report.labels import NO_UNIT, axis_of, joined, short
from calib.report.reference import FittedTable

_ALLOWED = "#bcd6ea"


def _legend(fig: Figure) -> None:
    """Draw one legend of all labels below a figure."""
    shown: dict[str, Any] = {}
    for ax in fig.axes:
        for handle, label in zip(*ax.get_legend_handles_labels(), strict=True):
            shown.setdefault(label, handle)
    legend_below(fig, shown, 3)


def costs_plate(audit: Audit) -> Plate:
    """Draw where the minimum of Eq 16 can lie, and where the genetic algorithm ends."""
    fig, axes = panels(1, 2, height=46.0, left=42.0, bottom=21.0, top=7.0, gap_x=43.0)
    _bounds(axes[0, 0], audit)
    _runs(axes[0, 1], audit)
    _legend(fig)
    return Plate(
        fig, "audit_costs",
        f"Left: {audit['table5_joint_cost'].evidence} Right, on reconstructed data: "
        f"{audit['genetic_joint'].evidence}",
        "The cost of Table 5, and the genetic algorithm",
    )  # fmt: skip


def _bounds(ax: Axes, audit: Audit) -> None:
    printed = audit.curvature.published_cost
    rows = audit["table5_joint_cost"].found
    names = ["minimum,\nany slips", "minimum,\nassumed slips", "the same, Table 4\noptimal",
             "minimum,\nreconstructed data"]  # fmt: skip
    for i, q in enumerate(rows):
        if np.isnan(q.value):
            ax.plot([q.lower, q.upper], [i, i], color=BLUE, lw=5.0, solid_capstyle="butt",
                    label="where the minimum can lie")  # fmt: skip
        else:
            ax.plot(q.value, i, "D", color=BLUE, ms=5, label="minimum on reconstructed data")
    for j, signs in enumerate(audit.curvature.order[:2]):
        ax.plot(audit.curvature.least[signs], len(rows) + j, "s", color=VERMILION, ms=5,
                label="least cost of Table 5's digits, Table 4 optimal")  # fmt: skip
        names.append(f"digits of Table 5,\nc9 {'positive' if signs[2] > 0 else 'negative'}")
    ax.axvline(printed, color=ORANGE, lw=1.4, ls=DASHES[1], label="printed cost")
    ax.set_yticks(range(len(names)), names)
    ax.set_ylim(len(names) - 0.5, -0.5)
    ax.set_xlim(0.055, 0.16)
    ax.set_xticks([0.06, 0.08, 0.10, 0.12, 0.14])
    ax.set_xlabel("Cost, Eq 16 (kN²)")
    ax.set_title("Table 5: where can 0.1050 come from?", loc="left")


def _runs(ax: Axes, audit: Audit) -> None:
    spread = np.random.default_rng(0)
    names = []
    for i, search in enumerate(audit.genetic.searches):
        y = i + spread.uniform(-0.25, 0.25, search.costs.size)
        ax.plot(search.costs / search.optimum, y, "o", color=BLUE, ms=3.4, mec="white", mew=0.3,
                label="final cost, one dot a seed")  # fmt: skip
        ax.plot(
            float(search.published) / search.optimum, i, "d", color=ORANGE, ms=6.5, mec="black",
            mew=0.6, zorder=4, label="printed cost over the least cost")  # fmt: skip
        names.append(f"{search.name}\n{search.arrived} of {search.costs.size} arrive")
    ax.axvline(1.0, color=GREY, lw=0.6)
    ax.set_xscale("log")
    ax.set_xlim(0.9, 15.0)
    ax.xaxis.set_major_locator(FixedLocator([1.0, 2.0, 5.0, 10.0]))
    ax.set_xticklabels(["1", "2", "5", "10"])
    ax.xaxis.set_minor_formatter(NullFormatter())
    ax.set_yticks(range(len(names)), names)
    ax.set_ylim(len(names) - 0.5, -0.5)
    ax.set_xlabel(f"Cost over the least cost ({NO_UNIT})")
    ax.set_title("Genetic algorithm over seeds", loc="left")


_SLIPS = np.linspace(0.0, 75.0, 301)
_PULL = "Drawbar pull (kN)"
_SLIP = "Slip (%)"


def _curve(table: FittedTable, sign: int = 1, slips: Array = _SLIPS) -> Array:
    values = table.values
    return magic_formula(slips, **{**values, "E": sign * values["E"]})


def signs_plate(audit: Audit) -> Plate:
    """Draw the curves of Tables 3 and 4 under both signs of E."""
    published = audit.published
    rows = (published.geometric, published.genetic)
    fig, axes = panels(
        2, 3, height=38.0, bottom=17.0, top=6.0, gap_x=10.0, gap_y=8.0, sharex=True, sharey="col",
    )  # fmt: skip
    for row, tables in zip(axes, rows, strict=True):
        for ax, table in zip(row, tables.values(), strict=True):
            ax.plot(_SLIPS, _curve(table), color=BLUE, lw=1.5, label="E as read (negative)")
            ax.plot(_SLIPS, _curve(table, -1), color=VERMILION, lw=1.3, ls=DASHES[1],
                    label="E with the other sign")  # fmt: skip
            ax.axhline(table.values["D"], color=GREY, lw=0.8, ls=DASHES[2],
                       label="D: the peak that is printed")  # fmt: skip
            ax.axhline(0.0, color=GREY, lw=0.5)
            ax.set_ylim(-0.35 * table.values["D"], 1.2 * table.values["D"])
            ax.set_title(f"{table.source}: E = {table.estimates['E'].text}".replace("-", "\u2212"))
            ax.set_xlim(0.0, _SLIPS[-1])
    for ax in axes[-1]:
        ax.set_xlabel(_SLIP)
    for ax in axes[:, 0]:
        ax.set_ylabel(_PULL)
    _legend(fig)
    open_ones = [
        f"{f.where.split(', Eqs')[0]}" for f in audit.findings
        if f.key.endswith("sign_of_E") and f.verdict == "consistent"
    ]  # fmt: skip
    return Plate(
        fig, "audit_signs",
        "With a positive E the pull never comes near the printed peak D and turns negative; only "
        f"{joined(open_ones) if open_ones else 'no curve'} would have a peak under either sign.",
        "The signs of E",
    )  # fmt: skip


def chord_plate(audit: Audit) -> Plate:
    """Draw Table 3's curves with the chord to their peak, beside Table 4's."""
    published = audit.published
    fig, axes = panels(1, 3, height=48.0, bottom=20.0, top=6.0, gap_x=9.0)
    slips = np.linspace(0.0, 30.0, 241)
    for ax, (psi, table) in zip(axes[0], published.geometric.items(), strict=True):
        fitted = published.genetic[psi]
        found = features(table)
        slope = float(found.slope.middle)
        steep = float(features(fitted).slope.middle)
        top = table.values["D"]
        reach = np.array([0.0, 1.12 * top / slope])
        lines = (
            ("Table 4 (genetic algorithm)", slips, _curve(fitted, slips=slips), BLACK, 1.5, "-"),
            ("its initial slope", [0.0, 1.12 * top / steep], [0.0, 1.12 * top], BLACK, 0.9,
             DASHES[2]),
            ("Table 3 (geometric)", slips, _curve(table, slips=slips), BLUE, 1.5, DASHES[1]),
            ("BCD of Table 3, printed as initial slope", reach, slope * reach, VERMILION, 1.2, "-"),
        )  # fmt: skip
        for name, x, y, colour, lw, ls in lines:
            ax.plot(x, y, color=colour, lw=lw, ls=ls, label=name)
        if found.x_peak is not None:
            ax.plot(float(found.x_peak.middle), top, "o", ms=6.0, mfc="none", mec=ORANGE, mew=1.4,
                    label="peak of Table 3")  # fmt: skip
        ax.set_xlim(0.0, slips[-1])
        ax.set_ylim(0.0, 1.15 * max(top, fitted.values["D"]))
        ax.set_title(f"{psi} psi")
        ax.set_xlabel(_SLIP)
    axes[0, 0].set_ylabel(_PULL)
    _legend(fig)
    return Plate(
        fig, "audit_chord",
        "BCD of Table 3 is the initial slope by Eq 6, but runs through the peak of its own curve: "
        "as if the chord had been read. " + audit["table3_initial_slope"].evidence,
        "The slope of Table 3",
    )  # fmt: skip


def digits_plate(audit: Audit) -> Plate:
    """Draw the pull that Table 5's digits allow at each pressure."""
    study = audit.rounding
    fig, axes = panels(1, 3, height=50.0, bottom=17.0, top=6.0, gap_x=4.0, sharey=True)
    for ax, psi in zip(axes[0], study.allowed, strict=True):
        allowed, table4 = study.allowed[psi], study.table4[psi]
        ax.fill_between(study.slips, allowed.lower, allowed.upper, color=_ALLOWED, lw=0.0,
                        label="all coefficients that print as Table 5")  # fmt: skip
        for edge in (allowed.lower, allowed.upper):
            ax.plot(study.slips, edge, color=BLUE, lw=0.6)
        curve = study.as_printed[psi]
        if np.isfinite(curve).all():
            ax.plot(study.slips, curve, color=VERMILION, lw=1.3, ls=DASHES[1],
                    label="Table 5 as printed")  # fmt: skip
        ax.plot(study.slips, table4.middle, color=BLACK, lw=1.4, label="Table 4")
        D = audit.published.genetic[psi].values["D"]
        open_by = 100.0 * float(allowed.half_width.max()) / D
        note(ax, f"open by ±{short(open_by)} % of D", x=0.97, y=0.04)
        ax.set_title(f"{psi} psi")
        ax.set_xlim(0.0, study.slips[-1])
        ax.set_xlabel(_SLIP)
    axes[0, 0].set_ylim(0.0, None)
    axes[0, 0].set_ylabel(_PULL)
    _legend(fig)
    caption = (
        f"{audit['table5_digits_of_pull'].evidence} Extremes are exact up to an enclosure that is "
        "a few newtons too wide, never too narrow."
    )
    return Plate(fig, "audit_digits", caption, "What the digits of Table 5 leave open")


_SHOWN = 1500
_AT_SLIP = 0.10


def rut_plate(audit: Audit) -> Plate:
    """Draw R^2 and RMSE against n, the exponents, and the ruts by pressure and at 30 psi."""
    fig, axes = panels(2, 2, height=50.0, left=15.0, bottom=24.0, gap_x=17.0, gap_y=15.0, top=7.0)
    for ax, draw in zip(axes.flat, (_points, _exponents, _by_pressure, _held_out), strict=True):
        draw(ax, audit)
    titles = (
        "How many points were fitted?", "Exponents: Eq 22 and the likelihood",
        f"Ruts brought to {100 * _AT_SLIP:g} % slip",
        f"Rut at {audit.published.setup.held_out_psi} psi, not fitted",
    )  # fmt: skip
    for ax, title in zip(axes.flat, titles, strict=True):
        ax.set_title(title, loc="left")
    _legend(fig)
    pressure = audit["table6_inverse_regression"].evidence
    return Plate(
        fig, "audit_rut",
        f"{audit['table6_consistency'].evidence} {pressure} Posterior, simulated campaigns and "
        "ruts are of reconstructed data.",
        "Table 6: points, exponents and prediction",
    )  # fmt: skip


def _points(ax: Axes, audit: Audit) -> None:
    study = audit.quality
    ax.fill_between(study.n, study.implied.lower, study.implied.upper, color=_ALLOWED, lw=0,
                    label="from R² and RMSE, digits propagated")  # fmt: skip
    contact = float(study.from_contact.middle)
    ax.axhline(contact, color=BLACK, lw=1.1, label="from the contact lengths")
    ax.axvline(study.assumed_n, color=GREY, lw=0.8, ls=DASHES[2])
    ax.text(study.assumed_n + 2, 0.408, f"n = {study.assumed_n}", fontsize=6.5)
    found = study.reconciled
    if found.size:
        ax.axvspan(found.min(), found.max(), color=ORANGE, alpha=0.25, lw=0)
        ax.text(found.min(), 0.408, f"n = {found.min():g} to {found.max():g}", fontsize=6.5)
    ax.set_ylim(0.40, 0.54)
    ax.set_xlim(4, study.n[-1])
    ax.set_xlabel(f"Points fitted, n ({NO_UNIT})")
    ax.set_ylabel(f"ln(pgr42/pgr18) ({NO_UNIT})")


def _exponents(ax: Axes, audit: Audit) -> None:
    study, values = audit.inverse, audit.published.rut_depth.values
    factor = float(attenuation(audit.published).middle)
    every = max(1, study.n0.size // _SHOWN)
    clouds = (
        ("Eq 22 in simulated campaigns, 95 %", study.simulated[:_SHOWN, :2], "#8f8f8f", DASHES[1]),
        ("posterior, 95 %", np.column_stack([study.n0, study.n1])[::every], BLUE, "-"),
    )
    for name, points, colour, dashes in clouds:
        ax.plot(*points.T, ".", color=colour, ms=1.5, alpha=0.35)
        ax.plot(*_ellipse(points), color=colour, lw=1.3, ls=dashes, label=name)
    direct = study.direct.reported
    marks = (
        ("Table 6 (Eq 22)", values["n0"], values["n1"], "D", ORANGE),
        ("Table 6 divided by R²", factor * values["n0"], factor * values["n1"], "s", VERMILION),
        ("least squares of ln z, the truth simulated", direct["n0"], direct["n1"], "^", "white"),
    )
    for name, n0, n1, marker, colour in marks:
        ax.plot(n0, n1, marker, color=colour, ms=6.0, mec=BLACK, mew=0.8,
                                   ls="none", label=name)  # fmt: skip
    ax.set_xlim(0.8, 4.8)
    ax.set_ylim(0.0, 3.2)
    ax.set_xlabel(f"n$_0$ ({NO_UNIT})")
    ax.set_ylabel(f"n$_1$ ({NO_UNIT})")


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
    some = (v[:: max(1, v.size // 2000), None] for v in (study.k, study.n0, study.n1))
    draws = 1000.0 * rut_depth(pressure, _AT_SLIP, *some)
    low, middle, high = np.quantile(draws, [0.025, 0.5, 0.975], axis=0)
    ax.fill_between(pressure, low, high, color=_ALLOWED, lw=0, label="mean rut, posterior 95 %")
    ax.plot(pressure, middle, color=BLUE, lw=1.4, label="mean rut, posterior median")
    printed = 1000.0 * rut_depth(pressure, _AT_SLIP, values["k"], values["n0"], values["n1"])
    ax.plot(pressure, printed, color=ORANGE, lw=1.6, ls=DASHES[1], label="Eq 21 with Table 6")
    fitted = _at_one_slip(study, study.calibration.problem.table)
    ax.plot(*fitted, "o", color=BLACK, ms=3.2, mec="white", mew=0.4, ls="none",
            label="reconstructed, 18 and 42 psi (fitted)")  # fmt: skip
    ax.plot(*_at_one_slip(study, study.held_out), "o", mfc="white", mec=VERMILION, ms=4.2, mew=1.1,
            ls="none")  # fmt: skip
    ax.set_xlabel("Average ground pressure (kPa)")
    ax.set_ylabel("Rut depth (mm)")


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
    ax.fill_between(slip, low, high, color=_ALLOWED, lw=0)
    ax.plot(slip, middle, color=BLUE, lw=1.4)
    ax.plot(slip, study.published_30, color=ORANGE, lw=1.6, ls=DASHES[1])
    ax.plot(slip, study.held_out["rut_depth_mm"], "o", mfc="white", mec=VERMILION, ms=5.0,
            mew=1.3, ls="none", label="reconstructed, 30 psi (held out)")  # fmt: skip
    ax.set_xlabel("Slip (%)")
    ax.set_ylabel("Rut depth (mm)")


_DRAWINGS: dict[str, Callable[[Audit], Plate]] = {
    "audit_costs": costs_plate, "audit_digits": digits_plate, "audit_rut": rut_plate,
    "audit_chord": chord_plate, "audit_signs": signs_plate,
}  # fmt: skip


def audit_plates(audit: Audit) -> list[Plate]:
    """Draw the figures of an audit; one that failed has a caption saying why instead."""
    return draw_all({name: partial(draw, audit) for name, draw in _DRAWINGS.items()})


# The source's gaps

_BAND = "#e6e6e6"
_Z_90 = 1.645
_MOST = 5
_PRESSURES = (18.0, 30.0, 42.0)


@style()
def gap_plate(result: FoundGap) -> Plate:
    """Draw errors over slip before and after the correction, and the probabilities."""
    own = output_rows(result.document)[0]
    rows = 2 if result.gap.unfitted is not None else 1
    fig, axes = panels(1, 3, height=46.0, top=6.0, bottom=12.0 + 4.0 * rows)
    # The names of the hypotheses need the room beside the last panel.
    for ax, left, width in zip(axes[0], (15.0, 70.0, 145.0), (52.0, 39.0, 32.0), strict=True):
        box = ax.get_position()
        ax.set_position((left / DOUBLE_MM, box.y0, width / DOUBLE_MM, box.height))
    before, after, which = axes[0]
    slip, pressure = (
        result.found.data.view.conditions[name][own.rows]
        for name in ("slip_ratio", "inflation_pressure_psi")
    )
    x_axis = axis_of("slip_ratio")
    x = x_axis.scale(slip)
    for ax in (before, after):
        _noise_band(ax, x, own)
        ax.set_xlabel(x_axis.label)
    _left_open(before, x, pressure, result.open_sd)
    _errors(before, x, pressure, own.measured - own.before, filled=False)
    _errors(after, x, pressure, own.measured - own.after, filled=True)
    kept_out = _neither_campaign(before, after, result)
    _same_height(before, after)
    after.tick_params(labelleft=False)
    before.set_ylabel(f"Measured minus predicted ({own.axis.unit})")
    before.set_title(f"Before: {own.name.replace('_', ' ')}", loc="left")
    after.set_title("After: corrected model", loc="left")
    _which(which, result)
    handles, labels = _key(pressure, kept_out=kept_out)
    legend_below(fig, dict(zip(labels, handles, strict=True)), 3)
    return Plate(fig, result.gap.name, _caption(own, kept_out=kept_out), result.gap.title)


def _noise_band(ax: Axes, x: Array, own: OutputRows) -> None:
    """Shade 90 % of the noise about zero; a straight line through the rows' own, as it may grow."""
    ends = np.array([x.min(), x.max()])
    level = _Z_90 * np.polyval(np.polyfit(x, own.noise, 1), ends)
    ax.fill_between(ends, -level, level, color=_BAND, lw=0.0, zorder=0)
    ax.axhline(0.0, color=GREY, lw=0.6, zorder=1)


def _left_open(ax: Axes, x: Array, pressure: Array, sd: Array) -> None:
    """Draw how far the calibrated simulator itself may be off, at each pressure."""
    for psi in np.unique(pressure):
        at = pressure == psi
        order = np.argsort(x[at])
        for sign in (-1.0, 1.0):
            ax.plot(
                x[at][order], sign * _Z_90 * sd[at][order], color=_colour(psi), lw=0.8,
                ls=(0, (4, 2)), zorder=1,
            )  # fmt: skip


def _errors(ax: Axes, x: Array, pressure: Array, error: Array, *, filled: bool) -> None:
    for psi in np.unique(pressure):
        at = pressure == psi
        ax.plot(
            x[at], error[at], _marker(psi), mfc=_colour(psi) if filled else "none",
            mec="white" if filled else _colour(psi), mew=0.4 if filled else 0.9,
            ms=4.6 if filled else 4.0, zorder=3,
        )  # fmt: skip


def _neither_campaign(before: Axes, after: Axes, result: FoundGap) -> bool:
    """Draw the errors at rows that stood in neither campaign."""
    rows = result.gap.unfitted
    if rows is None:
        return False
    predicted = result.found.new_predictions[result.output]
    x = axis_of("slip_ratio").scale(rows["slip_ratio"])
    measured = rows[OUTPUTS[result.output]]
    psi = float(rows["inflation_pressure_psi"][0])
    factor = axis_of(OUTPUTS[result.output]).factor
    for ax, values in ((before, predicted.before), (after, predicted.after)):
        ax.plot(
            x, factor * (measured - values), _marker(psi), color=_colour(psi), mfc="white",
            mew=0.9, ms=4.4, zorder=2,
        )  # fmt: skip
    return True


def _same_height(a: Axes, b: Axes) -> None:
    ends = np.array([a.get_ylim(), b.get_ylim()])
    low, high = float(ends.min()), float(ends.max())
    for ax in (a, b):
        ax.set_ylim(low, high)
        ax.ticklabel_format(axis="y", style="plain")


def _which(ax: Axes, result: FoundGap) -> None:
    p, order = result.found.ranking.probability, result.found.ranking.order
    names = order[:_MOST]
    y = np.arange(len(names))[::-1]
    for i, (yi, name) in enumerate(zip(y, names, strict=True)):
        ax.barh(yi, p[name], color=BLUE if i == 0 else SKY, height=0.62)
        ax.text(p[name] + 0.03, yi, chance(p[name]), va="center", fontsize=SMALLEST_PT)
    ax.set_yticks(y, [short_name(name).replace(" + ", "\n+ ") for name in names])
    ax.tick_params(axis="y", length=0.0, labelsize=SMALLEST_PT)
    ax.set_ylim(-0.6, len(names) - 0.4)
    ax.set_xlim(0.0, 1.0)
    ax.set_xticks([0.0, 0.5, 1.0], ["0", "0.5", "1"])
    ax.set_xlabel(f"Probability ({NO_UNIT})")
    ax.set_title("Which", loc="left")


def _key(pressure: Array, *, kept_out: bool) -> tuple[list[Any], list[str]]:
    """Return handles and labels; a key beside every colour."""
    handles: list[Any] = []
    labels: list[str] = []
    for psi in np.unique(pressure):
        handles.append(Line2D([], [], ls="", marker=_marker(psi), color=_colour(psi)))
        labels.append(f"{psi:g} psi")
    if kept_out:
        psi = 30.0
        handles.append(
            Line2D([], [], ls="", marker=_marker(psi), color=_colour(psi), mfc="white", mew=0.9)
        )
        labels.append(f"{psi:g} psi, in neither campaign")
    handles += [Patch(color=_BAND), Line2D([], [], color=GREY, lw=0.8, ls=(0, (4, 2)))]
    labels += ["90 % of the noise", "90 % of what the calibration left open"]
    return handles, labels


def _colour(psi: float) -> str:
    return CYCLE[_PRESSURES.index(float(psi))]


def _marker(psi: float) -> str:
    return MARKERS[_PRESSURES.index(float(psi))]


def _caption(own: OutputRows, *, kept_out: bool) -> str:
    before, after = (
        short(float(np.sqrt(np.mean((own.measured - v) ** 2)))) for v in (own.before, own.after)
    )
    unit = own.axis.unit
    text = (
        f"Left, measured {own.name.replace('_', ' ')} minus the calibrated simulator at the "
        f"{own.rows.size} field rows, {before} {unit} rms; a miss inside the dashed lines is no "
        f"more than the calibration left open. Middle, minus the corrected model, {after} {unit} "
        f"rms; the noise is {short(float(np.median(own.noise)))} {unit}."
    )
    if kept_out:
        text += " White markers are rows that neither campaign had."
    return f"{text} Right, the most probable hypotheses."
