"""Figure of the audit of Table 5's cost and of the genetic algorithm that found it."""

from __future__ import annotations

from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.ticker import FixedLocator, NullFormatter

from calib.he2019.audit import Audit
from calib.report.figures.plate import Plate
from calib.report.figures.style import BLUE, DASHES, GREY, ORANGE, VERMILION, legend_below, panels
from calib.report.labels import NO_UNIT


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
