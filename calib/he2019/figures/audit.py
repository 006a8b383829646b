"""Figures of the audit of the published tables; one that fails does not stop the rest."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.ticker import FixedLocator, NullFormatter

from calib.data import Table
from calib.he2019.audit import Audit
from calib.he2019.audit.geometric import features
from calib.he2019.audit.rounding import InverseStudy, attenuation
from calib.models.base import Array
from calib.models.bekker import rut_depth
from calib.models.magic_formula import magic_formula
from calib.report.figures.plate import Plate, draw_all
from calib.report.figures.style import (
    BLACK,
    BLUE,
    DASHES,
    GREY,
    ORANGE,
    VERMILION,
    legend_below,
    note,
    panels,
)
from calib.report.labels import NO_UNIT, joined, short
from calib.report.reference import FittedTable


def costs_plate(audit: Audit) -> Plate:
    """Draw where the minimum of Eq 16 can lie, and where the genetic algorithm ends."""
    fig, axes = panels(1, 2, height=46.0, left=42.0, bottom=21.0, top=7.0, gap_x=43.0)
    handles = _bounds(axes[0, 0], audit)
    handles |= _runs(axes[0, 1], audit)
    legend_below(fig, list(handles.values()), list(handles), 3)
    return Plate(
        fig, "audit_costs",
        f"Left: {audit['table5_joint_cost'].evidence} Right, on reconstructed data: "
        f"{audit['genetic_joint'].evidence}",
        "The cost of Table 5, and the genetic algorithm",
    )  # fmt: skip


def _bounds(ax: Axes, audit: Audit) -> dict[str, Any]:
    handles: dict[str, Any] = {}
    printed = audit.curvature.published_cost
    rows = audit["table5_joint_cost"].found
    names = ["minimum,\nany slips", "minimum,\nassumed slips", "the same, Table 4\noptimal",
             "minimum,\nreconstructed data"]  # fmt: skip
    for i, q in enumerate(rows):
        if np.isnan(q.value):
            (handles["where the minimum can lie"],) = ax.plot(
                [q.lower, q.upper], [i, i], color=BLUE, lw=5.0, solid_capstyle="butt"
            )
        else:
            (handles["minimum on reconstructed data"],) = ax.plot(q.value, i, "D", color=BLUE, ms=5)
    for j, signs in enumerate(audit.curvature.order[:2]):
        (handles["least cost of Table 5's digits, Table 4 optimal"],) = ax.plot(
            audit.curvature.least[signs], len(rows) + j, "s", color=VERMILION, ms=5
        )
        names.append(f"digits of Table 5,\nc9 {'positive' if signs[2] > 0 else 'negative'}")
    handles["printed cost"] = ax.axvline(printed, color=ORANGE, lw=1.4, ls=DASHES[1])
    ax.set_yticks(range(len(names)), names)
    ax.set_ylim(len(names) - 0.5, -0.5)
    ax.set_xlim(0.055, 0.16)
    ax.set_xticks([0.06, 0.08, 0.10, 0.12, 0.14])
    ax.set_xlabel("Cost, Eq 16 (kN²)")
    ax.set_title("Table 5: where can 0.1050 come from?", loc="left")
    return handles


def _runs(ax: Axes, audit: Audit) -> dict[str, Any]:
    handles: dict[str, Any] = {}
    spread = np.random.default_rng(0)
    names = []
    for i, search in enumerate(audit.genetic.searches):
        y = i + spread.uniform(-0.25, 0.25, search.costs.size)
        (handles["final cost, one dot a seed"],) = ax.plot(
            search.costs / search.optimum, y, "o", color=BLUE, ms=3.4, mec="white", mew=0.3
        )
        (handles["printed cost over the least cost"],) = ax.plot(
            float(search.published) / search.optimum, i, "d", color=ORANGE, ms=6.5, mec="black",
            mew=0.6, zorder=4,
        )  # fmt: skip
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
    return handles


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
    handles: dict[str, Any] = {}
    for row, tables in zip(axes, rows, strict=True):
        for ax, table in zip(row, tables.values(), strict=True):
            (handles["E as read (negative)"],) = ax.plot(_SLIPS, _curve(table), color=BLUE, lw=1.5)
            (handles["E with the other sign"],) = ax.plot(
                _SLIPS, _curve(table, -1), color=VERMILION, lw=1.3, ls=DASHES[1]
            )
            handles["D: the peak that is printed"] = ax.axhline(
                table.values["D"], color=GREY, lw=0.8, ls=DASHES[2]
            )
            ax.axhline(0.0, color=GREY, lw=0.5)
            ax.set_ylim(-0.35 * table.values["D"], 1.2 * table.values["D"])
            ax.set_title(f"{table.source}: E = {table.estimates['E'].text}".replace("-", "\u2212"))
            ax.set_xlim(0.0, _SLIPS[-1])
    for ax in axes[-1]:
        ax.set_xlabel(_SLIP)
    for ax in axes[:, 0]:
        ax.set_ylabel(_PULL)
    legend_below(fig, list(handles.values()), list(handles), 3)
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
    handles: dict[str, Any] = {}
    slips = np.linspace(0.0, 30.0, 241)
    for ax, (psi, table) in zip(axes[0], published.geometric.items(), strict=True):
        fitted = published.genetic[psi]
        found = features(table)
        slope = float(found.slope.middle)
        steep = float(features(fitted).slope.middle)
        top = table.values["D"]
        reach = np.array([0.0, 1.12 * top / slope])
        (handles["Table 4 (genetic algorithm)"],) = ax.plot(
            slips, _curve(fitted, slips=slips), color=BLACK, lw=1.5
        )
        (handles["its initial slope"],) = ax.plot(
            [0.0, 1.12 * top / steep], [0.0, 1.12 * top], color=BLACK, lw=0.9, ls=DASHES[2]
        )
        (handles["Table 3 (geometric)"],) = ax.plot(
            slips, _curve(table, slips=slips), color=BLUE, lw=1.5, ls=DASHES[1]
        )
        (handles["BCD of Table 3, printed as initial slope"],) = ax.plot(
            reach, slope * reach, color=VERMILION, lw=1.2
        )
        if found.x_peak is not None:
            (handles["peak of Table 3"],) = ax.plot(
                float(found.x_peak.middle), top, "o", ms=6.0, mfc="none", mec=ORANGE, mew=1.4
            )
        ax.set_xlim(0.0, slips[-1])
        ax.set_ylim(0.0, 1.15 * max(top, fitted.values["D"]))
        ax.set_title(f"{psi} psi")
        ax.set_xlabel(_SLIP)
    axes[0, 0].set_ylabel(_PULL)
    legend_below(fig, list(handles.values()), list(handles), 3)
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
    handles: dict[str, Any] = {}
    for ax, psi in zip(axes[0], study.allowed, strict=True):
        allowed, table4 = study.allowed[psi], study.table4[psi]
        handles["all coefficients that print as Table 5"] = ax.fill_between(
            study.slips, allowed.lower, allowed.upper, color="#bcd6ea", lw=0.0
        )
        for edge in (allowed.lower, allowed.upper):
            ax.plot(study.slips, edge, color=BLUE, lw=0.6)
        curve = study.as_printed[psi]
        if np.isfinite(curve).all():
            (handles["Table 5 as printed"],) = ax.plot(
                study.slips, curve, color=VERMILION, lw=1.3, ls=DASHES[1]
            )
        (handles["Table 4"],) = ax.plot(study.slips, table4.middle, color=BLACK, lw=1.4)
        D = audit.published.genetic[psi].values["D"]
        open_by = 100.0 * float(allowed.half_width.max()) / D
        note(ax, f"open by ±{short(open_by)} % of D", x=0.97, y=0.04)
        ax.set_title(f"{psi} psi")
        ax.set_xlim(0.0, study.slips[-1])
        ax.set_xlabel(_SLIP)
    axes[0, 0].set_ylim(0.0, None)
    axes[0, 0].set_ylabel(_PULL)
    legend_below(fig, list(handles.values()), list(handles), 3)
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
    handles = _points(axes[0, 0], audit)
    handles |= _exponents(axes[0, 1], audit)
    handles |= _by_pressure(axes[1, 0], audit)
    handles |= _held_out(axes[1, 1], audit)
    titles = (
        "How many points were fitted?", "Exponents: Eq 22 and the likelihood",
        f"Ruts brought to {100 * _AT_SLIP:g} % slip",
        f"Rut at {audit.published.setup.held_out_psi} psi, not fitted",
    )  # fmt: skip
    for ax, title in zip(axes.flat, titles, strict=True):
        ax.set_title(title, loc="left")
    legend_below(fig, list(handles.values()), list(handles), 3)
    pressure = audit["table6_inverse_regression"].evidence
    return Plate(
        fig, "audit_rut",
        f"{audit['table6_consistency'].evidence} {pressure} Posterior, simulated campaigns and "
        "ruts are of reconstructed data.",
        "Table 6: points, exponents and prediction",
    )  # fmt: skip


def _points(ax: Axes, audit: Audit) -> dict[str, Any]:
    study = audit.quality
    band = ax.fill_between(study.n, study.implied.lower, study.implied.upper, color="#bcd6ea", lw=0)
    contact = float(study.from_contact.middle)
    line = ax.axhline(contact, color=BLACK, lw=1.1)
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
    return {"from R² and RMSE, digits propagated": band, "from the contact lengths": line}


def _exponents(ax: Axes, audit: Audit) -> dict[str, Any]:
    study, values = audit.inverse, audit.published.rut_depth.values
    factor = float(attenuation(audit.published).middle)
    every = max(1, study.n0.size // _SHOWN)
    clouds = (
        ("Eq 22 in simulated campaigns, 95 %", study.simulated[:_SHOWN, :2], "#8f8f8f", DASHES[1]),
        ("posterior, 95 %", np.column_stack([study.n0, study.n1])[::every], BLUE, "-"),
    )
    handles: dict[str, Any] = {}
    for name, points, colour, dashes in clouds:
        ax.plot(*points.T, ".", color=colour, ms=1.5, alpha=0.35)
        (handles[name],) = ax.plot(*_ellipse(points), color=colour, lw=1.3, ls=dashes)
    direct = study.direct.reported
    marks = (
        ("Table 6 (Eq 22)", values["n0"], values["n1"], "D", ORANGE),
        ("Table 6 divided by R²", factor * values["n0"], factor * values["n1"], "s", VERMILION),
        ("least squares of ln z, the truth simulated", direct["n0"], direct["n1"], "^", "white"),
    )
    for name, n0, n1, marker, colour in marks:
        (handles[name],) = ax.plot(n0, n1, marker, color=colour, ms=6.0, mec=BLACK, mew=0.8,
                                   ls="none")  # fmt: skip
    ax.set_xlim(0.8, 4.8)
    ax.set_ylim(0.0, 3.2)
    ax.set_xlabel(f"n$_0$ ({NO_UNIT})")
    ax.set_ylabel(f"n$_1$ ({NO_UNIT})")
    return handles


def _ellipse(points: Array) -> tuple[Array, Array]:
    """Return the outline that holds 95 % of a normal cloud with these points' covariance."""
    turn = np.linspace(0.0, 2.0 * np.pi, 181)
    root = np.linalg.cholesky(np.cov(points.T))
    radius = np.sqrt(-2.0 * np.log(0.05))
    x, y = points.mean(axis=0)[:, None] + radius * root @ np.stack([np.cos(turn), np.sin(turn)])
    return x, y


