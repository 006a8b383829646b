"""Figure of the audit of Table 6: the number of points, and what the inverse regression does."""

from __future__ import annotations

from typing import Any

import numpy as np
from matplotlib.axes import Axes

from calib.data import Table
from calib.he2019.audit import Audit
from calib.he2019.audit.inverse_regression import InverseStudy, attenuation
from calib.models.base import Array
from calib.models.bekker import rut_depth
from calib.report.figures.plate import Plate
from calib.report.figures.style import (
    BLACK,
    BLUE,
    DASHES,
    GREY,
    ORANGE,
    VERMILION,
    legend_below,
    panels,
)
from calib.report.labels import NO_UNIT

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
