"""Figures of the audit of Tables 3 to 5: signs of E, the chord of Table 3, digits of Table 5."""

from __future__ import annotations

from typing import Any

import numpy as np
from matplotlib.axes import Axes

from calib.he2019.audit import Audit
from calib.he2019.audit.geometric import features
from calib.he2019.datasets.published import FittedTable
from calib.models.base import Array
from calib.models.magic_formula import magic_formula
from calib.report.figures.plate import Plate
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
from calib.report.labels import joined, short

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
        _edges(ax, study.slips, allowed.lower, allowed.upper)
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


def _edges(ax: Axes, x: Array, low: Array, high: Array) -> None:
    for edge in (low, high):
        ax.plot(x, edge, color=BLUE, lw=0.6)