def _by_pressure(ax: Axes, audit: Audit) -> dict[str, Any]:
    study, values = audit.inverse, audit.published.rut_depth.values
    pressure = np.geomspace(60.0, 320.0, 60)
    draws = 1000.0 * rut_depth(
        pressure,
        _AT_SLIP,
        *(v[:: max(1, v.size // 2000), None] for v in (study.k, study.n0, study.n1)),
    )
    low, middle, high = np.quantile(draws, [0.025, 0.5, 0.975], axis=0)
    band = ax.fill_between(pressure, low, high, color="#bcd6ea", lw=0)
    (median,) = ax.plot(pressure, middle, color=BLUE, lw=1.4)
    (eq_21,) = ax.plot(
        pressure,
        1000.0 * rut_depth(pressure, _AT_SLIP, values["k"], values["n0"], values["n1"]),
        color=ORANGE, lw=1.6, ls=DASHES[1],
    )  # fmt: skip
    fitted = _at_one_slip(study, study.calibration.problem.table)
    (rows,) = ax.plot(*fitted, "o", color=BLACK, ms=3.2, mec="white", mew=0.4, ls="none")
    ax.plot(*_at_one_slip(study, study.held_out), "o", mfc="white", mec=VERMILION, ms=4.2, mew=1.1,
            ls="none")  # fmt: skip
    ax.set_xlabel("Average ground pressure (kPa)")
    ax.set_ylabel("Rut depth (mm)")
    return {
        "mean rut, posterior 95 %": band, "mean rut, posterior median": median,
        "Eq 21 with Table 6": eq_21, "reconstructed, 18 and 42 psi (fitted)": rows,
    }  # fmt: skip


def _at_one_slip(study: InverseStudy, table: Table) -> tuple[Array, Array]:
    """Return ground pressures and ruts, brought to one slip by the least-squares fit."""
    pressure = table["average_ground_pressure_kpa"]
    v = study.direct.reported
    there, here = (
        rut_depth(pressure, slip, v["k"], v["n0"], v["n1"])
        for slip in (np.full_like(pressure, _AT_SLIP), table["slip_ratio"])
    )
    return pressure, table["rut_depth_mm"] * there / here


def _held_out(ax: Axes, audit: Audit) -> dict[str, Any]:
    study = audit.inverse
    slip = 100.0 * study.held_out["slip_ratio"]
    low, middle, high = np.quantile(study.mean_30, [0.025, 0.5, 0.975], axis=0)
    ax.fill_between(slip, low, high, color="#bcd6ea", lw=0)
    ax.plot(slip, middle, color=BLUE, lw=1.4)
    ax.plot(slip, study.published_30, color=ORANGE, lw=1.6, ls=DASHES[1])
    (held,) = ax.plot(slip, study.held_out["rut_depth_mm"], "o", mfc="white", mec=VERMILION,
                      ms=5.0, mew=1.3, ls="none")  # fmt: skip
    ax.set_xlabel("Slip (%)")
    ax.set_ylabel("Rut depth (mm)")
    return {"reconstructed, 30 psi (held out)": held}


_DRAWINGS: dict[str, Callable[[Audit], Plate]] = {
    "audit_costs": costs_plate,
    "audit_digits": digits_plate,
    "audit_rut": rut_plate,
    "audit_chord": chord_plate,
    "audit_signs": signs_plate,
}


def audit_plates(audit: Audit) -> list[Plate]:
    """Draw the figures of an audit; one that failed has a caption saying why instead."""
    return draw_all({name: partial(draw, audit) for name, draw in _DRAWINGS.items()})
